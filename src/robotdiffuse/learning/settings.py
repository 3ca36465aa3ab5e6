"""Settings as JSON and back, and settings whose kind another field names."""

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

from robotdiffuse.errors import InputError, unknown_name

Settings = TypeVar("Settings")


def of_kind(name: str, table: Mapping[str, tuple[Any, Any]]) -> dict[str, Any]:
    """Metadata of a field whose settings are of the kind that another field, `name`, says by a table's name.

    The table has pairs of a network and its settings, as ENCODERS and DENOISERS.
    """
    return {"name": name, "table": table}


def settings_to_json(settings: object) -> dict[str, Any]:
    """A settings dataclass as plain JSON values."""
    return dataclasses.asdict(typing.cast(Any, settings))


def settings_from_json(kind: type[Settings], values: object, where: str) -> Settings:
    """The settings dataclass of this kind.

    Fields may be numbers, text, tuples of them, or settings again, see `of_kind` too. Raises InputError for a
    field that is unknown, missing or of the wrong type; `where` names the origin in the message.
    """
    if not isinstance(values, dict):
        raise InputError(f"{where} is {values!r}; it must be a table of settings")
    fields = {f.name: f for f in dataclasses.fields(typing.cast(Any, kind))}
    hints = typing.get_type_hints(kind)
    for name in values:
        if name not in fields:
            raise InputError(f"{where}.{name} is not a setting; known: {', '.join(fields)}")
    found: dict[str, Any] = {}
    for name, entry in fields.items():
        hint = hints[name]
        if name not in values:
            if entry.default is dataclasses.MISSING and entry.default_factory is dataclasses.MISSING:
                raise InputError(f"{where}.{name} is missing")
        elif entry.metadata and values[name] is not None:
            chosen = values.get(entry.metadata["name"], fields[entry.metadata["name"]].default)
            if not isinstance(chosen, str) or chosen not in entry.metadata["table"]:
                raise unknown_name(f"{where}.{entry.metadata['name']}", chosen, entry.metadata["table"])
            settings = entry.metadata["table"][chosen][1]
            found[name] = settings_from_json(settings, values[name], f"{where}.{name}")
        elif dataclasses.is_dataclass(hint):
            found[name] = settings_from_json(typing.cast(type, hint), values[name], f"{where}.{name}")
        else:
            found[name] = _value(hint, values[name], f"{where}.{name}")
    return kind(**found)


def _value(hint: Any, value: object, where: str) -> Any:
    if typing.get_origin(hint) is tuple:
        if not isinstance(value, list | tuple):
            raise InputError(f"{where} is {value!r}; it must be a list")
        return tuple(_value(typing.get_args(hint)[0], entry, where) for entry in value)
    options = typing.get_args(hint) or (hint,)
    if float in options and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not any(type(value) is option for option in options):
        wanted = " or ".join(getattr(option, "__name__", str(option)) for option in options)
        raise InputError(f"{where} is {value!r}; it must be of type {wanted}")
    return value


def check_kind(field: str, name: str, settings: object, table: Mapping[str, tuple[Any, Any]]) -> None:
    """Raises InputError unless the name is in the table and the settings, if any, are of its kind."""
    if name not in table:
        raise unknown_name(field, name, table)
    if settings is not None and type(settings) is not table[name][1]:
        raise InputError(
            f"{field} is {name}, but its settings are {type(settings).__name__}; "
            f"they must be {table[name][1].__name__}"
        )
