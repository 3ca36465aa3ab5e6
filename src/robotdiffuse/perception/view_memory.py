"""ViewMemory: the views that showed most, with what each of them shows, computed once."""

from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from scipy.spatial import KDTree

from robotdiffuse.perception.assumptions import voxels_of
from robotdiffuse.perception.depth_filter import filtered
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.observed_volume import ObservedVolume, merged, observe
from robotdiffuse.perception.occupancy_map import MAP
from robotdiffuse.perception.seen_points import VOXEL, seen_points
from robotdiffuse.robots.robot import Robot

ALONE_DISTANCE = 0.02
"""With noise, a point of one view with no other point within this distance is stray [m]. Of surfaces at 1 m,
99 of 100 points have three or more there."""


class _Kept:
    """A view, and what it shows, computed when it is first needed."""

    def __init__(self, view: DepthView, robot: Robot, new_voxels: int) -> None:
        self.view, self._robot, self.new_voxels = view, robot, new_voxels

    @cached_property
    def volume(self) -> ObservedVolume:
        return observe([self.view], self._robot, self._configuration)

    @cached_property
    def points(self) -> Float32[ndarray, "n 3"]:
        return seen_points([self.view], self._robot, self._configuration)

    @property
    def _configuration(self) -> Float[ndarray, "dof"]:
        assert self.view.configuration is not None
        return self.view.configuration


class ViewMemory:
    """Keeps a number of views: a new one takes the place of the kept one that showed least."""

    def __init__(self, robot: Robot, most: int) -> None:
        self._robot, self._most = robot, most
        self._kept = list[_Kept]()

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, view: DepthView, new_voxels: int) -> None:
        """Keep a view with a configuration. new_voxels: the number of voxels that it showed first."""
        if len(self) >= self._most:
            self._kept.remove(min(self._kept, key=lambda kept: kept.new_voxels))
        self._kept.append(_Kept(view, self._robot, new_voxels))

    @property
    def views(self) -> list[DepthView]:
        """The kept views."""
        return [kept.view for kept in self._kept]

    def volume(self) -> ObservedVolume:
        """What the kept views together tell of each voxel of 4 cm."""
        return merged([kept.volume for kept in self._kept])

    def points(self, free: Bool[ndarray, "nx ny nz"]) -> Float[ndarray, "n 3"]:
        """The mean of the points that the kept views observed in each cell of a grid [m]; see `seen_points`.

        Stray points are left out: those in the free voxels of a map, since more views see through them, and
        with noise those of one view that have no other point near: surfaces show more.
        """
        every = np.concatenate([kept.points for kept in self._kept]).astype(np.float64)
        _, cell, counts = np.unique(_cells(every), return_inverse=True, return_counts=True)
        sums = [np.bincount(cell, every[:, axis], len(counts)) for axis in range(3)]
        points = np.stack(sums, axis=1) / counts[:, None]
        at = voxels_of(points, MAP)
        inside = MAP.contains(at)
        stray = np.zeros(len(points), np.bool_)
        stray[inside] = free[tuple(at[inside].T)]
        if any(filtered(kept.view).spread for kept in self._kept):
            once = counts == 1
            distances, _ = KDTree(points).query(points[once], k=2, distance_upper_bound=ALONE_DISTANCE)
            stray[once] |= np.isinf(distances[:, 1])
        return points[~stray]


def _cells(points: Float[ndarray, "n 3"]) -> ndarray:
    """A number for the cell of each point."""
    at = np.floor(points / VOXEL).astype(np.int64)
    at -= at.min(axis=0, initial=0)
    _, ny, nz = at.max(axis=0, initial=0) + 1
    return (at[:, 0] * ny + at[:, 1]) * nz + at[:, 2]
