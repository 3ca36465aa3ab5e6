"""Runs of the data factory for tests: in this process, or by the real command line."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from helpers.waiting import until
from robotdiffuse.generation import GenerationSettings
from robotdiffuse.processes.workers import Results

HEARS_CTRL_C = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
"""Where a shell starts the tests in the background, they and their children would ignore it."""
RUN = "from robotdiffuse.cli import main; raise SystemExit(main())"
COMMAND = (sys.executable, "-c", f"{HEARS_CTRL_C}; {RUN}")


def in_this_process(call: Callable[..., Any], calls: Sequence[tuple], _workers: int) -> Results:
    """Like `processes.on_this_machine`, but makes the calls in this process."""
    for number, arguments in enumerate(calls):
        yield number, call(*arguments)


def contents(folder: Path) -> dict[str, bytes]:
    """The contents of all files of a folder, hidden ones too."""
    files = (file for file in sorted(folder.rglob("*")) if file.is_file())
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def start(out: Path, settings: GenerationSettings, workers: int) -> subprocess.Popen[str]:
    """Starts the command in a process group of its own."""
    sizes = {name: getattr(settings, name) for name in ("trajectories", "shard", "waypoints")} | {"workers": workers}
    options = [text for name, value in sizes.items() for text in (f"--{name}", str(value))]
    command = [*COMMAND, "data", "generate", "--out", str(out), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


def shards(out: Path) -> int:
    return len(list(out.glob("shard_*.zarr")))


def wait_for_shards(run: subprocess.Popen[str], out: Path, count: int) -> None:
    """Waits until the folder contains this number of shards, or the command has ended."""
    until(lambda: shards(out) >= count or run.poll() is not None, 300.0)


def group_ends(group: int, seconds: float = 120.0) -> bool:
    """Whether all processes of a group end within a time."""
    try:
        until(lambda: not members(group), seconds)
    except AssertionError:
        os.killpg(group, signal.SIGKILL)
    return not members(group)


def members(group: int) -> list[int]:
    """The running processes of a group; ended processes that only wait to be collected do not count."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            # the name, in parentheses, may hold anything
            state, _, pgrp = stat.read_text().rpartition(")")[2].split()[:3]
        except (OSError, ValueError):
            continue
        if int(pgrp) == group and state != "Z":
            found.append(int(stat.parent.name))
    return found
