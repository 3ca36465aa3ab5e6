"""Compiling leaves alone what belongs to the whole process."""

import io
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from numba.core.errors import TypingError

from robotdiffuse.core.kernels import kernel


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_compiling_in_a_thread_leaves_the_streams_alone(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first run of the tests printed elsewhere: Numba had colorama replace both streams for each error that
    type inference meets, and then set what they had been, though another thread had set others since."""
    streams: list[io.StringIO] = []

    class Stream(io.StringIO):
        def isatty(self) -> bool:  # colorama asks while Numba makes an error's message
            streams.append(io.StringIO())
            setattr(sys, name, streams[-1])
            return False

    streams.append(Stream())
    monkeypatch.setattr(sys, name, streams[-1])
    with ThreadPoolExecutor(1) as pool, pytest.raises(TypingError):
        pool.submit(kernel(cache=False)(lambda number: number.nothing), 1.0).result()
    assert getattr(sys, name) is streams[-1]
