"""Checks that a call raises a one-line InputError."""

from collections.abc import Callable

import pytest

from robotdiffuse.core.errors import InputError


def refuses(message: str, call: Callable[..., object], *arguments: object, **more: object) -> str:
    """Asserts that the call raises a one-line InputError in which the pattern is found; returns its text."""
    with pytest.raises(InputError, match=message) as error:
        call(*arguments, **more)
    assert "\n" not in str(error.value)
    return str(error.value)
