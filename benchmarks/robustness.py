"""Robustness: damaged inputs of every kind, and data generation that is killed at random moments.

    python benchmarks/robustness.py fuzz [--seconds 600] [--seed 0] [--only problem,urdf] python
    benchmarks/robustness.py faults [--trajectories 1000] [--shard 10] [--kills 10] [--workers 2] [--seed 0]

`fuzz` prints benchmarks/results/fuzz.txt: each input of tests/helpers/fuzz must give an answer or a one-line
error, in bounded time. Where no compiled code is cached yet, run it a minute before: compiling counts as time
and memory.

`faults` prints faults.txt. The command `data generate` is killed with SIGKILL and started again; its files
must be those of a run that nothing disturbed. Moments are uniform, half of them in the first six seconds of a
start, when processes start and the manifest is written, half in the three seconds after the first new shard.
"""

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from common import header, parse, parts_of, print_table

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from helpers.fuzz.campaign import run_campaign
from helpers.fuzz.inputs import KINDS

COMMAND = (sys.executable, "-c", "import sys; from robotdiffuse.cli import main; sys.exit(main())")


def start(out: Path, arguments: argparse.Namespace) -> subprocess.Popen[bytes]:
    """Start the command in a process group of its own."""
    options = ("--trajectories", arguments.trajectories, "--shard", arguments.shard)
    options += ("--workers", arguments.workers, "--mix", "rop=0.7,rop_dense=0.3", "--out", out)
    command = [*COMMAND, "data", "generate", *map(str, options)]
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command, stdout=quiet, stderr=quiet, start_new_session=True)


def shards(out: Path) -> int:
    return len(list(out.glob("shard_*.zarr")))


def wait_for_shard(run: subprocess.Popen[bytes], out: Path) -> None:
    before = shards(out)
    while shards(out) == before and run.poll() is None:
        time.sleep(0.005)


def wait_for_workers(group: int) -> float:
    """Wait until no process of a killed command's group is left; seconds."""
    begun = time.monotonic()
    while any(_runs_in(group, stat) for stat in Path("/proc").glob("[0-9]*/stat")):
        time.sleep(0.02)
    return time.monotonic() - begun


def _runs_in(group: int, stat: Path) -> bool:
    try:
        state, _, found = stat.read_text().rpartition(")")[2].split()[:3]
    except (OSError, ValueError):
        return False
    return int(found) == group and state != "Z"


def contents(folder: Path) -> dict[str, bytes]:
    """All files by name, hidden ones too."""
    files = (file for file in folder.rglob("*") if file.is_file())
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def faults(arguments: argparse.Namespace) -> None:
    """Kill data generation, start it again, and compare the files with those of an undisturbed run."""
    planned = -(-arguments.trajectories // arguments.shard)
    print(header("numpy", "numba", "zarr"), "\n")
    rng = np.random.default_rng(arguments.seed)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        disturbed = Path(folder, "disturbed")
        undisturbed = Path(folder, "undisturbed")
        for kill in range(arguments.kills):
            run = start(disturbed, arguments)
            begun = time.monotonic()
            if kill % 2:
                wait_for_shard(run, disturbed)
                time.sleep(rng.uniform(0, 3))
            else:
                time.sleep(rng.uniform(0, 6))
            moment = time.monotonic() - begun
            ended = run.poll() is not None
            run.send_signal(signal.SIGKILL)
            run.wait()
            after = wait_for_workers(run.pid)
            halves = len(list(disturbed.glob(".*")))
            there = "all, it had ended" if ended else f"{shards(disturbed)} of {planned}"
            rows.append([str(kill + 1), f"{moment:.2f}", there, str(halves), f"{after:.2f}"])
        finished = start(disturbed, arguments).wait()
        alone = start(undisturbed, arguments).wait()
        same = contents(disturbed) == contents(undisturbed)
        files = len(contents(undisturbed))
        size = sum(map(len, contents(undisturbed).values()))
    columns = ["kill -9", "after, s", "shards there", "half-written", "workers ended after, s"]
    print_table("Killed, and started again", columns, rows)
    print(f"\nExit status of the last run: {finished}; of the undisturbed one: {alone}.")
    print(
        f"Finished set of {arguments.trajectories:,} trajectories, {files:,} files, {size / 1e6:.1f} MB: "
        f"{'bit-identical' if same else 'DIFFERENT'}, names and contents."
    )
    if not same or finished or alone:
        sys.exit(1)


def fuzz(arguments: argparse.Namespace) -> None:
    """Run damaged inputs and print their outcomes."""
    kinds = tuple(parts_of(arguments.only, KINDS))
    found = run_campaign(arguments.seconds, arguments.seed, kinds)
    rows = []
    for kind in kinds:
        counts = [found.counts[kind, what] for what in ("answer", "error", "fault")]
        rows.append([kind, f"{sum(counts):,}", *(f"{n:,}" for n in counts), f"{found.slowest[kind]:.2f}"])
    print(header("numpy", "trimesh", "coal"), "\n")
    columns = ["kind", "inputs", "answers", "one-line errors", "anything else", "slowest, s"]
    print_table(f"{found.counts.total():,} damaged inputs, from seed {arguments.seed}", columns, rows)
    for fault in found.faults[:200]:
        print(fault)
    if found.faults:
        sys.exit(1)


def main() -> None:
    parser = argparse.ArgumentParser(description="Damaged inputs, and data generation that is killed.")
    parser.add_argument("part", choices=("fuzz", "faults"), nargs="?", default="fuzz", help="(fuzz)")
    parser.add_argument("--seconds", type=float, default=600, help="of fuzz (600)")
    parser.add_argument("--only", default=",".join(KINDS), help="kinds of inputs (all)")
    parser.add_argument("--seed", type=int, default=0, help="(0)")
    parser.add_argument("--trajectories", type=int, default=1000, help="of the data set (1000)")
    parser.add_argument("--shard", type=int, default=10, help="trajectories in a file (10)")
    parser.add_argument("--kills", type=int, default=10, help="(10)")
    parser.add_argument("--workers", type=int, default=2, help="(2)")
    small = {"seconds": 10.0, "only": "head,cloud", "trajectories": 6, "shard": 2, "kills": 1, "workers": 1}
    arguments = parse(parser, **small)
    if arguments.part == "fuzz" or arguments.smoke:
        fuzz(arguments)
    if arguments.part == "faults" or arguments.smoke:
        faults(arguments)


if __name__ == "__main__":
    main()
