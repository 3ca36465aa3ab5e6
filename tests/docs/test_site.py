"""The documentation builds without a warning, and its pages load nothing from the network."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.browsers import CHROMIUM, opened

ROOT = Path(__file__).parents[2]
LOADED = re.compile(r'<(?:script|img|iframe|source)[^>]*\ssrc="(?:https?:)?//|<link[^>]*stylesheet[^>]*//')
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    silent = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(build, cwd=ROOT, env=silent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr + done.stdout == ""
    return folder


def test_pages_load_nothing_from_the_network(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 20
    assert [page.name for page in pages if LOADED.search(page.read_text(encoding="utf-8"))] == []


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")
def test_the_search_works_without_a_server(site: Path) -> None:
    with opened("about:blank") as page:
        page.context.set_offline(True)
        page.goto((site / "index.html").as_uri())
        page.locator("input.md-search__input").fill("upright cup", force=True)
        page.locator(".md-search-result__link", has_text="Gallery").first.wait_for(state="attached", timeout=60_000)


def test_the_command_reference_has_every_option_and_the_readme_is_short(site: Path) -> None:
    page = (site / "reference" / "commands.html").read_text(encoding="utf-8")
    options = ("data generate", "--safety-distance", "robotdiffuse bench report", "--no-replays")
    assert all(option in page for option in options)
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 130


def test_the_python_reference_has_every_public_name(site: Path) -> None:
    import robotdiffuse as rd

    page = (site / "reference" / "python.html").read_text(encoding="utf-8")
    for name in dir(rd):
        assert f'.{name}"' in page, name
