"""Registry entries that a program adds reach its worker processes."""

from pathlib import Path

import pytest

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
    """A family in a module of its own, added at run time."""
    (tmp_path / "one_obstacle.py").write_text(FAMILY)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(FAMILIES, "one", Entry("one_obstacle:ONE", "for tests"))
    return Rop(obstacles=(1, 1))


def test_added_entries_are_those_that_the_package_lacks(one: Rop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PLANNERS, "rrt_connect", Entry("mine:RRT", "in place of ours"))
    found = added_entries()
    assert found["family"] == {"one": FAMILIES["one"]}
    assert found["planner"] == {"rrt_connect": PLANNERS["rrt_connect"]}


def test_worker_processes_have_added_entries(one: Rop) -> None:
    assert list(on_this_machine(load_family, [("one",)], 1)) == [(0, one)]
    worker = SingleWorker(adopt_entries, ({},))
    assert worker.call(load_family, "one") == one
    worker.close()


def test_adopted_entries_are_in_registries_made_later() -> None:
    before, ours, theirs = Registry("fruit", {}), Entry("a:B", "ours"), Entry("c:D", "theirs")
    adopt_entries({"fruit": {"fig": theirs}, "nut": {"hazel": theirs}})
    assert before == {"fig": theirs}
    assert Registry("nut", {"pecan": ours}) == {"pecan": ours, "hazel": theirs}
    # a worker passes them on to its own workers
    found = added_entries()
    assert (found["fruit"], found["nut"]) == ({"fig": theirs}, {"hazel": theirs})
