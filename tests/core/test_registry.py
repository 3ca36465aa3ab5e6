"""Registry entries that a program adds reach its worker processes."""

from pathlib import Path

import pytest

from robotdiffuse import InputError
from robotdiffuse.core.registry import AddedEntries, Entry, Registry, added_entries, adopt_entries
from robotdiffuse.planning import PLANNERS
from robotdiffuse.problems.families import FAMILIES, load_family
from robotdiffuse.problems.families.rop import Rop
from robotdiffuse.processes.workers import Worker, on_this_machine

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
    assert found.tables["family"] == {"one": FAMILIES["one"]}
    assert found.tables["planner"] == {"rrt_connect": PLANNERS["rrt_connect"]}


def test_worker_processes_have_added_entries(one: Rop) -> None:
    assert list(on_this_machine(load_family, [("one",)], 1)) == [(0, one)]
    worker = Worker(adopt_entries, (AddedEntries({}, ()),))
    assert worker.call(load_family, "one") == one
    worker.close()


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


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Registry:
    """A registry, and an installed package with two entry points for it, one of which is broken."""
    package = tmp_path / "orchard-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: orchard\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text(
        "[test.fruits]\nplum = orchard:PLUM\nstone = orchard:STONE\ngone = no_such_module:GONE\n"
    )
    entry = (
        "from robotdiffuse.core.registry import Entry\nPLUM = Entry('pathlib:Path', 'a plum')\nSTONE = 1\n"
    )
    (tmp_path / "orchard.py").write_text(entry)
    monkeypatch.syspath_prepend(str(tmp_path))
    return Registry("drupe", {"pear": Entry("pathlib:PurePath", "a pear")}, group="test.fruits")


def test_entries_of_installed_packages_are_loaded_when_they_are_used(installed: Registry) -> None:
    assert list(installed) == ["pear"] and "plum" in installed
    assert installed.entry("plum").description == "a plum" and installed.load("plum") is Path
    assert list(installed) == ["pear", "plum"]
    with pytest.raises(InputError, match="known: gone, pear, plum, stone"):
        installed.entry("apple")


def test_an_entry_point_that_cannot_be_loaded_is_named(installed: Registry) -> None:
    with pytest.raises(InputError, match="drupe gone: its entry point no_such_module:GONE cannot be loaded"):
        installed.entry("gone")
    with pytest.raises(InputError, match="orchard:STONE is a int; it must be an Entry"):
        installed.load_installed()
