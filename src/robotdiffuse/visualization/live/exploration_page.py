"""The page on which people watch an exploration: shows its session in browsers with viser."""

import html
import socket
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from robotdiffuse.core.transforms import quaternion_from_rotation
from robotdiffuse.planning.exploration.recorded import RecordedAct, RecordedExplorer, RecordedView
from robotdiffuse.planning.exploration.steps import CHANCE, DONE, LOOK, POLICIES, STRICT
from robotdiffuse.problems.goals import JointGoal
from robotdiffuse.robots.scaling import reach
from robotdiffuse.visualization import style
from robotdiffuse.visualization.exploration import (
    LOOK_COLOR,
    UNKNOWN,
    frustum,
    in_known_scene,
    shown_voxels,
    title,
)
from robotdiffuse.visualization.live.access import AccessProxy
from robotdiffuse.visualization.live.drawing import (
    GHOST_OPACITY,
    TRACE_WIDTH,
    Arm,
    Obstacles,
    Poses,
    add_surface,
    draw_lines,
    draw_trace,
)
from robotdiffuse.visualization.live.exploration_session import (
    CHOOSING,
    ENDED,
    MOVING,
    PAUSED,
    RUNNING,
    STEPPING,
    ExplorationSession,
    ExplorationState,
)
from robotdiffuse.visualization.live.latest_task import LatestTask
from robotdiffuse.visualization.live.panel import badge_html, set_value
from robotdiffuse.visualization.live.server import add_stage, new_server, set_first_view, stop_server
from robotdiffuse.visualization.live.validity import INVALID, NO_MOTION, PENDING, VALID, Validity
from robotdiffuse.visualization.voxel_faces import faces_surface

CLEAR_OPACITY = 0.6
"""Of predicted voxels, and of those that a look is to show."""
UNKNOWN_OPACITY = 0.2
"""Of the boundary of unknown space, which is drawn where it faces the viewer: it never hides the arm."""
CAMERA_SIZE, CAMERA_COLOR = 0.12, (40, 48, 58)
"""Length of the pyramid of the camera on the arm [m], and its colour."""
SPEEDS = (0.1, 10.0)
"""Bounds of the slider of the speed."""
PROMISES = {
    STRICT: "only through space seen free",
    CHANCE: "where the stated confidence is high enough",
}
"""Policies in plain words."""


class ExplorationPage:
    """Shows an exploration to all browsers that pass the access proxy on `listening`, until it is closed. It
    runs from when the first one opens the page."""

    def __init__(self, session: ExplorationSession, listening: socket.socket, token: str = "") -> None:
        self.session, self._drawn = session, dict[str, tuple[object, ...]]()
        problem, robot = session.problem, session.problem.robot
        self.server, secret = new_server()
        add_stage(self.server, reach(robot))
        surfaces = style.robot_surfaces(robot)
        self._tool = style.tool_point(robot, surfaces)
        self._arm = Arm(self.server, "arm", surfaces)
        self._look = Arm(self.server, "look", surfaces, LOOK_COLOR, GHOST_OPACITY)
        self._ghost = Arm(self.server, "goal", surfaces, style.GOAL, GHOST_OPACITY)
        self._goal = problem.goal.positions[0] if isinstance(problem.goal, JointGoal) else None
        ends = np.stack([problem.start, problem.start if self._goal is None else self._goal])
        set_first_view(self.server, problem, surfaces, ends)
        self._obstacles = Obstacles(self.server, lambda _name: None)
        self._add_panel()
        self._lock, self._closed = threading.Lock(), False
        self._drawing = LatestTask[None](lambda _: self._draw_unless_closed(), "draw")
        session.on_change = self._redraw
        self._redraw()
        seen = threading.Event()

        @self.server.on_client_connect
        def _(_client: viser.ClientHandle) -> None:
            if not seen.is_set():
                seen.set()
                session.set_mode(RUNNING)

        self._proxy = AccessProxy(listening, self.server.get_port(), secret, token)

    def close(self) -> None:
        """Stop serving and end all threads."""
        self.session.close()
        self._proxy.close()
        self._drawing.close()
        with self._lock:  # what is being drawn is still sent
            self._closed = True
        stop_server(self.server)

    def _add_panel(self) -> None:
        gui, session, state = self.server.gui, self.session, self.session.state
        self._badge = gui.add_html("")
        self._run = gui.add_button("Run", icon=viser.Icon.PLAYER_PLAY)
        self._step = gui.add_button("Next step", icon=viser.Icon.PLAYER_SKIP_FORWARD)
        restart = gui.add_button("Restart", icon=viser.Icon.REFRESH)
        self._speed = gui.add_slider(
            "Speed",
            *SPEEDS,
            step=0.1,
            initial_value=float(np.clip(state.speed, *SPEEDS)),
            hint="1: real time",
        )
        policies = (STRICT,) if state.settings.see_goal else POLICIES
        self._policy = gui.add_dropdown(
            "Policy", policies, initial_value=state.settings.policy, hint="Restarts the exploration"
        )
        self._noise = gui.add_checkbox(
            "Noise", initial_value=state.noise, hint="Simulate the noise of depth cameras; restarts"
        )
        gui.add_html(_legend())
        self._unknown = gui.add_checkbox("Unknown space", initial_value=True)
        self._true = gui.add_checkbox("True scene", initial_value=False, hint="What the arm does not know")
        self._steps = gui.add_html("")
        self._run.on_click(lambda _: session.set_mode(RUNNING if session.state.mode == PAUSED else PAUSED))
        self._step.on_click(lambda _: session.set_mode(STEPPING))
        restart.on_click(lambda _: session.restart())
        changes: list[tuple[Any, Callable[[Any], None]]] = [
            (self._speed, session.set_speed),
            (self._policy, lambda value: session.restart(policy=value)),
            (self._noise, lambda value: session.restart(noise=value)),
            (self._unknown, lambda _: self._redraw()),
            (self._true, lambda _: self._redraw()),
        ]
        for widget, do in changes:
            # changes by the page itself have no client
            widget.on_update(lambda event, do=do: event.client and do(event.target.value))

    def _redraw(self) -> None:
        self._drawing.submit(None)

    def _draw_unless_closed(self) -> None:
        with self._lock:
            if not self._closed:
                self._draw()

    def _draw(self) -> None:
        """Draw what has changed; only this task draws."""
        state, robot, explorer = self.session.state, self.session.problem.robot, self.session.state.explorer
        act = state.acts[-1] if state.acts else None
        under_way = act if state.phase == MOVING else None
        with self.server.atomic():
            self._show_panel(state)
            if self._new("configuration", state.configuration):
                self._arm.show(Poses.of(robot, state.configuration[None]))
            arrived = act is not None and act.step.kind == DONE
            if self._goal is not None and self._new("arrived", arrived):
                self._ghost.show(None if arrived else Poses.of(robot, self._goal[None]))
            if explorer is None:
                return
            if self._new("explorer", explorer):
                self._known_scene = in_known_scene(explorer)
                self._show_camera(explorer)
            if self._new("scene", explorer, self._true.value):
                self._obstacles.show(self.session.problem.scene if self._true.value else explorer.scene, "")
            if self._new("known", state.known, act, under_way, self._unknown.value):
                self._show_voxels(state.known, act, under_way)
            if self._new("act", explorer, under_way):
                self._show_act(explorer, under_way)

    def _new(self, what: str, *values: object) -> bool:
        """Whether values have changed since the last drawing."""
        known = self._drawn.get(what)
        self._drawn[what] = values
        return known is None or any(
            a is not b and (a != b if isinstance(a, str | bytes | bool) else True)
            for a, b in zip(known, values, strict=True)
        )

    def _show_camera(self, explorer: RecordedExplorer) -> None:
        """Attach the first camera to the arm."""
        camera, robot = explorer.cameras[0], explorer.robot
        T = robot.T_frame_link(camera.link) @ camera.T_link_camera
        (width, height), fy = camera.size, camera.intrinsics[1]
        self.server.scene.add_camera_frustum(
            f"/arm/{robot.link_frame(camera.link)}/camera",
            fov=2 * np.arctan(height / 2 / fy),
            aspect=width / height,
            scale=CAMERA_SIZE,
            thickness=0.004,
            color=CAMERA_COLOR,
            wxyz=quaternion_from_rotation(T[:3, :3]),
            position=T[:3, 3],
        )

    def _show_voxels(
        self, known: RecordedView | None, act: RecordedAct | None, under_way: RecordedAct | None
    ) -> None:
        """Show what is known, with the prediction of a step, and what the look under way is to show."""
        if known is None:
            return
        occupied, predicted, unknown = shown_voxels(known, act, self._known_scene).layers
        wanted = None if under_way is None else under_way.step.wanted
        wanted = np.zeros_like(known.free) if wanted is None else wanted & known.unknown
        nothing = np.zeros_like(known.free), known.free
        for name, (inside, outside), color, opacity in (
            ("occupied", occupied, style.OBSERVED, None),
            ("predicted", predicted, style.ASSUMED, CLEAR_OPACITY),
            ("wanted", (wanted, ~wanted), LOOK_COLOR, CLEAR_OPACITY),
            ("unknown", unknown if self._unknown.value else nothing, UNKNOWN, UNKNOWN_OPACITY),
        ):
            surface = faces_surface(inside, outside, color)
            if not self._new(name, surface.vertices.tobytes()):
                continue
            if not len(surface.faces):
                self.server.scene.remove_by_name(f"/{name}")
            else:
                add_surface(self.server, f"/{name}", surface, color, opacity)

    def _show_act(self, explorer: RecordedExplorer, act: RecordedAct | None) -> None:
        """Show the trace of a step's motion, and of a look also its end and what is seen there."""
        robot = explorer.robot
        if act is None or act.trajectory is None:
            self.server.scene.remove_by_name("/trace")
        else:
            draw_trace(self.server, robot, self._tool, act.trajectory)
        if act is None or act.step.kind != LOOK:
            self.server.scene.remove_by_name("/pyramid")
            self._look.show(None)
            return
        self._look.show(Poses.of(robot, act.waypoints[-1:]))
        edges = frustum(explorer, act)
        colors = [np.tile(np.array(LOOK_COLOR, float), (len(edge), 1)) for edge in edges]
        draw_lines(self.server, "/pyramid", edges, colors, 0.5 * TRACE_WIDTH * reach(robot))

    def _show_panel(self, state: ExplorationState) -> None:
        paused = state.mode == PAUSED
        if self._new(
            "options", state.settings, state.noise, state.speed
        ):  # else a change on its way is undone
            set_value(self._policy, state.settings.policy)
            set_value(self._noise, state.noise)
            set_value(self._speed, float(np.clip(state.speed, *SPEEDS)))
        if self._new("badge", state.phase, state.mode, state.known, state.acts, state.failure):
            self._badge.content = badge_html(exploration_badge(state))
            self._steps.content = _steps_html(state.acts)
            self._run.label = "Run" if paused else "Pause"
            self._run.icon = viser.Icon.PLAYER_PLAY if paused else viser.Icon.PLAYER_PAUSE
            self._run.disabled = self._step.disabled = state.phase == ENDED


def exploration_badge(state: ExplorationState) -> Validity:
    """Kind and text of the badge: the step under way or the end, with its reason and confidence."""
    if state.failure:
        return Validity(INVALID, "failed", (state.failure,))
    if not state.acts or state.phase == CHOOSING:
        first = "a new machine compiles first, for about a minute"
        lines = () if state.acts else (first,)
        what = f"choosing step {len(state.acts) + 1}" if state.phase == CHOOSING else "not begun"
        return Validity(PENDING, what, (*lines, *_shares(state)))
    act, number = state.acts[-1], len(state.acts)
    headline = _title(number, act)
    if state.phase == ENDED and state.violation:
        return Validity(INVALID, f"collides in the true scene: {state.violation}", (headline,))
    kind = PENDING
    if state.phase == ENDED:
        kind = VALID if act.step.kind == DONE else NO_MOTION
    lines = [act.step.reason]
    if act.step.policy and act.step.motion is not None:
        lines.append(f"{act.step.policy}: {PROMISES[act.step.policy]}")
    if act.step.confidence is not None:
        confidence = np.floor(1000 * act.step.confidence) / 10  # never rounded up to 100 %
        lines.append(f"stated confidence that it is free: {confidence:g} %")
    rest = ", paused" if state.mode == PAUSED and state.phase != ENDED else ""
    return Validity(kind, headline + rest, (*lines, *_shares(state)))


def _shares(state: ExplorationState) -> tuple[str, ...]:
    if state.known is None:
        return ()
    free, unknown = (100 * voxels.mean() for voxels in (state.known.free, state.known.unknown))
    return (f"of the map {free:.0f} % seen free, {unknown:.0f} % unknown",)


def _title(number: int, act: RecordedAct) -> str:
    return f"{number}. {title(act)}"


def _steps_html(acts: tuple[RecordedAct, ...]) -> str:
    rows = "".join(f"<div>{html.escape(_title(i, act))}</div>" for i, act in enumerate(acts, 1))
    return f'<div style="margin: 0.4em 1em; font-size: 0.85em">{rows}</div>'


def _legend() -> str:
    colors = {
        "seen occupied": style.OBSERVED,
        "predicted occupied": style.ASSUMED,
        "boundary of unknown space": UNKNOWN,
        "next look, and what it is to show": LOOK_COLOR,
        "goal": style.GOAL,
    }
    mark = "display: inline-block; width: 0.8em; height: 0.8em; border-radius: 2px; margin-right: 0.5em"
    rows = (
        f'<div><span style="{mark}; background: rgb{color}"></span>{name}</div>'
        for name, color in colors.items()
    )
    return f'<div style="margin: 0.4em 1em; font-size: 0.85em">{"".join(rows)}</div>'
