"""Compiled code: what it leaves alone, and damaged files of it."""

import io
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from numba.core.errors import TypingError

from robotdiffuse.core import kernels
from robotdiffuse.core.kernels import kernel


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_compiling_in_a_thread_leaves_the_streams_alone(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Output of the tests went elsewhere: Numba let colorama replace both streams for each error that type
    inference meets, and restore what they had been, though another thread had set others since."""
    streams: list[io.StringIO] = []

    class Stream(io.StringIO):
        def isatty(self) -> bool:  # colorama asks while Numba makes an error's message
            streams.append(io.StringIO())
            setattr(sys, name, streams[-1])
            return False

    streams.append(Stream())
    monkeypatch.setattr(sys, name, streams[-1])
    with ThreadPoolExecutor(1) as pool, pytest.raises(TypingError):
        pool.submit(kernel()(lambda number: number.nothing), 1.0).result()
    assert getattr(sys, name) is streams[-1]


def triple(number: float) -> float:
    return 3 * number


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "cut": lambda content: content[: len(content) // 2],
    "empty": lambda content: b"",
    "zeros at its end": lambda content: content[: len(content) // 2].ljust(len(content), b"\0"),
    "zeros within": lambda content: content[:-3000] + bytes(2000) + content[-1000:],
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_damaged_files_of_compiled_code_are_compiled_anew(
    damage: str, ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A truncated file was a traceback in every run until somebody deleted it."""
    monkeypatch.setattr(kernels, "cache_folder", lambda: tmp_path)

    def hits() -> int:
        compiled: Any = kernel()(triple)
        assert compiled(1.0) == 3.0
        return sum(compiled.stats.cache_hits.values())

    assert [hits(), hits()] == [0, 1]
    (file,) = tmp_path.rglob(f"*.{ending}")
    file.write_bytes(DAMAGE[damage](file.read_bytes()))
    assert [hits(), hits()] == [0, 1]


def test_compiled_code_runs_where_it_cannot_be_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk ended a plan with an error."""
    folder = tmp_path / "folder"
    folder.write_text("this is no folder")
    monkeypatch.setattr(kernels, "cache_folder", lambda: folder)
    compiled: Any = kernel()(triple)
    assert compiled(1.0) == 3.0
