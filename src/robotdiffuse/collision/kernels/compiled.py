"""The decorator of the compiled functions that allocate nothing."""

from collections.abc import Callable
from typing import Any

from numba import njit


def allocation_free(fastmath: bool = False, inline: str = "never") -> Callable[[Callable], Any]:
    """Compile without Numba's reference counting.

    Counting the references of the arrays that go into every call takes two thirds of the collision kernel's
    time. Such a function must not allocate, nor assign an array to a slice.
    """
    options: dict[str, Any] = {"fastmath": fastmath, "inline": inline, "cache": True, "_nrt": False}
    return njit(**options)
