"""What depth views tell of the space within an arm's reach: voxels seen occupied, seen free, and the rest."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from robotdiffuse.core.bounds import for_kernels
from robotdiffuse.core.errors import InputError
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.free_space_kernel import BEHIND, FREE, OUT, SHADOW, carve
from robotdiffuse.robots.kinematics import placed_spheres
from robotdiffuse.robots.robot import Robot

VOXEL = 0.04
"""Edge of a voxel [m]."""
LOW = (-1.12, -1.12, -0.1)
"""Least corner of the volume, in the frame of the base [m]: a floor at z = 0 is in the middle of voxels, and
not between two layers of them."""
SHAPE = (56, 56, 32)
"""Voxels along x, y and z: all that an arm of a reach of 1.1 m on a table gets near."""
ARM_MARGIN = 0.015
"""Points so close to the arm's covering spheres are taken for the arm's own: more than depth is off [m]."""


@dataclass(frozen=True, eq=False)
class ObservedVolume:
    """What is known of each voxel of the volume. What is neither seen occupied nor free is unknown."""

    occupied: Bool[ndarray, "56 56 32"]
    """Points lie in it that are not the arm's."""
    free: Bool[ndarray, "56 56 32"]
    """A view saw through all of it."""
    shadow: Bool[ndarray, "56 56 32"]
    """Unknown, and in some view behind the arm."""
    out_of_view: Bool[ndarray, "56 56 32"]
    """In no image."""
    behind: Float32[ndarray, "56 56 32"]
    """How far behind a surface that was seen, in the view where that is least [m]; 0 where behind none."""

    @cached_property
    def unknown(self) -> Bool[ndarray, "56 56 32"]:
        return ~(self.occupied | self.free)


def observe(views: Sequence[DepthView], robot: Robot, start: Float[ndarray, "dof"]) -> ObservedVolume:
    """What the views tell together: occupied or free where any of them says so, occupied first.

    A voxel is free where no pixel that it may cover is nearer than its far side. `start`: the arm's
    configuration in views that tell none. Raises InputError without a view, or for a configuration of another
    robot.
    """
    if not len(views):
        raise InputError("views is empty; at least one depth view is needed")
    occupied, free, shadow = (np.zeros(SHAPE, np.bool_) for _ in range(3))
    out, behind = np.ones(SHAPE, np.bool_), np.full(SHAPE, np.inf, np.float32)
    state, depth, counts = np.empty(SHAPE, np.uint8), np.empty(SHAPE, np.float32), np.empty(SHAPE, np.int32)
    for view in views:
        q = start if view.configuration is None else view.configuration
        if len(q) != robot.dof:
            raise InputError(
                f"view.configuration has {len(q)} numbers; {robot.name} plans {robot.dof} joints"
            )
        T = view.T_base_camera
        spheres = placed_spheres(robot, q)
        spheres[:, :3] = (spheres[:, :3] - T[:3, 3]) @ T[:3, :3]
        spheres[:, 3] += ARM_MARGIN
        carve(
            for_kernels(view.depth, np.float32),
            np.array(view.intrinsics, np.float32),
            T.astype(np.float32),
            spheres.astype(np.float32),
            np.array(LOW, np.float32),
            np.float32(VOXEL),
            state,
            depth,
            counts,
        )
        occupied |= counts > 0
        free |= state == FREE
        shadow |= state == SHADOW
        out &= state == OUT
        np.copyto(behind, depth, where=(state == BEHIND) & (depth < behind))
    free &= ~occupied
    known = free | occupied
    behind[~np.isfinite(behind) | known] = 0.0
    return ObservedVolume(occupied, free, shadow & ~known, out, behind)
