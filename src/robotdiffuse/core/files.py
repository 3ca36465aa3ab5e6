"""Readers of untrusted files (JSON, YAML, XML and NumPy arrays, with bounds on size and nesting), atomic and
line-by-line writing, and locks on output folders.

For any content and any file name the readers return a value or raise InputError. Their time is bounded by the
size of the file: devices and pipes are not opened, nesting deeper than MAX_DEPTH is refused, and the values
that YAML aliases stand for are counted.
"""

import errno
import fcntl
import json
import os
import re
import secrets
import stat
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Any, BinaryIO, NoReturn

import numpy as np
import yaml
from numpy import ndarray

from robotdiffuse.core.errors import (
    MAX_WORD,
    InputError,
    OutputError,
    check_name,
    check_type,
    reading,
    repeated,
    shortened,
    shown,
)

MEGABYTE = 2**20
MAX_FILE_SIZE = 256 * MEGABYTE
MAX_YAML_SIZE = 16 * MEGABYTE
"""Largest size of a YAML file [bytes]. Parsing it takes ten seconds, JSON of this size less than one."""
MAX_DEPTH = 64
"""Deepest nesting of lists and mappings."""
MAX_VALUES = 2_000_000
"""Largest number of values in a YAML file after its aliases are expanded."""
MAX_DIGITS = 30
"""Largest number of digits of an integer."""

JsonObject = dict[str, Any]
"""A JSON object as it is read: values by name."""
_STRING = re.compile(r'"(?:[^"\\]|\\.)*"?')
_closed: ContextVar[bool] = ContextVar("closed", default=False)


@contextmanager
def no_files() -> Iterator[None]:
    """Within the block, `is_file` returns False and `input_file` raises InputError. For HTTP requests,
    which must not read files."""
    before = _closed.set(True)
    try:
        yield
    finally:
        _closed.reset(before)


def file_name(file: Any, what: str = "file") -> Path:
    """The name as a path. Raises InputError, naming `what`, for a value that is neither text nor a path, and
    for a name that is too long or that no file can have."""
    check_type(what, file, (str, os.PathLike), "a file name: a text or a pathlib.Path")
    path = Path(file)
    try:
        os.lstat(path)
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:  # pathlib would raise this OSError later, at the first access
            raise InputError(f"{what} {path}: {error.strerror}") from None
    except ValueError:  # a NUL or half a surrogate pair in the name
        raise InputError(f"{what} {shortened(path, MAX_WORD)} is not a valid file name") from None
    return path


def known_ending(file: str | Path, what: str, endings: Collection[str]) -> str:
    """The file's ending in lower case. Raises InputError, naming `what`, unless it is one of `endings`."""
    ending = file_name(file, what).suffix.lower()
    check_name(f"{what} format of {file}:", ending, endings)
    return ending


def is_file(file: str | Path) -> bool:
    """Whether a regular file of this name exists; False within `no_files`, and for impossible names."""
    try:
        return not _closed.get() and stat.S_ISREG(os.stat(file).st_mode)
    except (OSError, ValueError):
        return False


def input_file(file: str | Path, what: str = "", largest: int = MAX_FILE_SIZE) -> Path:
    """The path of a regular file of at most `largest` bytes; messages put `what` before its name.

    Raises InputError if the file is missing, not regular (a folder, a device, a pipe), too large or not
    readable, if no file can have this name, and within `no_files`.
    """
    named = f"{what} {shortened(file_name(file, what or 'file'), MAX_WORD)}".strip()
    if _closed.get():
        raise InputError(f"{named} is a file, and files are not read here: give its content instead")
    try:
        status = os.stat(file)
        permitted = os.access(file, os.R_OK)
    except FileNotFoundError:
        raise InputError(f"{named} does not exist") from None
    except OSError as error:
        raise InputError(f"{named} cannot be read: {error.strerror}") from None
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a device or a pipe"
        raise InputError(f"{named} cannot be read: it is {kind}; it must be a file")
    if not permitted:
        raise InputError(f"{named} cannot be read: permission denied")
    if status.st_size > largest:
        size = f"{status.st_size / MEGABYTE:.0f} MB"
        raise InputError(f"{named} is too large: it has {size}; at most {largest // MEGABYTE} MB are read")
    return Path(file)


def read_bytes(file: str | Path, what: str = "", largest: int = MAX_FILE_SIZE) -> bytes:
    """The content of a file. Raises InputError as `input_file` does."""
    path = input_file(file, what, largest)
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{what} {path} cannot be read: {error.strerror}".strip()) from None


def read_text(file: str | Path, what: str = "", largest: int = MAX_FILE_SIZE) -> str:
    """The content of a UTF-8 text file. Raises InputError as `input_file` does, and if it is not UTF-8."""
    return decoded(read_bytes(file, what, largest), f"{what} {file}".strip()).replace("\r\n", "\n")


def decoded(content: bytes, where: str) -> str:
    """UTF-8 text. Raises InputError, naming `where`, for other bytes."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{where} is not UTF-8 text: byte {error.start}") from None


def read_arrays(file: str | Path) -> dict[str, ndarray]:
    """The arrays of an .npz file by name. The array of an .npy file has the name "".

    Raises InputError as `input_file` does, for damaged files, and for archives that unpack to more than
    MAX_FILE_SIZE.
    """
    path = input_file(file)
    with reading(file):
        if path.suffix.lower() != ".npz":
            with path.open("rb") as stream:  # np.load would open a zip archive with any ending
                return {"": np.lib.format.read_array(stream, allow_pickle=False)}
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > MAX_FILE_SIZE:
            limit = MAX_FILE_SIZE // MEGABYTE
            raise InputError(f"{file} unpacks to {size // MEGABYTE} MB; at most {limit} MB are read")
        with np.load(path, allow_pickle=False) as arrays:
            content = {name: arrays[name] for name in arrays.files}
        for name, value in content.items():  # np.load gives other members of the archive as bytes
            check_type(name, value, ndarray, "an array")
        return content


def read_array(file: str | Path, name: str) -> ndarray:
    """The array of an .npy file; of an .npz file the array with this name, or its only array.

    Raises InputError as `read_arrays` does, and if no array has this name, unless there is only one array.
    """
    arrays = read_arrays(file)
    if name not in arrays and len(arrays) != 1:
        raise InputError(f"{file} holds {shown([*arrays])}; one must be named {name}")
    return arrays.get(name, next(iter(arrays.values())))


def read_json(file: str | Path) -> Any:
    """The content of a JSON file. Raises InputError as `read_text` and `parse_json` do."""
    return parse_json(read_text(file), str(file))


def parse_json(text: str, where: str) -> Any:
    """The value of a JSON text. Raises InputError, naming `where`, for invalid or too deeply nested JSON, for
    a key that appears twice and for integers of more than MAX_DIGITS digits."""
    if text.count("[") + text.count("{") > MAX_DEPTH:
        marks = np.frombuffer(_STRING.sub("", text).encode("utf-8", "replace"), np.uint8)
        opened = (marks == ord("[")) | (marks == ord("{"))
        closed = (marks == ord("]")) | (marks == ord("}"))
        if (np.cumsum(opened.astype(np.int64) - closed)).max(initial=0) > MAX_DEPTH:
            _too_deep(where)
    try:
        return json.loads(
            text,
            parse_int=lambda digits: int(_checked_digits(digits, where)),
            object_pairs_hook=lambda pairs: _object(pairs, where),
        )
    except json.JSONDecodeError as error:
        at = f"line {error.lineno}, column {error.colno}"
        raise InputError(f"{where} is not valid JSON: {error.msg} at {at}") from None
    except RecursionError:
        _too_deep(where)


def read_yaml(file: str | Path, what: str = "") -> Any:
    """The content of a YAML (or JSON) file. Raises InputError as `read_text` and `parse_yaml` do."""
    return parse_yaml(read_text(file, what, MAX_YAML_SIZE), str(file))


def parse_yaml(text: str, where: str) -> Any:
    """The value of a YAML text: null, booleans, numbers, strings, lists, and mappings with string keys.

    Dates are strings. Raises InputError, naming `where`, for invalid, too deeply nested or too large YAML and
    for tags.
    """
    try:
        loader = _Loader(text)
        try:
            return _Composer(loader, where).document()
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        raise InputError(f"{where} is not valid YAML: {_reason(error)}") from None
    except UnicodeEncodeError:
        raise InputError(
            f"{where} is not valid YAML: it contains invalid Unicode (an unpaired surrogate)"
        ) from None


def parse_xml(text: bytes, where: str) -> ET.Element:
    """The root of an XML text. Raises InputError, naming `where`, if it is not well-formed, too deeply nested
    or in an unknown encoding. As in MuJoCo and ROS, comments may contain "--", and stand before the
    declaration."""
    text = re.sub(rb"<!--.*?(-->|\Z)", lambda comment: b"\n" * comment[0].count(b"\n"), text, flags=re.DOTALL)
    depth = 0
    parser = ET.XMLPullParser(("start", "end"))
    try:
        parser.feed(text.lstrip())
        parser.close()
        events: list[Any] = list(parser.read_events())
        for event, _ in events:
            depth += 1 if event == "start" else -1
            if depth > MAX_DEPTH:
                _too_deep(where)
    except (ET.ParseError, ValueError, LookupError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{where} is not well-formed XML: {shortened(error, MAX_WORD)}") from None
    return events[0][1]


class _Loader(yaml.CSafeLoader):
    """Reads 1e-3 and 2.5e3 as numbers; in YAML 1.1 they are strings."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"),
    list("-+.0123456789"),
)


class _Composer:
    """Builds values from parser events, because libyaml's own composer recurses without bounds."""

    def __init__(self, loader: _Loader, where: str) -> None:
        self.loader = loader
        self.where = where
        self.count = 0
        self.anchors = dict[str, tuple[Any, int]]()
        """Value of each anchor, and the number of values that it contains, itself included."""

    def document(self) -> Any:
        loader = self.loader
        value = None
        loader.get_event()  # the start of the stream
        if not loader.check_event(yaml.StreamEndEvent):
            loader.get_event()
            value = self._node(0)
            loader.get_event()
            second_document = None
            if loader.check_event(yaml.DocumentStartEvent):  # `ros2 topic echo` ends messages with ---
                loader.get_event()
                second_document = self._node(0)
                loader.get_event()
            if second_document is not None or not loader.check_event(yaml.StreamEndEvent):
                raise InputError(f"{self.where} is not valid YAML: it holds more than one document")
        return value

    def _node(self, depth: int) -> Any:
        event = self._event()
        begun = self.count
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in self.anchors:
                self._refuse(event, f"alias {shown(event.anchor)} has no anchor before it")
            value, size = self.anchors[event.anchor]
            self.count += size
        else:
            value = self._value(event, depth)
            self.count += 1
        if self.count > MAX_VALUES:
            self._refuse(event, f"with aliases expanded, it stands for more than {MAX_VALUES:,} values")
        if event.anchor is not None:
            self.anchors[event.anchor] = value, self.count - begun
        return value

    def _value(self, event: Any, depth: int) -> Any:
        loader = self.loader
        if isinstance(event, yaml.ScalarEvent):
            return self._scalar(event)
        if depth >= MAX_DEPTH:
            _too_deep(self.where)
        if isinstance(event, yaml.SequenceStartEvent):
            values = []
            while not loader.check_event(yaml.SequenceEndEvent):
                values.append(self._node(depth + 1))
            loader.get_event()
            return values
        mapping: JsonObject = {}
        while not loader.check_event(yaml.MappingEndEvent):
            key = self._event()
            if not isinstance(key, yaml.ScalarEvent):
                self._refuse(key, "a key is not a plain string")
            if key.value in mapping:
                self._refuse(key, f"{key.value} appears twice")
            mapping[key.value] = self._node(depth + 1)
        loader.get_event()
        return mapping

    def _event(self) -> Any:
        event: Any = self.loader.get_event()
        if getattr(event, "tag", None) is not None:
            self._refuse(event, f"tag {shown(event.tag)} is not supported")
        return event

    def _scalar(self, event: yaml.ScalarEvent) -> Any:
        text = event.value
        if not event.implicit[0]:
            return text
        kind = self.loader.resolve(yaml.ScalarNode, text, event.implicit).rpartition(":")[2]
        if kind not in ("null", "bool", "float", "int"):
            return text
        if kind == "int":
            _checked_digits(text, self.where)
        try:
            return getattr(self.loader, f"construct_yaml_{kind}")(yaml.ScalarNode("", text))
        except ValueError:  # 0x_ has no digits
            self._refuse(event, f"{shown(text)} is not a number")

    def _refuse(self, event: Any, why: str) -> NoReturn:
        raise InputError(f"{self.where} is not valid YAML: {why} in line {event.start_mark.line + 1}")


def _reason(error: yaml.YAMLError) -> str:
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        mark = error.problem_mark
        return f"{shortened(error.problem or '')} in line {mark.line + 1}, column {mark.column + 1}"
    return shortened(error, MAX_WORD)


def _object(pairs: list[tuple[str, Any]], where: str) -> JsonObject:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        twice = repeated(name for name, _ in pairs)[0]
        raise InputError(f"{where} is not valid JSON: {shortened(twice)} appears twice")
    return mapping


def _checked_digits(text: str, where: str) -> str:
    if len(text) > MAX_DIGITS:
        raise InputError(f"{where} holds the integer {shortened(text)}; no field takes such a large number")
    return text


def _too_deep(where: str) -> NoReturn:
    raise InputError(f"{where} is nested more than {MAX_DEPTH} levels deep")


# Errors of the disk (full, over a quota, file too large, input/output error): another file name would not
# help.
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
    """Write a temporary file and rename it to `file`, or to the file that the link `file` names, so that no
    reader sees `file` half written.

    content: text, bytes, or a function that writes to the stream that it is given.
    make_folder: whether to make the folder of `file` if it does not exist.

    If writing fails or is interrupted, an existing `file` keeps its content. Raises InputError if the file
    cannot be written, and its subclass OutputError for an error of the disk, such as a full one.
    """
    with writing(file):
        target = Path(
            os.path.realpath(file_name(file))
        )  # a link stays, and the file that it names is replaced
        temporary = target.with_name(f".{target.name}.{secrets.token_hex(8)}.tmp")
        if make_folder:
            target.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("wb") as stream:
                if callable(content):
                    content(stream)
                else:
                    stream.write(content.encode("utf-8", "replace") if isinstance(content, str) else content)
            temporary.replace(target)
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
    with writing(out):  # `realpath` raises OSError if the current folder was deleted
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
        with file.open("a+b", buffering=0) as stream:
            size = stream.seek(0, os.SEEK_END)
            stream.seek(max(size - 1, 0))
            begin = "" if stream.read(1) in (b"", b"\n") else "\n"  # the last line may lack its end
            unwritten = memoryview(f"{begin}{line}\n".encode())
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
        self.rows = list[JsonObject]()
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

    def replace(self, rows: list[JsonObject]) -> None:
        """Replace all rows, atomically."""
        self.rows = rows
        if self._file is not None:
            write_atomically(self._file, "".join(json.dumps(row) + "\n" for row in rows), make_folder=True)

    def append(self, row: JsonObject) -> None:
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
    with writing(out):
        new_folders = [folder for folder in (out, *out.parents) if not folder.exists()]
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
