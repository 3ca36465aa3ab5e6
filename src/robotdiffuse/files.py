"""Files that are written whole or not at all, and folders that one process fills at a time."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from robotdiffuse.errors import InputError


def write_atomically(file: Path, content: str | bytes, make_folder: bool = False) -> None:
    """Write beside the file, then rename over it, so that nobody sees it half written.

    An interruption or a full disk leaves the old file, or none. Raises InputError when it cannot be written.
    """
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        if make_folder:
            file.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.write_bytes(content.encode() if isinstance(content, str) else content)
            temporary.replace(file)
        except OSError:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise InputError(f"{file} cannot be written: {error.strerror or error}") from None


@contextmanager
def alone_in(out: Path) -> Iterator[None]:
    """Make the folder and lock it; the lock ends with this process, however that ends.

    Raises InputError if another process has the lock, or there can be no such folder.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        folder = os.open(out, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        why = "it is a file" if isinstance(error, FileExistsError) else error.strerror
        raise InputError(f"cannot use the folder {out}: {why}") from None
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"another process is filling {out}; wait for it") from None
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(folder)
