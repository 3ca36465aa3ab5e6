"""Settings: frozen dataclasses with bounds in their field types, readable from JSON and from NAME=VALUE.

    @dataclass(frozen=True)
    class RRTConnectSettings(Settings, name="rrt_connect"):
        step: Positive = 1.0
        \"\"\"Longest extension of a tree [rad, joint-space L2].\"\"\"
        sampler: Annotated[str, OneOf(SAMPLERS)] = "uniform"

Each instance checks itself on creation; error messages name the field, its value and what would be right.
"""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from numbers import Integral, Real
from types import UnionType
from typing import Annotated, Any, ClassVar, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from robotdiffuse.core.errors import InputError, shortened, shown, unknown_name
from robotdiffuse.core.field_docstrings import field_docstrings
from robotdiffuse.core.input_files import parse_yaml
from robotdiffuse.core.registry import Registry

Given = TypeVar("Given", bound="Settings")
LONG = 40
"""Longest value shown in lists of settings [characters]."""


@dataclass(frozen=True)
class Bound:
    """Bounds of a number. Infinite values are rejected unless `infinite`."""

    above: float | None = None
    least: float | None = None
    below: float | None = None
    most: float | None = None
    infinite: bool = False

    def problem(self, value: Any) -> str | None:
        """The rule that the value breaks; None if it is within the bounds."""
        within = (
            (self.above is None or value > self.above)
            and (self.least is None or value >= self.least)
            and (self.below is None or value < self.below)
            and (self.most is None or value <= self.most)
        )
        if not within or value != value:
            return self.rule
        return "finite" if math.isinf(value) and not self.infinite else None

    @property
    def rule(self) -> str:
        low = f"at least {self.least:g}" if self.least is not None else ""
        low = f"above {self.above:g}" if self.above is not None else low
        high = f"at most {self.most:g}" if self.most is not None else ""
        high = f"below {self.below:g}" if self.below is not None else high
        if self.least is not None and self.most is not None:
            return f"between {self.least:g} and {self.most:g}"
        if not high and self.above == 0:
            return "positive"
        return " and ".join(part for part in (low, high) if part) or "a number"


@dataclass(frozen=True, eq=False)
class OneOf:
    """The value must be one of these names."""

    names: Iterable[str]


@dataclass(frozen=True)
class Filled:
    """The tuple must not be empty."""


@dataclass(frozen=True)
class SettingsOf:
    """Settings of the registry entry that another field names, such as `denoiser_settings` for `denoiser`.

    None if that field holds no name of the registry, e.g. a folder.
    """

    field: str
    table: Registry


Positive = Annotated[float, Bound(above=0.0)]
NotNegative = Annotated[float, Bound(least=0.0)]
Share = Annotated[float, Bound(least=0.0, most=1.0)]
Count = Annotated[int, Bound(least=1.0)]
Natural = Annotated[int, Bound(least=0.0)]
Sizes = Annotated[tuple[Count, ...], Filled()]
"""Layer sizes; at least one."""


class Setting(NamedTuple):
    """A field of a settings class, described for people."""

    name: str
    """Dotted for a field of settings within settings."""
    default: Any
    rule: str
    """Allowed values."""
    description: str

    @property
    def value(self) -> str:
        """The default in the form that `Settings.changed` takes; "..." if that is long."""
        plain = self.default is None or isinstance(self.default, bool)
        text = str(self.default).lower() if plain else str(self.default)
        return text if len(text) <= LONG else "..."

    @property
    def assignment(self) -> str:
        """NAME=VALUE."""
        return f"{self.name}={self.value}"


class Settings:
    """Base of settings classes. A subclass that overrides __post_init__ must call this one."""

    settings_name: ClassVar[str] = ""
    """Prefix of field names in messages."""

    def __init_subclass__(cls, name: str = "", **rest: Any) -> None:
        super().__init_subclass__(**rest)
        if name:
            cls.settings_name = name

    def __post_init__(self) -> None:
        """Turns lists into tuples, and NumPy's numbers into Python's.

        Raises InputError for the first field of the wrong type or out of bounds.
        """
        prefix = f"{self.settings_name}." if self.settings_name else ""
        for name, hint in _hints(type(self)).items():
            given = getattr(self, name)
            value = _plain(given)
            if _fits(hint, value):
                object.__setattr__(self, name, value)
            else:  # the error shows what was given
                value = given
            _check(prefix + name, hint, value, self)

    def to_json(self) -> dict[str, Any]:
        """All fields as plain JSON values."""
        return dataclasses.asdict(self)  # type: ignore[call-overload]

    @classmethod
    def from_json(cls: type[Given], values: object, where: str) -> Given:
        """The settings of `to_json`.

        Raises InputError, with `where` before the field, for one that is unknown, missing, of the wrong type
        or out of bounds.
        """
        if not isinstance(values, dict):
            raise InputError(f"{where} is {shown(values)}; it must be a table of settings")
        hints, fields = _hints(cls), {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
        for name in values:
            if name not in fields:
                raise InputError(
                    f"{where}.{shortened(str(name))} is not a setting; known: {', '.join(fields)}"
                )
        found: dict[str, Any] = {}
        for name, field in fields.items():
            if name in values:
                at = f"{where}.{name}"
                # no settings are given, so the name in the other field need not be in a registry
                kind = None if values[name] is None else _settings_class(hints[name], values, fields)
                if kind is not None:
                    found[name] = kind.from_json(values[name], at)
                else:
                    found[name] = _typed(hints[name], values[name], at)
            elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
                raise InputError(f"{where}.{name} is missing")
        return cls(**found)

    def changed(self: Given, assignments: Iterable[str]) -> Given:
        """A copy with some settings replaced: "step=0.5", "guidance.margin=0.02"; values as in YAML.

        Raises InputError for text that is not NAME=VALUE, an unknown name (the message lists all settings)
        and a value of the wrong type or out of bounds.
        """
        where = self.settings_name or type(self).__name__
        known = {setting.name: setting.assignment for setting in self.describe()}
        values: dict[str, Any] = {}
        for text in assignments:
            name, equals, value = text.partition("=")
            if not equals or not name:
                raise InputError(f"{shown(text)} is not NAME=VALUE; {where} has {', '.join(known.values())}")
            try:
                parsed = parse_yaml(value, name)
            except InputError:
                parsed = value
            if isinstance(parsed, str):
                # YAML 1.1 reads 1e-3 as a string, and does not know none as null
                parsed = None if parsed == "none" else _number(parsed)
            values[name] = parsed
        return self.replaced(values)

    def replaced(self: Given, values: Mapping[str, Any]) -> Given:
        """A copy with some settings replaced: {"step": 0.5, "guidance.margin": 0.02}, or nested tables.

        Raises InputError as `changed` does.
        """
        known = {setting.name: setting.assignment for setting in self.describe()}
        where = self.settings_name or type(self).__name__
        changes: dict[str, Any] = {}
        for name, value in self._flat(values):
            if name not in known:
                raise InputError(f"{where} has no setting {shown(name)}; it has {', '.join(known.values())}")
            *outer, last = name.split(".")
            inner = changes
            for part in outer:
                inner = inner.setdefault(part, {})
            inner[last] = value
        return self._merged(changes, where)

    def _flat(self, values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
        """Names and values of nested settings, with dots between the names."""
        for key, value in values.items():
            name = f"{prefix}{key}"
            at: Any = self
            for part in name.split("."):
                at = getattr(at, part, None)
            if isinstance(value, Mapping) and isinstance(at, Settings):
                yield from self._flat(value, f"{name}.")
            else:
                yield name, value

    def _merged(self: Given, changes: dict[str, Any], where: str) -> Given:
        hints, found = _hints(type(self)), {}
        for name, value in changes.items():
            now = getattr(self, name)
            if isinstance(now, Settings):
                found[name] = now._merged(value, f"{where}.{name}")
            else:
                found[name] = _typed(hints[name], value, f"{where}.{name}")
        return dataclasses.replace(self, **found)  # type: ignore[type-var]

    def describe(self) -> list[Setting]:
        """All settings with their values, including nested ones."""
        hints, documents = _hints(type(self)), field_docstrings(type(self))
        found: list[Setting] = []
        for name, hint in hints.items():
            value = getattr(self, name)
            if isinstance(value, Settings):
                found += [inner._replace(name=f"{name}.{inner.name}") for inner in value.describe()]
            else:
                found.append(Setting(name, value, _rule(hint), documents.get(name, "")))
        return found


@cache
def _hints(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def _options(hint: Any) -> tuple[Any, ...]:
    """The members of a union; a one-element tuple for any other type."""
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _split(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type and its Annotated metadata."""
    if get_origin(hint) is Annotated:
        bare, *marks = get_args(hint)
        return bare, tuple(marks)
    return hint, ()


def _plain(value: Any) -> Any:
    """The value with lists as tuples, and other kinds of numbers, such as NumPy's, as Python's."""
    if isinstance(value, list | tuple):
        return tuple(_plain(entry) for entry in value)
    if isinstance(value, Real) and not isinstance(value, bool):
        return int(value) if isinstance(value, Integral) else float(value)
    return value


def _fits(hint: Any, value: Any) -> bool:
    """Whether a value is of a type; entries of tuples are not looked at."""
    for option in _options(_split(hint)[0]):
        bare = _split(option)[0]
        kind = get_origin(bare) or bare
        if kind in (Union, UnionType):
            fits = _fits(bare, value)
        elif kind in (int, float):
            fits = isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
        else:
            fits = kind is Any or not isinstance(kind, type) or isinstance(value, kind)
        if fits:
            return True
    return False


def _check(where: str, hint: Any, value: Any, owner: object) -> None:
    if not _fits(hint, value):
        raise InputError(f"{where} is {shown(value)}; it takes {_rule(hint)}")
    if value is None:
        return
    for option in _options(hint):
        bare, marks = _split(option)
        for mark in marks:
            _check_mark(where, mark, value, owner)
        if get_origin(bare) is tuple and isinstance(value, tuple):
            for entry in value:
                _check(where, get_args(bare)[0], entry, owner)
        elif get_origin(bare) in (Union, UnionType):
            _check(where, bare, value, owner)


def _check_mark(where: str, mark: Any, value: Any, owner: object) -> None:
    if isinstance(mark, Bound) and isinstance(value, int | float):
        problem = mark.problem(value)
        if problem is not None:
            raise InputError(f"{where} is {value}; it must be {problem}")
    elif isinstance(mark, Filled) and value == ():
        raise InputError(f"{where} is (); it must have at least one entry")
    elif isinstance(mark, OneOf) and isinstance(value, str) and value not in mark.names:
        raise unknown_name(where, value, mark.names)
    elif isinstance(mark, SettingsOf):
        name = getattr(owner, mark.field)
        wanted = mark.table.settings(name) if name in mark.table else None
        if wanted is not None and type(value) is not wanted:
            raise InputError(
                f"{mark.field} is {name}, but its settings are {type(value).__name__}; "
                f"they must be {wanted.__name__}"
            )


def _settings_class(
    hint: Any, values: Mapping[str, Any], fields: dict[str, dataclasses.Field]
) -> type[Settings] | None:
    """The class of a nested settings field; None for any other field."""
    bare, marks = _split(hint)
    for mark in marks:
        if isinstance(mark, SettingsOf):
            return mark.table.settings(values.get(mark.field, fields[mark.field].default))
    for option in _options(bare):
        if isinstance(option, type) and issubclass(option, Settings):
            return option
    return None


def _typed(hint: Any, value: Any, where: str) -> Any:
    """The value converted to the field's type: lists become tuples, integers floats. Raises InputError for
    other types."""
    bare, _ = _split(hint)
    options = [_split(option)[0] for option in _options(bare)]
    if Any in options:
        return value
    for option in options:
        if get_origin(option) is tuple and isinstance(value, list | tuple):
            count = len(get_args(option))
            if get_args(option)[-1] is not Ellipsis and len(value) != count:
                raise InputError(f"{where} is {shown(value)}; it must have {count} entries")
            return tuple(_typed(get_args(option)[0], entry, where) for entry in value)
        if get_origin(option) is dict and isinstance(value, dict):
            return {str(key): _typed(get_args(option)[1], entry, where) for key, entry in value.items()}
    plain = [type(None) if option is None else get_origin(option) or option for option in options]
    if type(value) in plain:
        return value
    if float in plain and type(value) is int:
        return float(value)
    wanted = " or ".join("none" if kind is type(None) else kind.__name__ for kind in plain)
    raise InputError(f"{where} is {shown(value)}; it must be of type {wanted}")


def _number(text: str) -> float | str:
    """The text as a number if it is one, else unchanged."""
    try:
        return float(text)
    except ValueError:
        return text


def _rule(hint: Any) -> str:
    def parts(hint: Any) -> Iterator[str]:
        for option in _options(hint):
            bare, marks = _split(option)
            if get_origin(bare) in (Union, UnionType):
                yield from parts(bare)
                continue
            rules = [mark.rule for mark in marks if isinstance(mark, Bound)]
            names = [", ".join(mark.names) for mark in marks if isinstance(mark, OneOf)]
            kind = "none" if bare is type(None) else getattr(bare, "__name__", str(bare))
            yield " ".join(names or [kind, *rules])

    return " or ".join(parts(hint))
