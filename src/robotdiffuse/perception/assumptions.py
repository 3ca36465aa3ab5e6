"""Assumptions about unknown space: obstacles in addition to what was seen.

The space that the arm occupies at its start and goals is carved out of these obstacles.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_scene_for, reach_bound
from robotdiffuse.perception.depth_view import AssumedPoints
from robotdiffuse.perception.observed_volume import LOW, SHAPE, VOXEL, ObservedVolume
from robotdiffuse.perception.seen_points_kernel import near_scene, sphere_distances
from robotdiffuse.perception.swept_voxels_kernel import mark, surface
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.point_cloud import voxel_thin
from robotdiffuse.scenes.scene import Scene

PADDINGS = (0.09, 0.06, 0.04)
"""Paddings of observed points, the largest first [m]."""
PADDING_FACTOR, PADDING_MARGIN = 1.3, 0.01
"""Points nearer to the arm's covering spheres than this factor of their padding and this margin [m] are not
padded: thinning may enlarge them by so much."""
THINNING_CELL = 1 / 3
"""One point is kept of each cell of this size, as a fraction of the padding."""
THRESHOLDS = (0.1, 0.2, 0.35, 0.5)
"""Probabilities above which a predicted voxel is an obstacle, the most careful first."""
CARVING_MARGIN = 0.02
"""Voxels nearer to the arm's covering spheres than this are carved out [m]."""
FINE_VOXEL_SIZE = VOXEL / 2
"""Edge of a predicted voxel [m]."""
FINE_SHAPE = (2 * SHAPE[0], 2 * SHAPE[1], 2 * SHAPE[2])


@dataclass(frozen=True)
class VoxelGrid:
    """Cubic voxels in the frame of the base."""

    low: tuple[float, float, float]
    """Lower corner [m]."""
    shape: tuple[int, int, int]
    """Number of voxels along x, y and z."""
    edge: float
    """Of a voxel [m]."""

    @property
    def frame(self) -> tuple[Float32[ndarray, "3"], np.float32]:
        """The lower corner and the edge as compiled code takes them."""
        return np.array(self.low, np.float32), np.float32(self.edge)

    def centers(self, at: Int[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        """The centres of the voxels of these indices [m]."""
        return (at + 0.5) * self.edge + self.low

    def contains(self, at: Int[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Which of these indices are of voxels of the grid."""
        return np.asarray(((at >= 0) & (at < self.shape)).all(axis=1))


COARSE, FINE = VoxelGrid(LOW, SHAPE, VOXEL), VoxelGrid(LOW, FINE_SHAPE, FINE_VOXEL_SIZE)
"""The voxels of the observed volume, and those halved."""


class Assumption(ABC):
    """Obstacles in addition to what was seen."""

    name: str

    @abstractmethod
    def _touched(self, spheres: Float32[ndarray, "n 4"]) -> Bool[ndarray, "..."]:
        """Which obstacles are in the way of the arm's covering spheres: x y z radius [m]."""

    def touched(self, spheres: Float32[ndarray, "n 4"]) -> int:
        """The number of obstacles that have to be carved out for these spheres."""
        return int(self._touched(spheres).sum())

    @abstractmethod
    def obstacles(self, spheres: Float32[ndarray, "n 4"]) -> AssumedPoints:
        """The obstacles that are left once those in the way of these spheres are carved out."""


@dataclass(frozen=True, eq=False)
class Padded(Assumption):
    """Observed points, inflated."""

    points: Float[ndarray, "points 3"]
    padding: float
    """[m]"""

    @property
    def name(self) -> str:  # type: ignore[override]
        return f"points padded by {100 * self.padding:.0f} cm"

    def _touched(self, spheres: Float32[ndarray, "n 4"]) -> Bool[ndarray, "points"]:
        return sphere_distances(self.points, spheres) < PADDING_FACTOR * self.padding + PADDING_MARGIN

    def obstacles(self, spheres: Float32[ndarray, "n 4"]) -> AssumedPoints:
        """See `Assumption`."""
        return AssumedPoints(self.points[~self._touched(spheres)], self.padding, name="padded")


@dataclass(frozen=True, eq=False)
class Voxels(Assumption):
    """Occupied voxels of the observed volume, coarse or fine."""

    name: str
    occupied: Bool[ndarray, "nx ny nz"]
    robot: Robot
    known_scene: Scene
    """What is known without views; voxels within it are left out."""

    @property
    def grid(self) -> VoxelGrid:
        return COARSE if self.occupied.shape == SHAPE else FINE

    def _touched(self, spheres: Float32[ndarray, "n 4"]) -> Bool[ndarray, "nx ny nz"]:
        return self.occupied & voxels_in(spheres, CARVING_MARGIN + self.grid.edge / 2, self.grid)

    def obstacles(self, spheres: Float32[ndarray, "n 4"]) -> AssumedPoints:
        """The voxels at the surface of what is occupied: the arm starts outside and cannot get within. Those
        out of reach, and those in the known scene, are left out."""
        edge = self.grid.edge
        points = self.grid.centers(surface(self.occupied & ~self._touched(spheres)))
        points = points[np.linalg.norm(points, axis=1) < reach_bound(self.robot) + edge]
        points = without_known(points, edge, self.robot, self.known_scene)
        return AssumedPoints(points, edge / 2, name="unknown")


def without_known(
    centers: Float[ndarray, "n 3"], edge: float, robot: Robot, known_scene: Scene
) -> Float[ndarray, "m 3"]:
    """The centres of voxels with this edge, without those of voxels in the known scene [m]."""
    if not known_scene.shapes:
        return centers
    scene, inside = compile_scene_for(robot, known_scene), np.float32(edge / 2 - 1e-3)
    return centers[~near_scene(scene, centers.astype(np.float32), inside)]


def refined(voxels: Bool[ndarray, "mx my mz"]) -> Bool[ndarray, "nx ny nz"]:
    """Coarse voxels of the observed volume as fine ones, of half the edge."""
    return voxels.repeat(2, 0).repeat(2, 1).repeat(2, 2)


def voxels_of(points: Float[ndarray, "n 3"], grid: VoxelGrid) -> Int[ndarray, "n 3"]:
    """The indices of the voxels that points in the base frame lie in; they may be outside of the grid."""
    return np.floor((points - grid.low) / grid.edge).astype(np.int64)


def voxels_in(
    spheres: Float32[ndarray, "n 4"], margin: float = 0.0, grid: VoxelGrid = FINE
) -> Bool[ndarray, "nx ny nz"]:
    """Voxels with their centres in spheres, inflated by `margin` [m]."""
    out = np.zeros(grid.shape, np.bool_)
    larger = spheres + np.array([0, 0, 0, margin], np.float32)
    mark(larger, *grid.frame, out)
    return out


def padded_assumptions(points: Float[ndarray, "points 3"]) -> Iterator[Assumption]:
    """Observed points, inflated: the largest padding first."""
    for padding in PADDINGS:
        yield Padded(voxel_thin(points, padding * THINNING_CELL), padding)


def predicted_assumptions(
    predicted: Float32[ndarray, "nx ny nz"], robot: Robot, known_scene: Scene
) -> Iterator[Assumption]:
    """Voxels that are occupied with a probability above a threshold: the lowest threshold first.

    predicted: the probability that each fine voxel is occupied.
    """
    for threshold in THRESHOLDS:
        yield Voxels(f"predicted, p > {threshold:g}", predicted > threshold, robot, known_scene)


def occupied_assumption(volume: ObservedVolume, robot: Robot, known_scene: Scene) -> Assumption:
    """Every voxel that no view saw is occupied."""
    return Voxels("unknown is occupied", volume.unknown, robot, known_scene)
