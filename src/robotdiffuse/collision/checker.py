"""CollisionChecker: the compiled kernels for one robot in one scene."""

from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_robot, compile_scene_for, robot_groups
from robotdiffuse.collision.kernels import collision_cost, lane_clearance, lane_collision
from robotdiffuse.core.errors import InputError, counted
from robotdiffuse.core.types import for_kernels
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene


class CollisionChecker:
    """Checks the covering spheres of a robot for collision with a scene and between links.

    The spheres cover the robot's meshes, so a configuration that is reported free is free. Links that no
    planned joint moves are checked only against other links, since no motion changes their pose in the scene.
    A mesh obstacle is represented by its surface. The arm is connected and starts outside, so no link can get
    inside without touching the surface.
    """

    def __init__(self, robot: Robot, scene: Scene) -> None:
        self.robot = robot
        self.scene = scene
        self.robot_arrays = compile_robot(robot)
        self.scene_arrays = compile_scene_for(robot, scene)

    @cached_property
    def links(self) -> tuple[str, ...]:
        """The moving links with spheres, in the order of `link_clearances`."""
        return tuple(link for link in robot_groups(self.robot) if self.robot.link_frame(link) > 0)

    @cached_property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """The checked pairs of links, in the order of `pair_clearances`."""
        groups = robot_groups(self.robot)
        return tuple((groups[a], groups[b]) for a, b in self.robot_arrays.pairs[:, :2])

    def free(self, q: Float[ndarray, "n dof"]) -> Bool[ndarray, "n"]:
        """Whether each configuration is free of collision."""
        return lane_collision.free_many(self.robot_arrays, self.scene_arrays, self._rows(q), np.float32(0.0))

    def link_clearances(self, q: Float[ndarray, "n dof"], limit: float = 1.0) -> Float[ndarray, "n links"]:
        """Signed distance of each moving link to the scene [m], at most `limit`; a smaller `limit` is faster.

        Distances to point clouds and meshes are at most 0.3 m; above 0.1 m, they are only lower bounds.
        """
        arrays = self.robot_arrays, self.scene_arrays
        return lane_clearance.link_clearances(*arrays, self._rows(q), np.float32(limit))

    def clearances_and_gradients(
        self, q: Float[ndarray, "n dof"], limit: float, margin: float
    ) -> tuple[Float[ndarray, "n links"], Float[ndarray, "n dof"]]:
        """`link_clearances`, and the gradient of the arm's margin violation with respect to q [m/rad].

        The violation is sqrt(sum of h²) over the covering spheres. A sphere at signed distance D from the
        scene contributes h = max(0, margin - D). Violation and gradient are 0 where no sphere is within
        `margin` [m].
        """
        return collision_cost.clearances_and_gradients(
            self.robot_arrays,
            self.scene_arrays,
            self._rows(q),
            np.float32(limit),
            np.float32(margin),
        )

    def pair_clearances(self, q: Float[ndarray, "n dof"]) -> Float[ndarray, "n pairs"]:
        """Signed distance between the spheres of each checked pair of links [m], at most 1 m. It is also 1 m
        if the spheres touch but the pair's table (`sphere_pair_tables.py`) proves that the links do not."""
        return lane_clearance.pair_clearances(self.robot_arrays, self._rows(q), collision_cost.CLEARANCE_CAP)

    def cost_gradients(
        self, q: Float[ndarray, "n dof"], margin: float, self_margin: float = 0.01
    ) -> tuple[Float[ndarray, "n"], Float[ndarray, "n dof"]]:
        """Collision cost of each configuration and its gradient: the paper's hinge loss, squared.

        The cost is positive where the arm is nearer than `margin` [m] to an obstacle, or two links are nearer
        than `self_margin` [m] to each other.
        """
        return collision_cost.cost_gradients(
            self.robot_arrays,
            self.scene_arrays,
            self._rows(q),
            np.float32(margin),
            np.float32(self_margin),
        )

    def _rows(self, q: Float[ndarray, "n dof"]) -> Float[ndarray, "n dof"]:
        """Configurations as float32 for the kernels. They are checked here because compiled code does not
        check its arguments."""
        if q.shape[1] != self.robot.dof:
            raise InputError(
                f"q has {counted(q.shape[1], 'column')}; it must have the {self.robot.dof} planned joints"
            )
        if not np.isfinite(q).all():
            raise InputError("q holds values that are not finite; configurations must be numbers")
        return for_kernels(q, np.float32)
