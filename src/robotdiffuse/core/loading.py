"""Loading time: the time spent on compiling code, reading compiled code from the cache, importing modules,
and building the arrays of a robot. The planning time of a call excludes loading time."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class _Clock(threading.local):
    """The time that one thread has spent on loading [s]."""

    loading = compiling = began = 0.0
    depth = 0
    """Number of nested blocks of `loading` that the thread is in."""
    compiles = False
    """Whether code was compiled since the outermost block of `loading` began."""
    noted = 0.0
    """The value of `compiling` at the last `compile_note` [s]."""


_clock = _Clock()
compiled = list[str]()
"""Names of the functions that this process has compiled or is compiling; for reports of progress."""
on_first_compilation: Callable[[], None] | None = None
"""Called when this process begins to compile its first function; then set to None."""


@contextmanager
def loading() -> Iterator[None]:
    """Within the block, the time of this thread is loading time."""
    begin()
    try:
        yield
    finally:
        end()


def begin() -> None:
    """Begin a block of loading time."""
    if _clock.depth == 0:
        _clock.began = time.perf_counter()
        _clock.compiles = False
    _clock.depth += 1


def end() -> None:
    """End a block of loading time."""
    _clock.depth -= 1
    if _clock.depth == 0:
        took = time.perf_counter() - _clock.began
        _clock.loading += took
        _clock.compiling += took if _clock.compiles else 0.0


def compiles(name: str) -> None:
    """Record that this thread compiles a function: the whole block of `loading` is then compile time."""
    global on_first_compilation
    _clock.compiles = True
    compiled.append(name)
    if on_first_compilation is not None:
        call = on_first_compilation
        on_first_compilation = None
        call()


def loading_seconds() -> float:
    """Time that this thread has spent on loading so far [s], including the current block of `loading`."""
    return _clock.loading + (time.perf_counter() - _clock.began if _clock.depth else 0.0)


def compile_seconds() -> float:
    """Time that this thread has spent in outermost blocks of `loading` in which code was compiled [s]."""
    return _clock.compiling


def compile_note() -> str:
    """A note for users on this thread's compile time; empty if nothing was compiled since the last note."""
    if _clock.compiling == _clock.noted:
        return ""
    took = _clock.compiling - _clock.noted
    _clock.noted = _clock.compiling
    return f"compiled for {took:.1f} s, once on this machine; this is not part of the planning time"
