"""Settings: bounds in the types, JSON round trips, NAME=VALUE, descriptions; registries."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest

from helpers.refusals import refuses
from robotdiffuse.core.registry import AddedEntries, Entry, Registry, added_entries, adopt_entries
from robotdiffuse.core.settings import Bound, Count, NotNegative, OneOf, Positive, Settings, SettingsOf, Share
from robotdiffuse.planning import PLANNERS
from robotdiffuse.problems.families import FAMILIES, load_family
from robotdiffuse.problems.families.rop import Rop
from robotdiffuse.processes.workers import Worker, on_this_machine
from robotdiffuse.scenes.surface_points import VisibleRegion


@dataclass(frozen=True)
class Coarse(Settings):
    cells: Count = 3
    """How many."""


@dataclass(frozen=True)
class Fine(Settings):
    width: Positive = 0.1


GRIDS = Registry("grid", {name.lower(): Entry(f"{__name__}:{name}", "a grid", name) for name in ("Coarse", "Fine")})


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


def test_values_out_of_bounds_or_of_another_type_are_refused() -> None:
    refuses("^search.step is 0.0; it must be positive", Search, step=0.0)
    refuses("^search.step is nan; it must be positive", Search, step=float("nan"))
    refuses("^search.clearance is -1e-09; it must be at least 0", Search, clearance=-1e-9)
    refuses("^search.bias is 1.5; it must be between 0 and 1", Search, bias=1.5)
    refuses("^search.decay is 1.0; it must be at least 0 and below 1", Search, decay=1.0)
    refuses(r"^search.levels\[1\] is 0.0; it must be positive", Search, levels=(0.1, 0.0))
    refuses("^search.step is -1.0; it must be positive", Search, step=np.float32(-1))
    refuses(r"^unknown search.order 'worst'; known: best, first; did you mean first\?", Search, order="worst")
    refuses("^unknown search.grid 'round'; known: coarse, fine", Search, grid="round")
    refuses("^grid is coarse, but its settings are Fine; they must be Coarse", Search, grid_settings=Fine())
    refuses("^search.step is '1'; it takes a number above 0", Search, step="1")
    refuses("^search.step is True; it takes a number above 0", Search, step=True)
    refuses("^search.order is 1; it takes first, best", Search, order=1)
    refuses("^search.inner is 3; it takes Coarse", Search, inner=3)
    refuses(r"^search.levels\[0\] is 'a'; it takes a number above 0", Search, levels=["a"])


def test_json_and_back_and_json_that_is_wrong() -> None:
    settings = Search(step=2.0, range=0.5, levels=(1.0,), grid="fine", grid_settings=Fine(0.3), inner=Coarse(7))
    assert Search.from_json(settings.to_json(), "file") == settings
    assert Search.from_json({"step": 2}, "file") == Search(step=2.0)
    for values, message in (
        ({"stp": 1}, "file.stp is not a setting; known: step, clearance"),
        ({"step": "far"}, "file.step is 'far'; it takes a number above 0"),
        ({"inner": {"cells": 0}}, "cells is 0; it must be at least 1"),
        ({"inner": {"cells": 1.5}}, "file.inner.cells is 1.5; it takes an integer"),
        ({"grid": "fine", "grid_settings": {"cells": 2}}, "file.grid_settings.cells is not a setting"),
        ({"s" * 1000: 1}, f"file.{'s' * 57}... is not a setting"),
        ([], "must be a table of settings"),
    ):
        refuses(re.escape(message), Search.from_json, values, "file")
    # Regression: weights whose description lacked a number raised IndexError; found by fuzzing.
    refuses(r"region.center is \[0.0, 0.1\]; it must have 3 entries", VisibleRegion.from_json, {"center": [0.0, 0.1]}, "region")


def test_assignments_and_those_that_are_wrong() -> None:
    changed = Search().changed(["step=1e-3", "inner.cells=5", "greedy=true", "range=none", "order=best"])
    assert changed == Search(step=0.001, inner=Coarse(5), greedy=True, range=None, order="best")
    assert Search().changed(["levels=[1, 2]"]).levels == (1.0, 2.0)
    refuses("search has no setting 'reach'; it has step=1.0, .*range=none, .*inner.cells=3", Search().changed, ["reach=1"])
    refuses("'step' is not NAME=VALUE", Search().changed, ["step"])
    refuses("search.step is 'big'; it takes a number above 0", Search().changed, ["step=big"])
    refuses("search.greedy is 1; it takes true or false", Search().changed, ["greedy=1"])
    refuses("search.step is 10+...; it must be within ±1e308", Search().replaced, {"step": 10**309})


def test_descriptions() -> None:
    found = {setting.name: setting for setting in Search().describe()}
    assert found["step"].description == "Longest extension of a tree [rad]."
    assert (found["step"].default, found["step"].rule) == (1.0, "a number above 0")
    assert found["range"].rule == "a number above 0 or none"
    assert (found["inner.cells"].default, found["inner.cells"].description) == (3, "How many.")
    assert found["order"].rule == "first, best"


def test_registry() -> None:
    table = Registry("grid", dict(GRIDS))
    assert table.load("fine") is Fine and table.settings("coarse") is Coarse
    refuses("unknown grid 'round'; known: coarse, fine", table.load, "round")
    refuses("settings are Search; grid fine takes Fine", table.make, "fine", Search())
    table["bare"] = Entry("robotdiffuse.core.transforms:transform", "no settings")
    assert table.settings("bare") is None


def test_numbers_of_numpy_and_lists_are_kept_as_python_has_them() -> None:
    found = Search(step=np.float32(0.5), range=2, levels=[np.float64(0.5)], inner=Coarse(np.int64(2)))  # type: ignore
    assert found == Search(step=0.5, range=2.0, levels=(0.5,), inner=Coarse(2))
    assert [type(x) for x in (found.step, found.levels, found.inner.cells)] == [float, tuple, int]


def test_worker_processes_have_the_entries_that_the_package_lacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    family = "from robotdiffuse.problems.families.rop import Rop\nONE = Rop(obstacles=(1, 1))\n"
    (tmp_path / "one_obstacle.py").write_text(family)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(FAMILIES, "one", Entry("one_obstacle:ONE", "for tests"))
    one = Rop(obstacles=(1, 1))
    assert list(on_this_machine(load_family, [("one",)], 1)) == [(0, one)]
    worker = Worker(adopt_entries, (AddedEntries({}, ()),))
    assert worker.call(load_family, "one") == one
    worker.close()
    monkeypatch.setitem(PLANNERS, "rrt_connect", Entry("mine:RRT", "in place of ours"))
    found = added_entries()
    assert found.tables["family"] == {"one": FAMILIES["one"]}
    assert found.tables["planner"] == {"rrt_connect": PLANNERS["rrt_connect"]}


def test_adopted_entries_are_in_registries_made_later() -> None:
    before = Registry("fruit", {})
    ours = Entry("a:B", "ours")
    theirs = Entry("c:D", "theirs")
    adopt_entries(AddedEntries({"fruit": {"fig": theirs}, "nut": {"hazel": theirs}}, ()))
    assert before == {"fig": theirs}
    assert Registry("nut", {"pecan": ours}) == {"pecan": ours, "hazel": theirs}
    # a worker passes them on to its own workers
    found = added_entries().tables
    assert (found["fruit"], found["nut"]) == ({"fig": theirs}, {"hazel": theirs})


def test_entries_of_installed_packages_are_loaded_when_they_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A registry, and an installed package with entry points for it, of which one is broken."""
    package = tmp_path / "orchard-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: orchard\nVersion: 1.0\n")
    points = "[test.fruits]\nplum = orchard:PLUM\nstone = orchard:STONE\ngone = no_such_module:GONE\n"
    (package / "entry_points.txt").write_text(points)
    entry = "from robotdiffuse.core.registry import Entry\nPLUM = Entry('pathlib:Path', 'a plum')\nSTONE = 1\n"
    (tmp_path / "orchard.py").write_text(entry)
    monkeypatch.syspath_prepend(str(tmp_path))
    installed = Registry("drupe", {"pear": Entry("pathlib:PurePath", "a pear")}, group="test.fruits")
    assert list(installed) == ["pear"] and "plum" in installed
    assert installed.entry("plum").description == "a plum" and installed.load("plum") is Path
    assert list(installed) == ["pear", "plum"]
    refuses("known: gone, pear, plum, stone", installed.entry, "apple")
    refuses("drupe gone: its entry point no_such_module:GONE cannot be loaded", installed.entry, "gone")
    refuses("orchard:STONE is 1; it must be an Entry", installed.load_installed)


def test_settings_of_a_class_without_source() -> None:
    names = {"Settings": Settings, "dataclass": dataclass, "__name__": "typed"}
    exec("@dataclass(frozen=True)\nclass Typed(Settings):\n    step: float = 1.0\n", names)
    assert names["Typed"]().changed(["step=2"]).step == 2  # type: ignore[operator]
