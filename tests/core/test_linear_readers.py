"""Readers of names from requests and files compare each name a few times, however many there are."""

from typing import ClassVar

import pytest

from robotdiffuse import Box, InputError, Scene
from robotdiffuse.core.types import check_motion_arrays
from robotdiffuse.scenes.scene import MAX_CONTACT_LINKS

COUNT = 2000


class Name(str):
    """A text that counts how often it is compared."""

    compared: ClassVar[int] = 0

    def __eq__(self, other: object) -> bool:
        Name.compared += 1
        return str.__eq__(self, str(other))

    __hash__ = str.__hash__


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.setattr(Name, "compared", 0)
    return [Name(f"j{i}") for i in range(COUNT)]


def test_joint_names_are_compared_a_few_times_each(names: list[str]) -> None:
    with pytest.raises(InputError, match="joint_names has j7 more than once"):
        check_motion_arrays([*names, Name("j7")], {"positions": [[0.0]]})
    assert Name.compared < 5 * COUNT


def test_links_that_may_touch_an_obstacle_are_compared_a_few_times_each(names: list[str]) -> None:
    few = names[:MAX_CONTACT_LINKS]
    scene = Scene([Box([1, 0, 0], [0.1, 0.1, 0.1])], [("box", [name]) for name in few])
    assert Name.compared < 5 * COUNT
    assert scene.allowed_contacts == (("box", tuple(few)),)
    with pytest.raises(InputError, match=f"'box' has over {MAX_CONTACT_LINKS} links; write all"):
        Scene(scene.shapes, [("box", names)])
