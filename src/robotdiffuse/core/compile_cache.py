"""Chooses the folder for compiled code: Numba's own choice, or a temporary folder if that cannot be
written."""

import os
import sys
import tempfile
import warnings
from pathlib import Path


def ensure_cache() -> None:
    """Give Numba a temporary cache folder if it can write neither beside the package nor in the user's cache.

    Numba refuses to compile without a writable cache folder, as in a container with a read-only installation
    and no home. Call this before importing compiled code. NUMBA_CACHE_DIR, if set, takes precedence.
    """
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "numba"
    if os.environ.get("NUMBA_CACHE_DIR") or any(map(is_writable, (Path(__file__).parent, user))):
        return
    folder = Path(tempfile.gettempdir()) / f"robotdiffuse-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        if folder.is_symlink() or folder.stat().st_uid != os.getuid():
            raise PermissionError(f"{folder} belongs to another user")
    except OSError:
        folder = Path(tempfile.mkdtemp(prefix="robotdiffuse-"))
    warnings.warn(
        f"neither the package nor {user} is writable: compiled code is kept in {folder}; "
        "set NUMBA_CACHE_DIR to choose another folder",
        stacklevel=2,
    )
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].core.config.reload_config()


def is_writable(folder: Path) -> bool:
    """Whether a file can be written in the folder; permissions alone do not show that a disk is read-only."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True
