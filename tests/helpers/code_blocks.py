"""The code blocks of Markdown pages, tried in order in one empty folder and with one set of Python names.

Comments before a block, which pages do not show, say more about it:

    <!-- file: NAME -->    the block is the content of this file, for what comes after it
    <!-- needs: NAME -->   one of PREPARED is put into the folder first
    <!-- test: run -->     commands are run, not only looked at
    <!-- test: parse -->   Python is compiled, not run
    <!-- test: unsolved -->   it shows a problem that cannot be solved; the results of all other blocks must be solved

A language that TRIED lacks is an error, so that no block goes untested in silence.
"""

import re
import shlex
import shutil
import subprocess
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml

from helpers.quick_preparation import QUICK, coarse_grids
from robotdiffuse.cli import build_parser, main
from robotdiffuse.core.types import PlanResult
from robotdiffuse.problems.files import load_problem
from robotdiffuse.robots.fitting.preparation import add_robot

ROOT = Path(__file__).parents[2]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CONVENTIONS.md")),
    *(page for page in sorted((ROOT / "docs").rglob("*.md")) if page.name != "extending.md"),
]
FENCE = re.compile(r"^( *)```(\S*)\s*$")
MARK = re.compile(r"^ *<!-- (file|needs|test): (.+?) -->\s*$")


@dataclass(frozen=True)
class Block:
    where: str
    line: int
    """Number of its first line of code, from 1."""
    language: str
    code: str
    marks: dict[str, str]
    needs: tuple[str, ...] = ()


def code_blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page, in order."""
    blocks: list[Block] = []
    marks: dict[str, str] = {}
    needs: list[str] = []
    opened: tuple[int, str, int] | None = None
    lines = page.read_text(encoding="utf-8").split("\n")
    for i, text in enumerate(lines):
        fence = FENCE.match(text)
        mark = MARK.match(text)
        if opened is None and fence:
            opened = i + 1, fence.group(2), len(fence.group(1))
        elif opened is not None and fence:
            begin, language, indent = opened
            code = "".join(line[indent:] + "\n" for line in lines[begin:i])
            blocks.append(Block(f"{page.relative_to(ROOT)}:{begin + 1}", begin + 1, language, code, marks, tuple(needs)))
            opened, marks, needs = None, {}, []
        elif opened is None and mark and mark.group(1) == "needs":
            needs.append(mark.group(2))
        elif opened is None and mark:
            marks[mark.group(1)] = mark.group(2)
        elif opened is None and text.strip():
            assert not marks and not needs, f"{page}:{i + 1}: the comment before it belongs to a code block"
    assert opened is None, f"{page}: a code block has no end"
    return blocks


def a_cloud(folder: Path) -> None:
    """Writes cloud.ply: the points of a wall beside the arm."""
    side = np.linspace(-0.3, 0.3, 30)
    trimesh.PointCloud(np.stack(np.meshgrid([0.8], side, side + 0.4), axis=-1).reshape(-1, 3)).export(folder / "cloud.ply")


@cache
def _rop(home: Path) -> Path:
    assert main(["data", "generate", "--trajectories", "12", "--shard", "4", "--workers", "1", "--out", str(home / "rop")]) == 0
    return home / "rop"


def rop_data(folder: Path) -> None:
    """Writes rop: a data set of 12 motions."""
    shutil.copytree(_rop(folder.parent), folder / "rop")


def arm(urdf: str, **how: Any) -> None:
    """Prepares the robot of a URDF with few, large spheres, since `robot add` takes a minute."""
    with coarse_grids():
        add_robot(urdf, settings=QUICK, **how)


MOTION_BENCH_MAKER = "motion_bench_maker"
PREPARED: dict[str, Callable[[Path], object]] = {
    "cloud.ply": a_cloud,
    "rop": rop_data,
    "shelf.stl": lambda folder: trimesh.creation.box((0.3, 0.8, 0.02)).export(folder / "shelf.stl"),
    "bench_arm": lambda _: arm("arm.urdf", base="base", limits="joint_limits.yaml"),
    "example_arm": lambda _: arm("examples/data/arm.urdf"),
    MOTION_BENCH_MAKER: lambda folder: shutil.copytree(ROOT / "tests/files" / MOTION_BENCH_MAKER, folder / MOTION_BENCH_MAKER),
}


@dataclass
class Notebook:
    """The state of a page while its blocks are tried: its folder, and the Python names defined so far."""

    folder: Path
    names: dict[str, Any] = field(default_factory=lambda: {"__name__": "__main__"})

    def try_block(self, block: Block) -> None:
        """Tries a block. Raises an error if something is wrong with it."""
        for name in block.needs:
            PREPARED[name](self.folder)
        if "file" in block.marks:
            (self.folder / block.marks["file"]).write_text(block.code, encoding="utf-8")
        elif block.language not in TRIED:
            raise AssertionError(f"no test for {block.language!r}; known: {', '.join(TRIED)}")
        if block.language in TRIED:
            TRIED[block.language](self, block)


def _python(page: Notebook, block: Block) -> None:
    if "file" in block.marks or block.marks.get("test") == "parse":
        compile(block.code, block.where, "exec")
        return
    before = dict(page.names)
    exec(compile("\n" * (block.line - 1) + block.code, block.where, "exec"), page.names)
    made = [value for name, value in page.names.items() if value is not before.get(name)]
    unsolved = [value for value in made if isinstance(value, PlanResult) and not value.solved]
    assert bool(unsolved) == (block.marks.get("test") == "unsolved"), unsolved


def _yaml(page: Notebook, block: Block) -> None:
    data = yaml.safe_load(block.code)
    if isinstance(data, dict) and "robot" in data:
        file = page.folder / block.marks.get("file", "block.yaml")
        file.write_text(block.code, encoding="utf-8")
        load_problem(file)
    else:
        assert "file" in block.marks, "neither a problem nor a file for what comes after it"


def _content(page: Notebook, block: Block) -> None:
    assert "file" in block.marks, "not a file for what comes after it"


def _sh(page: Notebook, block: Block) -> None:
    for line in block.code.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words:
            _command(words, block.marks.get("test") == "run")


def _command(words: list[str], run: bool) -> None:
    program = Path(words[0]).name
    if "robotdiffuse" in words and program in ("python", "torchrun"):
        at = words.index("robotdiffuse")
        assert words[at - 1] == "-m", f"{' '.join(words)}: robotdiffuse is a module"
        program = "robotdiffuse"
        words = words[at:]
    if program == "robotdiffuse":
        build_parser().parse_args(words[1:])
        if run:
            assert main(words[1:]) == 0, " ".join(words)
        return
    assert not run, f"{program} is not run by tests"
    if program == "make":
        subprocess.run(["make", "-n", *words[1:]], cwd=ROOT, check=True, capture_output=True)
    elif program == "pip":
        _pip(words)
    elif words[1:3] == ["-m", "venv"] or words == ["source", ".venv/bin/activate"]:
        pass
    elif program == "python":
        assert (ROOT / words[1]).is_file(), f"{words[1]} does not exist"
    else:
        raise AssertionError(f"no test for the command {program!r}")


def _pip(words: list[str]) -> None:
    """Checks that the extras of a pip command exist."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for word in words:
        for extra in re.findall(r"\[(.+)\]", word):
            missing = {*extra.split(",")} - {*project["optional-dependencies"]}
            assert not missing, f"{word}: there is no extra {', '.join(missing)}"


TRIED: dict[str, Callable[[Notebook, Block], object]] = {"python": _python, "yaml": _yaml, "sh": _sh, "xml": _content}
TRIED |= {"text": lambda page, block: None, "toml": lambda page, block: tomllib.loads(block.code)}
