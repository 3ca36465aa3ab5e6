"""The documentation builds without a warning and loads nothing from the network; its files exist, texts of drawings fit."""

import os
import re
import subprocess
import sys
from itertools import combinations
from pathlib import Path

import pytest

import robotdiffuse as rd
from helpers.browsers import CHROMIUM, opened

ROOT = Path(__file__).parents[2]
PARAGRAPH = re.compile(r"<p>(.*?)</p>", re.DOTALL)
LOADED = re.compile(r'<(?:script|img|iframe|source)[^>]*\ssrc="(?:https?:)?//|<link[^>]*stylesheet[^>]*//')


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(build, cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr + done.stdout == ""
    return folder


@pytest.mark.slow
def test_pages_load_nothing_from_the_network_and_draw_no_list_as_a_paragraph(site: Path) -> None:
    pages = {page: page.read_text(encoding="utf-8") for page in site.rglob("*.html")}
    assert len(pages) > 20
    assert [page.name for page, text in pages.items() if LOADED.search(text)] == []
    paragraphs = [(page.name, paragraph) for page, text in pages.items() for paragraph in PARAGRAPH.findall(text)]
    assert len(paragraphs) > 500
    assert [(name, text) for name, text in paragraphs if re.search(r"\n\s*([-*]|\d+\.) ", text)] == []


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")
def test_the_search_works_without_a_server(site: Path) -> None:
    with opened("about:blank") as page:
        page.context.set_offline(True)
        page.goto((site / "index.html").as_uri())
        page.locator("input.md-search__input").fill("upright cup", force=True)
        page.locator(".md-search-result__link", has_text="Gallery").first.wait_for(state="attached", timeout=60_000)


@pytest.mark.slow
def test_the_references_have_every_option_and_public_name_and_the_readme_is_short(site: Path) -> None:
    commands, python = ((site / "reference" / f"{name}.html").read_text(encoding="utf-8") for name in ("commands", "python"))
    for option in ("data generate", "--safety-distance", "robotdiffuse bench report", "--no-replays"):
        assert option in commands, option
    for name in dir(rd):
        assert f'.{name}"' in python, name
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 130


BOXES = """[...document.querySelectorAll("text")].map(text => {
    const box = text.getBoundingClientRect();
    return [text.textContent, box.left, box.top, box.right, box.bottom];
})"""
LEADING = 3.0
"""Boxes of lines reach further up and down than their letters [pixels]."""


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")
@pytest.mark.parametrize("drawing", sorted((ROOT / "docs").rglob("*.svg")), ids=lambda file: file.name)
def test_texts_do_not_overlap(drawing: Path, tmp_path: Path) -> None:
    source = drawing.read_text(encoding="utf-8")
    assert 'font-family="Helvetica, Arial, sans-serif"' in source
    file = tmp_path / drawing.name
    with opened("about:blank", 1040, 500) as page:
        for font in ("Helvetica, Arial, sans-serif", "DejaVu Sans"):
            file.write_text(source.replace("Helvetica, Arial, sans-serif", font), encoding="utf-8")
            page.goto(file.as_uri())
            boxes = page.evaluate(BOXES)
            assert len(boxes) > 10
            for text, left, top, right, bottom in boxes:
                assert left >= 0 and right <= 1040 and top >= 0 and bottom <= 500, f"{text!r} leaves the drawing"
            for (a, *one), (b, *other) in combinations(boxes, 2):
                beside = one[2] <= other[0] or other[2] <= one[0]
                apart = one[3] - LEADING <= other[1] + LEADING or other[3] - LEADING <= one[1] + LEADING
                assert beside or apart, f"{a!r} overlaps {b!r}"


def test_every_named_file_exists_and_every_package_is_described() -> None:
    """A row of the page names a folder once; further files of the row have shorter paths."""
    source = ROOT / "src" / "robotdiffuse"
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    files = re.findall(r"`([\w/]+\.py)`", page)
    missing = [name for name in files if not (ROOT / name).is_file() and not any(source.rglob(name))]
    assert not missing, f"docs/architecture.md names {missing}"
    packages = {folder.name for folder in source.iterdir() if (folder / "__init__.py").is_file()}
    described = set(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE))
    assert packages <= described, f"docs/architecture.md lacks {', '.join(sorted(packages - described))}"
