"""The PyTorch data set, `rd.RopDataset("rop")`: trajectories with their scenes and point clouds."""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float32, Int8
from numpy import ndarray

from robotdiffuse.core.errors import InputError, check_name, check_type, described, needs, shown
from robotdiffuse.core.settings import AtLeastTwo, Bound, Count, converted
from robotdiffuse.core.types import frozen_dataclass
from robotdiffuse.datasets.shards import SPLITS, read_manifest, read_rows
from robotdiffuse.robots.kinematic_tree import JointNormalizer
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.packed_scenes import PackedScenes

with needs("torch", "train"):
    import torch
    from torch import Tensor
    from torch.utils.data import Dataset, get_worker_info

    from robotdiffuse.datasets.surface_clouds import surface_clouds

SHARDS_PER_BLOCK = 16
"""Number of shards whose rows are shuffled together. 16 shards of 500 rows are 57 MB of
memory-mapped files."""
Seed = Annotated[int, Bound(least=-(2.0**63), below=2.0**63)]
"""Integers of 64 bits, which PyTorch takes as seeds."""
MAX_THREADS = 8
"""Largest number of threads that prefetch batches."""


@frozen_dataclass
class RopBatch:
    """A batch of the data set, on its device."""

    trajectories: Float32[Tensor, "n waypoints dof"]
    """Scaled so that the robot's limits are -1 and 1."""
    start: Float32[Tensor, "n dof"]
    """The first waypoint, scaled like the trajectories."""
    goal: Float32[Tensor, "n dof"]
    """The goal that was reached, which is the last waypoint, scaled like the trajectories."""
    target_pose: Float32[Tensor, "n 7"]
    """Pose of the robot's tip in the base frame, wxyz_xyz."""
    obstacle_kinds: Int8[Tensor, "n slots"]
    """Kinds of the obstacles, as in `PackedScenes`."""
    obstacle_params: Float32[Tensor, "n slots 10"]
    points: Float32[Tensor, "n points 3"]
    """Points on the obstacles, in the base frame [m]."""

    def __len__(self) -> int:
        return len(self.trajectories)


class RopDataset(Dataset[dict[str, Tensor]]):
    """Trajectories, memory-mapped, with their scenes and newly drawn point clouds.

    `batches` is the fastest way to read them. A standard DataLoader works as well: an item is a dict of the
    tensors in RopBatch. The DataLoader's workers make the clouds, so `num_workers > 0` needs `device="cpu"`.
    """

    def __init__(
        self,
        folder: str | Path,
        split: str = "train",
        points: int = 1400,
        sort_points: bool = False,
        device: str | torch.device = "cpu",
        seed: int = 0,
        robot: Robot | None = None,
        waypoints: int | None = None,
    ) -> None:
        """Open a data set.

        Args:
            folder: The data set.
            split: train, validation or test; no scene is in two splits.
            points: Number of points of each cloud.
            sort_points: Whether points are sorted by x, then y, then z.
            device: Device of the tensors.
            seed: Seed of the clouds and the order.
            robot: The robot that the data are used for; None: any.
            waypoints: Number of waypoints to which trajectories are resampled in memory, evenly spaced along
                each path; None: the stored waypoints.

        Raises:
            InputError: For an unknown split, fewer than 1 point or 2 waypoints, a seed out of bounds, a
                device that PyTorch cannot use, a folder without data or with damaged shards, and data of
                another robot.
        """
        check_name("split", split, SPLITS)
        points = converted("points", Count, points)
        seed = converted("seed", Seed, seed)
        if waypoints is not None:
            waypoints = converted("waypoints", AtLeastTwo, waypoints)
        if robot is not None:
            check_type("robot", robot, Robot, "an rd.Robot")
        self.manifest = read_manifest(folder)
        # the full path, since a copy from a pickle may be read in another working folder
        folder = Path(folder).absolute()
        self._arguments = (folder, split, points, sort_points, device, seed, robot, waypoints)
        self.waypoints = waypoints or self.manifest.waypoints
        self.points = points
        self.sort_points = sort_points
        try:
            self.device = torch.device(device)
            torch.empty(0, device=self.device)
        except (AssertionError, RuntimeError, TypeError) as error:  # PyTorch without CUDA raises the first
            why = described(error)
            raise InputError(f"device is {shown(device)}; PyTorch cannot use it: {why}") from None
        self.seed = seed
        self._generators = dict[int, torch.Generator]()
        self.normalizer = JointNormalizer(np.array(self.manifest.lower), np.array(self.manifest.upper))
        middle, half_range = (
            a.astype(np.float32) for a in (self.normalizer.middle, self.normalizer.half_range)
        )
        # tiled over whole trajectories, as broadcasting along seven joints is slow
        self._scale, self._shift = (
            torch.from_numpy(np.tile(a, self.waypoints)).to(self.device)
            for a in (1 / half_range, -middle / half_range)
        )
        self._trajectories = list[ndarray]()
        places = []
        poses = []
        scenes = []
        for i, rows in enumerate(read_rows(folder, robot, waypoints)):
            of_split = np.flatnonzero(rows.split == SPLITS.index(split))
            self._trajectories.append(rows.q)
            places.append(np.stack([np.full(len(of_split), i), of_split], axis=1))
            poses.append(rows.shard["target_pose"][of_split])
            scenes.append(rows.scenes[of_split])
        self._places = np.concatenate(places)
        """Shard and row of each item."""
        self._poses, self._scenes = np.concatenate(poses), PackedScenes.joined(scenes)

    def __reduce__(self) -> tuple:
        return RopDataset, self._arguments  # pickling memory maps would copy the files

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"index is {index}; there are {len(self)} items")
        return self.__getitems__([index % len(self)])[0]

    def __getitems__(self, indices: list[int]) -> list[dict[str, Tensor]]:
        """Several items for a DataLoader; their clouds are made in one call."""
        worker = get_worker_info()
        number = -1 if worker is None else worker.id
        if number not in self._generators:
            # each worker has its own random numbers, and new ones in every epoch
            seed = self.seed if worker is None else worker.seed % 2**63
            self._generators[number] = torch.Generator(self.device).manual_seed(seed)
        batch = self._batch(np.array(indices), self._generators[number])
        return [{name: column[i] for name, column in vars(batch).items()} for i in range(len(indices))]

    def batches(
        self, batch_size: int, shuffle: bool = True, generator: torch.Generator | None = None
    ) -> Iterator[RopBatch]:
        """Read one epoch of batches, prefetched by as many threads as PyTorch uses, at most 8.

        The shards are put in random order, and the rows are shuffled within blocks of 16 shards. So
        batches that follow each other read the same few files.

        Args:
            batch_size: Number of motions in a batch; the last batch may be smaller.
            shuffle: Whether the order is random.
            generator: CPU generator of the order and the clouds; the same state gives the same batches for
                any number of threads. None: a new generator from `seed`, so that every call gives the same
                epoch.

        Returns:
            An iterator over the batches.

        Raises:
            InputError: For a batch size below 1.
        """
        batch_size = converted("batch_size", Count, batch_size)
        generator = generator or torch.Generator().manual_seed(self.seed)
        order = self._shuffled(generator) if shuffle else np.arange(len(self))
        starts = range(0, len(self), batch_size)
        seeds = torch.randint(2**62, (len(starts),), generator=generator).tolist()
        jobs = (
            partial(self._seeded, order[i : i + batch_size], seed)
            for i, seed in zip(starts, seeds, strict=True)
        )
        return self._run(jobs)

    def _run(self, jobs: Iterator) -> Iterator[RopBatch]:
        threads = min(MAX_THREADS, torch.get_num_threads())
        # each batch is made by one thread: PyTorch's own threads would wait for each other at every step
        pool = ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,))
        waiting: deque = deque()
        try:
            for job in jobs:
                waiting.append(pool.submit(job))
                if len(waiting) > threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _shuffled(self, generator: torch.Generator) -> ndarray:
        """A random order of the items: blocks of shards in random order, each with its items shuffled."""
        shard = self._places[:, 0]
        # items are sorted by shard; `first`: index of each shard's first item, then the number of items
        first = np.searchsorted(shard, np.arange(len(self._trajectories) + 1)).tolist()
        shards = torch.randperm(len(self._trajectories), generator=generator).tolist()
        blocks = [np.zeros(0, np.int64)]
        for i in range(0, len(shards), SHARDS_PER_BLOCK):
            rows = np.concatenate(
                [np.arange(first[s], first[s + 1]) for s in shards[i : i + SHARDS_PER_BLOCK]]
            )
            blocks.append(rows[torch.randperm(len(rows), generator=generator).numpy()])
        return np.concatenate(blocks)

    def _seeded(self, indices: ndarray, seed: int) -> RopBatch:
        return self._batch(indices, torch.Generator(self.device).manual_seed(seed))

    def _batch(self, indices: ndarray, generator: torch.Generator) -> RopBatch:
        shard, row = self._places[indices].T
        waypoints = self.waypoints
        dof = self.manifest.dof
        q = np.empty((len(indices), waypoints, dof), np.float32)
        for s in np.unique(shard):
            of_shard = np.flatnonzero(shard == s)
            q[of_shard] = self._trajectories[s][row[of_shard]]
        raw = torch.from_numpy(q).to(self.device).view(-1, waypoints * dof)
        scaled = torch.addcmul(self._shift, raw, self._scale).view(-1, waypoints, dof)
        scenes = self._scenes[indices]
        pose, kinds, params = (
            torch.from_numpy(a).to(self.device) for a in (self._poses[indices], scenes.kinds, scenes.params)
        )
        points = surface_clouds(scenes, self.points, generator, ordered=self.sort_points)
        return RopBatch(scaled, scaled[:, 0], scaled[:, -1], pose, kinds, params, points)
