"""Golden digests: what the package makes of fixed inputs, to be the same before and after code is moved.

    python tests/golden/golden.py            compares with golden.json; exit status 1 if anything differs
    python tests/golden/golden.py --write    makes golden.json anew; a commit that does says which and why
    ... [--only problems,shard]

An entry is a digest of its numbers: their shape and norm, and their projection on a fixed random direction.
Compilers and processors differ in the last bits: a projection within TOLERANCE counts as the same.
Motions are not here: they depend on the processor; `tests/planning/test_reproducibility.py` plans them twice.
"""

import argparse
import io
import json
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from itertools import starmap
from pathlib import Path
from typing import Any
from unittest.mock import patch

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy import ndarray

from robotdiffuse.cli import main as main_of_cli
from robotdiffuse.datasets.shards import read_shard
from robotdiffuse.generation import factory
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.files import problem_record
from robotdiffuse.problems.held_out import held_out_problem
from robotdiffuse.problems.problem import Problem

GOLDEN = Path(__file__).with_name("golden.json")
TOLERANCE = 1e-4
"""Of projections, relative to what numbers of this size and count have by chance."""
PROBLEMS = 8
MIX = ("rop", "rop_dense", "shelf", "crate", "table")
Entry = dict[str, Any]


def entry(numbers: ndarray) -> Entry:
    flat = np.nan_to_num(np.asarray(numbers, np.float64).ravel(), nan=-1e3, posinf=1e3, neginf=-1e3)
    direction = np.random.default_rng(0).standard_normal(len(flat))
    return {
        "shape": list(np.shape(numbers)),
        "projection": float(direction @ flat),
        "scale": float(np.linalg.norm(flat)),
    }


def same(a: Entry, b: Entry) -> bool:
    off = abs(a["projection"] - b["projection"])
    return a["shape"] == b["shape"] and off <= TOLERANCE * max(1.0, b["scale"])


def numbers_of(record: object) -> Iterator[float]:
    if isinstance(record, dict):
        for value in record.values():
            yield from numbers_of(value)
    elif isinstance(record, list | tuple):
        for value in record:
            yield from numbers_of(value)
    elif isinstance(record, int | float):
        yield float(record)


def problem_numbers(problem: Problem) -> ndarray:
    return np.array(list(numbers_of(problem_record(problem))))


def problems() -> Iterator[tuple[str, Entry]]:
    for family in FAMILIES:
        rows = [problem_numbers(held_out_problem(family, i)) for i in range(PROBLEMS)]
        yield family, entry(np.concatenate(rows))


def command(*arguments: str) -> None:
    said = io.StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        status = main_of_cli(list(arguments))
    if status:
        raise SystemExit(f"robotdiffuse {' '.join(arguments)}\n{said.getvalue()}")


def make_data(folder: Path) -> None:
    mix = ",".join(f"{name}=1" for name in MIX)
    sizes = ("--trajectories", "24", "--shard", "24", "--goals", "3", "--seed", "5", "--workers", "1")
    with patch.object(
        factory, "on_this_machine", lambda call, calls, _: (one for one in enumerate(starmap(call, calls)))
    ):
        command("data", "generate", "--out", str(folder), "--mix", mix, "--target", "pose", *sizes)


def shard() -> Iterator[tuple[str, Entry]]:
    with tempfile.TemporaryDirectory() as folder:
        make_data(Path(folder) / "data")
        for name, values in sorted(read_shard(Path(folder) / "data", 0).arrays.items()):
            yield name, entry(values)


SECTIONS: dict[str, Callable[[], Iterator[tuple[str, Entry]]]] = {"problems": problems, "shard": shard}


def compare(section: str) -> list[str]:
    """What differs from golden.json in a section: a line each."""
    golden = json.loads(GOLDEN.read_text())[section]
    found = dict(SECTIONS[section]())
    lines = [f"{section}: {name} is missing or new" for name in golden.keys() ^ found.keys()]
    for name in golden.keys() & found.keys():
        if not same(found[name], golden[name]):
            lines.append(f"{section}: {name} differs: {found[name]} in place of {golden[name]}")
    return lines


def main() -> int:
    parser = argparse.ArgumentParser(description="Compare with the golden digests, or write them.")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--only", default=",".join(SECTIONS))
    arguments = parser.parse_args()
    asked = arguments.only.split(",")
    if not arguments.write:
        lines = [line for section in asked for line in compare(section)]
        print("\n".join(lines) or "everything is the same")
        return int(bool(lines))
    golden = json.loads(GOLDEN.read_text()) if GOLDEN.exists() else {}
    for section in asked:
        golden[section] = dict(SECTIONS[section]())
    rows = {
        section: ",\n".join(f'  "{name}": {json.dumps(one)}' for name, one in entries.items())
        for section, entries in golden.items()
    }
    GOLDEN.write_text(
        "{\n" + ",\n".join(f' "{name}": {{\n{text}\n }}' for name, text in rows.items()) + "\n}\n"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
