"""Faults: data generation killed at ten random moments ends in the same files as one that nothing disturbed.

    python benchmarks/faults.py [--trajectories 1000] [--shard 10] [--kills 10] [--workers 2] [--seed 0]

Prints the report that is kept in benchmarks/results/faults.txt. The command line is started anew after each
kill -9; moments are uniform, half of them in the first six seconds of a start, when processes start and the
manifest is written, half in the three seconds that follow on the first new shard.
"""

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from report import header, print_table

COMMAND = (sys.executable, "-c", "import sys; from robotdiffuse.cli import main; sys.exit(main())")


def start(out: Path, arguments: argparse.Namespace) -> subprocess.Popen[bytes]:
    """The command, as the first of a process group of its own."""
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


def workers_end(group: int) -> float:
    """Seconds until no process of a killed command's group is left."""
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
    """All files, hidden ones too."""
    files = (file for file in folder.rglob("*") if file.is_file())
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--trajectories", type=int, default=1000)
    parser.add_argument("--shard", type=int, default=10)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    planned = -(-arguments.trajectories // arguments.shard)
    print(header("numpy", "numba", "zarr"), "\n")
    rng, rows = np.random.default_rng(arguments.seed), []
    with tempfile.TemporaryDirectory() as folder:
        disturbed, undisturbed = Path(folder, "disturbed"), Path(folder, "undisturbed")
        for kill in range(arguments.kills):
            run, begun = start(disturbed, arguments), time.monotonic()
            if kill % 2:
                wait_for_shard(run, disturbed)
                time.sleep(rng.uniform(0, 3))
            else:
                time.sleep(rng.uniform(0, 6))
            moment = time.monotonic() - begun
            ended = run.poll() is not None
            run.send_signal(signal.SIGKILL)
            run.wait()
            after = workers_end(run.pid)
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


if __name__ == "__main__":
    main()
