"""Samples drawn ahead of the training by processes of their own, without changing what is drawn."""

import copy
import multiprocessing
import os
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor

import numpy as np

from robotdiffuse.core.processes import block_interrupts_in_children, prepare_worker
from robotdiffuse.core.registry import AddedEntries, added_entries
from robotdiffuse.learning.completion.samples import Samples, draw_samples
from robotdiffuse.robots.robot import Robot

NICE = 5
"""The training itself comes first."""
DEPTH = 3
"""Batches that are drawn ahead, for each process."""
MOST = 2**62


class SamplesAhead:
    """Batches of samples for a training that draws nothing else from its random numbers.

    What comes next is known from a copy of these; so a run that is resumed has the same batches.
    """

    def __init__(self, families: Sequence[str], robot: Robot, batch: int, workers: int) -> None:
        """`workers` 0: the samples are drawn when they are asked for."""
        self._families, self._robot, self._batch = tuple(families), robot, batch
        self._depth = DEPTH * workers
        self._pool: ProcessPoolExecutor | None = None
        if workers:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(workers, context, _begin, (added_entries(),))
        self._pending: deque[tuple[tuple[int, ...], Future[Samples]]] = deque()

    def next(self, rng: np.random.Generator) -> Samples:
        """The batch of the seeds that `rng` draws."""
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
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def _seeds(self, rng: np.random.Generator) -> tuple[int, ...]:
        return tuple(rng.integers(MOST, size=self._batch).tolist())

    def _submit(self, seeds: tuple[int, ...]) -> None:
        assert self._pool is not None
        with block_interrupts_in_children():
            job = self._pool.submit(draw_samples, self._families, self._robot, seeds)
        self._pending.append((seeds, job))


def _begin(entries: AddedEntries) -> None:
    prepare_worker(entries)
    os.nice(NICE)
