"""Golden digests: what the package makes of fixed inputs, to be the same before and after code is moved.

    python tests/golden/golden.py            compares with golden.json; exit status 1 if anything differs
    python tests/golden/golden.py --write    makes golden.json anew; a commit that does says which and why
    ... [--only problems,shard,weights,plans,unsteady]

An entry has a digest of its numbers, rounded, and their projection on a fixed random direction. Compilers and
processors differ in the last bits: a projection within TOLERANCE counts as the same where the digest differs.
So do the process that compiles and those that find its code in the cache: after a move, run it twice.
Planners that search until time runs out and then return their best give another path at every call; they are
not here: OMPL's RRT*, Informed RRT*, BIT*, AORRTC, and its PRM, which has a second thread.
"""

import argparse
import hashlib
import io
import json
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from itertools import starmap
from pathlib import Path
from unittest.mock import patch

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from llvmlite.binding import get_host_cpu_name
from numpy import ndarray
from safetensors.numpy import load_file

from robotdiffuse.cli import main as main_of_cli
from robotdiffuse.datasets.shards import read_shard
from robotdiffuse.generation import factory
from robotdiffuse.planning import load_planner
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.files import problem_record
from robotdiffuse.problems.held_out import held_out_problem
from robotdiffuse.problems.problem import Problem

GOLDEN = Path(__file__).with_name("golden.json")
DECIMALS = 6
TOLERANCE = 1e-4
"""Of projections, relative to what numbers of this size and count have by chance."""
PROBLEMS = 20
PLANS = (("rop", 1), ("rop_dense", 0), ("shelf", 0), ("crate", 0), ("table", 0))
PLANNERS = (
    *("robotdiffuse", "aorrtc", "rrt_connect", "shared_tree_rrt_star", "mpnet", "mpinets"),
    *("a_star", "d_star_lite", "ompl_rrt", "ompl_rrt_connect"),
)
UNSTEADY = ("mpd", "edmp")
"""Their guides follow many small gradients: how a process happened to compile them can decide a path, most of
all on shelves. What differs is printed, and counts for nothing: no test asks for it."""
SEED = 3
TIME_LIMIT = 60.0
STEPS, BATCH = 100, 8
TRAIN = {
    "point_autoencoder": ("encoder", "--encoder", "point_autoencoder"),
    "compression_autoencoder": ("encoder", "--encoder", "compression_autoencoder"),
    "compact": ("planner", "--data", "{data}", "--encoder", "{point_autoencoder}"),
    "mpnet": ("baseline", "mpnet", "--data", "{data}"),
    "mpinets": ("baseline", "mpinets", "--data", "{data}"),
    "trajectory_prior": ("baseline", "trajectory_prior", "--data", "{data}"),
}
"""Every trainable thing but the completing network, which draws its samples itself: what follows
`robotdiffuse train`."""

Entry = dict[str, object]


def entry(numbers: ndarray) -> Entry:
    flat = np.nan_to_num(np.asarray(numbers, np.float64).ravel(), nan=-1e3, posinf=1e3, neginf=-1e3)
    direction = np.random.default_rng(0).standard_normal(len(flat))
    rounded = np.round(flat, DECIMALS) + 0.0
    return {
        "shape": list(np.shape(numbers)),
        "digest": hashlib.sha256(rounded.tobytes()).hexdigest()[:16],
        "projection": float(direction @ flat),
        "scale": float(np.linalg.norm(flat)),
    }


def same(a: Entry, b: Entry) -> str:
    """ "same", "rounding" or "differs"."""
    if a == b or a.get("digest") == b.get("digest"):
        return "same"
    if a.get("shape") != b.get("shape") or "projection" not in a:
        return "differs"
    close = abs(a["projection"] - b["projection"]) <= TOLERANCE * max(1.0, float(b["scale"]))  # type: ignore
    return "rounding" if close else "differs"


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
    mix = ",".join(f"{name}=1" for name, _ in PLANS)
    sizes = ("--trajectories", "60", "--shard", "60", "--goals", "3", "--seed", "5", "--workers", "1")
    with patch.object(
        factory, "on_this_machine", lambda call, calls, _: (one for one in enumerate(starmap(call, calls)))
    ):
        command("data", "generate", "--out", str(folder), "--mix", mix, "--target", "pose", *sizes)


def shard() -> Iterator[tuple[str, Entry]]:
    with tempfile.TemporaryDirectory() as folder:
        make_data(Path(folder) / "data")
        for name, values in sorted(read_shard(Path(folder) / "data", 0).arrays.items()):
            yield name, entry(values)


def weights() -> Iterator[tuple[str, Entry]]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        places = {"data": str(folder / "data"), **{run: str(folder / run) for run in TRAIN}}
        make_data(folder / "data")
        for run, arguments in TRAIN.items():
            sizes = ("--samples", str(STEPS * BATCH), "--batch", str(BATCH), "--out", places[run])
            command("train", *(text.format(**places) for text in arguments), *sizes)
            [file] = {*folder.joinpath(run).glob("*.safetensors")} - {folder / run / "training.safetensors"}
            tensors = load_file(file)
            yield run, entry(np.concatenate([tensors[key].astype(float).ravel() for key in sorted(tensors)]))


def plans(planners: tuple[str, ...] = PLANNERS) -> Iterator[tuple[str, Entry]]:
    asked = [(family, index, held_out_problem(family, index)) for family, index in PLANS]
    for name in planners:
        planner = load_planner(name)
        for family, index, problem in asked:
            limit = TIME_LIMIT if name not in ("mpnet", "mpinets", "mpd", "edmp", "ompl_rrt") else 10.0
            result = planner.plan(problem, time_limit=limit, seed=SEED)
            label = f"{name} {family}/{index}"
            yield label, {"shape": []} if result.path is None else entry(result.path.positions)


SECTIONS: dict[str, Callable[[], Iterator[tuple[str, Entry]]]] = {
    "problems": problems,
    "shard": shard,
    "weights": weights,
    "plans": plans,
    "unsteady": partial(plans, UNSTEADY),
}


def compare(section: str) -> list[str]:
    """What differs from golden.json in a section: a line each. Says on the way what is the same."""
    golden = json.loads(GOLDEN.read_text())[section]
    found = dict(SECTIONS[section]())
    lines = [f"{section}: {name} is missing" for name in golden.keys() - found.keys()]
    for name, new in found.items():
        verdict = same(new, golden[name]) if name in golden else "new"
        print(f"{section:10} {name:32} {verdict}", flush=True)
        if verdict in ("differs", "new") and section != "unsteady":
            lines.append(f"{section}: {name} {verdict}: {new} in place of {golden.get(name)}")
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
    golden["processor"] = get_host_cpu_name()
    for section in asked:
        golden[section] = dict(SECTIONS[section]())
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
