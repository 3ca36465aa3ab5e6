"""Pages of the site from files outside of docs/, and links to them that work in the repository too.

A page links to `../benchmarks/results/network.txt` as the repository has it. In the site a text report is a
page of its own, so such links are turned to where their file is there.
"""

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
REPORTS = "benchmarks/results"
ROOT_PAGES = {
    "CONVENTIONS.md": "conventions.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
LINK = re.compile(r"\]\(([^)#\s]+)((?:#[^)]*)?)\)")


def site_place(file: str) -> str:
    """Where a file of the repository is in the site's sources; texts become pages."""
    if file in ROOT_PAGES:
        return ROOT_PAGES[file]
    if file.startswith("docs/"):
        return file.removeprefix("docs/")
    return re.sub(r"\.txt$", ".md", file)


def outside_files() -> list[str]:
    """Files outside of docs/ that the site has, by their place in the repository."""
    found = [path for path in (ROOT / REPORTS).rglob("*") if path.is_file() and path.suffix != ".xz"]
    examples = [path for path in (ROOT / "examples").iterdir() if path.is_file()]
    return [*ROOT_PAGES, *sorted(path.relative_to(ROOT).as_posix() for path in (*found, *examples))]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    for file in outside_files():
        place = site_place(file)
        if file.endswith(".txt"):
            text = (ROOT / file).read_text(encoding="utf-8")
            title = Path(file).stem.replace("_", " ")
            page = f"# Report: {title}\n\n```text\n{text.rstrip()}\n```\n"
            files.append(File.generated(config, place, content=page))
        else:
            files.append(File.generated(config, place, abs_src_path=str(ROOT / file)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turns links to files of the repository to their place in the site."""
    places = {site_place(file): file for file in outside_files()}
    here = page.file.src_uri
    own = places.get(here, f"docs/{here}")
    if here.startswith(REPORTS):
        page.meta["hide"] = ["toc"]  # reports have wide tables

    def turned(match: re.Match[str]) -> str:
        target, anchor = match.groups()
        if ":" in target:
            return match.group(0)
        file = posixpath.normpath(posixpath.join(posixpath.dirname(own), target))
        place = site_place(file)
        return f"]({posixpath.relpath(place, posixpath.dirname(here) or '.')}{anchor})"

    return LINK.sub(turned, markdown)
