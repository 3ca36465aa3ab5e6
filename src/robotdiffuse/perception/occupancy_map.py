"""OccupancyMap: which voxels of 2 cm around the arm are free, occupied or unknown, updated view by view; and
ViewMemory: keeps the views that showed most new voxels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Int32, UInt8
from numpy import ndarray
from scipy.spatial import KDTree

from robotdiffuse.core import errors
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.locked import locked
from robotdiffuse.core.types import Configuration, Points, Values
from robotdiffuse.perception.depth_filter import PointErrors, filtered, point_errors
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.observed_volume import (
    FREE,
    HIDDEN,
    ObservedVolume,
    add_evidence,
    carve_view,
    merged,
    observed_by,
)
from robotdiffuse.perception.seen_points import CELL, END_SPREADS, POINT_RADIUS, seen_points
from robotdiffuse.perception.voxel_grid import MAP, Voxels
from robotdiffuse.robots.robot import Robot

Corners = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Low and high corner of a box [m]."""


HIT = np.float32(3.0)
"""A view with points in a voxel adds this to the voxel's evidence."""
MISS = np.float32(2.0)
"""A view that sees a whole voxel free subtracts this from the voxel's evidence."""
MOST_EVIDENCE = np.float32(8.0)
"""Evidence is clipped to ± this, so that a few views suffice to change a voxel's state."""
APPEARED_PADDING = 0.05
"""Radius of points that appear in space that was free before [m]: only the front of their object is seen."""
MIN_APPEARED = 12
"""An object appears only if a view has points in so many voxels that are deep in free space; in simulations
with noise and inexact poses, errors filled up to 4."""
COVER_RADIUS = MAP.edge * 3**0.5 / 2
"""Radius of the ball around a voxel's center that covers the voxel [m]."""


class OccupancyMap:
    """Which voxels are free, occupied or unknown, from many views, each taken into account once.

    Voxels that a view sees through are free, and voxels that contain its points are occupied. Noisy images
    are filtered first, so that stray pixels have no effect. Points of the arm and of the objects that it
    holds are ignored, and so are pixels without a return, except where nothing seems to be within the range
    that the view states. If views contradict each other, the sum of their evidence decides (see HIT).

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
        """Take a view into account. Returns the number of voxels that it observes for the first time.

        stamp: when the view was taken [s]. The view's `configuration` is that of the arm at this time. Raises
        InputError if the view has none, or one of the wrong length.
        """
        q = self.configuration_of(view)
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
    def add_points(self, points: Points, stamp: float = 0.0) -> None:
        """Take occupied points in the base frame into account [m], e.g. the points of an
        `rd.PointCloud.from_file`. They give no information about free space."""
        at = MAP.indices(errors.points("map", "points", points))
        at = at[MAP.contains(at)]
        counts = np.zeros(MAP.shape, np.int32)
        counts[tuple(at.T)] = 1
        self._update(np.full(MAP.shape, HIDDEN, np.uint8), counts, stamp)

    @locked
    def declare_free(self, zone: Corners) -> None:
        """Voxels inside a box, given by its low and high corner, count as free unless a view finds them
        occupied."""
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
        reached = MAP.within(spheres, COVER_RADIUS)
        self._doubted = reached & ~self._surely_free
        self._known = None

    @property
    def is_blind(self) -> bool:
        """Whether no view has observed any voxel."""
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
                occupied = occupied & self._fresh
                free = free & self._fresh
            free = free & ~self._doubted | self._declared & ~occupied
            self._known = occupied, free, ~(free | occupied)
            for voxels in self._known:
                voxels.flags.writeable = False
        return self._known

    @property
    def _fresh(self) -> Voxels:
        assert self.max_age is not None
        return self._seen_at >= self._now - self.max_age

    def _update(
        self,
        state: UInt8[ndarray, "nx ny nz"],
        counts: Int32[ndarray, "nx ny nz"],
        stamp: float,
        views: Sequence[DepthView] = (),
    ) -> int:
        """Add a view's evidence for each voxel. Returns the number of voxels observed for the first time.

        views: the view, if there is one. Its errors may displace surfaces, which then have not appeared.
        """
        self._now = max(self._now, stamp)
        self._known = None
        self._doubted[:] = False
        self._surely_free[counts > 0] = False
        observed = (counts > 0) | (state == FREE)
        if self.max_age is not None:
            self._evidence[~self._fresh] = 0.0
            self._surely_free[~self._fresh] = False
            self._seen_at[observed] = stamp
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


@dataclass(frozen=True, eq=False)
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

    def add(self, view: DepthView, new_voxels: int, stated: DepthView) -> None:
        """Keep a view with a configuration. new_voxels: number of voxels that it was the first to observe.
        stated: the same view with the pose that the caller stated."""
        if len(self) >= self._most:
            self._memories.remove(min(self._memories, key=lambda memory: memory.new_voxels))
        assert view.configuration is not None
        self._memories.append(_RememberedView(view, view.configuration, self._robot, new_voxels, stated))

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
        """For each cell of a grid, the mean over the kept views that have a point there (see `seen_points`)
        of these points [m]; and the errors of each mean, see `point_errors`.

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
            once = counts == 1
            distances, _ = KDTree(points).query(points[once], k=2, distance_upper_bound=ALONE_DISTANCE)
            stray[once] |= np.isinf(distances[:, 1])
        return points[~stray], errors[~stray]


def _cells(points: Points) -> ndarray:
    """The number of the cell of CELL edge length that contains each point; equal numbers mean one cell."""
    at = np.floor(points / CELL).astype(np.int64)
    at -= at.min(axis=0, initial=0)
    _, ny, nz = at.max(axis=0, initial=0) + 1
    return (at[:, 0] * ny + at[:, 1]) * nz + at[:, 2]
