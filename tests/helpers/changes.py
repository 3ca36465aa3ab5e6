"""Changes of what a test makes, written down before it is there."""

from collections.abc import Callable
from typing import Any


def later(change: Callable[..., object]) -> Callable[..., Callable[[Any], object]]:
    """Decorator of a change: called without its first argument, what it changes, it returns a function of that alone."""
    return lambda *given, **named: lambda what: change(what, *given, **named)
