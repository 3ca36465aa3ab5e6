"""The data factory beside a training: a process of its own that fills the folder meanwhile."""

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.processes import block_interrupts_in_children, prepare_worker, terminate
from robotdiffuse.core.registry import AddedEntries, added_entries

if TYPE_CHECKING:
    from robotdiffuse.generation import GenerationSettings

PATIENCE = 20.0
"""Until a factory that was told to end is killed [s]: it may be writing a shard."""
POLL = 0.2
"""Between two looks for the first shard [s]."""


@contextmanager
def filled_meanwhile(folder: str, workers: int, robot: str) -> Iterator[None]:
    """Within, so many processes fill the folder with what its manifest says, a new one with the default data.

    Begins when there is a shard; what is missing at the end is made by the next call. Of several processes of
    torchrun the first starts the factory, the others wait for the shard. `robot`: of a new folder. Raises
    InputError if the folder cannot be filled.
    """
    if int(os.environ.get("RANK", "0")) > 0:
        while not _has_shard(folder):
            time.sleep(POLL)
        yield
        return
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    factory = context.Process(target=_fill, args=(folder, workers, robot, theirs, added_entries()))
    # Ctrl-C is for this process, which then ends the factory
    with block_interrupts_in_children():
        factory.start()
    theirs.close()
    try:
        _wait_for_shard(folder, ours)
        yield
    finally:
        terminate([factory], signal.SIGINT, PATIENCE)
    error = _message(ours)
    if error:
        print(f"robotdiffuse: the data factory ended early: {error}", file=sys.stderr)


def _has_shard(folder: str) -> bool:
    from robotdiffuse.datasets.shards import shard_indices

    return bool(shard_indices(folder))


def _wait_for_shard(folder: str, connection: Connection) -> None:
    """Until the factory works, and there is a shard; its error, if it has one, is raised."""
    begun = False
    while not (begun and _has_shard(folder)):
        if not connection.poll(POLL):
            continue
        error = _message(connection)
        if error is None:
            raise InputError(f"the data factory for {folder} was killed, or could not be started")
        if error:
            raise InputError(error)
        begun = True
        if not _has_shard(folder):
            print(f"data: waiting for the first shard in {folder}", file=sys.stderr)


def _message(connection: Connection) -> str | None:
    """The next one, an error or "" for the beginning; None if there is none and the factory has ended."""
    try:
        return connection.recv()
    except EOFError:
        return None


def _fill(folder: str, workers: int, robot: str, connection: Connection, entries: AddedEntries) -> None:
    """The factory's process: tells that it began, or its error; ends on SIGINT, and with its parent."""
    os.setpgrp()  # the terminal's Ctrl-C does not reach it
    begun = False

    def tell(_done: int, _total: int) -> None:
        nonlocal begun
        if not begun:
            begun = True
            connection.send("")

    try:
        # a shell's background job ignores it, and its children with it
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        from robotdiffuse.generation import generate

        prepare_worker(entries)
        generate(_settings(folder, robot), Path(folder), workers, progress=tell)
    except InputError as error:
        connection.send(str(error))
    except KeyboardInterrupt:
        pass


def _settings(folder: str, robot: str) -> "GenerationSettings":
    from robotdiffuse.datasets.manifest import MANIFEST, read_manifest
    from robotdiffuse.generation import GenerationSettings

    if not (Path(folder) / MANIFEST).exists():
        return GenerationSettings(robot=robot)
    return GenerationSettings.from_json(read_manifest(folder).settings, f"{folder}/{MANIFEST}: settings")
