"""A data set that may still be being made while a training reads it."""

import sys
from collections.abc import Callable

from robotdiffuse.datasets.manifest import read_manifest
from robotdiffuse.datasets.shards import shard_indices
from robotdiffuse.learning.training.batches import TrajectoryData
from robotdiffuse.learning.training.processes import Processes

GROWTH = 1.25
"""A folder is read again when it has so many times the shards that are known, or all: then all readings
together take only a few times as long as the last."""


class GrowingData:
    """The rows of a folder's shards; of more of them, after `grow`, while the data factory is filling it.

    A folder that has all shards of its manifest is read once, and a training on it is reproducible. One on
    data that grew is not: what was drawn depends on how fast the data were made.
    """

    def __init__(
        self,
        folder: str,
        read: Callable[[Callable[[str], None]], TrajectoryData],
        processes: Processes,
    ) -> None:
        """read: reads the whole folder, and reports on that to its argument."""
        manifest = read_manifest(folder)
        self._folder, self._read, self._processes = folder, read, processes
        self._all = -(-manifest.trajectories // manifest.shard)
        self._shards = 0
        self.now = self._load(self._print)
        """The rows known by now."""

    def grow(self) -> bool:
        """Read the folder again if it has enough more by now; whether it was. All processes call it."""
        there = len(shard_indices(self._folder))
        more = there > self._shards and (there >= GROWTH * self._shards or there >= self._all)
        if not any(self._processes.mean(more)):
            return False
        self.now = self._load(lambda text: None)
        self._print(f"data: grown to {len(self.now):,} trajectories")
        return True

    def _load(self, report: Callable[[str], None]) -> TrajectoryData:
        # the first process leaves the codes of scenes for the others
        with self._processes.first_goes_first():
            self._shards = len(shard_indices(self._folder))
            return self._read(report)

    def _print(self, text: str) -> None:
        if self._processes.first:
            print(text, file=sys.stderr)
