"""Settings: bounds in the types, JSON round trips, NAME=VALUE, and descriptions."""

from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
import pytest

from robotdiffuse import InputError
from robotdiffuse.core.registry import Entry, Registry
from robotdiffuse.core.settings import Bound, Count, NotNegative, OneOf, Positive, Settings, SettingsOf, Share
from robotdiffuse.scenes.surface_points import VisibleRegion


@dataclass(frozen=True)
class Coarse(Settings):
    cells: Count = 3
    """How many."""


@dataclass(frozen=True)
class Fine(Settings):
    width: Positive = 0.1


GRIDS = Registry(
    "grid", {name.lower(): Entry(f"{__name__}:{name}", "a grid", name) for name in ("Coarse", "Fine")}
)


@dataclass(frozen=True)
class Search(Settings, name="search"):
    step: Positive = 1.0
    """Longest extension
    of a tree [rad]."""
    clearance: NotNegative = 0.0
    bias: Share = 0.1
    decay: Annotated[float, Bound(least=0.0, below=1.0)] = 0.9
    range: Positive | None = None
    levels: tuple[Positive, ...] = (0.1, 0.2)
    order: Annotated[str, OneOf(("first", "best"))] = "first"
    grid: Annotated[str, OneOf(GRIDS)] = "coarse"
    grid_settings: Annotated[Settings | None, SettingsOf("grid", GRIDS)] = None
    inner: Coarse = field(default_factory=Coarse)
    greedy: bool = False


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"step": 0.0}, "search.step is 0.0; it must be positive"),
        ({"step": float("nan")}, "search.step is nan; it must be positive"),
        ({"clearance": -1e-9}, "search.clearance is -1e-09; it must be at least 0"),
        ({"bias": 1.5}, "search.bias is 1.5; it must be between 0 and 1"),
        ({"decay": 1.0}, "search.decay is 1.0; it must be at least 0 and below 1"),
        ({"levels": (0.1, 0.0)}, "search.levels is 0.0; it must be positive"),
        ({"step": np.float32(-1)}, "search.step is -1.0; it must be positive"),
        ({"order": "worst"}, "unknown search.order 'worst'; known: best, first; did you mean first?"),
        ({"grid": "round"}, "unknown search.grid 'round'; known: coarse, fine"),
        ({"grid_settings": Fine()}, "grid is coarse, but its settings are Fine; they must be Coarse"),
    ],
)
def test_bounds(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as error:
        Search(**values)
    assert str(error.value) == message


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"step": "1"}, "search.step is '1'; it takes float positive"),
        ({"step": True}, "search.step is True; it takes float positive"),
        ({"order": 1}, "search.order is 1; it takes first, best"),
        ({"inner": 3}, "search.inner is 3; it takes Coarse"),
        ({"levels": ["a"]}, "search.levels is 'a'; it takes float positive"),
    ],
)
def test_values_of_another_type_are_refused(values: dict[str, Any], message: str) -> None:
    """They were taken, and ended later with a traceback."""
    with pytest.raises(InputError, match=f"^{message}"):
        Search(**values)
    assert Search(step=np.float32(0.5), range=2).step == 0.5  # type: ignore[arg-type]


def test_json_and_back() -> None:
    settings = Search(
        step=2.0, range=0.5, levels=(1.0,), grid="fine", grid_settings=Fine(0.3), inner=Coarse(7)
    )
    assert Search.from_json(settings.to_json(), "file") == settings
    assert Search.from_json({"step": 2}, "file") == Search(step=2.0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"stp": 1}, "file.stp is not a setting; known: step, clearance"),
        ({"step": "far"}, "file.step is 'far'; it takes float positive"),
        ({"inner": {"cells": 0}}, "cells is 0; it must be at least 1"),
        ({"inner": {"cells": 1.5}}, "file.inner.cells is 1.5; it takes int"),
        ({"grid": "fine", "grid_settings": {"cells": 2}}, "file.grid_settings.cells is not a setting"),
        ({"s" * 1000: 1}, f"file.{'s' * 57}... is not a setting"),
        ([], "must be a table of settings"),
    ],
)
def test_json_that_is_wrong(values: object, message: str) -> None:
    with pytest.raises(InputError) as error:
        Search.from_json(values, "file")
    assert message in str(error.value)


def test_assignments() -> None:
    changed = Search().changed(["step=1e-3", "inner.cells=5", "greedy=true", "range=none", "order=best"])
    expected = Search(step=0.001, inner=Coarse(5), greedy=True, range=None, order="best")
    assert changed == expected
    assert Search().changed(["levels=[1, 2]"]).levels == (1.0, 2.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("reach=1", "search has no setting 'reach'; it has step=1.0, .*range=none, .*inner.cells=3"),
        ("step", "'step' is not NAME=VALUE"),
        ("step=big", "search.step is 'big'; it takes float positive"),
        ("greedy=1", "search.greedy is 1; it takes bool"),
    ],
)
def test_assignments_that_are_wrong(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Search().changed([text])


def test_tuples_of_a_fixed_length_have_it() -> None:
    """It raised IndexError for weights whose description lacked a number; found by fuzzing."""
    with pytest.raises(InputError, match=r"region.center is \[0.0, 0.1\]; it must have 3 entries"):
        VisibleRegion.from_json({"center": [0.0, 0.1]}, "region")


def test_descriptions() -> None:
    found = {setting.name: setting for setting in Search().describe()}
    assert found["step"].description == "Longest extension of a tree [rad]."
    assert (found["step"].default, found["step"].rule) == (1.0, "float positive")
    assert found["range"].rule == "float positive or none"
    assert (found["inner.cells"].default, found["inner.cells"].description) == (3, "How many.")
    assert found["order"].rule == "first, best"


def test_registry() -> None:
    table = Registry("grid", dict(GRIDS))
    assert table.load("fine") is Fine and table.settings("coarse") is Coarse
    with pytest.raises(InputError, match="unknown grid 'round'; known: coarse, fine"):
        table.load("round")
    with pytest.raises(InputError, match="settings are Search; grid fine takes Fine"):
        table.make("fine", Search())
    table["bare"] = Entry("robotdiffuse.core.transforms:transform", "no settings")
    assert table.settings("bare") is None


def test_numbers_of_numpy_and_lists_are_kept_as_python_has_them() -> None:
    found = Search(step=np.float32(0.5), levels=[np.float64(0.5)], inner=Coarse(np.int64(2)))  # type: ignore
    assert found == Search(step=0.5, levels=(0.5,), inner=Coarse(2))
    assert [type(x) for x in (found.step, found.levels, found.inner.cells)] == [float, tuple, int]
