"""Robustness: damaged inputs of every kind, and data generation that is killed at random moments.

    python benchmarks/robustness.py fuzz [--seconds 600] [--seed 0] [--only problem,urdf]
    python benchmarks/robustness.py faults [--trajectories 1000] [--shard 10] [--kills 10] [--workers 2]
        [--seed 0]

`fuzz` prints benchmarks/results/fuzz.txt: each input of tests/helpers/fuzz must give an answer or a one-line
error, in bounded time. If no compiled code is cached yet, first run it for a minute, since compiling would
count as time and memory of inputs.

`faults` prints faults.txt. The command `data generate` is killed with SIGKILL and started again; in the end,
its files must be equal to those of an undisturbed run. The moments of the kills are uniformly distributed:
half of them in the first six seconds after a start, when processes start and the manifest is written, half in
the three seconds after the first new shard.
"""

import argparse
import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from common import header, parse, parts_of, print_table

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from helpers.fuzz.inputs import KINDS, outcome_of

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
    """Wait until no process of a killed command's group is left; returns how long that took [s]."""
    begun = time.monotonic()
    while any(_runs_in(group, stat) for stat in Path("/proc").glob("[0-9]*/stat")):
        time.sleep(0.02)
    return time.monotonic() - begun


def _runs_in(group: int, stat: Path) -> bool:
    try:
        state, _, process_group = stat.read_text().rpartition(")")[2].split()[:3]
    except (OSError, ValueError):
        return False
    return int(process_group) == group and state != "Z"


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


CPU_LIMIT = 5.0
"""Largest CPU time of an input [s]; inputs of kind `socket` have a limit of their own, `server.LIMIT`."""
HANG_TIMEOUT = 60.0
"""Time after which an input that has not ended is given up [s]."""
MEMORY_LIMIT = 12 * 2**30
"""Memory limit of the process that runs inputs [bytes]."""


class Campaign(NamedTuple):
    counts: Counter[tuple[str, str]]
    """Number of inputs by kind and outcome."""
    faults: list[str]
    """Inputs that led to anything but an answer or a one-line error: kind, seed and what happened."""
    slowest: dict[str, float]
    """Longest time of an input, by kind [s]."""


def run_inputs(pipe: Connection, seed: int, kinds: tuple[str, ...]) -> None:
    """Run inputs numbered from `seed` on, with alternating kinds, and send a message for each."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT, MEMORY_LIMIT))
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 2)
    with tempfile.TemporaryDirectory() as folder:
        number = seed
        while True:
            kind = kinds[number % len(kinds)]
            clock = time.monotonic if kind == "socket" else time.process_time
            began = clock()
            inner = Path(folder) / str(number)
            inner.mkdir()
            pipe.send((*outcome_of(kind, number, inner), clock() - began))
            shutil.rmtree(inner)
            number += 1


def run_campaign(seconds: float, seed: int, kinds: tuple[str, ...]) -> Campaign:
    """Run as many inputs as there is time for, numbered from `seed` on."""
    campaign = Campaign(Counter(), [], dict.fromkeys(kinds, 0.0))
    context = multiprocessing.get_context("spawn")
    until = time.monotonic() + seconds
    number = seed
    while time.monotonic() < until:
        pipe, worker_end = context.Pipe()
        worker = context.Process(target=run_inputs, args=(worker_end, number, kinds), daemon=True)
        worker.start()
        worker_end.close()
        ended = False
        first = True
        while not ended and time.monotonic() < until:
            kind = kinds[number % len(kinds)]
            took = 0.0
            try:
                ended = not pipe.poll(HANG_TIMEOUT)
                result, message, took = ("fault", "it does not end", HANG_TIMEOUT) if ended else pipe.recv()
            except EOFError:
                worker.join()
                ended = True
                result = "fault"
                message = f"the process ended with {worker.exitcode}"
            took = 0.0 if first else took  # the first input loads compiled code
            if took > CPU_LIMIT and kind != "socket":
                result = "fault"
                message = f"{took:.1f} s"
            campaign.counts[kind, result] += 1
            campaign.slowest[kind] = max(campaign.slowest[kind], took)
            if result == "fault":
                campaign.faults.append(f"{kind} {number}: {message}")
            number = number + 1
            first = False
        worker.kill()
        worker.join()
    return campaign


def fuzz(arguments: argparse.Namespace) -> None:
    """Run damaged inputs and print their outcomes."""
    kinds = tuple(parts_of(arguments.only, KINDS))
    campaign = run_campaign(arguments.seconds, arguments.seed, kinds)
    rows = []
    for kind in kinds:
        counts = [campaign.counts[kind, what] for what in ("answer", "error", "fault")]
        rows.append([kind, f"{sum(counts):,}", *(f"{n:,}" for n in counts), f"{campaign.slowest[kind]:.2f}"])
    print(header("numpy", "trimesh", "coal"), "\n")
    columns = ["kind", "inputs", "answers", "one-line errors", "anything else", "slowest, s"]
    print_table(f"{campaign.counts.total():,} damaged inputs, from seed {arguments.seed}", columns, rows)
    for fault in campaign.faults[:200]:
        print(fault)
    if campaign.faults:
        sys.exit(1)


def main() -> None:
    parser = argparse.ArgumentParser(description="Damaged inputs, and data generation that is killed.")
    parser.add_argument(
        "part", choices=("fuzz", "faults"), nargs="?", default="fuzz", help="what to run (fuzz)"
    )
    parser.add_argument("--seconds", type=float, default=600, help="duration of `fuzz` (600)")
    parser.add_argument("--only", default=",".join(KINDS), help="kinds of inputs (all)")
    parser.add_argument("--seed", type=int, default=0, help="seed (0)")
    parser.add_argument(
        "--trajectories", type=int, default=1000, help="number of trajectories of the data set (1000)"
    )
    parser.add_argument("--shard", type=int, default=10, help="number of trajectories in a file (10)")
    parser.add_argument("--kills", type=int, default=10, help="number of kills (10)")
    parser.add_argument("--workers", type=int, default=2, help="number of worker processes (2)")
    small = {"seconds": 3.0, "only": "head,cloud", "trajectories": 6, "shard": 2, "kills": 1, "workers": 1}
    arguments = parse(parser, **small)
    if arguments.part == "fuzz" or arguments.smoke:
        fuzz(arguments)
    if arguments.part == "faults" or arguments.smoke:
        faults(arguments)


if __name__ == "__main__":
    main()
