"""OccupancyMap: what many depth views tell of each voxel of 2 cm around the arm, view by view."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.locked import locked
from robotdiffuse.core.settings import NotNegative, Positive, Settings
from robotdiffuse.perception.assumptions import FINE_SHAPE, FINE_VOXEL_SIZE, VoxelGrid, voxels_of
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.free_space_kernel import FREE, HIDDEN, add_evidence
from robotdiffuse.perception.observed_volume import LOW, carve_view
from robotdiffuse.robots.robot import Robot

LAYERS_BELOW = 20
"""Layers of voxels of the map below the observed volume."""
MAP = VoxelGrid(
    (LOW[0], LOW[1], LOW[2] - LAYERS_BELOW * FINE_VOXEL_SIZE),
    (FINE_SHAPE[0], FINE_SHAPE[1], FINE_SHAPE[2] + LAYERS_BELOW),
    FINE_VOXEL_SIZE,
)
"""The voxels of a map: those of `ObservedVolume`, halved, and 0.4 m below it, where an arm on a stand
reaches."""
Corners = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Low and high corner of a box [m]."""


@dataclass(frozen=True)
class MapSettings(Settings, name="map"):
    hit: Positive = 3.0
    """Added to a voxel's evidence by a view with points in it."""
    miss: Positive = 2.0
    """Taken from it by a view that sees through all of it."""
    largest: Positive = 8.0
    """Evidence stays within this, so that a voxel can change."""
    arm_margin: NotNegative = 0.015
    """Points within this distance of the arm's covering spheres are points of the arm [m]; more with noise.
    At least the error of camera calibration."""
    max_age: Positive | None = None
    """Evidence older than this is forgotten [s]; None: never."""


class OccupancyMap:
    """Voxels seen free, occupied, and unknown ones, from many views, each taken into account once.

    A view counts as free what it sees through, and as occupied what holds points. Noisy images are filtered
    first, so that a stray pixel neither blocks nor fills a voxel; pixels without a return say nothing; of the
    arm, and of what it holds, nothing is kept. Where views contradict each other, their number decides.

    The voxels are those of `MAP`.
    """

    def __init__(self, robot: Robot, settings: MapSettings = MapSettings()) -> None:
        self.robot, self.settings = robot, settings
        self._evidence = np.zeros(MAP.shape, np.float32)
        """Above 0 occupied, below free, 0 unknown."""
        self._seen_at = np.full(MAP.shape, -np.inf, np.float64)
        self._declared = np.zeros(MAP.shape, np.bool_)
        self._now = -np.inf
        self._state, self._behind = np.empty(MAP.shape, np.uint8), np.empty(MAP.shape, np.float32)
        self._counts = np.empty(MAP.shape, np.int32)
        self._known: tuple[Bool[ndarray, "nx ny nz"], ...] | None = None

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
        arrays = self._state, self._behind, self._counts
        carve_view(view, self.robot, q, self.settings.arm_margin, MAP.low, MAP.edge, *arrays)
        return self._update(stamp)

    @locked
    def add_points(self, points: Float[ndarray, "n 3"], stamp: float = 0.0) -> None:
        """Take occupied points in the base frame into account [m], such as those of a cloud without a camera
        or of `rd.PointCloud.from_file`. They say nothing about free space."""
        at = voxels_of(np.asarray(points), MAP)
        at = at[MAP.contains(at)]
        self._state[:], self._counts[:] = HIDDEN, 0
        self._counts[tuple(at.T)] = 1
        self._update(stamp)

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

    @property
    def is_blind(self) -> bool:
        """Whether no view has told anything about a voxel."""
        return not self._evidence.any()

    @property
    def occupied(self) -> Bool[ndarray, "nx ny nz"]:
        return self._of_evidence[0]

    @property
    def free(self) -> Bool[ndarray, "nx ny nz"]:
        """Seen free, or declared so and not found occupied."""
        return self._of_evidence[1]

    @property
    def unknown(self) -> Bool[ndarray, "nx ny nz"]:
        return self._of_evidence[2]

    @property
    @locked
    def _of_evidence(self) -> tuple[Bool[ndarray, "nx ny nz"], ...]:
        """Occupied, free and unknown voxels, computed once after each change; read-only."""
        if self._known is None:
            occupied, free = self._evidence > 0, self._evidence < 0
            if self.settings.max_age is not None:
                occupied, free = occupied & self._fresh, free & self._fresh
            free |= self._declared & ~occupied
            self._known = occupied, free, ~(free | occupied)
            for voxels in self._known:
                voxels.flags.writeable = False
        return self._known

    @property
    def _fresh(self) -> Bool[ndarray, "nx ny nz"]:
        assert self.settings.max_age is not None
        return self._seen_at >= self._now - self.settings.max_age

    def _update(self, stamp: float) -> int:
        """Take what `_state` and `_counts` show into account; returns the number of voxels that nothing was
        known of before."""
        self._now = max(self._now, stamp)
        self._known = None
        settings = self.settings
        if settings.max_age is not None:
            self._evidence[~self._fresh] = 0.0
            self._seen_at[(self._counts > 0) | (self._state == FREE)] = stamp
        weights = np.array([settings.hit, settings.miss, settings.largest], np.float32)
        return add_evidence(self._state, self._counts, self._evidence, *weights)
