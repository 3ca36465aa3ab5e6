"""Draws training samples in advance in worker processes, without changing what is drawn."""

import copy
import multiprocessing
import os
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor

import numpy as np

from robotdiffuse.core.processes import block_interrupts_in_children, prepare_worker
from robotdiffuse.core.registry import AddedEntries, added_entries
from robotdiffuse.learning.completion import Samples, draw_samples
from robotdiffuse.robots.robot import Robot

NICENESS = 5
"""Workers give way to the training itself."""
BATCHES_AHEAD = 3
"""Batches drawn in advance, for each worker."""
SEED_LIMIT = 2**62
"""Seeds of samples are below this."""


class SamplePrefetcher:
    """Batches of samples for a training that draws nothing else from its random number generator.

    A copy of the generator tells the seeds of the next batches, so a resumed run has the same batches.
    """

    def __init__(self, families: Sequence[str], robot: Robot, batch: int, workers: int) -> None:
        """workers: number of worker processes; 0: `next` draws the samples itself."""
        self._families = tuple(families)
        self._robot = robot
        self._batch = batch
        self._depth = BATCHES_AHEAD * workers
        self._pool: ProcessPoolExecutor | None = None
        if workers:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(workers, context, _start_worker, (added_entries(),))
        self._pending: deque[tuple[tuple[int, ...], Future[Samples]]] = deque()

    def next(self, rng: np.random.Generator) -> Samples:
        """The batch of samples with the seeds that `rng` draws."""
        seeds = self._seeds(rng)
        if self._pool is None:
            return draw_samples(self._families, self._robot, seeds)
        if not self._pending or self._pending[0][0] != seeds:
            self._pending.clear()
            self._submit(seeds)
        following = copy.deepcopy(rng)
        for _ in range(len(self._pending) - 1):
            self._seeds(following)
        while len(self._pending) <= self._depth:
            self._submit(self._seeds(following))
        return self._pending.popleft()[1].result()

    def close(self) -> None:
        """Stop the workers."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def _seeds(self, rng: np.random.Generator) -> tuple[int, ...]:
        return tuple(rng.integers(SEED_LIMIT, size=self._batch).tolist())

    def _submit(self, seeds: tuple[int, ...]) -> None:
        assert self._pool is not None
        with block_interrupts_in_children():
            job = self._pool.submit(draw_samples, self._families, self._robot, seeds)
        self._pending.append((seeds, job))


def _start_worker(entries: AddedEntries) -> None:
    prepare_worker(entries)
    os.nice(NICENESS)
