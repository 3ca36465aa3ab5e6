"""Checks that a call raises a one-line InputError."""

from collections.abc import Callable

import pytest

from robotdiffuse.core.errors import InputError


def refuses(message: str, call: Callable[..., object], *arguments: object, **more: object) -> None:
    """The call raises an InputError of one line in which the pattern is found."""
    with pytest.raises(InputError, match=message) as error:
        call(*arguments, **more)
    assert "\n" not in str(error.value)
