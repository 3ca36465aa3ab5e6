"""Files written whole or not at all, or line by line; folders that one process fills at a time."""

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from robotdiffuse.core.errors import InputError, shown


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


def check_output(file: str | Path, endings: tuple[str, ...]) -> Path:
    """The file as a path, after a check that it can be written.

    Raises InputError for an ending that is not among `endings` and for a folder that is missing or read-only.
    """
    path = Path(file)
    if path.suffix.lower() not in endings:
        raise InputError(f"{path}: unknown ending {shown(path.suffix)}; known: {', '.join(endings)}")
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a file")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")
    if not os.access(path.parent, os.W_OK) or (path.exists() and not os.access(path, os.W_OK)):
        raise InputError(f"{path} cannot be written: permission denied")
    return path


class JsonLines:
    """JSON objects, one a line; each is on the disk when `append` returns. Without a file, in memory."""

    def __init__(self, file: Path | None) -> None:
        """What is there already, but for a last line that was cut off. Raises InputError, naming file and
        line, for any other line that is no JSON object."""
        self.rows: list[dict[str, Any]] = []
        self._file = file
        self._mended: bytes | None = None
        if file is None or not file.is_file():
            return
        content = file.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]
        for number, line in enumerate(whole.splitlines(), start=1):
            try:
                self.rows.append(dict(json.loads(line)))
            except (ValueError, TypeError) as error:
                raise InputError(f"{file}, line {number} is no JSON object: {error}") from None
        if whole != content:
            self._mended = whole

    def replace(self, rows: list[dict[str, Any]]) -> None:
        """Write these in place of what is there, whole or not at all."""
        self.rows = rows
        if self._file is not None:
            write_atomically(self._file, "".join(json.dumps(row) + "\n" for row in rows), make_folder=True)

    def append(self, row: dict[str, Any]) -> None:
        self.rows.append(row)
        if self._file is None:
            return
        if self._mended is not None:  # only now: another process may be about to end that line
            write_atomically(self._file, self._mended)
            self._mended = None
        self._file.parent.mkdir(parents=True, exist_ok=True)
        with self._file.open("a") as stream:
            stream.write(json.dumps(row) + "\n")
            stream.flush()
            os.fsync(stream.fileno())


@contextmanager
def lock_folder(out: Path) -> Iterator[None]:
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
