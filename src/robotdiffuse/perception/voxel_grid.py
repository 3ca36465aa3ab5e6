"""Grids of voxels around an arm, and the voxels that it fills and sweeps."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.collision.kernels.collision_cost import frames_of, placed
from robotdiffuse.core.kernels import HALF, ONE, kernel
from robotdiffuse.core.types import Configuration, Mask, Path, Points, Spheres
from robotdiffuse.robots.robot import Robot

Voxels = Bool[ndarray, "nx ny nz"]
Probabilities = Float32[ndarray, "nx ny nz"]
"""The probability that each voxel is occupied."""
Indices = Int[ndarray, "n 3"]
"""Indices of voxels along x, y and z."""
VOXEL = 0.04
"""Edge length of a coarse voxel [m]."""
LOW = (-1.12, -1.12, -0.1)
"""Lower corner of the observed volume, in the frame of the base [m]. A floor at z = 0 is in the middle of a
layer of coarse voxels."""
SHAPE = (56, 56, 32)
"""Number of coarse voxels along x, y and z: the space around an arm with a reach of 1.1 m on a table."""
JOINT_STEP = np.float32(0.05)
"""Largest motion of a joint between two sampled configurations of a path [rad], [m] for prismatic joints."""
MIN_MOVE = np.float32(0.1)
"""`sweep` marks a sphere again once it has moved by more than this fraction of a voxel's edge."""


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
    """Edge of a voxel [m]."""

    @property
    def frame(self) -> tuple[Float32[ndarray, "3"], np.float32]:
        """The lower corner and the edge as float32, for compiled code."""
        return np.array(self.low, np.float32), np.float32(self.edge)

    def centers(self, at: Indices) -> Points:
        """The centers of the voxels with these indices [m]."""
        return (at + 0.5) * self.edge + self.low

    @property
    def all_centers(self) -> Points:
        """The centers of all voxels, in the order of a flattened grid [m]."""
        return self.centers(np.argwhere(np.ones(self.shape)))

    def indices(self, points: Points) -> Indices:
        """The indices of the voxels that contain points of the base frame; they may be outside the grid."""
        return np.floor((points - self.low) / self.edge).astype(np.int64)

    def contains(self, at: Indices) -> Mask:
        """Which of these indices are inside the grid."""
        return np.asarray(((at >= 0) & (at < self.shape)).all(axis=1))

    def hold(self, marked: Voxels, points: Points) -> Mask:
        """Whether each point is in one of the marked voxels."""
        at = self.indices(points)
        marks = self.contains(at)
        marks[marks] = marked[tuple(at[marks].T)]
        return marks

    def enclose(self, marked: Voxels, points: Points, distance: "float | Float[ndarray, 'n']") -> Mask:
        """Whether each point is in a marked voxel, with marked voxels on all six sides at a distance [m]."""
        sides = np.vstack([np.eye(4, 3), -np.eye(3)])  # row 3 is zero: the point
        return np.all([self.hold(marked, points + np.outer(distance, side)) for side in sides], axis=0)

    def filled(self, robot: Robot, configurations: Iterable[Configuration], margin: float = 0.0) -> Voxels:
        """Voxels with their centers in the arm's covering spheres, inflated by `margin` [m], at any of these
        configurations."""
        return self.within(np.concatenate([robot.placed_spheres(q) for q in configurations]), margin)

    def within(self, spheres: Spheres, margin: float = 0.0) -> Voxels:
        """Voxels with their centers in spheres, inflated by `margin` [m]."""
        out = np.zeros(self.shape, np.bool_)
        mark(spheres.astype(np.float32) + np.array([0, 0, 0, margin], np.float32), *self.frame, out)
        return out

    def swept(self, robot: Robot, path: Path, margin: float = 0.0) -> Voxels:
        """Voxels with their centers in the covering spheres of the arm's moving links, inflated by `margin`
        [m], anywhere on a path."""
        out = np.zeros(self.shape, np.bool_)
        sweep(compile_robot(robot), path.positions.astype(np.float32), np.float32(margin), *self.frame, out)
        return out

    def swept_and_left(self, robot: Robot, path: Path) -> tuple[Voxels, bool]:
        """The voxels of `swept`, and whether the links also sweep space next to the grid."""
        x, y, z = self.low
        nx, ny, nz = self.shape
        low = (x - self.edge, y - self.edge, z - self.edge)
        larger = VoxelGrid(low, (nx + 2, ny + 2, nz + 2), self.edge).swept(robot, path)
        inside = larger[1:-1, 1:-1, 1:-1]
        return inside, bool(larger.sum() > inside.sum())


COARSE = VoxelGrid(LOW, SHAPE, VOXEL)
"""The voxels of the observed volume (4 cm)."""
FINE = VoxelGrid(LOW, FINE_SHAPE, FINE_VOXEL_SIZE)
"""Voxels with half the edge (2 cm) in the same space."""


LAYERS_BELOW = 20
"""Layers of voxels of the map below the observed volume."""
MAP = VoxelGrid(
    (LOW[0], LOW[1], LOW[2] - LAYERS_BELOW * FINE_VOXEL_SIZE),
    (FINE_SHAPE[0], FINE_SHAPE[1], FINE_SHAPE[2] + LAYERS_BELOW),
    FINE_VOXEL_SIZE,
)
"""The voxels of an `OccupancyMap`: the fine ones of the observed volume, and further ones down to 0.4 m
below it, where an arm on a stand reaches."""


def refined(voxels: Bool[ndarray, "mx my mz"], parts: int = 2) -> Voxels:
    """Divides each voxel into `parts` along each axis; the default turns COARSE voxels into FINE ones."""
    return voxels.repeat(parts, 0).repeat(parts, 1).repeat(parts, 2)


@kernel(nogil=True)
def sweep(robot, path, margin, low, voxel, swept):
    """Marks in `swept`, bool[nx, ny, nz], the voxels whose centers the moving links' spheres pass over.

    robot: RobotArrays. path: float32[n, dof]. margin: the covering spheres are inflated by this [m]. low: the
    lower corner of the grid [m]. voxel: edge of a voxel [m].
    """
    dof = path.shape[1]
    frames = np.zeros((dof + 1, 12), np.float32)
    q = np.empty(dof, np.float32)
    last = np.full((len(robot.spheres), 3), np.inf, np.float32)
    still = (MIN_MOVE * voxel) ** 2
    for i in range(max(len(path) - 1, 1)):
        a = path[i]
        b = path[min(i + 1, len(path) - 1)]
        steps = max(int(np.ceil(np.abs(b - a).max() / JOINT_STEP)), 1)
        for step in range(steps + 1):
            for j in range(dof):
                q[j] = a[j] + np.float32(step / steps) * (b[j] - a[j])
            frames_of(robot, q, frames)
            for g in range(len(robot.frame)):
                if robot.frame[g] == 0:
                    continue
                for s in range(robot.first[g], robot.first[g + 1]):
                    sphere = robot.spheres[s]
                    x, y, z = placed(frames[robot.frame[g]], sphere)
                    at = last[s]
                    if (x - at[0]) ** 2 + (y - at[1]) ** 2 + (z - at[2]) ** 2 <= still:
                        continue
                    at[0] = x
                    at[1] = y
                    at[2] = z
                    _mark(x, y, z, sphere[3] + margin, low, voxel, swept)


@kernel(nogil=True)
def mark(spheres, low, voxel, marked):
    """Marks the voxels whose centers are in one of the spheres [n, 4]; see `sweep` for low and voxel."""
    for s in range(len(spheres)):
        _mark(spheres[s, 0], spheres[s, 1], spheres[s, 2], spheres[s, 3], low, voxel, marked)


def surface(marked: Voxels) -> Indices:
    """Indices of the marked voxels that share a face with an unmarked voxel of the grid, in the order of the
    array."""
    from scipy.ndimage import binary_erosion

    return np.argwhere(marked & ~binary_erosion(marked, border_value=1))


@kernel(nogil=True)
def _mark(x, y, z, radius, low, voxel, marked):
    nx, ny, nz = marked.shape
    x = (x - low[0]) / voxel - HALF
    y = (y - low[1]) / voxel - HALF
    z = (z - low[2]) / voxel - HALF
    r = radius / voxel
    for i in range(max(int(np.ceil(x - r)), 0), min(int(np.floor(x + r)), nx - 1) + 1):
        dx = np.float32(i) - x
        for j in range(max(int(np.ceil(y - r)), 0), min(int(np.floor(y + r)), ny - 1) + 1):
            dy = np.float32(j) - y
            square = r * r - dx * dx - dy * dy
            if square < 0:
                continue
            reach = np.sqrt(square)
            first = max(int(np.ceil(z - reach)), 0)
            beyond = min(int(np.floor(z + reach + ONE)), nz)
            for k in range(first, beyond):
                marked[i, j, k] = True


def heaviest_part(marked: Voxels, weights: Probabilities) -> Int[ndarray, "2 3"]:
    """Bounding box of the connected part of the marked voxels with the largest sum of weights.

    Returns the indices of its first voxel, and those of its last voxel plus one; zeros if no voxel is marked.
    Voxels that share a face are connected.
    """
    from scipy import ndimage

    parts, count = ndimage.label(marked)  # type: ignore[misc]
    if not count:
        return np.zeros((2, 3), np.int64)
    heaviest = np.argmax(np.bincount(parts.ravel(), weights.ravel())[1:])
    box = ndimage.find_objects(parts)[heaviest]
    return np.array([[side.start for side in box], [side.stop for side in box]])
