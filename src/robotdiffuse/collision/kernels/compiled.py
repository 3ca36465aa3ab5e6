"""What compiled code shares: the decorator of functions that allocate nothing, and random numbers."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy import ndarray


def allocation_free(fastmath: bool = False, inline: str = "never") -> Callable[[Callable], Any]:
    """Compile without Numba's reference counting.

    Counting the references of the arrays that go into every call takes two thirds of the collision kernel's
    time. Such a function must not allocate, nor assign an array to a slice.
    """
    options: dict[str, Any] = {"fastmath": fastmath, "inline": inline, "cache": True, "_nrt": False}
    return njit(**options)


def random_state(seed: int, attempt: int = 0) -> ndarray:
    """State of the compiled random numbers, well mixed."""
    return np.random.SeedSequence([seed, attempt]).generate_state(1, np.uint64) | np.uint64(1)


@allocation_free()
def random(state):
    """Uniform in [0, 1) from the state uint64[1] (xorshift64*, S. Vigna 2016)."""
    x = state[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    state[0] = x
    return np.float32((x * np.uint64(2685821657736338717)) >> np.uint64(40)) * np.float32(5.9604645e-08)
