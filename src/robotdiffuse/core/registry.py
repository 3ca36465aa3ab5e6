"""Registries: tables of planners, encoders, problem families and so on by name, imported on first use."""

from dataclasses import dataclass
from importlib import import_module
from typing import Any

from robotdiffuse.core.errors import InputError, unknown_name


@dataclass(frozen=True)
class Entry:
    """An entry of a registry."""

    location: str
    """module:name of a class, function or value; imported on first use."""
    description: str
    """What it is or does, in one line."""
    settings: str = ""
    """Name of its settings class in the same module; empty for none."""
    kind: str = ""
    """Category within its registry, e.g. search, learned or hybrid for planners."""


AddedEntries = dict[str, dict[str, Entry]]
"""Entries by the kind of their registry, then by name."""
_tables: dict[str, "Registry"] = {}
_adopted: AddedEntries = {}


def added_entries() -> AddedEntries:
    """The entries that this program has added to the package's own, for `adopt_entries` in worker
    processes."""
    found = {what: dict(table.items() - table.own.items()) for what, table in _tables.items()}
    return {what: entries for what, entries in found.items() if entries}


def adopt_entries(entries: AddedEntries) -> None:
    """Add the entries of the parent process to all registries, including those created later."""
    _adopted.update(entries)
    for what in _tables.keys() & entries.keys():
        _tables[what].update(entries[what])


class Registry(dict[str, Entry]):
    """Entries by name, in the order of listing. A program may add its own:

    PLANNERS["mine"] = Entry("my_package.planner:MyPlanner", "what it does", "MySettings")

    Worker processes get them too.
    """

    def __init__(self, what: str, entries: dict[str, Entry]) -> None:
        """`what`: the kind of entry in error messages, e.g. "planner"."""
        super().__init__(entries | _adopted.get(what, {}))
        self.what, self.own = what, entries
        _tables[what] = self

    def entry(self, name: object) -> Entry:
        """The entry of a name. Raises InputError, listing the known names, for an unknown one."""
        if not isinstance(name, str) or name not in self:
            raise unknown_name(self.what, name, self)
        return self[name]

    def load(self, name: str) -> Any:
        """Import the class, function or value of an entry. Raises InputError as `entry` does."""
        module, _, found = self.entry(name).location.partition(":")
        return getattr(import_module(module), found)

    def settings(self, name: str) -> type | None:
        """The settings class of an entry; None if it has none. Raises InputError as `entry` does."""
        entry = self.entry(name)
        if not entry.settings:
            return None
        return getattr(import_module(entry.location.partition(":")[0]), entry.settings)

    def defaults(self, name: str) -> Any:
        """The default settings of an entry; None if it has none."""
        kind = self.settings(name)
        return None if kind is None else kind()

    def make(self, name: str, settings: object | None = None) -> Any:
        """A new instance of the entry's class, with default settings if none are given.

        Raises InputError for an unknown name and for settings of another class.
        """
        kind = self.load(name)
        if settings is None:
            return kind()
        wanted = self.settings(name)
        if wanted is None or not isinstance(settings, wanted):
            takes = "takes none" if wanted is None else f"takes {wanted.__name__}"
            raise InputError(f"settings are {type(settings).__name__}; {self.what} {name} {takes}")
        return kind(settings)
