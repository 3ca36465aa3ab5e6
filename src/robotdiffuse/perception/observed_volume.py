"""ObservedVolume: voxels within an arm's reach that depth views observed occupied or free; the rest is
unknown."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.perception.depth_filter import filtered, grown_for_noise
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.free_space_kernel import BEHIND, FREE, OUT, SHADOW, carve
from robotdiffuse.robots.kinematics import placed_spheres
from robotdiffuse.robots.robot import Robot

VOXEL = 0.04
"""Edge length of a voxel [m]."""
LOW = (-1.12, -1.12, -0.1)
"""Lower corner of the volume, in the frame of the base [m]. A floor at z = 0 is in the middle of a layer of
voxels, not between two layers."""
SHAPE = (56, 56, 32)
"""Number of voxels along x, y and z: the space around an arm with a reach of 1.1 m on a table."""
ARM_MARGIN = 0.015
"""Points within this distance of the arm's covering spheres are points of the arm [m]; more with noise: see
`grown_for_noise`."""


@dataclass(frozen=True, eq=False)
class ObservedVolume:
    """What the views tell about each voxel. Voxels observed neither occupied nor free are unknown."""

    occupied: Bool[ndarray, "56 56 32"]
    """The voxel contains points that are not the arm's."""
    free: Bool[ndarray, "56 56 32"]
    """A view observed all of it as free."""
    shadow: Bool[ndarray, "56 56 32"]
    """Unknown, and behind the arm in some view."""
    out_of_view: Bool[ndarray, "56 56 32"]
    """Outside all images."""
    behind: Float32[ndarray, "56 56 32"]
    """Depth behind an observed surface, the minimum over all views [m]; 0 if it is behind none."""

    @cached_property
    def unknown(self) -> Bool[ndarray, "56 56 32"]:
        return ~(self.occupied | self.free)


def observe(views: Sequence[DepthView], robot: Robot, start: Float[ndarray, "dof"]) -> ObservedVolume:
    """The volume observed by all views: a voxel is occupied, or else free, if any view says so.

    A voxel is free in a view if none of the pixels that it may cover is nearer than its far side. start: the
    arm's configuration in views without one. Raises InputError without a view, or for a configuration of the
    wrong length.
    """
    if not len(views):
        raise InputError("views is empty; at least one depth view is needed")
    return merged([_observed(view, robot, start) for view in views])


def merged(volumes: Sequence[ObservedVolume]) -> ObservedVolume:
    """What several volumes tell together: a voxel is occupied, or else free, if any of them says so."""
    occupied, free, shadow = (np.zeros(SHAPE, np.bool_) for _ in range(3))
    out, behind = np.ones(SHAPE, np.bool_), np.full(SHAPE, np.inf, np.float32)
    for volume in volumes:
        occupied |= volume.occupied
        free |= volume.free
        shadow |= volume.shadow
        out &= volume.out_of_view
        np.copyto(behind, volume.behind, where=(volume.behind > 0) & (volume.behind < behind))
    free &= ~occupied
    known = free | occupied
    behind[~np.isfinite(behind) | known] = 0.0
    return ObservedVolume(occupied, free, shadow & ~known, out, behind)


def _observed(view: DepthView, robot: Robot, start: Float[ndarray, "dof"]) -> ObservedVolume:
    """The volume observed by one view."""
    q = start if view.configuration is None else view.configuration
    if len(q) != robot.dof:
        raise InputError(f"view.configuration has {len(q)} numbers; {robot.name} plans {robot.dof} joints")
    state, depth, counts = np.empty(SHAPE, np.uint8), np.empty(SHAPE, np.float32), np.empty(SHAPE, np.int32)
    carve_view(view, robot, q, ARM_MARGIN, LOW, VOXEL, state, depth, counts)
    occupied = counts > 0
    depth[(state != BEHIND) | occupied] = 0.0
    return ObservedVolume(
        occupied, (state == FREE) & ~occupied, (state == SHADOW) & ~occupied, state == OUT, depth
    )


def carve_view(
    view: DepthView,
    robot: Robot,
    q: Float[ndarray, "dof"],
    arm_margin: float,
    low: tuple[float, float, float],
    voxel: float,
    state: UInt8[ndarray, "nx ny nz"],
    behind: Float32[ndarray, "nx ny nz"],
    counts: Int32[ndarray, "nx ny nz"],
) -> None:
    """Write what one view tells of each voxel from the corner `low` on, by its filtered image; see `carve`.

    q: the arm's configuration in the view. arm_margin: points within this distance of its covering spheres
    are points of the arm; more with noise [m]. voxel: edge of a voxel [m].
    """
    T, (depth, spread) = view.T_base_camera, filtered(view)
    spheres = grown_for_noise(placed_spheres(robot, q), T, spread)
    spheres[:, :3] = (spheres[:, :3] - T[:3, 3]) @ T[:3, :3]
    spheres[:, 3] += arm_margin
    carve(
        depth,
        np.array(view.intrinsics, np.float32),
        T.astype(np.float32),
        spheres.astype(np.float32),
        np.array(low, np.float32),
        np.float32(voxel),
        state,
        behind,
        counts,
    )
