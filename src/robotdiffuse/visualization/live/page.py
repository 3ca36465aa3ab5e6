"""The page: shows a session in browsers with viser."""

import contextlib
import threading
from functools import partial
from typing import Any

import numpy as np
import viser
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import rotation_from_quaternion, transform
from robotdiffuse.drawables import GOAL, START, drawables, own_frame
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.scaling import reach
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.visualization.arm import DrawnArm, interpolated
from robotdiffuse.visualization.live.drawing import (
    GHOST_OPACITY,
    POSE_RATE,
    RED,
    Arm,
    Obstacles,
    draw_candidates,
    draw_trace,
    draw_trees,
    place,
    sampled_frames,
)
from robotdiffuse.visualization.live.panel import Panel, PanelCallbacks
from robotdiffuse.visualization.live.server import PageServer
from robotdiffuse.visualization.live.session import COLLISIONS, Session, State, validity
from robotdiffuse.visualization.live.threads import Changes, LatestTask, Player

GIZMO_SIZE, SMALL_GIZMO_SIZE = 0.23, 0.16
"""Sizes of gizmos, as fractions of the arm's reach."""


class Page:
    """Shows a session to all browsers that the server lets in, until it is closed."""

    def __init__(self, session: Session, server: PageServer) -> None:
        self.session = session
        self.server = server
        self._selected = ""
        self._changes = Changes()
        server.add_stage(reach(session.state.problem.robot))
        self.goal_gizmo = _Gizmo(server, "/drag/goal", GIZMO_SIZE, session.move_goal)
        self._start_gizmo = _Gizmo(server, "/drag/start", SMALL_GIZMO_SIZE, session.move_start)
        self._obstacle_gizmo = _Gizmo(server, "/drag/obstacle", GIZMO_SIZE, self._move_selected)
        self._gizmos = self.goal_gizmo, self._start_gizmo, self._obstacle_gizmo
        self._panel = Panel(server, session, PanelCallbacks(self.select, self._seek, self._set_playing))
        self._obstacles = Obstacles(server, self.select)
        self._moving = Obstacles(server)
        self._arms: dict[str, Arm] = {}
        self._frames: Float[ndarray, "n frames 4 4"] | None = None
        self._lock = threading.Lock()
        self.player = Player(self._show_time)
        self._drawing = LatestTask[None](lambda _: self._draw(), "draw")
        session.on_change = self._redraw
        self._redraw()
        session.start()

    def select(self, name: str) -> None:
        """Select an obstacle by name; "" for none."""
        self._selected = name
        self._redraw()

    def close(self) -> None:
        """Stop serving and end all threads."""
        self.session.close()
        self.player.close()
        for gizmo in self._gizmos:
            gizmo.close()
        self._drawing.close()
        self.server.stop()

    def _move_selected(self, T_base_handle: Float[ndarray, "4 4"]) -> None:
        if self._selected:
            self.session.move_obstacle(self._selected, T_base_handle)

    def _redraw(self) -> None:
        self._drawing.submit(None)

    def _draw(self) -> None:
        """Draw what has changed; only this task and the player draw."""
        state, selected, new = self.session.state, self._selected, self._changes.new
        problem, robot = state.problem, state.problem.robot
        if new("robot", robot):
            self._new_robot(robot)
        self._drawn.frames(problem.start)  # compiles here, since nothing is sent within the block
        with self.server.atomic():
            self._panel.show(state, validity(state), selected)
            if new("scene", problem.scene, selected):
                self._obstacles.show(drawables(problem.scene), selected)
                shapes = {shape.name: shape for shape in problem.known_scene.shapes}
                self._obstacle_gizmo.show(own_frame(shapes[selected]) if selected in shapes else None)
            if new("moving", problem.moving):
                self._show_moving(0.0)
            self._start_gizmo.show(link_pose(robot, problem.start, robot.tip))
            if new("start", problem.start, state.motion):
                self._arms["start"].show(None if _starts_at_start(state) else problem.start)
            if new("goal", state.goal_configuration):
                self._arms["goal"].show(state.goal_configuration)
            self.goal_gizmo.show(state.goal_pose)
            if new("motion", state.motion):
                self._new_motion(state)
            if new("validation", state.validation):
                self._arms["contact"].show(_first_collision(state))
            if new("candidates", state.candidates):
                draw_candidates(self.server, self._drawn, state.candidates)
            answer = state.answer
            shown = answer if state.options.trees else None
            if (answer is not None or not state.options.trees) and new("trees", shown):
                draw_trees(self.server, self._drawn, () if shown is None else shown.trees)

    def _new_robot(self, robot: Robot) -> None:
        for arm in self._arms.values():
            arm.root.remove()
        self._drawn = DrawnArm(robot)
        draw = partial(Arm, self.server)
        self._arms = {
            "arm": draw("arm", self._drawn),
            "start": draw("start", self._drawn, START, GHOST_OPACITY),
            "goal": draw("goal", self._drawn, GOAL, GHOST_OPACITY),
            "contact": draw("contact", self._drawn, RED, 2 * GHOST_OPACITY),
        }
        for gizmo in self._gizmos:
            gizmo.handle.scale = gizmo.size * reach(robot)
        problem, goal = self.session.state.problem, self.session.state.goal_configuration
        ends = np.stack([problem.start, problem.start if goal is None else goal])
        self.server.set_first_view(self._drawn, problem, ends)
        draw_trees(self.server, self._drawn, ())
        self._changes.forget("start", "goal", "motion", "validation", "scene", "trees")

    def _new_motion(self, state: State) -> None:
        motion = None if state.motion is None else state.motion.trajectory
        frames = None if motion is None else sampled_frames(self._drawn, motion)
        with self._lock:
            self._frames = frames
        draw_trace(self.server, self._drawn, motion)
        if motion is None:
            self._arms["arm"].show(state.problem.start)
        else:
            self.player.load(motion.duration)

    def _show_time(self, at: float) -> None:
        with self._lock:
            if self._frames is None or "arm" not in self._arms:
                return
            row = min(round(at * POSE_RATE), len(self._frames) - 1)
            self._arms["arm"].show_frames(self._frames[row])
        self._show_moving(at)
        self._panel.show_time(at, self.player.duration)

    def _show_moving(self, at: float) -> None:
        """Show the moving obstacles where they are at a time of the motion [s]."""
        obstacles = drawables(Scene(), self.session.state.problem.moving)
        with self._lock:
            self._moving.show(obstacles, time=at)

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
        self.size = size
        self._held = False
        self._moved = moved
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

    def show(self, T: Float[ndarray, "4 4"] | None) -> None:
        """Move to a pose, unless it is being dragged; hide for None."""
        if T is not None and not self._held:
            place(self.handle, T)
        if self.handle.visible is not (T is not None):
            self.handle.visible = T is not None


def _starts_at_start(state: State) -> bool:
    """Whether the motion shown starts at the problem's start, so that no start arm is needed."""
    motion = None if state.motion is None else state.motion.trajectory
    return motion is None or np.allclose(motion.positions[0], state.problem.start)


def _first_collision(state: State) -> Float[ndarray, "dof"] | None:
    """The configuration at the first collision of the motion; None if there is none."""
    violation = None if state.validation is None else state.validation.report.violation
    motion = None if state.motion is None else state.motion.trajectory
    if violation is None or motion is None or violation.kind not in COLLISIONS:
        return None
    return interpolated(np.array([violation.time]), motion.times, motion.positions)[0]
