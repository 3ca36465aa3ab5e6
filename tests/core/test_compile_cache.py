"""There is always a folder for compiled code, even in a read-only installation."""

import os
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


def test_numba_chooses_among_writable_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    compile_cache.ensure_cache()
    assert "NUMBA_CACHE_DIR" not in os.environ


def testis_writable_is_found_by_writing(tmp_path: Path) -> None:
    assert compile_cache.is_writable(tmp_path / "new" / "folder")
    assert not compile_cache.is_writable(Path("/proc/nowhere"))
