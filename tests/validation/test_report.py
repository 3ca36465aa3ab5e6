"""Violations as lines."""

import pytest

from robotdiffuse.validation.report import Violation


@pytest.mark.parametrize(
    ("message", "line"),
    [
        ("link1 is 2.0 mm inside ball", "link1 is 2.0 mm inside ball (at 0.500)"),
        ("joint1 at 0.500 s: its velocity is 3", "joint1 at 0.500 s: its velocity is 3"),
        (
            "joint1 is 3 at waypoint 1; its limits are -2 to 2",
            "joint1 is 3 at waypoint 1; its limits are -2 to 2",
        ),
    ],
)
def test_the_place_is_named_once(message: str, line: str) -> None:
    assert Violation("limits", 0.5, message).line == line
