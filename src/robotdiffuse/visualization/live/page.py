"""The page: a session's view in browsers, by viser, behind a door of its own."""

import contextlib
import io
import secrets
import socket
import threading
from typing import Any

import numpy as np
import viser
from jaxtyping import Float
from numpy import ndarray
from viser import infra

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import quaternion_from_rotation, rotation_from_quaternion, transform
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.scaling import reach
from robotdiffuse.validation.validator import Violation
from robotdiffuse.visualization import style
from robotdiffuse.visualization.camera import VERTICAL_FIELD, view_of_motion
from robotdiffuse.visualization.live.access import SECRET, Door
from robotdiffuse.visualization.live.certificate import certificate
from robotdiffuse.visualization.live.drawing import (
    GHOST,
    RED,
    Arm,
    Obstacles,
    Poses,
    draw_fan,
    draw_trace,
    draw_trees,
    film,
)
from robotdiffuse.visualization.live.drawing import RATE as FILM_RATE
from robotdiffuse.visualization.live.latest_task import Latest
from robotdiffuse.visualization.live.panel import Deeds, Panel
from robotdiffuse.visualization.live.player import Player
from robotdiffuse.visualization.live.session import Session, State
from robotdiffuse.visualization.style import GOAL, START, Surface

GIZMO, SMALL_GIZMO = 0.23, 0.16
"""Sizes, as shares of the arm's reach."""
FLOOR = 4.7
"""Side, in the same."""
FRAME, FREE = (900, 800), (0.06, 0.06)
"""What the first view is made for [pixels], and the shares of its height that stay free."""
SUNS = (2.0, (-2.0, -3.0, 5.0)), (1.1, (3.0, 2.0, 3.0)), (0.7, (-3.0, 3.0, 1.0))
"""Lights: how bright, and from where."""
BESIDE_PANEL = 0.2
"""Of the window's height, how far what is looked at stands to the left."""


class _Server(viser.ViserServer):
    """viser's, which publishes nothing."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """A browser may ask for a tunnel from the internet to the page: it gets none."""
        return None


class Page:
    """Shows a session to all who come through the door on `listening`, until it is closed."""

    def __init__(self, session: Session, listening: socket.socket, token: str = "") -> None:
        self.session = session
        self._selected, self._drawn = "", dict[str, Any]()
        secret = secrets.token_urlsafe(32)
        with contextlib.redirect_stdout(io.StringIO()):  # it would print its own address
            self._server = _Server("127.0.0.1", 0, verbose=False)
        _only_with(secret, self._server)
        self._furnish()
        deeds = Deeds(self.select, self._seek, self._set_playing)
        self._panel = Panel(self._server, session, deeds)
        self._obstacles = Obstacles(self._server, self.select)
        self._arms: dict[str, Arm] = {}
        self._film: Poses | None = None
        self._lock = threading.Lock()
        self._player = Player(self._show_time)
        self._drawing = Latest[None](lambda _: self._draw(), "draw")
        session.tell = self._redraw
        self._door = Door(listening, self._server.get_port(), secret, token)
        self._redraw()
        session.begin()

    def select(self, name: str) -> None:
        """Of the obstacles; "" for none."""
        self._selected = name
        self._redraw()

    def close(self) -> None:
        self.session.close()
        self._door.close()
        self._player.close()
        for gizmo in self._gizmos:
            gizmo.close()
        self._drawing.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _furnish(self) -> None:
        """What stays as it is: light, floor, the view."""
        server = self._server
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.set_panel_label("RobotDiffuse")
        # viser's own light, an image of surroundings with shadows, is a hundred times as slow without a
        # graphics card
        server.scene.configure_environment_map(None)
        server.scene.configure_default_lights(enabled=False)
        server.scene.add_light_ambient("/light/sky", intensity=1.1)
        for i, (intensity, at) in enumerate(SUNS):
            server.scene.add_light_directional(f"/light/{i}", intensity=intensity, position=at)
        side = FLOOR * reach(self.session.state.problem.robot)
        server.scene.add_grid(
            "/floor",
            side,
            side,
            cell_size=side / 40,
            cell_color=(236, 238, 241),
            section_size=side / 8,
            section_color=(214, 218, 224),
        )
        self._goal_gizmo = _Gizmo(server, "/drag/goal", GIZMO, self.session.move_goal)
        self._start_gizmo = _Gizmo(server, "/drag/start", SMALL_GIZMO, self.session.move_start)
        self._obstacle_gizmo = _Gizmo(server, "/drag/obstacle", GIZMO, self._move_selected)
        self._gizmos = self._goal_gizmo, self._start_gizmo, self._obstacle_gizmo

    def _move_selected(self, T_base_handle: Float[ndarray, "4 4"]) -> None:
        if self._selected:
            self.session.move_obstacle(self._selected, T_base_handle)

    def _redraw(self) -> None:
        self._drawing.ask(None)

    def _draw(self) -> None:
        """What has changed since the last time; the only caller of what draws, but for the player."""
        state, selected = self.session.state, self._selected
        problem, robot = state.problem, state.problem.robot
        with self._server.atomic():
            self._panel.show(state, certificate(state), selected)
            if self._new("robot", robot):
                self._new_robot(robot)
            if self._new("scene", problem.scene) | self._new("selected", selected):
                self._obstacles.show(problem.scene, selected)
                names = [shape.name for shape in problem.known_scene.shapes]
                T = self.session.obstacle_pose(selected) if selected in names else None
                self._obstacle_gizmo.show(T)
            self._start_gizmo.show(link_pose(robot, problem.start, robot.tip))
            if self._new("start", problem.start) | self._new("motion begins", state.motion):
                self._ghost("start", None if _begins_there(state) else problem.start)
            if self._new("goal", state.goal_configuration):
                self._ghost("goal", state.goal_configuration)
            self._goal_gizmo.show(state.goal_pose)
            if self._new("motion", state.motion):
                self._new_motion(state)
            if self._new("verdict", state.verdict):
                self._show_violation(state)
            if self._new("candidates", state.candidates):
                draw_fan(self._server, robot, self._tool, state.candidates)
            answer = state.answer
            trees = answer.trees if state.choice.trees and answer is not None else ()
            if (answer is not None or not state.choice.trees) and self._new("trees", trees):
                draw_trees(self._server, robot, self._tool, trees)

    def _new(self, what: str, value: object) -> bool:
        """Whether it is another than at the last drawing."""
        known = what in self._drawn and self._drawn[what] is value
        self._drawn[what] = value
        return not known

    def _new_robot(self, robot: Robot) -> None:
        for arm in self._arms.values():
            arm.remove()
        surfaces = style.robot_surfaces(robot)
        self._tool = style.tool_point(robot, surfaces)
        self._arms = {
            "arm": Arm(self._server, "arm", surfaces),
            "start": Arm(self._server, "start", surfaces, START, GHOST),
            "goal": Arm(self._server, "goal", surfaces, GOAL, GHOST),
            "contact": Arm(self._server, "contact", surfaces, RED, 2 * GHOST),
        }
        for gizmo in self._gizmos:
            gizmo.fit(reach(robot))
        self._look_at_all(surfaces)
        draw_trees(self._server, robot, self._tool, ())
        for what in ("start", "goal", "motion", "verdict", "scene", "trees"):
            self._drawn.pop(what, None)

    def _look_at_all(self, surfaces: list[Surface]) -> None:
        """Where browsers that come look from: so that most is seen of start, goal and what lies between."""
        state = self.session.state
        problem, goal = state.problem, state.goal_configuration
        q = np.stack([problem.start, problem.start if goal is None else goal])
        view = view_of_motion(problem.robot, problem.scene, surfaces, self._tool, q, *FRAME, FREE)
        height = 2 * np.tan(VERTICAL_FIELD / 2) * np.linalg.norm(view.target - view.eye)
        aside = BESIDE_PANEL * height * view.rotation[0]
        camera = self._server.initial_camera
        camera.fov = VERTICAL_FIELD
        camera.position, camera.look_at = tuple(view.eye + aside), tuple(view.target + aside)

    def _ghost(self, name: str, q: Float[ndarray, "dof"] | None) -> None:
        robot = self.session.state.problem.robot
        self._arms[name].show(None if q is None else Poses.of(robot, q[None]))

    def _new_motion(self, state: State) -> None:
        motion = None if state.motion is None else state.motion.trajectory
        if motion is None:
            with self._lock:
                self._film = None
            self._server.scene.remove_by_name("/trace")
            self._arms["arm"].show(Poses.of(state.problem.robot, state.problem.start[None]))
            return
        poses = film(state.problem.robot, motion)
        with self._lock:
            self._film = poses
        draw_trace(self._server, state.problem.robot, self._tool, motion)
        self._player.load(motion.duration)

    def _show_violation(self, state: State) -> None:
        """The arm in red where the motion shown is wrong first."""
        violation = None if state.verdict is None else state.verdict.report.violation
        motion = None if state.motion is None else state.motion.trajectory
        if violation is None or motion is None or not _is_collision(violation):
            self._arms["contact"].show(None)
            return
        q = np.array([np.interp(violation.time, motion.times, column) for column in motion.positions.T])
        self._arms["contact"].show(Poses.of(state.problem.robot, q[None]))

    def _show_time(self, at: float) -> None:
        with self._lock:
            if self._film is None or "arm" not in self._arms:
                return
            row = min(round(at * FILM_RATE), len(self._film.xyz) - 1)
            self._arms["arm"].show(self._film, row)
        self._panel.show_time(at, self._player.duration)

    def _seek(self, at: float) -> None:
        self._set_playing(False)
        self._player.seek(at)

    def _set_playing(self, playing: bool) -> None:
        (self._player.play if playing else self._player.pause)()
        self._panel.show_playing(playing)


class _Gizmo:
    """Arrows and rings that a pose is dragged by; `moved` is called with the pose as it goes."""

    def __init__(self, server: viser.ViserServer, name: str, size: float, moved: Any) -> None:
        """`size`: as a share of the arm's reach."""
        self._handle = server.scene.add_transform_controls(name, depth_test=False, visible=False)
        self._held, self._size, self._moved = False, size, moved
        self._moving = Latest(self._move, name)

        @self._handle.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            self._held = event.phase != "end"
            if event.phase != "start":
                rotation = rotation_from_quaternion(np.array(event.target.wxyz))
                self._moving.ask(transform(np.array(event.target.position), rotation))

    def _move(self, T: Float[ndarray, "4 4"]) -> None:
        with contextlib.suppress(InputError):  # it has been taken away by someone else
            self._moved(T)

    def close(self) -> None:
        self._moving.close()

    def fit(self, reach: float) -> None:
        """To an arm that reaches so far [m]."""
        self._handle.scale = self._size * reach

    def show(self, T: Float[ndarray, "4 4"] | None) -> None:
        """At a pose, unless it is being dragged; hidden without."""
        if T is not None and not self._held:
            wxyz = quaternion_from_rotation(T[:3, :3])
            handle = self._handle
            if not (np.allclose(handle.position, T[:3, 3]) and np.allclose(handle.wxyz, wxyz)):
                handle.position, handle.wxyz = T[:3, 3], wxyz
        if self._handle.visible is not (T is not None):
            self._handle.visible = T is not None


def _begins_there(state: State) -> bool:
    """Whether the motion shown begins at the start, so that the arm itself shows where that is."""
    motion = None if state.motion is None else state.motion.trajectory
    return motion is None or np.allclose(motion.positions[0], state.problem.start)


def _is_collision(violation: Violation) -> bool:
    return violation.kind in ("scene_collision", "self_collision")


def _only_with(secret: str, server: viser.ViserServer) -> None:
    """Close connections that did not come through the door: viser itself lets in any page of any browser of
    this machine that finds its port. Raises AttributeError for a viser that is built otherwise."""
    inner = server._websock_server
    connections = inner._live_connections

    async def check(client: infra.WebsockClientConnection) -> None:
        connection = connections[client.client_id]
        request = connection.request
        given = "" if request is None else request.headers.get(SECRET, "")
        if not secrets.compare_digest(given.encode(), secret.encode()):
            await connection.close(1008)

    inner.on_client_connect(check)
