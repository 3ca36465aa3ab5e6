"""The cache of compiled code: there is always a folder for it, even in a read-only installation; damaged files."""

import io
import os
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numba
import pytest
from numba.core.errors import TypingError

from helpers.commands import python
from robotdiffuse.core import kernels
from robotdiffuse.core.kernels import kernel


@pytest.fixture(autouse=True)
def fresh() -> None:
    kernels.cache_folder.cache_clear()


def test_the_supported_version_of_numba_is_installed() -> None:
    """`core.kernels` and `collision.kernels.simd` use internals of Numba, which may change between versions."""
    assert numba.__version__.startswith("0.68."), "port core/kernels.py and collision/kernels/simd.py first"


def test_compiled_code_has_a_writable_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert kernels.cache_folder() == tmp_path / "robotdiffuse"
    assert kernels.is_writable(tmp_path / "new" / "folder")
    assert not kernels.is_writable(Path("/proc/nowhere"))


def test_a_temporary_folder_is_used_if_nothing_else_is_writable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: Numba raised RuntimeError in a read-only installation without a home folder."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(kernels, "is_writable", lambda folder: False)
    with pytest.warns(UserWarning, match=f"kept in {tmp_path}.*NUMBA_CACHE_DIR"):
        folder = kernels.cache_folder()
    assert folder.stat().st_mode & 0o777 == 0o700


def test_a_user_without_a_home_has_no_writable_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: pathlib raised RuntimeError for a user without HOME who is not in the password file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    with pytest.warns(UserWarning, match="is not writable"):
        kernels.cache_folder()
    assert [path.name for path in tmp_path.iterdir()] == ["temporary"]


def test_importing_the_package_touches_no_file(tmp_path: Path) -> None:
    """Regression: the import removed files of the user's cache, also those of other packages."""
    python("import robotdiffuse", XDG_CACHE_HOME=str(tmp_path / "cache"), NUMBA_CACHE_DIR="")
    assert not list(tmp_path.iterdir())


FILES = {
    "__init__": "",
    "sizes": "SIZE = 1",
    "called": """
from arm.sizes import SIZE
from robotdiffuse.core.kernels import kernel
@kernel()
def second(pair):
    return pair.a * SIZE
""",
    "kernel": """
from arm.called import second
from robotdiffuse.core.kernels import kernel
@kernel()
def first(pair):
    return second(pair)
""",
    "pairs": "from typing import NamedTuple\nclass Pair(NamedTuple):\n    a: int\n    b: int\n",
}
CALL = """
import re
from pathlib import Path
from robotdiffuse.core import kernels
kernels.PACKAGE = Path("arm").resolve()
kernels.MODULE = re.compile(rb"\\barm(?:\\.\\w+)+")
kernels.IMPORT = re.compile(kernels.IMPORT.pattern.replace(b"robotdiffuse", b"(?:arm|robotdiffuse)"), re.M)
from arm.{module} import Pair
from arm.kernel import first
print(first(Pair(a=1, b=2)), sum(first.stats.cache_hits.values()))
"""


def test_what_compiled_code_depends_on_makes_it_compile_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: Numba failed after modules had moved, and kept old layouts of classes and old code of other modules."""
    package = tmp_path / "here" / "arm"

    def write(**files: str) -> None:
        package.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (package / f"{name}.py").write_text(text)

    def answer(module: str = "pairs") -> str:
        monkeypatch.chdir(package.parent)
        return python(CALL.format(module=module), NUMBA_CACHE_DIR=str(tmp_path / "cache")).stdout.strip()

    write(**FILES)
    assert [answer(), answer()] == ["1 0", "1 1"]
    write(sizes="SIZE = 3")
    assert answer() == "3 0"
    write(called=FILES["called"].replace("*", "+"))
    assert answer() == "4 0"
    (package / "pairs.py").rename(package / "moved.py")
    assert answer("moved") == "4 0"
    write(moved=FILES["pairs"].replace("    a: int\n    b: int", "    b: int\n    a: int"))
    assert answer("moved") == "4 0"
    package.parent.rename(tmp_path / "there")
    package = tmp_path / "there" / "arm"
    assert answer("moved") == "4 1"


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_compiling_in_a_thread_leaves_the_streams_alone(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: for each error of type inference, Numba lets colorama replace both streams and restores the previous ones."""
    streams: list[io.StringIO] = []

    class Stream(io.StringIO):
        def isatty(self) -> bool:  # colorama asks while Numba makes an error's message
            streams.append(io.StringIO())
            setattr(sys, name, streams[-1])
            return False

    streams.append(Stream())
    monkeypatch.setattr(sys, name, streams[-1])
    with ThreadPoolExecutor(1) as pool, pytest.raises(TypingError):
        pool.submit(kernel()(lambda number: number.nothing), 1.0).result()
    assert getattr(sys, name) is streams[-1]


def triple(number: float) -> float:
    return 3 * number


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "cut": lambda content: content[: len(content) // 2],
    "empty": lambda content: b"",
    "zeros at its end": lambda content: content[: len(content) // 2].ljust(len(content), b"\0"),
    "zeros within": lambda content: content[:-3000] + bytes(2000) + content[-1000:],
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_damaged_files_are_compiled_anew(damage: str, ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: a truncated file caused a traceback in every run until somebody deleted it."""
    monkeypatch.setattr(kernels, "cache_folder", lambda: tmp_path)

    def hits() -> int:
        compiled: Any = kernel()(triple)
        assert compiled(1.0) == 3.0
        return sum(compiled.stats.cache_hits.values())

    assert [hits(), hits()] == [0, 1]
    (file,) = tmp_path.rglob(f"*.{ending}")
    file.write_bytes(DAMAGE[damage](file.read_bytes()))
    assert [hits(), hits()] == [0, 1]


def test_compiled_code_runs_where_it_cannot_be_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: a full disk ended a plan with an error."""
    folder = tmp_path / "folder"
    folder.write_text("this is no folder")
    monkeypatch.setattr(kernels, "cache_folder", lambda: folder)
    compiled: Any = kernel()(triple)
    assert compiled(1.0) == 3.0
