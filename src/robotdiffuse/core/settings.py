"""Settings: frozen dataclasses with bounds in their field types, readable from JSON and from NAME=VALUE.

    @dataclass(frozen=True)
    class MyPlannerSettings(Settings, name="my_planner"):
        step: Positive = 1.0
        \"\"\"Longest extension of a tree [rad, joint-space L2].\"\"\"
        sampler: Annotated[str, OneOf(SAMPLERS)] = "uniform"

Each instance checks itself on creation; error messages name the field, its value and what would be right.
"""

import ast
import dataclasses
import inspect
import math
import sys
import textwrap
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from numbers import Integral, Real
from types import UnionType
from typing import Annotated, Any, ClassVar, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from robotdiffuse.core.errors import InputError, check_name, shortened, shown, suggestion
from robotdiffuse.core.files import JsonObject, parse_yaml
from robotdiffuse.core.registry import Registry

SettingsT = TypeVar("SettingsT", bound="Settings")
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
        """The rule that the value breaks, such as "at least 1"; None if it breaks none."""
        within = (
            (self.above is None or value > self.above)
            and (self.least is None or value >= self.least)
            and (self.below is None or value < self.below)
            and (self.most is None or value <= self.most)
        )
        if not within or value != value:  # NaN differs from itself
            return "positive" if self.rule == "above 0" else self.rule or "finite"
        return "finite" if math.isinf(value) and not self.infinite else None

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> JsonObject:
        keywords = {
            "exclusiveMinimum": self.above,
            "minimum": self.least,
            "exclusiveMaximum": self.below,
            "maximum": self.most,
        }
        return handler(schema) | {word: bound for word, bound in keywords.items() if bound is not None}

    @property
    def rule(self) -> str:
        """The bounds in words, such as "above 0 and at most 1"; empty without bounds."""
        if self.least is not None and self.most is not None:
            return f"between {self.least:g} and {self.most:g}"
        bounds = {"at least": self.least, "above": self.above, "at most": self.most, "below": self.below}
        return " and ".join(f"{word} {bound:g}" for word, bound in bounds.items() if bound is not None)


@dataclass(frozen=True, eq=False)
class OneOf:
    """The value must be one of these names."""

    names: Collection[str]

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> JsonObject:
        return handler(schema) | {"enum": list(self.names)}


@dataclass(frozen=True)
class Filled:
    """The tuple must not be empty."""


@dataclass(frozen=True)
class SettingsOf:
    """The value must be the settings of a registry entry. Another field holds the name of this entry: the
    type of `denoiser_settings` is annotated with SettingsOf("denoiser", DENOISERS).

    The value is None if the other field does not hold a name in the registry, but for example a folder.
    """

    field: str
    """Name of the other field."""
    table: Registry


Number = Annotated[float, Bound()]
"""Any finite number."""
Positive = Annotated[float, Bound(above=0.0)]
NotNegative = Annotated[float, Bound(least=0.0)]
Share = Annotated[float, Bound(least=0.0, most=1.0)]
ShareBelowOne = Annotated[float, Bound(least=0.0, below=1.0)]
ShareBetween = Annotated[float, Bound(above=0.0, below=1.0)]
Count = Annotated[int, Bound(least=1.0)]
AtLeastTwo = Annotated[int, Bound(least=2.0)]
Natural = Annotated[int, Bound(least=0.0)]
Sizes = Annotated[tuple[Count, ...], Filled()]
"""Layer sizes; at least one."""


KINDS = {
    type(None): "none",
    bool: "true or false",
    int: "an integer",
    float: "a number",
    str: "a text",
    tuple: "a list",
    dict: "values by name",
}
"""What messages call the types of settings."""
CLASSES = {int: Integral, float: Real, tuple: (list, tuple), Any: object}
"""For types of fields that accept values of other classes too: the accepted classes."""
UNIONS = (Union, UnionType)


class Setting(NamedTuple):
    """A field of a settings class, described for people."""

    name: str
    """Dotted for a field of settings within settings."""
    default: Any
    """The value in the described settings: the default, unless it was changed there."""
    rule: str
    """Allowed values."""
    description: str

    @property
    def value(self) -> str:
        """`default` in the form that `Settings.changed` takes; "..." if it has more than LONG characters."""
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
        """Converts lists to tuples, and numbers of NumPy to Python's int and float.

        Raises InputError for the first field of the wrong type or out of bounds.
        """
        prefix = f"{self.settings_name}." if self.settings_name else ""
        for name, hint in _hints(type(self)).items():
            object.__setattr__(self, name, converted(prefix + name, hint, getattr(self, name), self))

    def to_json(self) -> JsonObject:
        """Convert the settings to plain JSON values.

        Returns:
            All fields by name; nested settings are dicts too.
        """
        return dataclasses.asdict(self)  # type: ignore[call-overload]

    @classmethod
    def from_json(cls: type[SettingsT], values: object, where: str) -> SettingsT:
        """Make settings of the values that `to_json` returned.

        Args:
            values: The fields by name; fields that have a default may be missing.
            where: What the values are, for messages, e.g. "settings".

        Returns:
            The checked settings.

        Raises:
            InputError: For a field that is unknown, missing, of the wrong type or out of bounds.
        """
        if not isinstance(values, dict):
            raise InputError(f"{where} is {shown(values)}; it must be a table of settings")
        hints = _hints(cls)
        fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
        for name in values:
            if name not in fields:
                raise InputError(f"{where}.{shortened(name)} is not a setting; known: {', '.join(fields)}")
        checked = dict[str, Any]()
        for name, field in fields.items():
            if name in values:
                at = f"{where}.{name}"
                value = values[name]
                # None needs no class: the field that `SettingsOf` names then holds a folder, which has no
                # registry entry.
                kind = None if value is None else _settings_class(hints[name], values, fields)
                checked[name] = kind.from_json(value, at) if kind else converted(at, hints[name], value)
            elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
                raise InputError(f"{where}.{name} is missing")
        return cls(**checked)

    def changed(self: SettingsT, assignments: Iterable[str]) -> SettingsT:
        """Replace some settings, given as on the command line.

        Args:
            assignments: Texts such as "step=0.5" and "guidance.margin=0.02", with values as in YAML.

        Returns:
            A copy with these values.

        Raises:
            InputError: For text that is not NAME=VALUE, an unknown name (the message lists all settings), and
                a value of the wrong type or out of bounds.
        """
        owner = self.settings_name or type(self).__name__
        valid_assignments = ", ".join(setting.assignment for setting in self.describe())
        values = dict[str, Any]()
        for text in assignments:
            name, equals, value = text.partition("=")
            if not equals or not name:
                raise InputError(f"{shown(text)} is not NAME=VALUE; {owner} has {valid_assignments}")
            parsed: Any = value
            with suppress(InputError):
                parsed = parse_yaml(value, name)
            if isinstance(parsed, str):
                # YAML 1.1 reads 1e-3 as a string, and does not know none as null
                with suppress(ValueError):
                    parsed = None if parsed == "none" else float(parsed)
            values[name] = parsed
        return self.replaced(values)

    def replaced(self: SettingsT, values: Mapping[str, Any]) -> SettingsT:
        """Replace some settings.

        Args:
            values: New values by name, such as {"step": 0.5, "guidance.margin": 0.02}, or with nested
                settings as a table, {"guidance": {"margin": 0.02}}.

        Returns:
            A copy with these values.

        Raises:
            InputError: For an unknown name, and a value of the wrong type or out of bounds.
        """
        assignments = [setting.assignment for setting in self.describe()]
        return self._replaced(values, self.settings_name, assignments)

    def _replaced(self: SettingsT, values: Mapping[str, Any], where: str, known: list[str]) -> SettingsT:
        hints = _hints(type(self))
        replaced = {}
        nested_changes = dict[str, dict[str, Any]]()
        for name, value in values.items():
            first, dot, rest = str(name).partition(".")
            nested = first in hints and isinstance(getattr(self, first), Settings)
            if nested and (dot or isinstance(value, Mapping)):
                nested_changes.setdefault(first, {}).update({rest: value} if dot else value)
            elif nested or name not in hints:
                # "diffusion has no setting 'guidance.margn'": the owner is the outermost settings object
                root, _, path = f"{where}.{name}".partition(".")
                owner = root or type(self).__name__
                hint = suggestion(name, hints)
                raise InputError(f"{owner} has no setting {shown(path)}; it has {', '.join(known)}{hint}")
            else:
                replaced[name] = converted(f"{where}.{name}".removeprefix("."), hints[name], value)
        for name, changes in nested_changes.items():
            group = f"{where}.{name}".removeprefix(".")
            replaced[name] = getattr(self, name)._replaced(changes, group, known)
        return dataclasses.replace(self, **replaced)  # type: ignore[type-var]

    def describe(self) -> list[Setting]:
        """List the settings.

        Returns:
            Name, value, allowed values and description of each setting; nested ones have dotted names.
        """
        hints = _hints(type(self))
        documents = field_docstrings(type(self))
        settings = list[Setting]()
        for name, hint in hints.items():
            value = getattr(self, name)
            if isinstance(value, Settings):
                settings += [nested._replace(name=f"{name}.{nested.name}") for nested in value.describe()]
            else:
                settings.append(Setting(name, value, _rule(hint), documents.get(name, "")))
        return settings


@cache
def _hints(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def _split(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type and its Annotated metadata."""
    if get_origin(hint) is Annotated:
        bare, *marks = get_args(hint)
        return bare, tuple(marks)
    return hint, ()


def _members(hint: Any) -> Iterator[tuple[Any, tuple[Any, ...]]]:
    """The types that a value may have, each with its Annotated metadata: the members of a union, or the type
    itself."""
    bare, marks = _split(hint)
    if get_origin(bare) not in UNIONS:
        yield bare, marks
        return
    for option in get_args(bare):
        yield from _members(option)


def _fits(hint: Any, value: Any) -> bool:
    """Whether a value is of a type; the entries of a tuple are not checked."""
    kinds = [get_origin(bare) or bare for bare, _ in _members(hint)]
    if isinstance(value, bool):
        kinds = [kind for kind in kinds if kind not in (int, float)]
    return isinstance(value, tuple(CLASSES.get(kind, kind) for kind in kinds))


def converted(where: str, hint: Any, value: Any, owner: object = None) -> Any:
    """The value as its field stores it: a list as a tuple, a number of NumPy as Python's int or float.

    owner: the settings object that has the field; None if this object does not exist yet. A SettingsOf mark
    is then not checked, since it reads another field of the object. Raises InputError for a value of the
    wrong type, out of bounds, or refused by another mark of the field.
    """
    if not _fits(hint, value):
        raise InputError(f"{where} is {shown(value)}; it takes {_rule(hint)}")
    bare, marks = _split(hint)
    kind = get_origin(bare)
    kinds = get_args(bare)
    if kind in UNIONS:
        fitting = next(option for option in kinds if _fits(option, value))
        value = converted(where, fitting, value, owner)
    elif kind is tuple:
        if kinds[-1] is not Ellipsis and len(value) != len(kinds):
            raise InputError(f"{where} is {shown(value)}; it must have {len(kinds)} entries")
        value = tuple(converted(f"{where}[{i}]", kinds[0], entry, owner) for i, entry in enumerate(value))
    elif kind is dict:
        named = {str(key): entry for key, entry in value.items()}
        value = {key: converted(f"{where}.{key}", kinds[1], entry, owner) for key, entry in named.items()}
    elif bare in (int, float):
        if isinstance(value, int) and abs(value) > sys.float_info.max:
            raise InputError(f"{where} is {shown(value)}; it must be within ±1e308")
        value = bare(value)
    for mark in marks:
        _check_mark(where, mark, value, owner)
    return value


def _check_mark(where: str, mark: Any, value: Any, owner: object) -> None:
    if isinstance(mark, Bound):
        problem = mark.problem(value)
        if problem is not None:
            raise InputError(f"{where} is {value}; it must be {problem}")
    elif isinstance(mark, Filled) and value == ():
        raise InputError(f"{where} is (); it must have at least one entry")
    elif isinstance(mark, OneOf) and isinstance(value, str):
        check_name(where, value, mark.names)
    elif isinstance(mark, SettingsOf) and owner is not None and value is not None:
        name = getattr(owner, mark.field)
        expected = mark.table.settings(name) if name in mark.table else None
        if expected is not None and type(value) is not expected:
            raise InputError(
                f"{mark.field} is {name}, but its settings are {type(value).__name__}; "
                f"they must be {expected.__name__}"
            )


def _settings_class(
    hint: Any, values: Mapping[str, Any], fields: dict[str, dataclasses.Field]
) -> type[Settings] | None:
    """The class of a nested settings field; None for any other field."""
    bare, marks = _split(hint)
    for mark in marks:
        if isinstance(mark, SettingsOf):
            return mark.table.settings(values.get(mark.field, fields[mark.field].default))
    for member, _ in _members(bare):
        if isinstance(member, type) and issubclass(member, Settings):
            return member
    return None


def _rule(hint: Any) -> str:
    texts = []
    for bare, marks in _members(hint):
        rules = [mark.rule for mark in marks if isinstance(mark, Bound)]
        names = [", ".join(mark.names) for mark in marks if isinstance(mark, OneOf)]
        texts.append(
            " ".join(names or [KINDS.get(get_origin(bare) or bare) or bare.__name__, *rules]).strip()
        )
    return " or ".join(texts)


def field_docstrings(kind: type) -> dict[str, str]:
    """The docstring below each field of a class and of its base classes."""
    docstrings = dict[str, str]()
    for cls in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(cls):
            continue
        try:
            source = inspect.getsource(cls)
        except (OSError, TypeError):  # a class that was typed in, or made by a function
            continue
        [tree] = ast.parse(textwrap.dedent(source)).body
        for field, text in pairwise(tree.body if isinstance(tree, ast.ClassDef) else []):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and isinstance(text, ast.Expr)
                and isinstance(text.value, ast.Constant)
                and isinstance(text.value.value, str)
            ):
                docstrings[field.target.id] = " ".join(text.value.value.split())
    return docstrings
