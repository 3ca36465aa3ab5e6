"""Texts in the drawings of the documentation lie inside the drawing and do not overlap."""

from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

from helpers.browsers import CHROMIUM, opened

DRAWINGS = sorted((Path(__file__).parents[2] / "docs").rglob("*.svg"))
BOXES = """[...document.querySelectorAll("text")].map(text => {
    const box = text.getBoundingClientRect();
    return [text.textContent, box.left, box.top, box.right, box.bottom];
})"""
LEADING = 3.0
"""Boxes of lines reach further up and down than their letters [pixels]."""


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")
@pytest.mark.parametrize("drawing", DRAWINGS, ids=lambda file: file.name)
def test_texts_do_not_overlap(drawing: Path, tmp_path: Path) -> None:
    source = drawing.read_text(encoding="utf-8")
    assert 'font-family="Helvetica, Arial, sans-serif"' in source
    file = tmp_path / drawing.name
    with opened("about:blank", 1040, 500) as page:
        for font in ("Helvetica, Arial, sans-serif", "DejaVu Sans"):
            file.write_text(source.replace("Helvetica, Arial, sans-serif", font), encoding="utf-8")
            page.goto(file.as_uri())
            check(page.evaluate(BOXES))


def check(boxes: list[Any]) -> None:
    assert len(boxes) > 10
    for text, left, top, right, bottom in boxes:
        assert left >= 0 and right <= 1040 and top >= 0 and bottom <= 500, f"{text!r} leaves the drawing"
    for (a, *one), (b, *other) in combinations(boxes, 2):
        beside = one[2] <= other[0] or other[2] <= one[0]
        apart = one[3] - LEADING <= other[1] + LEADING or other[3] - LEADING <= one[1] + LEADING
        assert beside or apart, f"{a!r} overlaps {b!r}"
