"""CollisionChecker: the compiled kernels for one robot in one scene."""

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_robot, compile_scene_for, robot_groups
from robotdiffuse.collision.kernels import clearance_gradients, distance, lane_clearance, lane_collision
from robotdiffuse.core.bounds import for_kernels
from robotdiffuse.core.errors import InputError
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene


class CollisionChecker:
    """Collision of covering spheres against the obstacles of a scene and between links.

    The spheres cover the robot's meshes, so that what is called free is free. Links that no planned joint
    moves are checked against other links alone, for no motion could change how they stand to the scene.
    A mesh obstacle counts by its surface: the arm is one piece that starts outside, so it cannot get in.
    """

    def __init__(self, robot: Robot, scene: Scene, padding: float = 0.0) -> None:
        """`padding` [m] is added to the spheres' radii towards the scene."""
        self.robot, self.scene, self.padding = robot, scene, np.float32(padding)
        self.robot_arrays = compile_robot(robot)
        self.scene_arrays = compile_scene_for(robot, scene)
        groups = robot_groups(robot)
        self.links = tuple(link for link in groups if robot.link_frame(link) > 0)
        """The moving links with spheres, in the order of `link_clearances`."""
        self.pairs = tuple((groups[a], groups[b]) for a, b in self.robot_arrays.pairs[:, :2])
        """The checked pairs of links, in the order of `pair_clearances`."""

    def free(self, q: Float[ndarray, "n dof"]) -> Bool[ndarray, "n"]:
        """Whether each configuration is free of collision."""
        return lane_collision.free_many(self.robot_arrays, self.scene_arrays, self._rows(q), self.padding)

    def link_clearances(self, q: Float[ndarray, "n dof"], limit: float = 1.0) -> Float[ndarray, "n links"]:
        """Signed distance of each moving link to the scene [m], at most `limit`; the lower, the faster.

        Towards point clouds and meshes at most 0.3 m, and a lower bound beyond 0.1 m.
        """
        arrays = self.robot_arrays, self.scene_arrays
        return lane_clearance.link_clearances(*arrays, self._rows(q), np.float32(limit)) - self.padding

    def clearances_and_gradients(
        self, q: Float[ndarray, "n dof"], limit: float, margin: float
    ) -> tuple[Float[ndarray, "n links"], Float[ndarray, "n dof"]]:
        """`link_clearances`, and the gradients by the joints of how far the arm is too close [m/rad].

        That is the root of the sum of h² over the covering spheres, with the hinge h = max(0, margin - D) on
        their signed distances to the scene; 0 where no link is within the margin [m].
        """
        links, gradients = clearance_gradients.clearances_and_gradients(
            self.robot_arrays,
            self.scene_arrays,
            self._rows(q),
            np.float32(limit),
            np.float32(margin) + self.padding,
        )
        return links - self.padding, gradients

    def pair_clearances(self, q: Float[ndarray, "n dof"]) -> Float[ndarray, "n pairs"]:
        """Distance between the links of each checked pair [m], at most 1 m."""
        return lane_clearance.pair_clearances(self.robot_arrays, self._rows(q), distance.CAP)

    def cost_gradients(
        self, q: Float[ndarray, "n dof"], margin: float, self_margin: float = 0.01
    ) -> tuple[Float[ndarray, "n"], Float[ndarray, "n dof"]]:
        """Collision cost of each configuration and its gradient: the paper's hinge, squared.

        `margin` and `self_margin` [m]: distances to obstacles and between links below which cost arises.
        """
        return lane_clearance.cost_gradients(
            self.robot_arrays,
            self.scene_arrays,
            self._rows(q),
            np.float32(margin) + self.padding,
            np.float32(self_margin),
        )

    def _rows(self, q: Float[ndarray, "n dof"]) -> Float[ndarray, "n dof"]:
        """Compiled code trusts its arguments, so they are looked at here."""
        if q.shape[1] != self.robot.dof:
            raise InputError(f"q has {q.shape[1]} columns; it must have the {self.robot.dof} planned joints")
        if not np.isfinite(q).all():
            raise InputError("q holds values that are not finite; configurations must be numbers")
        return for_kernels(q, np.float32)
