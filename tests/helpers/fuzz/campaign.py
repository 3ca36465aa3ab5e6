"""Runs damaged inputs for some time, in a process that is started anew when an input kills or blocks it."""

import multiprocessing
import os
import resource
import shutil
import tempfile
import time
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

from helpers.fuzz.inputs import outcome_of

CPU_LIMIT = 5.0
"""Most processor time of an input [s]; inputs of kind `socket` have a limit of their own, `server.LIMIT`."""
HANG_TIMEOUT = 60.0
"""An input that has not ended by then is given up [s]."""
MEMORY_LIMIT = 12 * 2**30
"""Of the process that runs inputs [bytes]."""


class Campaign(NamedTuple):
    counts: Counter[tuple[str, str]]
    """Inputs by kind and outcome."""
    faults: list[str]
    """What ended in anything but an answer or one line: kind, seed and what happened."""
    slowest: dict[str, float]
    """Longest time of an input, by kind [s]."""


def _work(pipe: Connection, seed: int, kinds: tuple[str, ...]) -> None:
    """Run inputs from a seed on, kinds in turn, and send one message for each."""
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
    found = Campaign(Counter(), [], dict.fromkeys(kinds, 0.0))
    context = multiprocessing.get_context("spawn")
    until = time.monotonic() + seconds
    number = seed
    while time.monotonic() < until:
        ours, theirs = context.Pipe()
        worker = context.Process(target=_work, args=(theirs, number, kinds), daemon=True)
        worker.start()
        theirs.close()
        ended = False
        first = True
        while not ended and time.monotonic() < until:
            kind = kinds[number % len(kinds)]
            took = 0.0
            try:
                ended = not ours.poll(HANG_TIMEOUT)
                result, said, took = ("fault", "it does not end", HANG_TIMEOUT) if ended else ours.recv()
            except EOFError:
                worker.join()
                ended = True
                result = "fault"
                said = f"the process ended with {worker.exitcode}"
            took = 0.0 if first else took  # the first input loads compiled code
            if took > CPU_LIMIT and kind != "socket":
                result = "fault"
                said = f"{took:.1f} s"
            found.counts[kind, result] += 1
            found.slowest[kind] = max(found.slowest[kind], took)
            if result == "fault":
                found.faults.append(f"{kind} {number}: {said}")
            number = number + 1
            first = False
        worker.kill()
        worker.join()
    return found
