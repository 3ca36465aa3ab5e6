"""OccupancyMap: what many depth views tell of each voxel of 2 cm around the arm, view by view; and
ViewMemory: the views that showed most, with what each of them shows, computed once.
"""

from collections.abc import Callable
from functools import cached_property

import numpy as np
from jaxtyping import Int32, UInt8
from numpy import ndarray
from scipy.spatial import KDTree

from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.locked import locked
from robotdiffuse.core.types import Configuration, Points, Values
from robotdiffuse.perception.depth_filter import PointErrors, filtered, point_errors
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.observed_volume import (
    ARM_MARGIN,
    FREE,
    HIDDEN,
    ObservedVolume,
    add_evidence,
    carve_view,
    merged,
    observe,
)
from robotdiffuse.perception.seen_points import CELL, POINT_RADIUS, seen_points
from robotdiffuse.perception.voxel_grid import MAP, Voxels
from robotdiffuse.robots.robot import Robot

Corners = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Low and high corner of a box [m]."""


HIT, MISS = np.float32(3.0), np.float32(2.0)
"""Added to a voxel's evidence by a view with points in it, and taken from it by a view that sees through all
of it."""
MOST_EVIDENCE = np.float32(8.0)
"""Evidence stays within this, so that a voxel can change."""
COVER_RADIUS = MAP.edge * 3**0.5 / 2
"""Radius of the ball around a voxel's center that covers the voxel [m]."""


class OccupancyMap:
    """Which voxels are free, occupied or unknown, from many views, each taken into account once.

    A view counts as free what it sees through, and as occupied what holds points. Noisy images are filtered
    first, so that a stray pixel neither blocks nor fills a voxel; pixels without a return say nothing; of the
    arm, and of what it holds, nothing is kept. Where views contradict each other, the majority decides.

    The voxels are those of `MAP`.
    """

    def __init__(self, robot: Robot, max_age: float | None = None) -> None:
        """max_age: evidence older than this is forgotten [s]; None: never."""
        self.robot = robot
        self.max_age = max_age
        self._evidence = np.zeros(MAP.shape, np.float32)
        """Above 0 occupied, below free, 0 unknown."""
        self._surely_free = np.zeros(MAP.shape, np.bool_)
        """Seen free even if the camera's pose is off by all that it may be, and without points since."""
        self._doubted = np.zeros(MAP.shape, np.bool_)
        """See `doubt`."""
        self._seen_at = np.full(MAP.shape, -np.inf, np.float64)
        self._declared = np.zeros(MAP.shape, np.bool_)
        self._now = -np.inf
        self._known: tuple[Voxels, ...] | None = None

    @locked
    def add(self, view: DepthView, stamp: float = 0.0) -> int:
        """Take a view into account; returns the number of voxels that nothing was known of before.

        stamp: when it was taken [s]; `view.configuration` is the arm's at that time. Raises InputError for a
        view without a configuration, or with one of the wrong length.
        """
        q = view.configuration
        if q is None or len(q) != self.robot.dof:
            raise InputError(
                f"view.configuration is {shown(q)}; a map needs the {self.robot.dof} joint positions of"
                f" {self.robot.name} when the view was taken"
            )
        state, _, counts = carve_view(view, self.robot, q, ARM_MARGIN, MAP)
        new_voxels = self._update(state, counts, stamp)
        if any(view.pose_deviation):
            state, _, _ = carve_view(view, self.robot, q, ARM_MARGIN, MAP, narrowed=1.0)
        self._surely_free |= state == FREE
        return new_voxels

    @locked
    def add_points(self, points: Points, stamp: float = 0.0) -> None:
        """Take occupied points in the base frame into account [m], such as those of a cloud without a camera
        or of `rd.PointCloud.from_file`. They say nothing about free space."""
        at = MAP.indices(np.asarray(points))
        at = at[MAP.contains(at)]
        counts = np.zeros(MAP.shape, np.int32)
        counts[tuple(at.T)] = 1
        self._update(np.full(MAP.shape, HIDDEN, np.uint8), counts, stamp)

    @locked
    def declare_free(self, zone: Corners) -> None:
        """Voxels inside a box count as seen free unless a view finds them occupied."""
        low, high = np.asarray(zone, np.float64)
        if not (low < high).all():
            raise InputError(f"free_zone is {shown(zone)}; its low corner must be below its high corner")
        first = np.maximum(np.ceil((low - MAP.low) / MAP.edge - 1e-6), 0).astype(int)
        end = np.maximum(np.floor((high - MAP.low) / MAP.edge + 1e-6), 0).astype(int)
        self._declared[tuple(slice(a, b) for a, b in zip(first, end, strict=True))] = True
        self._known = None

    @locked
    def doubt(self, points: Points, errors: Values) -> None:
        """Until the next view, free voxels within the error of an observed point count as unknown, since an
        obstacle may be there, unless they are declared free or a view sees them free even if its pose is off
        by its largest error.

        points: observed points [m]; errors: how far off each may be [m].
        """
        spheres = np.column_stack([points, POINT_RADIUS + errors])[errors > 0]
        reached = MAP.within(spheres, COVER_RADIUS)
        self._doubted = reached & ~self._surely_free
        self._known = None

    @property
    def is_blind(self) -> bool:
        """Whether no view has told anything about a voxel."""
        return not self._evidence.any()

    @property
    def occupied(self) -> Voxels:
        return self._of_evidence[0]

    @property
    def free(self) -> Voxels:
        """Seen free, or declared so and not found occupied."""
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
        self, state: UInt8[ndarray, "nx ny nz"], counts: Int32[ndarray, "nx ny nz"], stamp: float
    ) -> int:
        """Take what a view shows of each voxel into account; returns the number of voxels that nothing was
        known of before."""
        self._now = max(self._now, stamp)
        self._known = None
        self._doubted[:] = False
        self._surely_free[counts > 0] = False
        if self.max_age is not None:
            self._evidence[~self._fresh] = 0.0
            self._surely_free[~self._fresh] = False
            self._seen_at[(counts > 0) | (state == FREE)] = stamp
        return add_evidence(state, counts, self._evidence, HIT, MISS, MOST_EVIDENCE)


MAX_VIEWS = 12
"""Views that are kept."""
MUCH_BETTER = 0.8
"""Views get a new pose if its deviation is less than this part of the old one's."""
ALONE_DISTANCE = 0.02
"""With noise, a point of one view with no other point within this distance is stray [m]. Of surfaces at 1 m,
99 of 100 points have three or more there."""


class _Kept:
    """A view, and what it shows, computed when it is first needed."""

    def __init__(self, view: DepthView, robot: Robot, new_voxels: int, stated: DepthView) -> None:
        self.view = view
        self._robot = robot
        self.new_voxels = new_voxels
        self.stated = stated

    @cached_property
    def volume(self) -> ObservedVolume:
        return observe([self.view], self._robot, self._configuration)

    @cached_property
    def points(self) -> Points:
        return seen_points([self.view], self._robot, self._configuration)

    @cached_property
    def errors(self) -> PointErrors:
        return point_errors([self.view], self.points)

    @property
    def _configuration(self) -> Configuration:
        assert self.view.configuration is not None
        return self.view.configuration


class ViewMemory:
    """Keeps a number of views: a new one takes the place of the kept one that showed least."""

    def __init__(self, robot: Robot, most: int = MAX_VIEWS) -> None:
        self._robot = robot
        self._most = most
        self._kept = list[_Kept]()

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, view: DepthView, new_voxels: int, stated: DepthView) -> None:
        """Keep a view with a configuration. new_voxels: the number of voxels that it showed first. stated:
        the same view with the pose as the caller gave it."""
        if len(self) >= self._most:
            self._kept.remove(min(self._kept, key=lambda kept: kept.new_voxels))
        self._kept.append(_Kept(view, self._robot, new_voxels, stated))

    def refine(self, refined: Callable[[DepthView], DepthView]) -> None:
        """Give the kept views refined poses where they are much better. refined: takes a view with the
        pose as the caller gave it, and returns it with the pose as it is known now."""
        for at, kept in enumerate(self._kept):
            view = refined(kept.stated)
            if sum(view.pose_deviation) < MUCH_BETTER * sum(kept.view.pose_deviation):
                self._kept[at] = _Kept(view, self._robot, kept.new_voxels, kept.stated)

    @property
    def views(self) -> list[DepthView]:
        """The kept views."""
        return [memory.view for memory in self._kept]

    def volume(self) -> ObservedVolume:
        """What the kept views together tell of each voxel of 4 cm."""
        return merged([memory.volume for memory in self._kept])

    def points(self, free: Voxels) -> tuple[Points, PointErrors]:
        """The mean of the points that the kept views observed in each cell of a grid [m], see `seen_points`,
        and their errors.

        Stray points are left out: those in the free voxels of a map, which more views see through, and, if
        images are noisy, points of a single view with no other point near, since a surface gives several.
        """
        every = np.concatenate([memory.points for memory in self._kept]).astype(np.float64)
        _, cell, counts = np.unique(_cells(every), return_inverse=True, return_counts=True)
        sums = [np.bincount(cell, every[:, axis], len(counts)) for axis in range(3)]
        points = np.stack(sums, axis=1) / counts[:, None]
        errors = np.zeros((len(counts), 2))
        np.maximum.at(errors, cell, np.concatenate([memory.errors for memory in self._kept]))
        at = MAP.indices(points)
        inside = MAP.contains(at)
        stray = np.zeros(len(points), np.bool_)
        stray[inside] = free[tuple(at[inside].T)]
        if any(filtered(memory.view).spread for memory in self._kept):
            once = counts == 1
            distances, _ = KDTree(points).query(points[once], k=2, distance_upper_bound=ALONE_DISTANCE)
            stray[once] |= np.isinf(distances[:, 1])
        return points[~stray], errors[~stray]


def _cells(points: Points) -> ndarray:
    """A number for the cell of each point."""
    at = np.floor(points / CELL).astype(np.int64)
    at -= at.min(axis=0, initial=0)
    _, ny, nz = at.max(axis=0, initial=0) + 1
    return (at[:, 0] * ny + at[:, 1]) * nz + at[:, 2]
