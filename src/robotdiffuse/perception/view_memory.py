"""ViewMemory: the views that told most, with what each of them shows, computed once."""

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.observed_volume import ObservedVolume, merged, observe
from robotdiffuse.perception.seen_points import VOXEL, seen_points
from robotdiffuse.robots.robot import Robot


class ViewMemory:
    """Keeps a number of views: a new one takes the place of the kept one that told least."""

    def __init__(self, robot: Robot, most: int) -> None:
        self._robot, self._most = robot, most
        self._told = list[int]()
        self._volumes = list[ObservedVolume]()
        self._points = list[Float32[ndarray, "n 3"]]()

    def __len__(self) -> int:
        return len(self._told)

    def add(self, view: DepthView, told: int) -> None:
        """Keep a view. told: the number of voxels that no view before it told of."""
        q = view.configuration
        assert q is not None
        if len(self) >= self._most:
            least = int(np.argmin(self._told))
            for kept in (self._told, self._volumes, self._points):
                del kept[least]
        self._told.append(told)
        self._volumes.append(observe([view], self._robot, q))
        self._points.append(seen_points([view], self._robot, q))

    def volume(self) -> ObservedVolume:
        """What the kept views together tell of each voxel of 4 cm."""
        return merged(self._volumes)

    def points(self) -> Float[ndarray, "n 3"]:
        """The mean of the points that the kept views observed in each cell of a grid [m]; see
        `seen_points`."""
        every = np.concatenate(self._points).astype(np.float64)
        _, cell, counts = np.unique(_cells(every), return_inverse=True, return_counts=True)
        sums = [np.bincount(cell, every[:, axis], len(counts)) for axis in range(3)]
        return np.stack(sums, axis=1) / counts[:, None]


def _cells(points: Float[ndarray, "n 3"]) -> ndarray:
    """A number for the cell of each point."""
    at = np.floor(points / VOXEL).astype(np.int64)
    at -= at.min(axis=0, initial=0)
    _, ny, nz = at.max(axis=0, initial=0) + 1
    return (at[:, 0] * ny + at[:, 1]) * nz + at[:, 2]
