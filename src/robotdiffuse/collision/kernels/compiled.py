"""Shared by compiled code: a decorator for functions that do not allocate, random numbers, and the account
of loading time."""

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
from numba import njit
from numba.core import event, types
from numba.extending import overload
from numpy import ndarray

from robotdiffuse.core import loading


def _without_scipy(module: str) -> None:
    """Import a module of Numba without SciPy, which it imports only to choose an algorithm for
    `np.convolve`."""
    blas = "scipy.linalg.cython_blas"
    if blas not in sys.modules:
        sys.modules[blas] = None  # pyright: ignore[reportArgumentType]  (makes the import fail)
        try:
            import_module(module)
        finally:
            del sys.modules[blas]


_without_scipy("numba.np.arraymath")  # SciPy would take a ninth of the time of a plan by search


class _Listener(event.Listener):
    """Counts the work of Numba's compiler as loading: reading code from the cache, compiling and writing it."""

    def on_start(self, event: event.Event) -> None:
        if event.kind == LOCK:
            loading.begin()
        else:
            loading.compiles(event.data["dispatcher"].__name__)

    def on_end(self, event: event.Event) -> None:
        if event.kind == LOCK:
            loading.end()


LOCK, COMPILE = "numba:compiler_lock", "numba:compile"
"""Events of Numba: it holds its lock while it reads from the cache too, and compiles within that."""
for kind in (LOCK, COMPILE):
    event.register(kind, _Listener())


def allocation_free(
    fastmath: bool = False, inline: str = "never", forceinline: bool = False
) -> Callable[[Callable], Any]:
    """A decorator that compiles a function without Numba's reference counting.

    Counting references to the arrays in every call would take two thirds of the collision kernel's time. Such
    a function must not allocate memory, nor assign an array to a slice.
    """
    options: dict[str, Any] = {"fastmath": fastmath, "inline": inline, "forceinline": forceinline}
    options |= {"cache": True, "_nrt": False}
    return njit(**options)


def parent_of(parents, j):
    """The parent frame of joint j. `parents` is None for a chain; code for chains is compiled separately, so
    that support for trees costs them nothing."""
    return j if parents is None else parents[j]


@overload(parent_of, inline="always")
def _parent_of(parents, j):
    return (lambda parents, j: j) if parents is types.none else (lambda parents, j: parents[j])


def random_state(seed: int, attempt: int = 0) -> ndarray:
    """State [1] of the compiled random number generator, from a seed and an attempt."""
    return np.random.SeedSequence([seed, attempt]).generate_state(1, np.uint64) | np.uint64(1)


@allocation_free()
def random(state):
    """A uniform random float32 in [0, 1); advances the state uint64[1] (xorshift64*, S. Vigna 2016)."""
    x = state[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    state[0] = x
    return np.float32((x * np.uint64(2685821657736338717)) >> np.uint64(40)) * np.float32(5.9604645e-08)
