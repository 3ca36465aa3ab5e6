"""Tables of things by name: planners, encoders, families, ... A new one is a file and a line in its table."""

from dataclasses import dataclass
from importlib import import_module
from typing import Any

from robotdiffuse.core.errors import InputError, unknown_name


@dataclass(frozen=True)
class Entry:
    """A line of a table."""

    location: str
    """module:name of a class, function or value; imported when it is asked for."""
    description: str
    """One line."""
    settings: str = ""
    """Name of its settings class in the same module; empty if it has none."""
    kind: str = ""
    """What entries of one table are told apart by, e.g. search, learned, hybrid for planners."""
    supports: frozenset[str] = frozenset()
    """What not every entry of a table supports, e.g. path constraints for planners."""


Added = dict[str, dict[str, Entry]]
"""Entries by name, by what they are."""
_tables: dict[str, "Registry"] = {}
_taken_over: Added = {}


def added() -> Added:
    """What this program has added to the tables that the package has, for `take_over` in its processes."""
    found = {what: dict(table.items() - table.own.items()) for what, table in _tables.items()}
    return {what: entries for what, entries in found.items() if entries}


def take_over(entries: Added) -> None:
    """Add to all tables, those too that are made later, what the program that started this one has added."""
    _taken_over.update(entries)
    for what in _tables.keys() & entries.keys():
        _tables[what].update(entries[what])


class Registry(dict[str, Entry]):
    """Entries by name, in the order that they are listed in. A program may add its own:

    PLANNERS["mine"] = Entry("my_package.planner:MyPlanner", "what it does", "MySettings")

    Processes that it starts have them too.
    """

    def __init__(self, what: str, entries: dict[str, Entry]) -> None:
        """`what` they are, in error messages: "planner"."""
        super().__init__(entries | _taken_over.get(what, {}))
        self.what, self.own = what, entries
        _tables[what] = self

    def entry(self, name: object) -> Entry:
        """Raises InputError, listing the known names, for an unknown one."""
        if not isinstance(name, str) or name not in self:
            raise unknown_name(self.what, name, self)
        return self[name]

    def load(self, name: str) -> Any:
        """The class, function or value of an entry, imported now; InputError as `entry`."""
        module, _, found = self.entry(name).location.partition(":")
        return getattr(import_module(module), found)

    def settings(self, name: str) -> type | None:
        """The settings class of an entry, None if it has none; InputError as `entry`."""
        entry = self.entry(name)
        if not entry.settings:
            return None
        return getattr(import_module(entry.location.partition(":")[0]), entry.settings)

    def defaults(self, name: str) -> Any:
        """The settings of an entry as they are if nothing is said; None if it has none."""
        kind = self.settings(name)
        return None if kind is None else kind()

    def make(self, name: str, settings: object | None = None) -> Any:
        """An instance of the entry's class, with its default settings unless some are given.

        Raises InputError for an unknown name, and for settings of another class.
        """
        kind = self.load(name)
        if settings is None:
            return kind()
        wanted = self.settings(name)
        if wanted is None or not isinstance(settings, wanted):
            takes = "takes none" if wanted is None else f"takes {wanted.__name__}"
            raise InputError(f"settings are {type(settings).__name__}; {self.what} {name} {takes}")
        return kind(settings)
