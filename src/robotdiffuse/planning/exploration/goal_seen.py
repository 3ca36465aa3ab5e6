"""What was seen of the space that an arm fills at a goal.

Voxels of 2 cm are too coarse for that: those that a goal's arm touches are rarely seen free as a whole. So
the arm's surface there is covered with small balls, each of which an image must see through, or which lies in
voxels that the map knows to be free. What is within the surface needs no view: nothing floats.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from robotdiffuse.perception.assumptions import voxels_of
from robotdiffuse.perception.depth_filter import MARGIN_SPREADS, filtered
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.occupancy_map import MAP, OccupancyMap
from robotdiffuse.perception.seen_balls_kernel import see_through, within_voxels
from robotdiffuse.perception.surface_balls import BALL_RADIUS, surface_balls
from robotdiffuse.perception.view_memory import ViewMemory
from robotdiffuse.perception.seen_points_kernel import sphere_distances
from robotdiffuse.robots.kinematics import placed_spheres
from robotdiffuse.robots.robot import Robot

BORDER = np.float32(1.0)
"""Pixels around a ball's projection that count too in images that were filtered: the filter moves edges by
about one."""



class GoalSeen:
    """Which balls of the arm's surface at goal configurations no view has shown to be free."""

    def __init__(self, robot: Robot, known: OccupancyMap, views: ViewMemory) -> None:
        """views: kept ones, which count for goals that are new."""
        self._robot, self._known, self._views = robot, known, views
        self._unseen: dict[bytes, Float32[ndarray, "n 3"]] = {}
        """Balls that no view sees through, by configuration."""
        self.taken: list[Float[ndarray, "dof"]] = []
        """Configurations of the views since the goal was set."""

    def forget(self) -> None:
        """There is another goal."""
        self._unseen.clear()
        self.taken.clear()

    def observe(self, view: DepthView) -> None:
        """Take a new view into account."""
        if view.configuration is not None:
            self.taken.append(view.configuration)
        for key, balls in self._unseen.items():
            self._unseen[key] = self._not_shown(balls, [view])

    def best(self, goals: Float[ndarray, "n dof"]) -> Float[ndarray, "dof"]:
        """The goal of whose surface least is unseen."""
        return min(goals, key=lambda q: len(self.unseen(q)))

    def unseen(self, q: Float[ndarray, "dof"]) -> Float32[ndarray, "n 3"]:
        """The centres of the balls at a configuration that neither a view nor the map shows to be free
        [m]."""
        key = q.tobytes()
        if key not in self._unseen:
            self._unseen[key] = self._not_shown(surface_balls(self._robot, q), self._views.views)
        balls = self._unseen[key]
        within = np.zeros(len(balls), np.bool_)
        within_voxels(balls, np.float32(BALL_RADIUS), self._known.free, *MAP.frame, within)
        return balls[~within]

    def wanted(self, q: Float[ndarray, "dof"]) -> Bool[ndarray, "nx ny nz"]:
        """The voxels of the unseen balls at a configuration."""
        at = voxels_of(self.unseen(q), MAP)
        at = at[((at >= 0) & (at < MAP.shape)).all(axis=1)]
        out = np.zeros(MAP.shape, np.bool_)
        out[tuple(at.T)] = True
        return out

    def why(self, q: Float[ndarray, "dof"]) -> str:
        """Says how much of the arm's surface at a configuration was not seen; "" if all was."""
        unseen = len(self.unseen(q))
        share = unseen / len(surface_balls(self._robot, q)) if unseen else 0.0
        return f"{100 * share:.2g} % of the arm's surface at the goal was not seen" if unseen else ""

    def _not_shown(
        self, balls: Float32[ndarray, "n 3"], views: Iterable[DepthView]
    ) -> Float32[ndarray, "n 3"]:
        """The balls that no view shows to be free. Where the arm was when it was taken is free too."""
        for view in views:
            depth, spread = filtered(view)
            seen = np.zeros(len(balls), np.bool_)
            if view.configuration is not None:
                spheres = placed_spheres(self._robot, view.configuration).astype(np.float32)
                seen |= sphere_distances(balls, spheres) < -BALL_RADIUS
            see_through(
                depth,
                np.array(view.intrinsics, np.float32),
                view.T_base_camera.astype(np.float32),
                balls,
                np.float32(BALL_RADIUS),
                np.float32(MARGIN_SPREADS * spread),
                BORDER if spread else np.float32(0),
                seen,
            )
            balls = balls[~seen]
        return balls
