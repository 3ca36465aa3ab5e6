"""The browser that tests drive, and the data in pages."""

import json
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update"]
FLAGS += ["--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
"""WebGL without a graphics card."""
MARKS = [pytest.mark.browser, pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")]
"""Marks of tests that need it."""
PATIENCE = 300.0
"""A new machine compiles first, and WebGL without a graphics card is slow [s]."""


@contextmanager
def opened(url: str, width: int = 900, height: int = 600) -> Iterator[Any]:
    """A page of the browser at this address."""
    with pytest.importorskip("playwright.sync_api", reason="browsers are driven by playwright").sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, headless=True, args=FLAGS)
        view = browser.new_page(viewport={"width": width, "height": height})
        view.set_default_timeout(1000 * PATIENCE)
        view.goto(url)
        yield view
        browser.close()


def page_data(file: Path) -> Any:
    """The data in the page of a replay."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', file.read_text("utf-8"), re.S)
    assert found is not None
    return json.loads(found[1])
