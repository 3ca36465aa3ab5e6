"""Chooses the folder for compiled code: Numba's own choice, or a temporary folder if that cannot be
written. Removes compiled code of an older layout of the package."""

import hashlib
import os
import re
import sys
import tempfile
import warnings
from contextlib import suppress
from pathlib import Path

PACKAGE = Path(__file__).parents[1]


def ensure_cache() -> None:
    """Give Numba a temporary cache folder if it can write neither beside the package nor in the user's cache,
    and remove stale indexes from the folders in use.

    Numba refuses to compile without a writable cache folder, as in a container with a read-only installation
    and no home. Call this before importing compiled code. NUMBA_CACHE_DIR, if set, takes precedence.
    """
    # unlike Path.expanduser, this leaves ~ as it is for a user without a home
    user = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "numba"
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    remove_stale_indexes(PACKAGE, Path(chosen or user))
    if chosen or any(map(is_writable, (Path(__file__).parent, user))):
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
    """Whether a file can be written in the folder; permissions alone do not show that a disk is read-only.
    False for ~, a home that is not known."""
    if folder.parts[:1] == ("~",):
        return False
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def remove_stale_indexes(package: Path, cache: Path) -> None:
    """Remove the indexes of compiled code that name a module of the package that is missing or newer.

    Numba unpickles an index before it compares the source, and fails if a class in it has moved; and it loads
    code that was compiled for an older definition of a class in another module. Indexes lie in `__pycache__`
    beside the sources, or in a cache folder for all packages, `cache`.
    """
    module = re.compile(rb"\b%s(?:\.\w+)+" % package.name.encode())
    changed: dict[bytes, float] = {}
    for folder, folders, _ in os.walk(package):
        folders[:] = [name for name in folders if name != "__pycache__"]
        hashed = hashlib.sha1(folder.encode()).hexdigest()
        for place in (Path(folder, "__pycache__"), cache / f"{Path(folder).name}_{hashed}"):
            for index in place.glob("*.nbi"):
                with suppress(OSError):  # another process removed it, or it may not be removed
                    named = set(module.findall(index.read_bytes()))
                    for name in named - changed.keys():
                        changed[name] = _changed(package.parent, name.decode())
                    if any(changed[name] > index.stat().st_mtime for name in named):
                        index.unlink()


def _changed(root: Path, module: str) -> float:
    """The time at which a module's file was changed; infinite if there is no such module."""
    file = root.joinpath(*module.split("."))
    for source in (file.with_suffix(".py"), file / "__init__.py"):
        with suppress(OSError):
            return source.stat().st_mtime
    return float("inf")
