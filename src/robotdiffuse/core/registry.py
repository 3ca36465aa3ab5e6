"""Registries: tables of planners, encoders, problem families and so on by name, imported on first use.

Installed packages add entries by entry points, see `Registry.group`; modules add their own when they are
imported.
"""

import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pkgutil import resolve_name
from typing import Any, NamedTuple

from robotdiffuse.core.errors import InputError, check_type, described, unknown_name


@dataclass(frozen=True)
class Entry:
    """An entry of a registry."""

    location: str
    """module:name of a class, function or value; imported on first use."""
    description: str
    """What the entry is or does, in one line."""
    settings: str = ""
    """Name of its settings class in the same module, or module:name; empty for none."""
    kind: str = ""
    """Category within its registry, e.g. search or learned for planners."""
    supports: frozenset[str] = frozenset()
    """The optional features that the entry supports, e.g. path constraints for a planner."""


class AddedEntries(NamedTuple):
    """What a program has added to the package's tables."""

    tables: dict[str, dict[str, Entry]]
    """Added entries by registry (`Registry.what`), then by name."""
    modules: tuple[str, ...]
    """Modules that `import_modules` imported; they may also add to tables that are no Registry, such as the
    table of metrics."""


_tables = dict[str, "Registry"]()
_adopted = dict[str, dict[str, Entry]]()
imported = list[str]()
"""Modules that `import_modules` has imported."""


def added_entries() -> AddedEntries:
    """The entries that this program has added to the package's own, for `adopt_entries` in worker
    processes."""
    added = {registry: dict(table.items() - table.own.items()) for registry, table in _tables.items()}
    tables = {registry: entries for registry, entries in added.items() if entries}
    return AddedEntries(tables, tuple(imported))


def adopt_entries(added: AddedEntries) -> None:
    """Import the modules of the parent process and add its entries to the registries of this process,
    including registries that are created later."""
    import_modules(added.modules)
    _adopted.update(added.tables)
    for registry in _tables.keys() & added.tables.keys():
        _tables[registry].update(added.tables[registry])


class Registry(dict[str, Entry]):
    """Entries by name, in the order of listing. A program may add an entry:

    PLANNERS["mine"] = Entry("my_package.planner:MyPlanner", "what it does", "MySettings")

    Worker processes get added entries too.
    """

    def __init__(self, what: str, entries: dict[str, Entry], group: str = "") -> None:
        """Make a table of the package's own entries, and of those that a parent process added.

        Args:
            what: The kind of entry in error messages, e.g. "planner".
            entries: The package's own entries by name.
            group: The group of entry points, e.g. "robotdiffuse.planners", in which an installed package may
                name an Entry; empty if packages cannot add entries.
        """
        super().__init__(entries | _adopted.get(what, {}))
        self.what = what
        self.own = entries
        self.group = group
        _tables[what] = self

    @cached_property
    def _installed(self) -> dict[str, EntryPoint]:
        """Entry points of installed packages by name. The search takes 20 ms, so it runs on first use."""
        return {point.name: point for point in entry_points(group=self.group)} if self.group else {}

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or name in self._installed

    def __missing__(self, name: str) -> Entry:
        """The entry that the entry point of an installed package names. Raises InputError if the entry point
        cannot be loaded."""
        point = self._installed[name]
        try:
            entry = point.load()
        except Exception as error:  # an import may raise anything
            raise InputError(
                f"{self.what} {name}: its entry point {point.value} cannot be loaded: {described(error)}"
            ) from None
        check_type(f"{self.what} {name}: its entry point {point.value}", entry, Entry, "an Entry")
        self[name] = entry
        return entry

    def load_installed(self) -> "Registry":
        """Load the entries of all installed packages, for listing.

        Returns:
            This registry.

        Raises:
            InputError: For an entry point that cannot be loaded.
        """
        for name in self._installed:
            self[name]
        return self

    def entry(self, name: object) -> Entry:
        """Look up an entry.

        Args:
            name: Its name.

        Returns:
            The entry, without importing what it names.

        Raises:
            InputError: For an unknown name; the message lists the known ones.
        """
        if not isinstance(name, str) or name not in self:
            raise unknown_name(self.what, name, {*self, *self._installed})
        return self[name]

    def load(self, name: str) -> Any:
        """Import what an entry names.

        Args:
            name: Name of the entry.

        Returns:
            The class, function or value at the entry's location.

        Raises:
            InputError: For an unknown name.
        """
        return resolve_name(self.entry(name).location)

    def settings(self, name: str) -> type | None:
        """Import the settings class of an entry.

        Args:
            name: Name of the entry.

        Returns:
            The class; None if the entry has no settings.

        Raises:
            InputError: For an unknown name.
        """
        entry = self.entry(name)
        if not entry.settings:
            return None
        module = entry.location.partition(":")[0]
        return resolve_name(entry.settings if ":" in entry.settings else f"{module}:{entry.settings}")

    def defaults(self, name: str) -> Any:
        """Make the default settings of an entry.

        Args:
            name: Name of the entry.

        Returns:
            A new settings object; None if the entry has no settings.

        Raises:
            InputError: For an unknown name.
        """
        kind = self.settings(name)
        return None if kind is None else kind()

    def make(self, name: str, settings: object | None = None) -> Any:
        """Make an instance of an entry's class.

        Args:
            name: Name of the entry.
            settings: An object of the entry's settings class; None: the defaults.

        Returns:
            The new instance.

        Raises:
            InputError: For an unknown name, and for settings of another class.
        """
        kind = self.load(name)
        if settings is None:
            return kind()
        expected = self.settings(name)
        if expected is None or not isinstance(settings, expected):
            takes = "takes none" if expected is None else f"takes {expected.__name__}"
            raise InputError(f"settings are {type(settings).__name__}; {self.what} {name} {takes}")
        return kind(settings)


def import_modules(names: Iterable[str]) -> None:
    """Import modules that add entries to the registries; modules in the current folder are found too.

    Raises InputError for a module that cannot be imported.
    """
    for name in names:
        try:
            if os.getcwd() not in sys.path:
                sys.path.insert(0, os.getcwd())
            import_module(name)
        except Exception as error:  # an import may raise anything
            raise InputError(f"module {name!r} cannot be imported: {described(error)}") from None
        imported.append(name)
