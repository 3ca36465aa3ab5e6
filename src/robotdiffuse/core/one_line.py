"""The text of a dataclass in one line, with large arrays by their shapes."""

from dataclasses import MISSING, fields
from typing import Any

import numpy as np
from numpy import ndarray

MAX_NUMBERS = 8
"""Arrays of more numbers than this are shown by their shape."""
MAX_ENTRIES = 3
"""Tuples and tables of more entries than this are shown by their number."""
MAX_TEXT = 200
"""Longest text of a value [characters]."""


def one_line(value: Any) -> str:
    """A dataclass as Name(field=value, ...) in one line; fields with their default are left out."""
    found = []
    for field in fields(value):
        if field.repr and not _is_default(field.default, now := getattr(value, field.name)):
            found.append(f"{field.name}={short(now)}")
    text = f"{type(value).__name__}({', '.join(found)})"
    return text if len(text) <= MAX_TEXT else f"{text[: MAX_TEXT - 4]}...)"


def short(value: Any) -> str:
    """A short text of a value: of small arrays their numbers, of large ones their shape."""
    if isinstance(value, ndarray):
        if value.size <= MAX_NUMBERS:
            return _numbers(value.tolist())
        return f"<{' x '.join(map(str, value.shape))} array>"
    if isinstance(value, tuple | list) and not hasattr(value, "_fields"):
        if len(value) > MAX_ENTRIES:
            return f"<{len(value)} entries>"
        inner = ", ".join(map(short, value))
        return f"({inner},)" if len(value) == 1 else f"({inner})"
    if isinstance(value, dict):
        return f"<{len(value)} entries>"
    return " ".join(repr(value).split())


def _numbers(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_numbers, value))}]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _is_default(default: Any, value: Any) -> bool:
    if default is MISSING:
        return False
    if value is default:
        return True
    try:
        return bool(np.array_equal(value, default))
    except (TypeError, ValueError):
        return False
