"""Compiled code is kept somewhere, wherever the package is."""

import os
import tempfile
from pathlib import Path

import pytest

from robotdiffuse.core import compile_cache


def test_a_folder_of_temporary_files_where_nothing_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A read-only install without a home ended in a RuntimeError of Numba."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(compile_cache, "_writable", lambda folder: False)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    with pytest.warns(UserWarning, match=f"kept in {tmp_path}.*NUMBA_CACHE_DIR"):
        compile_cache.ensure_cache()
    assert Path(os.environ["NUMBA_CACHE_DIR"]).stat().st_mode & 0o777 == 0o700


def test_what_can_be_written_is_left_to_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    compile_cache.ensure_cache()
    assert "NUMBA_CACHE_DIR" not in os.environ


def test_writable_is_found_by_writing(tmp_path: Path) -> None:
    assert compile_cache._writable(tmp_path / "new" / "folder")
    assert not compile_cache._writable(Path("/proc/nowhere"))
