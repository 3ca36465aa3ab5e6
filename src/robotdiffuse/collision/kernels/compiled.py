"""What compiled code shares: the decorator of functions that allocate nothing, random numbers, and the time
that compiling took."""

import sys
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
from numba import njit
from numba.core import event, types
from numba.extending import overload
from numpy import ndarray


def _without_scipy(module: str) -> None:
    """Import a module of Numba that imports SciPy only to choose how `np.convolve` multiplies."""
    blas = "scipy.linalg.cython_blas"
    if blas not in sys.modules:
        sys.modules[blas] = None  # pyright: ignore[reportArgumentType]  (which no import finds)
        try:
            import_module(module)
        finally:
            del sys.modules[blas]


_without_scipy("numba.np.arraymath")  # a ninth of what a plan by search takes from start to end


class _CompileTimer(event.Listener):
    """Adds up the outermost compilations; one thread compiles at a time, the others wait for it."""

    def __init__(self) -> None:
        self.seconds, self._depth, self._began = 0.0, 0, 0.0

    def on_start(self, event: event.Event) -> None:
        if self._depth == 0:
            self._began = time.perf_counter()
        self._depth += 1

    def on_end(self, event: event.Event) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._began


_timer = _CompileTimer()
event.register("numba:compile", _timer)


def compile_seconds() -> float:
    """Time that this process has spent on compiling so far [s]; code that is loaded from disk counts none."""
    return _timer.seconds


def allocation_free(
    fastmath: bool = False, inline: str = "never", forceinline: bool = False
) -> Callable[[Callable], Any]:
    """Compile without Numba's reference counting.

    Counting the references of the arrays that go into every call takes two thirds of the collision kernel's
    time. Such a function must not allocate, nor assign an array to a slice.
    """
    options: dict[str, Any] = {"fastmath": fastmath, "inline": inline, "forceinline": forceinline}
    options |= {"cache": True, "_nrt": False}
    return njit(**options)


def parent_of(parents, j):
    """The frame that joint j hangs from. Code for chains, which have None, is compiled apart, so that they
    lose nothing to trees."""
    return j if parents is None else parents[j]


@overload(parent_of, inline="always")
def _parent_of(parents, j):
    return (lambda parents, j: j) if parents is types.none else (lambda parents, j: parents[j])


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
