"""Atomic and line-by-line writing of files, and locks on output folders."""

import errno
import fcntl
import json
import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Any, BinaryIO

from robotdiffuse.core.errors import InputError, OutputError, shown
from robotdiffuse.core.input_files import file_name

# Errors of the disk (full, over a quota, file too large, input/output error), which another file name would
# not avoid.
DISK_FAILURES = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


@contextmanager
def writing(file: Path) -> Iterator[None]:
    """Within the block, an OSError becomes the error for a file or folder that could not be written:
    OutputError for an error of the disk, such as a full one, otherwise InputError."""
    try:
        yield
    except OSError as error:
        kind = OutputError if error.errno in DISK_FAILURES else InputError
        raise kind(f"{file} cannot be written: {error.strerror or error}") from None


def write_atomically(
    file: Path, content: str | bytes | Callable[[BinaryIO], object], make_folder: bool = False
) -> None:
    """Write a temporary file and rename it to `file`, so that no reader sees `file` half written.

    content: text, bytes, or a function that writes to the stream that it is given.
    make_folder: whether to make the folder of `file` if it does not exist.

    If writing fails or is interrupted, an existing `file` keeps its content. Raises InputError if the file
    cannot be written, and its subclass OutputError for an error of the disk, such as a full one.
    """
    temporary = file.with_name(f".{file.name}.{secrets.token_hex(8)}.tmp")
    with writing(file):
        if make_folder:
            file.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("wb") as stream:
                if callable(content):
                    content(stream)
                else:
                    stream.write(content.encode("utf-8", "replace") if isinstance(content, str) else content)
            temporary.replace(file)
        except BaseException:
            with suppress(OSError):
                temporary.unlink()
            raise


@contextmanager
def replaced_folder(target: Path) -> Iterator[Path]:
    """Yields a path at which the block makes a folder. At the end of the block, the folder replaces `target`.
    If the block or the replacement fails, an existing `target` stays.

    Raises InputError as `write_atomically` does.
    """
    with writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(
            prefix=f".{target.name}.", dir=target.parent, ignore_cleanup_errors=True
        ) as scratch:
            new = Path(scratch, target.name)
            old = Path(scratch, f"{target.name}.old")
            yield new
            try:
                with suppress(FileNotFoundError):
                    target.replace(old)
                new.replace(target)
            except BaseException:
                with suppress(OSError):
                    old.replace(target)
                raise


def check_not_input(out: Path, *inputs: str | None) -> None:
    """Raise InputError if the file or folder `out` is one of the inputs."""
    with writing(out):  # a relative path in a deleted folder cannot be
        if os.path.realpath(out) in map(os.path.realpath, filter(None, inputs)):
            raise InputError(f"{out} is an input of this command; name another output")


def check_output(file: str | Path, endings: tuple[str, ...], *inputs: str | None) -> Path:
    """The file as a path, after checking that it can be written.

    Raises InputError for an ending that is not in `endings`, for the name of a folder, if the file or its
    folder is read-only, if its folder is missing, and if it would replace one of the files `inputs`. Raises
    the subclass OutputError for a full disk.
    """
    path = file_name(file)
    check_not_input(path, *inputs)
    if path.suffix.lower() not in endings:
        raise InputError(f"{path}: unknown ending {shown(path.suffix)}; known: {', '.join(endings)}")
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a file")
    if not path.parent.is_dir():
        why = "is a file, not a folder" if path.parent.exists() else "does not exist"
        raise InputError(f"{path}: the folder {path.parent} {why}")
    with writing(path):
        TemporaryFile(dir=path.parent).close()
        if path.exists() and not os.access(path, os.W_OK):
            raise PermissionError("permission denied")
    return path


def append_line(file: Path, line: str, make_folder: bool = False) -> None:
    """Append a line to `file` and flush it to the disk. `make_folder` as for `write_atomically`.

    If writing fails, an existing `file` keeps its content. Raises InputError as `write_atomically` does.
    """
    with writing(file):
        if make_folder:
            file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("ab", buffering=0) as stream:
            size = stream.seek(0, os.SEEK_END)
            unwritten = memoryview(f"{line}\n".encode())
            try:
                while unwritten:
                    unwritten = unwritten[stream.write(unwritten) :]
                os.fsync(stream.fileno())
            except BaseException:
                stream.truncate(size)
                raise


class JsonLines:
    """A file of JSON objects, one per line. `append` returns once the row is on disk. If `file` is None, rows
    are kept in memory only."""

    def __init__(self, file: Path | None) -> None:
        """Read the existing rows. A last line without a line break, as a killed process leaves, is ignored.

        Raises InputError, naming file and line, for a complete line that is not a JSON object.
        """
        self.rows: list[dict[str, Any]] = []
        self._file = file
        self._without_cut_line: bytes | None = None
        if file is None or not file.is_file():
            return
        content = file.read_bytes()
        complete_lines = content[: content.rfind(b"\n") + 1]
        for number, line in enumerate(complete_lines.splitlines(), start=1):
            try:
                self.rows.append(dict(json.loads(line)))
            except (ValueError, TypeError) as error:
                raise InputError(f"{file}, line {number} is not a JSON object: {error}") from None
        if complete_lines != content:
            self._without_cut_line = complete_lines

    def replace(self, rows: list[dict[str, Any]]) -> None:
        """Replace all rows, atomically."""
        self.rows = rows
        if self._file is not None:
            write_atomically(self._file, "".join(json.dumps(row) + "\n" for row in rows), make_folder=True)

    def append(self, row: dict[str, Any]) -> None:
        """Add a row and flush it to the disk. If writing fails, the row is in neither the file nor `rows`."""
        if self._file is not None:
            if self._without_cut_line is not None:
                # The incomplete line is removed only now: at reading, another process could still be writing
                # it.
                write_atomically(self._file, self._without_cut_line)
                self._without_cut_line = None
            append_line(self._file, json.dumps(row), make_folder=True)
        self.rows.append(row)


@contextmanager
def lock_folder(out: Path) -> Iterator[None]:
    """Make the folder, and lock it during the block. The lock is also released if the process is killed.
    Temporary files that a killed process left (see `write_atomically`) are removed. At the end of the block,
    folders that were made here and are still empty are removed.

    Raises InputError if another process holds the lock or the folder cannot be made or written into.
    """
    new_folders = [folder for folder in (out, *out.parents) if not folder.exists()]
    with writing(out):
        try:
            out.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            raise InputError(f"cannot use the folder {out}: it is a file, or a link to nothing") from None
        TemporaryFile(dir=out).close()
        folder = os.open(out, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"another process is filling {out}; wait for it") from None
        except OSError:
            pass  # this file system has no locks
        for leftover in out.glob(f".*.{'[0-9a-f]' * 16}.tmp"):
            leftover.unlink(missing_ok=True)
        yield
    finally:
        os.close(folder)
        with suppress(OSError):  # one is not empty
            for empty in new_folders:
                empty.rmdir()
