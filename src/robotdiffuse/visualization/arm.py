"""The arm in pictures and on pages: its surfaces, its motions, and facts about a motion."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.exact_meshes import forward_frames
from robotdiffuse.core.types import (
    Configuration,
    Configurations,
    Path,
    PlanResult,
    Points,
    Trajectory,
    Values,
    interpolated,
)
from robotdiffuse.drawables import Surface, join, link_surfaces
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.visual_meshes import has_visual

UNTIMED_SPEED = 0.8
"""Speed in joint space at which a path without times is played [rad/s]."""
TRACE_POINTS = 240
"""Number of configurations along a motion for drawing the tool's trace and for choosing the view."""


class DrawnArm:
    """The surfaces of a robot on each of its dof + 1 frames, and the point of its tool that draws the trace.

    The point is on the z axis of the tip link, as far out as the surfaces on the tip's frame extend: for a
    gripper, this is between the fingertips.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        by_frame: list[list[Surface]] = [[] for _ in range(robot.dof + 1)]
        for link, surface in link_surfaces(robot).items():
            by_frame[robot.link_frame(link)].append(surface.moved(robot.T_frame_link(link)))
        self.surfaces = [join(surfaces) for surfaces in by_frame]
        """One surface for each frame, in the coordinates of the frame [m]."""
        self.tool_frame = robot.link_frame(robot.tip)
        T_frame_tip = robot.T_frame_link(robot.tip)
        heights = (self.surfaces[self.tool_frame].vertices - T_frame_tip[:3, 3]) @ T_frame_tip[:3, 2]
        self.tool_point = T_frame_tip[:3, 3] + max(0.0, heights.max(initial=0.0)) * T_frame_tip[:3, 2]
        """The point that draws the trace, in the coordinates of frame `tool_frame` [m]."""

    def frames(self, q: Float[ndarray, "*batch dof"]) -> Float[ndarray, "*batch frames 4 4"]:
        """T_base_frame of all dof + 1 frames at each configuration."""
        T = forward_frames(self.robot, q.reshape(-1, self.robot.dof))
        return T.reshape(*q.shape[:-1], *T.shape[1:])

    def posed(self, q: Configuration, begin: int = 0) -> Surface:
        """The surface of the arm at a configuration, in the base frame. Only frames from `begin` on are
        included: 1 leaves out the base."""
        poses = zip(self.surfaces[begin:], self.frames(q)[begin:], strict=True)
        return join([surface.moved(T) for surface, T in poses])

    def tool_points(self, q: Configurations) -> Points:
        """Positions of the tool point in the base frame [m]."""
        return self.frames(q)[:, self.tool_frame, :3] @ np.append(self.tool_point, 1.0)

    def trace(self, q: Configurations) -> Points:
        """Positions of the tool point at TRACE_POINTS configurations, equally spaced along a path in joint
        space [m]."""
        return self.tool_points(dense(q))


def dense(q: Configurations) -> Configurations:
    """TRACE_POINTS configurations, equally spaced along a path in joint space; one configuration if the path
    has no length."""
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1))])
    return q[:1] if s[-1] == 0 else interpolated(np.linspace(0, s[-1], TRACE_POINTS), s, q)


def timed(motion: Path | Trajectory) -> tuple[Values, Configurations]:
    """Times [s] and positions of a motion; a path without times gets a constant speed in joint space."""
    if isinstance(motion, Trajectory):
        return motion.times, motion.positions
    steps = np.linalg.norm(np.diff(motion.positions, axis=0), axis=1) / UNTIMED_SPEED
    return np.concatenate([[0.0], np.cumsum(steps)]), motion.positions


def facts(
    motion: Path | Trajectory, result: PlanResult | None, robot: Robot | None = None
) -> list[tuple[str, str]]:
    """Labels and values of facts about a motion, for headers and captions. With `robot`, one of them says
    that the arm is drawn by its collision geometry, if no visual meshes of this robot are bundled."""
    length = result.path_length if result is not None else None
    if length is None:
        length = Path(motion.joint_names, motion.positions).length
    rows = []
    if result is not None:
        rows.append(("status", result.status.value.replace("_", " ")))
        same_planner = result.stage in ("", result.planner)
        rows.append(("planner", result.planner if same_planner else f"{result.planner} · {result.stage}"))
        rows.append(("planning time", f"{1e3 * result.planning_time:.0f} ms"))
    rows.append(("path length", f"{length:.2f} rad"))
    if result is not None and result.min_clearance is not None:
        rows.append(("clearance", f"{result.min_clearance * 1e3:.1f} mm"))
    if result is not None and result.confidence is not None:
        rows.append(("free in unknown space", f"{100 * result.confidence:.0f} %"))
    rows.append(("duration", f"{motion.duration:.2f} s" if isinstance(motion, Trajectory) else "untimed"))
    if robot is not None and not has_visual(robot):
        rows.append(("drawn by", "collision geometry"))
    return rows
