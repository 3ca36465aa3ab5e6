"""Adds files outside of docs/ to the site, and makes links to them work in both places.

Pages link to files by their path in the repository, as `../benchmarks/results/network.txt`. In the site each
text report is a page of its own, so this hook rewrites such links.
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
    "benchmarks/README.md": "benchmarks/reports.md",
}
LINK = re.compile(r"\]\(([^)#\s]+)((?:#[^)]*)?)\)")


def site_path(file: str) -> str:
    """Path of a file of the repository among the sources of the site; .txt files become .md pages."""
    if file in ROOT_PAGES:
        return ROOT_PAGES[file]
    if file.startswith("docs/"):
        return file.removeprefix("docs/")
    return re.sub(r"\.txt$", ".md", file)


def outside_files() -> list[str]:
    """Files outside of docs/ that belong to the site, by their path in the repository."""
    reports = [path for path in (ROOT / REPORTS).rglob("*") if path.is_file() and path.suffix != ".xz"]
    examples = [path for path in (ROOT / "examples").iterdir() if path.is_file()]
    return [*ROOT_PAGES, *sorted(path.relative_to(ROOT).as_posix() for path in (*reports, *examples))]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    for file in outside_files():
        path = site_path(file)
        if file.endswith(".txt"):
            text = (ROOT / file).read_text(encoding="utf-8")
            title = Path(file).stem.replace("_", " ")
            page = f"# Report: {title}\n\n```text\n{text.rstrip()}\n```\n"
            files.append(File.generated(config, path, content=page))
        else:
            files.append(File.generated(config, path, abs_src_path=str(ROOT / file)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrites links to files of the repository."""
    sources = {site_path(file): file for file in outside_files()}
    here = page.file.src_uri
    source = sources.get(here, f"docs/{here}")
    if here.startswith(REPORTS):
        page.meta["hide"] = ["toc"]  # reports have wide tables

    def rewritten(match: re.Match[str]) -> str:
        target, anchor = match.groups()
        if ":" in target:
            return match.group(0)
        file = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        return f"]({posixpath.relpath(site_path(file), posixpath.dirname(here) or '.')}{anchor})"

    return LINK.sub(rewritten, markdown)
