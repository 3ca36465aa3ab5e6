"""Decorators of compiled functions, and the account of the time that Numba takes; see `loading.py`."""

import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import caching, errors, event

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

# For each error that type inference meets, thousands in a large function, Numba would let colorama replace
# sys.stdout and sys.stderr and restore what they were, even if another thread has set others since.
errors.ColorShell = nullcontext  # type: ignore[misc]


# before the checksum at the end of a file of compiled code, which Numba itself does not read
CHECKSUM = b"crc32"


class _CacheFile(caching.IndexDataCacheFile):
    """Numba's files of compiled code with a checksum: damaged machine code would end the process."""

    def _dump(self, obj: Any) -> bytes:
        data = super()._dump(obj)
        return data + CHECKSUM + zlib.crc32(data).to_bytes(4, "big")

    def _load_data(self, name: str) -> Any:
        content = Path(self._data_path(name)).read_bytes()
        data, marker, checksum = content.rpartition(CHECKSUM)
        if marker and zlib.crc32(data).to_bytes(4, "big") != checksum:
            raise ValueError(f"{name} is damaged")
        return super()._load_data(name)


@contextmanager
def _rebuild_damaged(cache: caching.Cache) -> Iterator[None]:
    """Around reading and writing: what cannot be read is compiled anew; a full disk is no error."""
    try:
        yield
    except Exception:  # pickle raises errors of many kinds
        with suppress(OSError):
            cache.flush()


caching.IndexDataCacheFile = _CacheFile  # type: ignore[misc]
caching.Cache._guard_against_spurious_io_errors = _rebuild_damaged  # type: ignore[method-assign]


class _Listener(event.Listener):
    """Counts the work of Numba's compiler as loading: reading from the cache, compiling, writing."""

    def on_start(self, event: event.Event) -> None:
        if event.kind == LOCK:
            loading.begin()
        else:
            loading.compiles(event.data["dispatcher"].__name__)  # type: ignore[index]

    def on_end(self, event: event.Event) -> None:
        if event.kind == LOCK:
            loading.end()


LOCK, COMPILE = "numba:compiler_lock", "numba:compile"
"""Events of Numba: it holds its lock while it reads from the cache too, and compiles within that."""
for kind in (LOCK, COMPILE):
    event.register(kind, _Listener())


def kernel(**options: Any) -> Callable[[Callable], Any]:
    """A decorator that compiles a function that Python calls; `options` are those of `numba.njit`."""
    every: dict[str, Any] = {"cache": True, "no_cfunc_wrapper": True}
    return njit(**every | options)


def inner_kernel(**options: Any) -> Callable[[Callable], Any]:
    """A decorator that compiles a function that only compiled code calls.

    The code by which Python would call it is left out: for robots and scenes, tuples of many arrays, it takes
    a quarter of the compile time. Numba compiles all that a function calls again as a part of it, so
    functions with one caller are better inlined (`inline="always"`).
    """

    def compiled(function: Callable) -> Any:
        dispatcher = kernel(no_cpython_wrapper=True, **options)(function)

        def refuse(*_: Any, **__: Any) -> None:
            raise TypeError(f"{function.__name__} is an inner kernel: only compiled code calls it")

        # Python finds no code to call, which would end the process, and asks for it
        dispatcher._insert = lambda *_: None
        dispatcher._compile_for_args = refuse
        return dispatcher

    return compiled


def allocation_free(
    fastmath: bool = False, inline: str = "never", forceinline: bool = False, inner: bool = True
) -> Callable[[Callable], Any]:
    """A decorator that compiles a function without Numba's reference counting; an inner kernel by default.

    Counting references to the arrays in every call would take two thirds of the collision kernel's time. Such
    a function must not allocate memory, nor assign an array to a slice.
    """
    options: dict[str, Any] = {"fastmath": fastmath, "inline": inline, "forceinline": forceinline}
    return (inner_kernel if inner else kernel)(_nrt=False, **options)
