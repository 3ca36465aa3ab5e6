"""The page: shows a session in browsers with viser, behind an access proxy."""

import contextlib
import socket
import threading
from typing import Any

import numpy as np
import viser
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import quaternion_from_rotation, rotation_from_quaternion, transform
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.scaling import reach
from robotdiffuse.scenes.moving_obstacles import MovingObstacle
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.validation.report import Violation
from robotdiffuse.visualization import style
from robotdiffuse.visualization.live.access import AccessProxy
from robotdiffuse.visualization.live.drawing import (
    GHOST_OPACITY,
    POSE_RATE,
    RED,
    Arm,
    Obstacles,
    Poses,
    draw_candidates,
    draw_trace,
    draw_trees,
    sampled_poses,
)
from robotdiffuse.visualization.live.latest_task import LatestTask
from robotdiffuse.visualization.live.panel import Panel, PanelCallbacks
from robotdiffuse.visualization.live.player import Player
from robotdiffuse.visualization.live.server import add_stage, new_server, set_first_view, stop_server
from robotdiffuse.visualization.live.session import Session, State
from robotdiffuse.visualization.live.validity import validity
from robotdiffuse.visualization.style import GOAL, START, Surface

GIZMO_SIZE, SMALL_GIZMO_SIZE = 0.23, 0.16
"""Sizes of gizmos, as fractions of the arm's reach."""


class Page:
    """Shows a session to all browsers that pass the access proxy on `listening`, until it is closed."""

    def __init__(self, session: Session, listening: socket.socket, token: str = "") -> None:
        self.session = session
        self._selected, self._drawn = "", dict[str, Any]()
        self.server, secret = new_server()
        self._add_static_scene()
        callbacks = PanelCallbacks(self.select, self._seek, self._set_playing)
        self._panel = Panel(self.server, session, callbacks)
        self._obstacles = Obstacles(self.server, self.select)
        self._moving = Obstacles(self.server, lambda _: None)
        self._arms: dict[str, Arm] = {}
        self._poses: Poses | None = None
        self._lock = threading.Lock()
        self.player = Player(self._show_time)
        self._drawing = LatestTask[None](lambda _: self._draw(), "draw")
        session.on_change = self._redraw
        self._proxy = AccessProxy(listening, self.server.get_port(), secret, token)
        self._redraw()
        session.start()

    def select(self, name: str) -> None:
        """Select an obstacle by name; "" for none."""
        self._selected = name
        self._redraw()

    def close(self) -> None:
        """Stop serving and end all threads."""
        self.session.close()
        self._proxy.close()
        self.player.close()
        for gizmo in self._gizmos:
            gizmo.close()
        self._drawing.close()
        stop_server(self.server)

    def _add_static_scene(self) -> None:
        """Add lights, floor and gizmos."""
        server = self.server
        add_stage(server, reach(self.session.state.problem.robot))
        self.goal_gizmo = _Gizmo(server, "/drag/goal", GIZMO_SIZE, self.session.move_goal)
        self._start_gizmo = _Gizmo(server, "/drag/start", SMALL_GIZMO_SIZE, self.session.move_start)
        self._obstacle_gizmo = _Gizmo(server, "/drag/obstacle", GIZMO_SIZE, self._move_selected)
        self._gizmos = self.goal_gizmo, self._start_gizmo, self._obstacle_gizmo

    def _move_selected(self, T_base_handle: Float[ndarray, "4 4"]) -> None:
        if self._selected:
            self.session.move_obstacle(self._selected, T_base_handle)

    def _redraw(self) -> None:
        self._drawing.submit(None)

    def _draw(self) -> None:
        """Draw what has changed; only this task and the player draw."""
        state, selected = self.session.state, self._selected
        problem, robot = state.problem, state.problem.robot
        Poses.of(robot, problem.start[None])  # compiles here, since nothing is sent within the block
        with self.server.atomic():
            self._panel.show(state, validity(state), selected)
            if self._new("robot", robot):
                self._new_robot(robot)
            if self._new("scene", problem.scene) | self._new("selected", selected):
                self._obstacles.show(problem.scene, selected)
                names = [shape.name for shape in problem.known_scene.shapes]
                T = self.session.obstacle_pose(selected) if selected in names else None
                self._obstacle_gizmo.show(T)
            if self._new("moving", problem.moving):
                self._show_moving(problem.moving, 0.0)
            self._start_gizmo.show(link_pose(robot, problem.start, robot.tip))
            if self._new("start", problem.start) | self._new("motion start", state.motion):
                self._ghost("start", None if _starts_at_start(state) else problem.start)
            if self._new("goal", state.goal_configuration):
                self._ghost("goal", state.goal_configuration)
            self.goal_gizmo.show(state.goal_pose)
            if self._new("motion", state.motion):
                self._new_motion(state)
            if self._new("validation", state.validation):
                self._show_violation(state)
            if self._new("candidates", state.candidates):
                draw_candidates(self.server, robot, self._tool, state.candidates)
            answer = state.answer
            trees = answer.trees if state.options.trees and answer is not None else ()
            if (answer is not None or not state.options.trees) and self._new("trees", trees):
                draw_trees(self.server, robot, self._tool, trees)

    def _new(self, what: str, value: object) -> bool:
        """Whether a value has changed since the last drawing."""
        known = what in self._drawn and self._drawn[what] is value
        self._drawn[what] = value
        return not known

    def _new_robot(self, robot: Robot) -> None:
        for arm in self._arms.values():
            arm.remove()
        surfaces = style.robot_surfaces(robot)
        self._tool = style.tool_point(robot, surfaces)
        self._arms = {
            "arm": Arm(self.server, "arm", surfaces),
            "start": Arm(self.server, "start", surfaces, START, GHOST_OPACITY),
            "goal": Arm(self.server, "goal", surfaces, GOAL, GHOST_OPACITY),
            "contact": Arm(self.server, "contact", surfaces, RED, 2 * GHOST_OPACITY),
        }
        for gizmo in self._gizmos:
            gizmo.fit(reach(robot))
        self._set_first_view(surfaces)
        draw_trees(self.server, robot, self._tool, ())
        for what in ("start", "goal", "motion", "validation", "scene", "trees"):
            self._drawn.pop(what, None)

    def _set_first_view(self, surfaces: list[Surface]) -> None:
        """Set the view of new browsers so that most of start and goal is visible."""
        state = self.session.state
        problem, goal = state.problem, state.goal_configuration
        q = np.stack([problem.start, problem.start if goal is None else goal])
        set_first_view(self.server, problem, surfaces, q)

    def _ghost(self, name: str, q: Float[ndarray, "dof"] | None) -> None:
        robot = self.session.state.problem.robot
        self._arms[name].show(None if q is None else Poses.of(robot, q[None]))

    def _new_motion(self, state: State) -> None:
        motion = None if state.motion is None else state.motion.trajectory
        if motion is None:
            with self._lock:
                self._poses = None
            self.server.scene.remove_by_name("/trace")
            self._arms["arm"].show(Poses.of(state.problem.robot, state.problem.start[None]))
            return
        poses = sampled_poses(state.problem.robot, motion)
        with self._lock:
            self._poses = poses
        draw_trace(self.server, state.problem.robot, self._tool, motion)
        self.player.load(motion.duration)

    def _show_violation(self, state: State) -> None:
        """Show the arm in red at the first collision of the motion."""
        violation = None if state.validation is None else state.validation.report.violation
        motion = None if state.motion is None else state.motion.trajectory
        if violation is None or motion is None or not _is_collision(violation):
            self._arms["contact"].show(None)
            return
        q = np.array([np.interp(violation.time, motion.times, column) for column in motion.positions.T])
        self._arms["contact"].show(Poses.of(state.problem.robot, q[None]))

    def _show_time(self, at: float) -> None:
        with self._lock:
            if self._poses is None or "arm" not in self._arms:
                return
            row = min(round(at * POSE_RATE), len(self._poses.xyz) - 1)
            self._arms["arm"].show(self._poses, row)
        self._show_moving(self.session.state.problem.moving, at)
        self._panel.show_time(at, self.player.duration)

    def _show_moving(self, moving: tuple[MovingObstacle, ...], at: float) -> None:
        """Show the moving obstacles where they are at a time of the motion [s]."""
        with self._lock:
            self._moving.show(Scene([one.at(at) for one in moving]), "")

    def _seek(self, at: float) -> None:
        self._set_playing(False)
        self.player.seek(at)

    def _set_playing(self, playing: bool) -> None:
        (self.player.play if playing else self.player.pause)()
        self._panel.show_playing(playing)


class _Gizmo:
    """A transform control; `moved` is called with its pose while it is dragged."""

    def __init__(self, server: viser.ViserServer, name: str, size: float, moved: Any) -> None:
        """size: as a fraction of the arm's reach."""
        self.handle = server.scene.add_transform_controls(name, depth_test=False, visible=False)
        self._held, self._size, self._moved = False, size, moved
        self._moving = LatestTask(self._move, name)

        @self.handle.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            self._held = event.phase != "end"
            if event.phase != "start":
                rotation = rotation_from_quaternion(np.array(event.target.wxyz))
                self._moving.submit(transform(np.array(event.target.position), rotation))

    def _move(self, T: Float[ndarray, "4 4"]) -> None:
        with contextlib.suppress(InputError):  # another visitor has deleted the obstacle
            self._moved(T)

    def close(self) -> None:
        """End its thread."""
        self._moving.close()

    def fit(self, reach: float) -> None:
        """Scale to an arm of this reach [m]."""
        self.handle.scale = self._size * reach

    def show(self, T: Float[ndarray, "4 4"] | None) -> None:
        """Move to a pose, unless it is being dragged; hide for None."""
        if T is not None and not self._held:
            wxyz = quaternion_from_rotation(T[:3, :3])
            handle = self.handle
            if not (np.allclose(handle.position, T[:3, 3]) and np.allclose(handle.wxyz, wxyz)):
                handle.position, handle.wxyz = T[:3, 3], wxyz
        if self.handle.visible is not (T is not None):
            self.handle.visible = T is not None


def _starts_at_start(state: State) -> bool:
    """Whether the motion shown starts at the problem's start, so that no start arm is needed."""
    motion = None if state.motion is None else state.motion.trajectory
    return motion is None or np.allclose(motion.positions[0], state.problem.start)


def _is_collision(violation: Violation) -> bool:
    return violation.kind in ("scene_collision", "self_collision")
