"""Where compiled code is kept: beside the package, or in the user's cache; where neither can be written, for
as long as the machine is up."""

import os
import sys
import tempfile
import warnings
from pathlib import Path


def ensure_cache() -> None:
    """Give Numba a folder of temporary files where it would find no folder to write to, and refuse to work.

    So it is in a container or a service with a read-only installation and no home. To be called before
    anything compiled is imported; NUMBA_CACHE_DIR, where it is set, is obeyed.
    """
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "numba"
    if os.environ.get("NUMBA_CACHE_DIR") or any(map(_writable, (Path(__file__).parent, user))):
        return
    folder = Path(tempfile.gettempdir()) / f"robotdiffuse-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        if folder.is_symlink() or folder.stat().st_uid != os.getuid():
            raise PermissionError(f"{folder} is somebody else's")
    except OSError:
        folder = Path(tempfile.mkdtemp(prefix="robotdiffuse-"))
    warnings.warn(
        f"neither the package nor {user} can be written to: compiled code is kept in {folder}; "
        "NUMBA_CACHE_DIR names another folder",
        stacklevel=2,
    )
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].core.config.reload_config()


def _writable(folder: Path) -> bool:
    """Found by writing: permissions do not tell of a read-only disk."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True
