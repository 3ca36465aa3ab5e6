"""There is always a folder for compiled code, even in a read-only installation."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from robotdiffuse.core import compile_cache


def test_a_temporary_folder_is_used_if_nothing_else_is_writable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Numba raised RuntimeError in a read-only installation without a home."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(compile_cache, "is_writable", lambda folder: False)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    with pytest.warns(UserWarning, match=f"kept in {tmp_path}.*NUMBA_CACHE_DIR"):
        compile_cache.ensure_cache()
    assert Path(os.environ["NUMBA_CACHE_DIR"]).stat().st_mode & 0o777 == 0o700


def test_a_user_without_a_home_has_no_writable_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """pathlib raised RuntimeError for a user without HOME who is not in the password file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    compile_cache.ensure_cache()
    assert not compile_cache.is_writable(Path("~/.cache/numba"))
    assert not list(tmp_path.iterdir())


def test_numba_chooses_among_writable_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    compile_cache.ensure_cache()
    assert "NUMBA_CACHE_DIR" not in os.environ


def test_a_folder_is_writable_if_a_file_can_be_written(tmp_path: Path) -> None:
    assert compile_cache.is_writable(tmp_path / "new" / "folder")
    assert not compile_cache.is_writable(Path("/proc/nowhere"))


KERNEL = """
from numba import njit

@njit(cache=True)
def first(pair):
    return pair.a
"""
PAIR = """
from typing import NamedTuple

class Pair(NamedTuple):
    a: int
    b: int
"""
CALL = """
from pathlib import Path
from robotdiffuse.core.compile_cache import remove_stale_indexes
remove_stale_indexes(Path("arm").resolve(), Path("cache").resolve())
from arm.{module} import Pair
from arm.kernel import first
print(first(Pair(a=1, b=2)), sum(first.stats.cache_hits.values()))
"""


@pytest.mark.parametrize(
    "chosen",
    [
        pytest.param("", id="beside the sources"),
        pytest.param("cache", id="in NUMBA_CACHE_DIR", marks=pytest.mark.slow),
    ],
)
def test_compiled_code_of_an_older_layout_is_removed(tmp_path: Path, chosen: str) -> None:
    """Numba raised ModuleNotFoundError after modules had moved, and kept the layout of a changed class."""
    package = tmp_path / "arm"
    package.mkdir()
    for name, text in {"__init__": "", "kernel": KERNEL, "pairs": PAIR}.items():
        (package / f"{name}.py").write_text(text)

    def answer(module: str) -> str:
        environment = os.environ | {"NUMBA_CACHE_DIR": chosen and str(tmp_path / chosen)}
        command = [sys.executable, "-c", CALL.format(module=module)]
        ended = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert ended.returncode == 0, ended.stderr
        return ended.stdout.strip()

    assert answer("pairs") == "1 0"
    (package / "pairs.py").rename(package / "moved.py")
    assert answer("moved") == "1 0"
    (package / "moved.py").write_text(PAIR.replace("    a: int\n    b: int", "    b: int\n    a: int"))
    assert answer("moved") == "1 0"
    assert answer("moved") == "1 1"
