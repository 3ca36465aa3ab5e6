"""Unknown space, which no view saw: assumptions about it, the part of it that a motion passes through, and
the probability that the motion is free. `OccupancyMap` says which voxels of 2 cm around the arm are free,
occupied or unknown, and is updated view by view. `ViewMemory` keeps the views that showed most new voxels.

An assumption is a set of obstacles in addition to the observed ones. The space that the arm occupies at its
start and goals is removed from them (carved out).
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Int32, UInt8
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import reach_bound
from robotdiffuse.core import errors
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.locked import locked
from robotdiffuse.core.types import Configuration, Path, Points, Spheres, Values, frozen_dataclass
from robotdiffuse.perception.depth_filter import PointErrors, filtered, point_errors, wide_regions
from robotdiffuse.perception.depth_view import AssumedPoints, DepthView
from robotdiffuse.perception.observed_volume import (
    FREE,
    ObservedVolume,
    add_evidence,
    carve_view,
    merged,
    observed_by,
)
from robotdiffuse.perception.seen_points import (
    CELL,
    END_SPREADS,
    POINT_RADIUS,
    near_scene,
    seen_points,
    sphere_distances,
)
from robotdiffuse.perception.voxel_grid import (
    COARSE,
    FINE,
    MAP,
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


@frozen_dataclass
class Padded:
    """Observed points, inflated."""

    points: Points
    padding: float
    """Radius of the inflated points [m]."""

    @property
    def name(self) -> str:
        return f"points padded by {100 * self.padding:.0f} cm"

    def touched(self, spheres: Spheres) -> Bool[ndarray, "points"]:
        """Which points touch the arm's covering spheres at start or goals and have to be carved out."""
        return sphere_distances(self.points, spheres) < PADDING_FACTOR * self.padding + PADDING_MARGIN

    def obstacles(self, spheres: Spheres) -> AssumedPoints:
        """The obstacles without those that touch these spheres."""
        return AssumedPoints(self.points[~self.touched(spheres)], self.padding, name="padded")


@frozen_dataclass
class OccupiedVoxels:
    """Voxels of the observed volume, coarse or fine, that an assumption takes for occupied."""

    name: str
    occupied: Voxels
    robot: Robot
    known_scene: Scene
    """Shapes that the problem states; voxels inside them are left out."""

    @property
    def grid(self) -> VoxelGrid:
        return COARSE if self.occupied.shape == SHAPE else FINE

    def touched(self, spheres: Spheres) -> Voxels:
        """Which voxels touch these spheres and have to be carved out."""
        return self.occupied & self.grid.within(spheres, CARVING_MARGIN + self.grid.edge / 2)

    def obstacles(self, spheres: Spheres) -> AssumedPoints:
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


Corners = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Low and high corner of a box [m]."""


LOST_WIDTH = 3
"""Smallest width [voxels of 4 cm] of lost regions. The images that the network was trained with had smaller
ones, so it mistakes large ones for free space."""
LOST_PROBABILITY = 0.15
"""Lower predicted probabilities of voxels in lost regions are raised to this. Measured: behind obstacles
that gave no return, 18 % of these voxels were occupied on average; behind a hand in front of the lens, 3 to
7 %."""


def lost_regions(volume: ObservedVolume) -> Voxels:
    """The fine voxels of regions at least LOST_WIDTH wide that are on rays without a return, or behind a
    surface that may cover the lens; see `ObservedVolume.lost`."""
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
        swept, leaves = self._grid.swept_and_left(self._robot, path)
        swept &= self._elsewhere
        crossed = swept & self.unknown
        swept_count = max(int(swept.sum()), 1)
        lost = 0.0 if self._lost is None else float((crossed & self._lost).sum()) / swept_count
        unseen = float(crossed.sum()) / swept_count
        return CrossedSpace(crossed, self.probability, self._grid, lost, unseen, leaves)


@frozen_dataclass
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
    leaves: bool = False
    """Whether the arm leaves the grid, beyond which views are not evaluated."""

    @property
    def blind(self) -> str:
        """Why views say too little about the motion; "" if they say enough."""
        if self.leaves:
            return (
                "the motion leaves the space in which views are evaluated: 1.12 m to each side of the base, "
                "from 0.1 m below to 1.18 m above it"
            )
        if self.unseen_share > MAX_UNSEEN_SHARE:
            return "the views see hardly anything of the space that the motion crosses"
        return ""

    @cached_property
    def risk(self) -> float | None:
        """The summed probability of the voxels; None without a prediction."""
        return None if self.probability is None else float(self.probability[self.voxels].sum(dtype=float))

    @property
    def region(self) -> Corners | None:
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
"""For each assumption: of the motions planned under it without a prediction, the fraction that was free in
the true scene. `python benchmarks/cameras.py --fit` prints these from its problems with even numbers."""

UNSEEN_CONFIDENCE = 0.5
"""Largest confidence of a motion about which views say too little; see `CrossedSpace.blind`."""
MAX_UNSEEN_SHARE = 0.99

# The log odds that a motion is free in the true scene are the first number plus the second times log(risk).
# The risk is the sum of the predicted probabilities of the unknown voxels that the motion passes through.
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
    UNSEEN_CONFIDENCE if views say too little about this space.
    """
    stated = (
        RATES[assumption] * (1 - crossed.lost_share)
        if crossed.risk is None
        else probability_free(crossed.risk, ONE_VIEW)
    )
    return min(stated, UNSEEN_CONFIDENCE) if crossed.blind else stated


HIT = np.float32(3.0)
"""A view with points in a voxel adds this to the voxel's evidence."""
MISS = np.float32(2.0)
"""A view that sees a whole voxel free subtracts this from the voxel's evidence."""
MOST_EVIDENCE = np.float32(8.0)
"""Evidence is clipped to ± this, so that a few views suffice to change a voxel's state."""
APPEARED_PADDING = 0.05
"""Radius of points that appear in space that was free before [m]: only the front of their object is seen."""
MIN_APPEARED = 12
"""An object appears only if a view has points in at least this many voxels that are deep in free space; in
simulations with noise and inexact poses, errors put points into at most 4 such voxels."""
COVER_RADIUS = MAP.edge * 3**0.5 / 2
"""Radius of the ball around a voxel's center that covers the voxel [m]."""


class OccupancyMap:
    """Which voxels are free, occupied or unknown, from many views, each taken into account once.

    Voxels that a view sees through are free, and voxels that contain its points are occupied. Noisy images
    are filtered first, so that stray pixels have no effect. Points of the arm and of the objects that it
    holds are ignored. So are pixels without a return, except in large regions at the border of the image if
    the view states a range: there, nothing seems to be within this range (see `DepthView.range`). If views
    contradict each other, the sum of their evidence decides (see HIT).

    The voxels are those of `MAP`.
    """

    def __init__(self, robot: Robot, max_age: float | None = None) -> None:
        """max_age: evidence that is older than the latest view by more than this is forgotten [s]; None:
        never."""
        self.robot = robot
        self.max_age = max_age
        self._evidence = np.zeros(MAP.shape, np.float32)
        """Positive: occupied; negative: free; 0: unknown."""
        self._surely_free = np.zeros(MAP.shape, np.bool_)
        """Voxels that a view saw free for every camera pose within the error of its pose, and that no later
        view saw occupied."""
        self._doubted = np.zeros(MAP.shape, np.bool_)
        """See `doubt`."""
        self._seen_at = np.full(MAP.shape, -np.inf, np.float64)
        """Time of the last view that observed each voxel [s]; only used with a maximum age."""
        self._declared = np.zeros(MAP.shape, np.bool_)
        """See `declare_free`."""
        self.stale = np.zeros(MAP.shape, np.bool_)
        """Voxels seen free, but not since an object appeared within APPEARED_PADDING: they may be a part of
        it."""
        self._now = -np.inf
        """Time of the latest view [s]."""
        self._known: tuple[Voxels, ...] | None = None
        """Cache of `_of_evidence`; None after a change."""

    @locked
    def add(self, view: DepthView, stamp: float = 0.0) -> int:
        """Take a view into account. Returns the number of voxels that it observes and that had no evidence.

        stamp: when the view was taken [s]. The view's `configuration` is that of the arm at this time. Raises
        InputError if the view has none, or one of the wrong length.
        """
        q = self.configuration_of(view)
        if stamp < self.oldest:  # already forgotten
            return 0
        state, _, counts = carve_view(view, self.robot, q, MAP)
        new_voxels = self._update(state, counts, stamp, [view])
        if any(view.pose_deviation):
            state, _, _ = carve_view(view, self.robot, q, MAP, narrowed=1.0)
        self._surely_free |= state == FREE
        return new_voxels

    def configuration_of(self, view: DepthView) -> Configuration:
        """The arm's configuration in a view. Raises InputError if the view has none, or one of the wrong
        length."""
        q = view.configuration
        if q is None or len(q) != self.robot.dof:
            raise InputError(
                f"view.configuration is {shown(q)}; a map needs the {self.robot.dof} joint positions of"
                f" {self.robot.name} when the view was taken"
            )
        return q

    @locked
    def declare_free(self, zone: Corners) -> None:
        """Voxels inside a box, given by its low and high corner [m], count as free unless a view finds them
        occupied. Raises InputError unless these are two corners, the low one below the high one."""
        low, high = errors.rows("free_zone", zone, 2, 3)
        if not (low < high).all():
            raise InputError(f"free_zone is {shown(zone)}; its low corner must be below its high corner")
        first = np.maximum(np.ceil((low - MAP.low) / MAP.edge - 1e-6), 0).astype(int)
        end = np.maximum(np.floor((high - MAP.low) / MAP.edge + 1e-6), 0).astype(int)
        self._declared[tuple(slice(a, b) for a, b in zip(first, end, strict=True))] = True
        self._known = None

    @locked
    def doubt(self, points: Points, errors: Values) -> None:
        """Until the next view, free voxels within the error of an observed point count as unknown: an
        obstacle may be there.

        Voxels that are declared free stay free, and so do voxels that a view sees free even with the largest
        error of its pose. points: observed points [m]. errors: how far each point may be displaced [m].
        """
        spheres = np.column_stack([points, POINT_RADIUS + errors])[errors > 0]
        self._doubted = MAP.within(spheres, COVER_RADIUS) & ~self._surely_free
        self._known = None

    @property
    def is_blind(self) -> bool:
        """Whether the map holds no evidence, of views or of points."""
        return not self._evidence.any()

    @property
    def occupied(self) -> Voxels:
        return self._of_evidence[0]

    @property
    def free(self) -> Voxels:
        """Voxels that were seen free, or declared free and not found occupied."""
        return self._of_evidence[1]

    @property
    def unknown(self) -> Voxels:
        return self._of_evidence[2]

    @property
    @locked
    def _of_evidence(self) -> tuple[Voxels, ...]:
        """Occupied, free and unknown voxels, computed once after each change; read-only."""
        if self._known is None:
            occupied = self._evidence > 0
            free = self._evidence < 0
            if self.max_age is not None:
                fresh = self._fresh
                occupied = occupied & fresh
                free = free & fresh
            free = free & ~self._doubted | self._declared & ~occupied
            self._known = occupied, free, ~(free | occupied)
            for voxels in self._known:
                voxels.flags.writeable = False
        return self._known

    @property
    def oldest(self) -> float:
        """What was seen before this time is forgotten [s]."""
        return -np.inf if self.max_age is None else self._now - self.max_age

    @property
    def _fresh(self) -> Voxels:
        return self._seen_at >= self.oldest

    def _update(
        self,
        state: UInt8[ndarray, "nx ny nz"],
        counts: Int32[ndarray, "nx ny nz"],
        stamp: float,
        views: Sequence[DepthView] = (),
    ) -> int:
        """Add a view's evidence for each voxel. Returns the number of observed voxels without evidence
        before.

        views: the view, if there is one. A point is taken for a new object only if it is deeper in free
        space than the view's errors may have displaced it.
        """
        self._now = max(self._now, stamp)
        self._known = None
        self._doubted[:] = False
        self._surely_free[counts > 0] = False
        observed = (counts > 0) | (state == FREE)
        if self.max_age is not None:
            forgotten = ~self._fresh
            self._evidence[forgotten] = 0.0
            self._surely_free[forgotten] = False
            self._seen_at[observed] = np.maximum(self._seen_at[observed], stamp)
        # an object that appears is there at once, however often its space was seen free before
        free = self._evidence < 0
        points = MAP.centers(np.argwhere((counts > 0) & free))
        errors = point_errors(views, points)
        appeared = points[MAP.enclose(free, points, MAP.edge + errors @ (1.0, END_SPREADS))]
        self.stale &= ~observed
        if len(appeared) >= (MIN_APPEARED if views else 1):
            near = MAP.within(np.insert(appeared, 3, APPEARED_PADDING, axis=1)) & free & (state != FREE)
            self._evidence[near] = 0.0
            self._surely_free[near] = False
            self.stale |= near
        return add_evidence(state, counts, self._evidence, HIT, MISS, MOST_EVIDENCE)


MAX_VIEWS = 12
"""Default number of views that a ViewMemory keeps."""
MUCH_BETTER = 0.8
"""A kept view gets its refined pose once the deviation of the refined pose, meters plus radians, is below
this fraction of the deviation of its present pose."""
ALONE_DISTANCE = 0.02
"""If images are noisy, a point that only one view shows is stray if no other point is within this distance
[m]. On surfaces at 1 m, 99 of 100 points have at least three others within this distance."""


@frozen_dataclass
class _RememberedView:
    """A view, and what it observes, computed when it is first needed."""

    view: DepthView
    configuration: Configuration
    """The view's configuration."""
    robot: Robot
    new_voxels: int
    """Number of voxels that the view was the first to observe."""
    stated: DepthView
    """The view with the pose that the caller stated."""
    stamp: float
    """When the view was taken [s]."""

    @cached_property
    def volume(self) -> ObservedVolume:
        return observed_by(self.view, self.robot, self.configuration)

    @cached_property
    def points(self) -> Points:
        return seen_points([self.view], self.robot, self.configuration)

    @cached_property
    def errors(self) -> PointErrors:
        return point_errors([self.view], self.points)


class ViewMemory:
    """Keeps at most `most` views: a new view replaces the kept view that showed the fewest new voxels."""

    def __init__(self, robot: Robot, most: int = MAX_VIEWS) -> None:
        self._robot = robot
        self._most = most
        self._memories = list[_RememberedView]()

    def __len__(self) -> int:
        return len(self._memories)

    def add(self, view: DepthView, new_voxels: int, stated: DepthView, stamp: float, oldest: float) -> None:
        """Keep a view with a configuration. new_voxels: number of voxels that it was the first to observe.
        stated: the same view with the pose that the caller stated. stamp: when it was taken [s]. oldest:
        views from before this time are dropped [s]."""
        q = view.configuration
        assert q is not None
        self._memories.append(_RememberedView(view, q, self._robot, new_voxels, stated, stamp))
        self._memories = [memory for memory in self._memories if memory.stamp >= oldest]
        if len(self) > self._most:
            self._memories.remove(min(self._memories[:-1], key=lambda memory: memory.new_voxels))

    def refine(self, refined: Callable[[DepthView], DepthView]) -> None:
        """Give the kept views their refined poses, if these are much better. refined: takes a view with the
        pose that the caller stated, and returns it with the present estimate of the pose."""
        for i, memory in enumerate(self._memories):
            view = refined(memory.stated)
            if sum(view.pose_deviation) < MUCH_BETTER * sum(memory.view.pose_deviation):
                self._memories[i] = replace(memory, view=view)

    @property
    def views(self) -> list[DepthView]:
        """The kept views."""
        return [memory.view for memory in self._memories]

    def volume(self) -> ObservedVolume:
        """The states of voxels of 4 cm according to all kept views."""
        return merged([memory.volume for memory in self._memories])

    def points(self, free: Voxels) -> tuple[Points, PointErrors]:
        """The mean of the kept views' points in each cell of a grid [m], and the errors of each mean, the
        largest errors of its points (see `point_errors`). A view has at most one point in a cell (see
        `seen_points`).

        Stray points are left out: points in free voxels of the map (`free`), through which other views saw,
        and, in noisy images, points of a single view without another point nearby, because a surface gives
        several points.
        """
        every = np.concatenate([memory.points for memory in self._memories]).astype(np.float64)
        _, cell, counts = np.unique(_cells(every), return_inverse=True, return_counts=True)
        sums = [np.bincount(cell, every[:, axis], len(counts)) for axis in range(3)]
        points = np.stack(sums, axis=1) / counts[:, None]
        errors = np.zeros((len(counts), 2))
        np.maximum.at(errors, cell, np.concatenate([memory.errors for memory in self._memories]))
        stray = MAP.hold(free, points)
        if any(filtered(memory.view).spread for memory in self._memories):
            from scipy.spatial import KDTree  # late: plans need no KDTree

            once = counts == 1
            distances, _ = KDTree(points).query(points[once], k=2, distance_upper_bound=ALONE_DISTANCE)
            stray[once] |= np.isinf(distances[:, 1])
        return points[~stray], errors[~stray]


def _cells(points: Points) -> ndarray:
    """The number of the cell of CELL edge length that contains each point; equal numbers mean one cell."""
    at = np.floor(points / CELL).astype(np.int64)
    at -= at.min(axis=0, initial=0)
    return np.asarray(np.ravel_multi_index(tuple(at.T), tuple(at.max(axis=0, initial=0) + 1)))
