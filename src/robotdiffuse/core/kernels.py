"""Decorators that compile functions with Numba, the folder for compiled code, and the measurement of Numba's
time as loading time (see `loading.py`)."""

import os
import re
import sys
import tempfile
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from hashlib import blake2b
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numba import njit
from numba.core import caching, errors, event

from robotdiffuse.core import loading

# `numba.np.arraymath` imports SciPy only to choose an algorithm for `np.convolve`. This would take 11 % of
# the time of a `plan` command, so the import is made to fail.
BLAS = "scipy.linalg.cython_blas"
if BLAS not in sys.modules:
    sys.modules[BLAS] = None  # pyright: ignore[reportArgumentType]
    try:
        import_module("numba.np.arraymath")
    finally:
        del sys.modules[BLAS]

# Type inference meets thousands of errors in a large function. For each, Numba would let colorama replace
# sys.stdout and sys.stderr and then restore them, even if another thread has replaced them in the meantime.
errors.ColorShell = nullcontext  # type: ignore[misc]


# numbers in single precision, for compiled code
ZERO = np.float32(0.0)
HALF = np.float32(0.5)
ONE = np.float32(1.0)
TINY = np.float32(1e-9)  # against division by zero
# Marks the checksum at the end of a file of compiled code; Numba ignores what follows its own data.
CHECKSUM = b"crc32"
PACKAGE = Path(__file__).parents[1]
MODULE = re.compile(rb"\b%s(?:\.\w+)+" % PACKAGE.name.encode())
IMPORT = re.compile(rb"^from (%s[\w.]*) import (\([^)]*\)|[^\n]*)" % PACKAGE.name.encode(), re.MULTILINE)
NAME = re.compile(rb"\w+")


@cache
def cache_folder() -> Path:
    """The folder for compiled code: NUMBA_CACHE_DIR, or a folder in the user's cache. If it is not writable,
    as in a container without a home, a temporary folder."""
    # unlike Path.expanduser, this leaves ~ as it is for a user without a home
    user = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(user, PACKAGE.name))
    if is_writable(folder):
        return folder
    fallback = Path(tempfile.gettempdir()) / f"{PACKAGE.name}-{os.getuid()}"
    try:
        fallback.mkdir(mode=0o700, exist_ok=True)
        if fallback.is_symlink() or fallback.stat().st_uid != os.getuid():
            raise PermissionError(f"{fallback} belongs to another user")
    except OSError:
        fallback = Path(tempfile.mkdtemp(prefix=f"{PACKAGE.name}-"))
    warnings.warn(
        f"{folder} is not writable: compiled code is kept in {fallback}; set NUMBA_CACHE_DIR to choose "
        "another folder",
        stacklevel=2,
    )
    return fallback


def is_writable(folder: Path) -> bool:
    """Whether a file can be written in the folder, by writing one, since permissions do not show that a disk
    is read-only. False for a path in ~ that was not expanded, because the user has no home."""
    if folder.parts[:1] == ("~",):
        return False
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


class _Locator(caching._SourceFileBackedLocatorMixin, caching._CacheLocator):
    """Tells Numba the folder for the compiled code of one module. The folder's name contains a digest of the
    modules from which the code is compiled, so that only installations with the same modules share it."""

    def __init__(self, function: Callable, file: str) -> None:
        self._py_file = file
        self._lineno = function.__code__.co_firstlineno
        self._module = function.__module__

    @classmethod
    def from_function(cls, py_func: Callable, py_file: str) -> "_Locator":
        return cls(py_func, py_file)

    def get_cache_path(self) -> str:
        return str(cache_folder() / _folder_name(self._module))

    def get_source_stamp(self) -> str:
        return ""


@cache
def _folder_name(module: str) -> str:
    return f"{module.removeprefix(f'{PACKAGE.name}.')}-{_digest(_compiled_from(module))}"


def _compiled_from(module: str) -> set[str]:
    """The modules with code or constants that are compiled into a module: itself and the modules of the
    package that it imports; of these, each that imports `core.kernels` is followed in the same way."""
    modules = set[str]()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in modules:
            continue
        modules.add(name)
        if b".core.kernels import" in _source(name):
            waiting.extend(_imported(name))
    return modules


@cache
def _imported(module: str) -> frozenset[str]:
    """The modules of the package that a module imports, or from which it imports names."""
    imports = [match.groups() for match in IMPORT.finditer(_source(module))]
    parts = {(source + b"." + name).decode() for source, names in imports for name in NAME.findall(names)}
    return frozenset(source.decode() for source, _ in imports).union(filter(_source, parts))


@cache
def _source(module: str) -> bytes:
    """The text of a module of the package; empty if there is no module with this name."""
    file = PACKAGE.parent.joinpath(*module.split("."))
    for source in (file.with_suffix(".py"), file / "__init__.py"):
        with suppress(OSError):
            return source.read_bytes()
    return b""


def _digest(modules: Iterable[str]) -> str:
    """A digest of the texts of modules."""
    return blake2b(b"".join(map(_text_digest, sorted(modules))), digest_size=12).hexdigest()


@cache
def _text_digest(module: str) -> bytes:
    return blake2b(_source(module)).digest()


class _CacheImpl(caching.CompileResultCacheImpl):
    _locator_classes: ClassVar[list] = [_Locator]


class _CacheFile(caching.IndexDataCacheFile):
    """Numba's files of compiled code, with a checksum, because damaged machine code would end the process."""

    def _dump(self, obj: Any) -> bytes:
        data = super()._dump(obj)
        return data + CHECKSUM + zlib.crc32(data).to_bytes(4, "big")

    def _load_data(self, name: str) -> Any:
        content = Path(self._data_path(name)).read_bytes()
        data, marker, checksum = content.rpartition(CHECKSUM)
        if marker and zlib.crc32(data).to_bytes(4, "big") != checksum:
            raise ValueError(f"{name} is damaged")
        return super()._load_data(name)

    def _save_index(self, overloads: dict) -> None:
        self._source_stamp = _named_in(self._dump(overloads))
        super()._save_index(overloads)

    def _load_index(self) -> dict:
        """The index; an empty one if a module that it names has changed, since the module's classes may have
        other fields now."""
        index = Path(self._index_path)
        self._source_stamp = _named_in(index.read_bytes()) if index.is_file() else ""
        return super()._load_index()


def _named_in(index: bytes) -> str:
    """A digest of the modules whose classes are named in the index of a file of compiled code."""
    return _digest({name.decode() for name in MODULE.findall(index)})


class _Cache(caching.FunctionCache):
    """Compiled code of one function, in a folder of the package's own."""

    _impl_class = _CacheImpl

    def __init__(self, function: Callable) -> None:
        super().__init__(function)
        self._cache_file = _CacheFile(self._cache_path, self._impl.filename_base, "")

    @contextmanager
    def _guard_against_spurious_io_errors(self) -> Iterator[None]:
        """Around reading and writing: an error, a full disk too, is ignored, and the function's cached code
        is dropped, so that it is compiled again."""
        try:
            yield
        except Exception:  # pickle raises errors of many kinds
            with suppress(OSError):
                self.flush()


class _Listener(event.Listener):
    """Counts the time of Numba's compiler as loading time: reading from the cache, compiling, writing."""

    def on_start(self, event: event.Event) -> None:
        if event.kind == LOCK:
            loading.begin()
        else:
            loading.compiles(event.data["dispatcher"].__name__)  # type: ignore[index]

    def on_end(self, event: event.Event) -> None:
        if event.kind == LOCK:
            loading.end()


# Events of Numba: its lock is held while it reads from the cache and while it compiles.
LOCK = "numba:compiler_lock"
COMPILE = "numba:compile"
for kind in (LOCK, COMPILE):
    event.register(kind, _Listener())


def kernel(**options: Any) -> Callable[[Callable], Any]:
    """A decorator that compiles a function that Python calls; `options` are those of `numba.njit`."""

    compiler: Any = njit  # the type stubs of njit lack some options

    def compiled(function: Callable) -> Any:
        dispatcher = compiler(no_cfunc_wrapper=True, **options)(function)
        dispatcher._cache = _Cache(function)
        return dispatcher

    return compiled


def inner_kernel(**options: Any) -> Callable[[Callable], Any]:
    """A decorator that compiles a function that only compiled code calls.

    The wrapper by which Python would call the function is left out: for robots and scenes, which are tuples
    of many arrays, the wrapper takes a quarter of the compile time. Numba compiles a called function
    alone, and again in each caller; with a single caller, `inline="always"` saves compiling it alone.
    """

    def compiled(function: Callable) -> Any:
        dispatcher = kernel(no_cpython_wrapper=True, **options)(function)

        def refuse(*_: Any, **__: Any) -> None:
            raise TypeError(f"{function.__name__} is an inner kernel: only compiled code calls it")

        # `_insert` registers no code, so a call from Python goes to `_compile_for_args`, which refuses it. A
        # call of code without a wrapper would end the process.
        dispatcher._insert = lambda *_: None
        dispatcher._compile_for_args = refuse
        return dispatcher

    return compiled


def allocation_free(
    fastmath: bool | set[str] = False, inline: str = "never", forceinline: bool = False, inner: bool = True
) -> Callable[[Callable], Any]:
    """A decorator that compiles a function without Numba's reference counting; an inner kernel by default.

    Counting references to arrays in every call would take two thirds of the collision kernel's time. A
    function without reference counting must not allocate memory or assign an array to a slice.
    """
    options: dict[str, Any] = {"fastmath": fastmath, "inline": inline, "forceinline": forceinline}
    return (inner_kernel if inner else kernel)(_nrt=False, **options)
