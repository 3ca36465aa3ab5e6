"""The control panel of the page: widgets that show and change a session."""

import html
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import viser
from viser import uplot

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.planning import PLANNERS
from robotdiffuse.robots.robot import Robot
from robotdiffuse.visualization.live.files import problem_text, replay_page, uploaded_problem
from robotdiffuse.visualization.live.session import (
    INVALID,
    MAX_DIMENSION,
    MIN_DIMENSION,
    NEW_OBSTACLES,
    NO_MOTION,
    PENDING,
    TREE_SETTINGS,
    VALID,
    Session,
    State,
    Validity,
    dimensions,
)
from robotdiffuse.visualization.live.threads import Changes

BADGE_COLORS = {VALID: "#0f8f6f", INVALID: "#c92f2f", NO_MOTION: "#b26a00", PENDING: "#6b7684"}
JOINT_COLORS = ("#4f7fd9", "#10a37f", "#d97b5c", "#8a63d2", "#c2a23a", "#4fa3b8", "#c96a9a", "#7a8794")
"""Colours of joints in the plot."""
NO_OBSTACLE = "(none)"
"""Option of the dropdown for no selected obstacle."""
PLOTS = ("position", "velocity", "acceleration")
NOTIFICATION_TIME = 8.0
"""Time that notifications stay [s]."""


@dataclass(frozen=True)
class PanelCallbacks:
    """Functions of the page that the panel calls."""

    select: Callable[[str], None]
    seek: Callable[[float], None]
    play: Callable[[bool], None]


class Panel:
    """The widgets of the control panel."""

    def __init__(self, server: viser.ViserServer, session: Session, callbacks: PanelCallbacks) -> None:
        self._server, self._session, self._callbacks = server, session, callbacks
        gui = server.gui
        self._changes = Changes()
        self._badge = gui.add_html("")
        self._slider = gui.add_slider("Time", min=0.0, max=1.0, step=0.01, initial_value=0.0)
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Plan"):
            self._plan_tab()
        with tabs.add_tab("Obstacles"):
            self._obstacles_tab()
        with tabs.add_tab("Start"):
            self._joints_box = gui.add_folder("Joints")
            self._joints: list[viser.GuiInputHandle[float]] = []
        with tabs.add_tab("Files"):
            self._files_tab()
        self._on(self._slider, lambda event: callbacks.seek(event.target.value))
        self._play.on_click(lambda _event: callbacks.play(self._play.label == "Play"))

    def _on(self, widget: Any, do: Callable[[Any], object]) -> None:
        """Call `do` when a visitor changes a widget; show its InputError as a notification."""

        @widget.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self.guarded(event, lambda: do(event))

    def guarded(self, event: viser.GuiEvent, do: Callable[[], object]) -> None:
        """Call `do`; show its InputError as a notification to the visitor."""
        try:
            do()
        except InputError as error:
            if event.client is not None:
                event.client.add_notification(
                    "Not possible", str(error), auto_close_seconds=NOTIFICATION_TIME, color="red"
                )

    # tabs

    def _plan_tab(self) -> None:
        gui, session, options = self._server.gui, self._session, self._session.state.options
        hints = {
            "follow": "Plan again after each change",
            "candidates": "Motions proposed by the network: red in collision, green from 5 cm clearance",
            "trees": "Search trees from the start (blue) and the goal (green); planners: "
            + ", ".join(TREE_SETTINGS),
        }
        labels = {"follow": "Plan automatically", "candidates": "Candidates", "trees": "Search trees"}
        self._options: dict[str, Any] = {
            "planner": gui.add_dropdown("Planner", tuple(PLANNERS), initial_value=options.planner)
        }
        limit = gui.add_slider(
            "Time limit [s]", min=0.05, max=10.0, step=0.05, initial_value=min(options.time_limit, 10.0)
        )
        for name, hint in hints.items():
            value = getattr(options, name)
            self._options[name] = gui.add_checkbox(labels[name], initial_value=value, hint=hint)
        self._now = gui.add_button("Plan now", icon=viser.Icon.ROUTE)
        self._stages = gui.add_html("")
        self._kind = gui.add_dropdown("Plot", PLOTS, initial_value=PLOTS[0])
        self._plot_box = gui.add_folder("Joint values relative to limits")
        self._plot: viser.GuiUplotHandle | None = None
        for name, widget in {**self._options, "time_limit": limit}.items():
            self._on(widget, lambda event, name=name: session.set_options(**{name: event.target.value}))
        self._on(self._kind, lambda _event: self._show_plot(session.state))
        self._now.on_click(lambda event: self.guarded(event, session.plan_now))

    def _obstacles_tab(self) -> None:
        gui = self._server.gui
        names: tuple[str, ...] = (NO_OBSTACLE,)
        self._selected: Any = gui.add_dropdown("Obstacle", names, initial_value=NO_OBSTACLE)
        self._sizes_box = gui.add_folder("Size [m]", visible=False)
        self._sizes: dict[str, Any] = {}
        self._delete = gui.add_button("Delete", icon=viser.Icon.TRASH, visible=False)
        self._new = gui.add_dropdown("New obstacle", tuple(NEW_OBSTACLES), initial_value="sphere")
        self._add = gui.add_button("Add", icon=viser.Icon.PLUS)
        self._on(self._selected, lambda event: self._callbacks.select(_name(event.target.value)))
        self._delete.on_click(
            lambda event: self.guarded(event, lambda: self._session.delete_obstacle(self._selected.value))
        )
        self._add.on_click(lambda event: self.guarded(event, self._add_obstacle))

    def _add_obstacle(self) -> None:
        self._callbacks.select(self._session.add_obstacle(self._new.value))

    def _files_tab(self) -> None:
        gui, session = self._server.gui, self._session
        load = gui.add_upload_button("Load problem", icon=viser.Icon.UPLOAD, mime_type=".yaml,.yml,.json")
        save = gui.add_button("Save problem", icon=viser.Icon.DOWNLOAD)
        share = gui.add_button("Save replay", icon=viser.Icon.SHARE)

        @load.on_upload
        def _(event: viser.GuiEvent) -> None:
            file, robot = load.value, session.state.problem.robot
            self.guarded(event, lambda: session.open(uploaded_problem(file.content, file.name, robot)))

        save.on_click(lambda event: self.guarded(event, lambda: _send(event, *self._problem_file())))
        share.on_click(lambda event: self.guarded(event, lambda: _send(event, *self._replay_file())))

    def _problem_file(self) -> tuple[str, bytes]:
        return "problem.yaml", problem_text(self._session.state.problem)

    def _replay_file(self) -> tuple[str, bytes]:
        state = self._session.state
        if state.motion is None:
            raise InputError("there is no motion to save yet")
        candidates = () if state.candidates is None else state.candidates.positions
        paths = tuple(Path(state.problem.robot.joint_names, q) for q in candidates)
        return "replay.html", replay_page(state.problem, state.motion, paths)

    # display

    def show(self, state: State, validity: Validity, selected: str) -> None:
        """Update the widgets to a state."""
        if self._changes.new("validity", (validity.kind, validity.headline, validity.lines), state.planning):
            self._badge.content = badge_html(validity, state.planning)
        if self._changes.new("seconds", state.seconds):
            self._stages.content = _stages_html(state.seconds)
        for name, widget in self._options.items():
            set_value(widget, getattr(state.options, name))
        if self._changes.new("motion", state.motion):
            self._show_plot(state)
        if self._changes.new("robot", state.problem.robot):
            self._new_joints(state.problem.robot)
        if self._changes.new("start", state.problem.start):
            for widget, value in zip(self._joints, state.problem.start, strict=True):
                set_value(widget, round(float(value), 3))
        self._show_obstacle(state, selected)

    def _show_obstacle(self, state: State, selected: str) -> None:
        shapes = {shape.name: shape for shape in state.problem.known_scene.shapes}
        options: tuple[str, ...] = (NO_OBSTACLE, *shapes)
        if self._changes.new("options", options):
            self._selected.options = options
        name = selected if selected in shapes else NO_OBSTACLE
        set_value(self._selected, name)
        shape = shapes.get(selected)
        self._delete.visible = shape is not None
        sizes = {} if shape is None else dimensions(shape)
        self._sizes_box.visible = bool(sizes)
        if self._changes.new("sizes of", (name, *sizes)):
            for widget in self._sizes.values():
                widget.remove()
            with self._sizes_box:
                self._sizes = {of: self._size_slider(name, of, value) for of, value in sizes.items()}
        for of, value in sizes.items():
            set_value(self._sizes[of], value)

    def _size_slider(self, name: str, dimension: str, value: float) -> Any:
        most = max(MAX_DIMENSION, value)
        slider = self._server.gui.add_slider(
            dimension, min=min(MIN_DIMENSION, value), max=most, step=0.005, initial_value=value
        )
        self._on(slider, lambda event: self._session.resize_obstacle(name, dimension, event.target.value))
        return slider

    def _new_joints(self, robot: Robot) -> None:
        for widget in self._joints:
            widget.remove()
        self._joints = []
        limits = zip(robot.joint_names, robot.lower, robot.upper, robot.continuous, strict=True)
        with self._joints_box:
            for name, low, high, turns in limits:
                low, high = (-np.pi, np.pi) if turns else (float(low), float(high))
                low, high = np.floor(100 * low) / 100, np.ceil(100 * high) / 100  # for short labels
                widget = self._server.gui.add_slider(name, min=low, max=high, step=0.001, initial_value=low)
                self._on(widget, partial(self._move_joint, len(self._joints)))
                self._joints.append(widget)

    def _move_joint(self, index: int, event: Any) -> None:
        problem = self._session.state.problem
        q = problem.start.copy()
        q[index] = np.clip(event.target.value, problem.robot.lower[index], problem.robot.upper[index])
        self._session.set_start(q)

    def show_time(self, at: float, duration: float) -> None:
        """Set the time slider [s]."""
        most = max(np.ceil(100 * duration) / 100, 0.01)
        if self._slider.max != most:
            self._slider.max = most
        self._slider.value = round(at, 2)

    def show_playing(self, playing: bool) -> None:
        """Set the play button."""
        self._play.label = "Pause" if playing else "Play"
        self._play.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY

    def _show_plot(self, state: State) -> None:
        robot, motion = state.problem.robot, state.motion
        if motion is None or motion.trajectory is None:
            return
        data = plotted(robot, motion.trajectory, self._kind.value)
        names = tuple(robot.joint_names)
        if self._plot is not None and not self._changes.new("joints of the plot", names):
            self._plot.data = data
            return
        if self._plot is not None:
            self._plot.remove()
        self._changes.new("joints of the plot", names)
        joints = [
            uplot.Series(label=name, stroke=JOINT_COLORS[i % len(JOINT_COLORS)], width=1.5)
            for i, name in enumerate(names)
        ]
        limit = uplot.Series(label="limit", stroke="#c92f2f", width=1, dash=(6, 4))
        with self._plot_box:
            self._plot = self._server.gui.add_uplot(
                data=data,
                series=(uplot.Series(label="time [s]"), *joints, limit, limit),
                scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=(-118.0, 118.0))},
                axes=(uplot.Axis(label="s"), uplot.Axis(label="% of limit")),
                legend=uplot.Legend(show=False),
                height=220,
            )


def plotted(robot: Robot, motion: Trajectory, kind: str) -> tuple[np.ndarray, ...]:
    """Plot data: times, each joint in % of its limits, and the limits 100 and -100.

    Position 0 % is the middle of the range; the limit of a continuous joint is half a turn.
    """
    if kind == "velocity":
        values = motion.velocities / robot.velocity
    elif kind == "acceleration":
        values = motion.accelerations / robot.acceleration
    else:
        middle = np.where(robot.continuous, 0.0, 0.5 * (robot.lower + robot.upper))
        half = np.where(robot.continuous, np.pi, 0.5 * (robot.upper - robot.lower))
        values = (motion.positions - middle) / half
    limit = np.full(len(motion.times), 100.0)
    return (motion.times, *(100.0 * values).T, limit, -limit)


def set_value(widget: Any, value: object) -> None:
    """Set a widget, without a message to browsers if it already has the value."""
    if widget.value != value:
        widget.value = value


def _name(option: str) -> str:
    return "" if option == NO_OBSTACLE else option


def _send(event: viser.GuiEvent, name: str, content: bytes) -> None:
    if event.client is not None:
        event.client.send_file_download(name, content, save_immediately=True)


def badge_html(validity: Validity, planning: bool = False) -> str:
    """A coloured box with a headline and lines."""
    lines = "".join(f"<div>{html.escape(line)}</div>" for line in validity.lines)
    busy = " · planning" if planning and validity.kind != PENDING else ""
    return (
        f'<div data-validity="{validity.kind}" style="margin: 0 0.8em 0.8em; padding: 0.7em 0.9em; '
        f"border-radius: 8px; color: white; font-size: 0.85em; line-height: 1.4; "
        f'background: {BADGE_COLORS[validity.kind]}; overflow-wrap: anywhere">'
        f"<b>{html.escape(validity.headline)}</b>{busy}{lines}</div>"
    )


def _stages_html(seconds: tuple[tuple[str, float], ...]) -> str:
    rows = "".join(
        f'<tr><td>{html.escape(stage)}</td><td style="text-align: right">{1e3 * took:.1f} ms</td></tr>'
        for stage, took in seconds
    )
    return f'<table style="margin: 0 0.8em; width: calc(100% - 1.6em); font-size: 0.85em">{rows}</table>'
