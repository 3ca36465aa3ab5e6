"""Unknown space, which no view saw: assumptions about it, the part of it that a motion passes through, and
the probability that this part is free.

An assumption is a set of obstacles in addition to the observed ones. The space that the arm occupies at its
start and goals is removed from them (carved out).
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import reach_bound
from robotdiffuse.core.types import Configuration, Path, Points
from robotdiffuse.perception.depth_filter import wide_regions
from robotdiffuse.perception.depth_view import AssumedPoints
from robotdiffuse.perception.observed_volume import ObservedVolume
from robotdiffuse.perception.seen_points import near_scene, sphere_distances
from robotdiffuse.perception.voxel_grid import (
    COARSE,
    FINE,
    SHAPE,
    Probabilities,
    VoxelGrid,
    Voxels,
    heaviest_part,
    refined,
    surface,
)
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

PADDINGS = (0.09, 0.06, 0.04)
"""Radii to which observed points are inflated, the largest first [m]."""
# Points nearer to the arm's covering spheres at start or goals than PADDING_FACTOR times their padding plus
# PADDING_MARGIN [m] are left out: thinning may enlarge points by so much.
PADDING_FACTOR = 1.3
PADDING_MARGIN = 0.01
THRESHOLDS = (0.1, 0.2, 0.35, 0.5)
"""Probabilities above which a predicted voxel is an obstacle, the most cautious first."""
CARVING_MARGIN = 0.02
"""Voxels nearer to the arm's covering spheres at start or goals than this are carved out [m]."""


@dataclass(frozen=True, eq=False)
class Padded:
    """Observed points, inflated."""

    points: Points
    padding: float
    """Radius of the inflated points [m]."""

    @property
    def name(self) -> str:
        return f"points padded by {100 * self.padding:.0f} cm"

    def touched(self, spheres: Float32[ndarray, "n 4"]) -> Bool[ndarray, "points"]:
        """Which points touch the arm's covering spheres (x, y, z, radius [m]) at start or goals and have to
        be carved out."""
        return sphere_distances(self.points, spheres) < PADDING_FACTOR * self.padding + PADDING_MARGIN

    def obstacles(self, spheres: Float32[ndarray, "n 4"]) -> AssumedPoints:
        """The obstacles without those that touch these spheres."""
        return AssumedPoints(self.points[~self.touched(spheres)], self.padding, name="padded")


@dataclass(frozen=True, eq=False)
class OccupiedVoxels:
    """Occupied voxels of the observed volume, coarse or fine."""

    name: str
    occupied: Voxels
    robot: Robot
    known_scene: Scene
    """Shapes that the problem states; voxels inside them are left out."""

    @property
    def grid(self) -> VoxelGrid:
        return COARSE if self.occupied.shape == SHAPE else FINE

    def touched(self, spheres: Float32[ndarray, "n 4"]) -> Voxels:
        """Which voxels touch these spheres and have to be carved out."""
        return self.occupied & self.grid.within(spheres, CARVING_MARGIN + self.grid.edge / 2)

    def obstacles(self, spheres: Float32[ndarray, "n 4"]) -> AssumedPoints:
        """The occupied voxels at the boundary of the occupied region; the arm, which starts outside, cannot
        reach inner ones. Voxels out of the arm's reach or in the known scene are left out."""
        edge = self.grid.edge
        points = self.grid.centers(surface(self.occupied & ~self.touched(spheres)))
        points = points[np.linalg.norm(points, axis=1) < reach_bound(self.robot) + edge]
        points = without_known(points, edge, self.robot, self.known_scene)
        return AssumedPoints(points, edge / 2, name="unknown")


Assumption = Padded | OccupiedVoxels
"""Obstacles in unknown space, in addition to the observed ones."""


def without_known(centers: Points, edge: float, robot: Robot, known_scene: Scene) -> Points:
    """The centers of those voxels that are not in the known scene [m]. edge: edge of the voxels [m]."""
    return centers[~near_scene(robot, known_scene, centers, edge / 2 - 1e-3)]


Box = tuple[tuple[float, ...], tuple[float, ...]]
"""Low and high corner [m]."""


LOST_WIDTH = 3
"""Smallest width [voxels of 4 cm] of lost regions. The images that the network was trained with had smaller
ones, so it mistakes large ones for free space."""
LOST_PROBABILITY = 0.15
"""Smallest probability that a voxel of a lost region is occupied. Behind obstacles that gave no return it was
0.18 on average, behind a hand before the lens 0.03 to 0.07."""


def lost_regions(volume: ObservedVolume) -> Voxels:
    """The fine voxels that were lost in regions at least LOST_WIDTH wide."""
    lost = volume.lost
    return refined(wide_regions(lost, LOST_WIDTH) if lost.any() else lost)


class UnknownSpace:
    """The unknown voxels outside the arm at its start and goals, and their predicted probabilities."""

    def __init__(
        self,
        robot: Robot,
        free_configurations: Iterable[Configuration],
        unknown: Voxels,
        predicted: Probabilities | None,
        margin: float = CARVING_MARGIN,
        grid: VoxelGrid = FINE,
        lost: Voxels | None = None,
    ) -> None:
        """
        free_configurations: configurations at which the arm is known to be free: the start and the goals.
        unknown: the voxels of the grid that no view saw.
        predicted: the probability that each voxel is occupied; None without a prediction.
        margin: voxels nearer to the arm at these configurations than this count as occupied by it [m].
        lost: see `lost_regions`; only confidences without a prediction depend on it.
        """
        self._robot = robot
        self._grid = grid
        self._lost = lost
        self._elsewhere = ~grid.filled(robot, free_configurations, margin)
        self.unknown = unknown & self._elsewhere
        self.probability = None if predicted is None else np.where(self.unknown, predicted, np.float32(0))

    def crossed(self, path: Path) -> "CrossedSpace":
        """The unknown voxels that the arm passes through on a path."""
        swept = self._grid.swept(self._robot, path) & self._elsewhere
        crossed = swept & self.unknown
        swept_count = max(int(swept.sum()), 1)
        lost = 0.0 if self._lost is None else float((crossed & self._lost).sum()) / swept_count
        return CrossedSpace(crossed, self.probability, self._grid, lost, float(crossed.sum()) / swept_count)


@dataclass(frozen=True, eq=False)
class CrossedSpace:
    """The unknown space that a motion passes through."""

    voxels: Voxels
    probability: Probabilities | None
    """Predicted probability that each voxel is occupied; None without a prediction."""
    grid: VoxelGrid = FINE
    lost_share: float = 0.0
    """Fraction of the voxels on the motion that are in lost regions."""
    unseen_share: float = 0.0
    """Fraction of the voxels on the motion that no view saw."""

    @cached_property
    def risk(self) -> float | None:
        """The summed probability of the voxels; None without a prediction."""
        return None if self.probability is None else float(self.probability[self.voxels].sum(dtype=float))

    @property
    def region(self) -> Box | None:
        """The bounding box of the connected part of the voxels with the largest summed probability or,
        without a prediction, with the most voxels; None if there are no voxels."""
        if not self.voxels.any():
            return None
        weights = np.ones(self.grid.shape, np.float32) if self.probability is None else self.probability
        corners = heaviest_part(self.voxels, weights) * self.grid.edge + np.array(self.grid.low)
        low, high = corners.round(3).tolist()
        return tuple(low), tuple(high)


RATES: dict[str, float] = {
    "as seen": 0.64,
    "points padded by 9 cm": 0.82,
    "points padded by 6 cm": 0.7,
    "points padded by 4 cm": 0.5,
    "unknown is occupied": 0.99,
}
"""For each assumption, the fraction of the motions planned under it without a prediction that were free in
the true scene. `python benchmarks/cameras.py --fit` prints these from its problems with even numbers."""

UNSEEN_CONFIDENCE = 0.5
"""Largest confidence of a motion with an unseen share above MAX_UNSEEN_SHARE."""
MAX_UNSEEN_SHARE = 0.99

# The log odds that a motion is free in the true scene are the first number plus the second times log(risk),
# where risk is the summed probability that the voxels that the motion passes through are occupied.
ONE_VIEW = (2.56, -0.66)
"""Fitted to 820 motions from one view, by `python benchmarks/cameras.py --fit`."""
EXPLORED = (4.05, -1.15)
"""For motions of an Explorer, whose views left little unknown. Fitted to 493 motions of
`benchmarks/exploring.py`, half of them with noise; see its report."""
MIN_RISK = 0.2
"""Smaller risks are raised to this."""


def probability_free(risk: float, curve: tuple[float, float]) -> float:
    """The probability that a motion with a risk is free in the true scene. curve: ONE_VIEW or EXPLORED."""
    odds, slope = curve
    return 1 / (1 + math.exp(-(odds + slope * math.log(max(risk, MIN_RISK)))))


def confidence(assumption: str, crossed: CrossedSpace) -> float:
    """The probability that a motion under an assumption is free in the true scene.

    It follows from the risk. Without a prediction, it is the rate of the assumption in RATES, reduced in
    proportion to the share of lost regions in the space that the motion passes through. It is at most
    UNSEEN_CONFIDENCE if views saw hardly any of this space.
    """
    stated = (
        RATES[assumption] * (1 - crossed.lost_share)
        if crossed.risk is None
        else probability_free(crossed.risk, ONE_VIEW)
    )
    return min(stated, UNSEEN_CONFIDENCE) if crossed.unseen_share > MAX_UNSEEN_SHARE else stated
