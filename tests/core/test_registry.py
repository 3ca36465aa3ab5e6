"""Tables of things by name: what a program adds, its processes have too."""

from pathlib import Path

import pytest

from robotdiffuse.core import registry
from robotdiffuse.core.processes import SingleWorker, on_this_machine
from robotdiffuse.core.registry import Entry, Registry, added_entries, adopt_entries
from robotdiffuse.planning import PLANNERS
from robotdiffuse.problems.families import FAMILIES, load_family
from robotdiffuse.problems.families.rop import Rop

FAMILY = """from robotdiffuse.problems.families.rop import Rop
ONE = Rop(obstacles=(1, 1))
"""


@pytest.fixture
def one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rop:
    """A family that stands in a module of its own and is added at run time."""
    (tmp_path / "one_obstacle.py").write_text(FAMILY)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(FAMILIES, "one", Entry("one_obstacle:ONE", "for tests"))
    return Rop(obstacles=(1, 1))


def test_added_are_entries_that_the_package_has_not(one: Rop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PLANNERS, "rrt_connect", Entry("mine:RRT", "in place of ours"))
    assert added_entries() == {
        "family": {"one": FAMILIES["one"]},
        "planner": {"rrt_connect": PLANNERS["rrt_connect"]},
    }


def test_processes_have_what_was_added(one: Rop) -> None:
    assert list(on_this_machine(load_family, [("one",)], 1)) == [(0, one)]
    worker = SingleWorker(adopt_entries, ({},))
    assert worker.call(load_family, "one") == one
    worker.close()


def test_what_was_taken_over_is_in_tables_made_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_taken_over", {})
    monkeypatch.setattr(registry, "_tables", {})
    before, ours, theirs = Registry("fruit", {}), Entry("a:B", "ours"), Entry("c:D", "theirs")
    adopt_entries({"fruit": {"fig": theirs}, "nut": {"hazel": theirs}})
    assert before == {"fig": theirs}
    assert Registry("nut", {"pecan": ours}) == {"pecan": ours, "hazel": theirs}
    # and on to the processes of a process
    assert added_entries() == {"fruit": {"fig": theirs}, "nut": {"hazel": theirs}}
