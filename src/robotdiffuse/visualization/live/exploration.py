"""A live exploration: its session, and the page that shows it in browsers.

A thread of the session chooses steps and executes them at the speed of the motion. Visitors can pause, step,
restart and change the options. A step of the kind `look` moves the arm to take a view.
"""

import html
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import viser

from robotdiffuse.core.errors import InputError, described
from robotdiffuse.core.transforms import quaternion_from_rotation
from robotdiffuse.core.types import Configuration, frozen_dataclass
from robotdiffuse.drawables import ASSUMED, GOAL, OBSERVED, drawables
from robotdiffuse.perception.depth_view import DepthNoise
from robotdiffuse.planning.exploration.simulated import (
    RecordedExplorer,
    RecordedStep,
    RecordedView,
    explore,
    simulated_explorer,
)
from robotdiffuse.planning.exploration.steps import (
    DONE,
    LOOK,
    POLICIES,
    PROBABILISTIC,
    STRICT,
    ExplorerSettings,
)
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.visualization.exploration import (
    LOOK_COLOR,
    READING_TIME,
    UNKNOWN,
    faces_surface,
    frustum,
    in_known_scene,
    shares,
    shown_voxels,
    title,
    views_of,
)
from robotdiffuse.visualization.live.page import (
    GHOST_OPACITY,
    TRACE_WIDTH,
    Arm,
    LivePage,
    Obstacles,
    add_surface,
    badge_html,
    draw_lines,
    draw_trace,
    set_value,
)
from robotdiffuse.visualization.live.server import PageServer
from robotdiffuse.visualization.live.session import (
    FRAME_RATE,
    INVALID,
    NO_MOTION,
    PENDING,
    VALID,
    LatestTask,
    Validity,
)
from robotdiffuse.visualization.picture import DrawnArm

# phases: paused before a step, choosing a step, executing it, and after the last step
WAITING = "waiting"
CHOOSING = "choosing"
MOVING = "moving"
ENDED = "ended"
# modes that visitors choose: paused, one step and then a pause, or all steps
PAUSED = "paused"
STEPPING = "stepping"
RUNNING = "running"
CLEAR_OPACITY = 0.6
"""Opacity of predicted voxels, and of the unknown voxels that the next view should show."""
UNKNOWN_OPACITY = 0.2
"""Opacity of the boundary of unknown space."""
# length of the pyramid that stands for the camera on the arm [m], and its color
CAMERA_SIZE = 0.12
CAMERA_COLOR = (40, 48, 58)
SPEEDS = (0.1, 10.0)
"""Bounds of the speed slider, as factors on the motion's own speed."""
PROMISES = {
    STRICT: "only through space seen free",
    PROBABILISTIC: "where the stated confidence is high enough",
}
"""Where each policy lets the arm move, in words for the page."""


@frozen_dataclass
class ExplorationState:
    """Everything that the page shows at one moment."""

    settings: ExplorerSettings
    noise: bool
    configuration: Configuration
    mode: str = PAUSED
    phase: str = WAITING
    speed: float = 1.0
    """Speed at which motions are shown, as a factor on their own speed."""
    explorer: RecordedExplorer | None = None
    """The explorer. Only the session's thread changes it; other threads may read its cameras and its known
    scene."""
    steps: tuple[RecordedStep, ...] = ()
    """All steps so far. In the phase MOVING, the last step is being executed."""
    known: RecordedView | None = None
    """The latest view, and what is known after it."""
    violation: str = ""
    """Why the validator refuses the last motion in the true scene; empty if it accepts the motion."""
    failure: str = ""
    """Why the exploration cannot go on, in one line; empty if it can."""


class _OutdatedError(Exception):
    """Raised in the thread of an exploration that was restarted or closed."""


class ExplorationSession:
    """The state of an exploration and its thread. `on_change` is called after each change of the state, from
    any thread."""

    def __init__(
        self, problem: Problem, settings: ExplorerSettings, noise: bool, seed: int, speed: float = 1.0
    ) -> None:
        """The exploration is paused at the problem's start until `set_mode` is called."""
        self.problem = problem
        self._seed = seed
        self.on_change: Callable[[], None] = lambda: None
        self._changed = threading.Condition()
        self._run = 0
        self.state = ExplorationState(settings, noise, problem.start, speed=speed)
        """The current state."""
        self._task = LatestTask(self._explore, "explore")

    def set_mode(self, mode: str) -> None:
        """Set the mode: PAUSED, STEPPING or RUNNING. STEPPING executes one step, or the rest of the current
        step."""
        self._change(self._run == 0, mode=mode)

    def set_speed(self, speed: float) -> None:
        """Change the speed of motions."""
        self._change(False, speed=speed)

    def restart(self, policy: str | None = None, noise: bool | None = None) -> None:
        """Start again from the beginning, with another policy or noise if given. Raises InputError for an
        unknown policy."""
        old = self.state
        settings = old.settings if policy is None else replace(old.settings, policy=policy)
        noise = old.noise if noise is None else noise
        new = ExplorationState(settings, noise, self.problem.start, old.mode, speed=old.speed)
        self._change(True, **vars(new))

    def _change(self, begin: bool, **changes: Any) -> None:
        """Change fields of the state. With `begin`, the exploration then starts from the beginning."""
        with self._changed:
            self.state = replace(self.state, **changes)
            if begin:
                self._run += 1
                self._task.submit(self._run)
            self._changed.notify_all()
        self.on_change()

    def close(self) -> None:
        """End the thread. If it is choosing a step, it ends when the step is chosen."""
        with self._changed:
            self._run += 1
            self._changed.notify_all()
        self._task.close()

    # Work of the thread

    def _explore(self, run: int) -> None:
        try:
            self._take_steps(run)
        except _OutdatedError:
            return
        except Exception as error:  # the page survives any error
            failure = str(error) if isinstance(error, InputError) else described(error)
            with suppress(_OutdatedError):
                self._update(run, phase=ENDED, failure=failure)

    def _take_steps(self, run: int) -> None:
        state = self._update(run, phase=CHOOSING)
        noise = DepthNoise() if state.noise else None
        explorer = simulated_explorer(self.problem, state.settings, noise, self._seed)
        self._update(run, explorer=explorer, known=explorer.views[-1])
        events = explore(self.problem, explorer, noise, self._seed)
        ended = False
        while not ended:
            if self.state.mode == PAUSED:
                self._update(run, phase=WAITING)
            self._wait_while_paused(run)
            self._update(run, phase=CHOOSING)
            event = next(events)
            self._execute(run, explorer)
            ended = event.step.motion is None or not event.free
            with self._changed:
                self._update(
                    run,
                    mode=PAUSED if self.state.mode == STEPPING else self.state.mode,
                    phase=ENDED if ended else CHOOSING,
                    violation=event.violation,
                    known=explorer.views[-1],
                )

    def _execute(self, run: int, explorer: RecordedExplorer) -> None:
        """Show the execution of the last step: move the arm along its motion, and show each view at the time
        at which it was taken."""
        record = explorer.steps[-1]
        views = views_of(explorer, len(explorer.steps) - 1)
        self._update(run, phase=MOVING, steps=tuple(explorer.steps), known=views[0])
        at = -READING_TIME
        last = time.perf_counter()
        while record.trajectory is not None and at < record.duration:
            if self._wait_while_paused(run):
                last = time.perf_counter()
            time.sleep(1 / FRAME_RATE)
            now = time.perf_counter()
            # a slow speed does not prolong the pause before the motion
            speed = self.state.speed if at >= 0 else max(self.state.speed, 1.0)
            at = min(at + speed * (now - last), record.duration)
            last = now
            if at > 0:
                taken_views = [view for view in views if view.time <= record.begins + at]
                self._update(run, configuration=record.trajectory.at(at).positions, known=taken_views[-1])

    def _update(self, run: int, **changes: Any) -> ExplorationState:
        with self._changed:
            if run != self._run:
                raise _OutdatedError
            self.state = state = replace(self.state, **changes)
        self.on_change()
        return state

    def _wait_while_paused(self, run: int) -> bool:
        """Wait until the mode is not PAUSED; returns whether it was PAUSED."""
        with self._changed:
            paused = self.state.mode == PAUSED
            self._changed.wait_for(lambda: run != self._run or self.state.mode != PAUSED)
            if run != self._run:
                raise _OutdatedError
        return paused


class ExplorationPage(LivePage):
    """The page of an exploration. The exploration starts when a browser first opens the page."""

    session: ExplorationSession

    def __init__(self, session: ExplorationSession, server: PageServer) -> None:
        problem = session.problem
        robot = problem.robot
        super().__init__(session, server, robot)
        self._drawn = DrawnArm(robot)
        self._arm = Arm(server, "arm", self._drawn)
        self._look = Arm(server, "look", self._drawn, LOOK_COLOR, GHOST_OPACITY)
        self._ghost = Arm(server, "goal", self._drawn, GOAL, GHOST_OPACITY)
        self._goal = problem.goal.positions[0] if isinstance(problem.goal, JointGoal) else None
        server.set_first_view(self._drawn, problem, self._goal)
        self._obstacles = Obstacles(server)
        self._add_panel()
        self._begin()
        opened = threading.Event()

        @server.on_client_connect
        def _(_client: viser.ClientHandle) -> None:
            if not opened.is_set():
                opened.set()
                session.set_mode(RUNNING)

    def _add_panel(self) -> None:
        gui = self.server.gui
        session = self.session
        state = self.session.state
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
        for widget, on_change in changes:
            # only changes by visitors have a client; the page itself also sets widgets
            widget.on_update(
                lambda event, on_change=on_change: event.client and on_change(event.target.value)
            )

    def _draw(self) -> None:
        state = self.session.state
        explorer = state.explorer
        record = state.steps[-1] if state.steps else None
        under_way = record if state.phase == MOVING else None
        with self.server.atomic():
            self._show_panel(state)
            if self._changes.new("configuration", state.configuration):
                self._arm.show(state.configuration)
            arrived = record is not None and record.step.kind == DONE
            if self._goal is not None and self._changes.new("arrived", arrived):
                self._ghost.show(None if arrived else self._goal)
            if explorer is None:
                return
            if self._changes.new("explorer", explorer):
                self._known_scene = in_known_scene(explorer)
                self._show_camera(explorer)
            if self._changes.new("scene", explorer, self._true.value):
                scene = self.session.problem.scene if self._true.value else explorer.scene
                self._obstacles.show(drawables(scene))
            if self._changes.new("known", state.known, record, under_way, self._unknown.value):
                self._show_voxels(state.known, record, under_way)
            if self._changes.new("step", explorer, under_way):
                self._show_step(explorer, under_way)

    def _show_camera(self, explorer: RecordedExplorer) -> None:
        """Draw the arm's first camera as a pyramid that moves with the arm."""
        camera = explorer.cameras[0]
        robot = explorer.robot
        T = robot.T_frame_link(camera.link) @ camera.T_link_camera
        (width, height), fy = camera.size, camera.intrinsics[1]
        self.server.scene.add_camera_frustum(
            f"/arm/{robot.link_frame(camera.link)}/camera",
            fov=2 * np.arctan(height / 2 / fy),
            aspect=width / height,
            scale=CAMERA_SIZE,
            thickness=0.004,
            color=CAMERA_COLOR,
            wxyz=quaternion_from_rotation(T),
            position=T[:3, 3],
        )

    def _show_voxels(
        self, known: RecordedView | None, record: RecordedStep | None, under_way: RecordedStep | None
    ) -> None:
        """Show what is known, the prediction of the step `record`, and the voxels that the step being
        executed, `under_way`, shall observe."""
        if known is None:
            return
        occupied, predicted, unknown = shown_voxels(known, record, self._known_scene)
        to_view = None if under_way is None else under_way.step.wanted
        to_view = np.zeros_like(known.free) if to_view is None else to_view & known.unknown
        nothing = np.zeros_like(known.free), known.free
        for name, (inside, outside), color, opacity in (
            ("occupied", occupied, OBSERVED, None),
            ("predicted", predicted, ASSUMED, CLEAR_OPACITY),
            ("wanted", (to_view, ~to_view), LOOK_COLOR, CLEAR_OPACITY),
            ("unknown", unknown if self._unknown.value else nothing, UNKNOWN, UNKNOWN_OPACITY),
        ):
            surface = faces_surface(inside, outside, color)
            if not self._changes.new(name, surface.vertices.tobytes()):
                continue
            if not len(surface.faces):
                self.server.scene.remove_by_name(f"/{name}")
            else:
                add_surface(self.server, f"/{name}", surface, color, opacity)

    def _show_step(self, explorer: RecordedExplorer, record: RecordedStep | None) -> None:
        """Show the trace of a step's motion and, for the kind `look`, the arm at its end and the view pyramid
        there."""
        draw_trace(self.server, self._drawn, None if record is None else record.trajectory)
        look = record if record is not None and record.step.kind == LOOK else None
        self._look.show(None if look is None else look.waypoints[-1])
        edges = [] if look is None else frustum(explorer, look)
        width = 0.5 * TRACE_WIDTH * explorer.robot.reach
        draw_lines(self.server, "/pyramid", edges, LOOK_COLOR, width)

    def _show_panel(self, state: ExplorationState) -> None:
        paused = state.mode == PAUSED
        # only if the state changed: otherwise, a visitor's change that has not arrived yet would be undone
        if self._changes.new("options", state.settings, state.noise, state.speed):
            set_value(self._policy, state.settings.policy)
            set_value(self._noise, state.noise)
            set_value(self._speed, float(np.clip(state.speed, *SPEEDS)))
        if self._changes.new("badge", state.phase, state.mode, state.known, state.steps, state.failure):
            self._badge.content = badge_html(exploration_badge(state))
            self._steps.content = _steps_html(state.steps)
            self._run.label = "Run" if paused else "Pause"
            self._run.icon = viser.Icon.PLAYER_PLAY if paused else viser.Icon.PLAYER_PAUSE
            self._run.disabled = self._step.disabled = state.phase == ENDED


def exploration_badge(state: ExplorationState) -> Validity:
    """The badge of a state: the current step or the end of the exploration, with its reason and
    confidence."""
    if state.failure:
        return Validity(INVALID, "failed", (state.failure,))
    if not state.steps or state.phase == CHOOSING:
        first = "on a new machine, code is compiled first, for about a minute"
        lines = () if state.steps else (first,)
        doing = f"choosing step {len(state.steps) + 1}" if state.phase == CHOOSING else "not begun"
        return Validity(PENDING, doing, (*lines, *_shares(state)))
    record = state.steps[-1]
    headline = f"{len(state.steps)}. {title(record)}"
    if state.phase == ENDED and state.violation:
        return Validity(INVALID, f"collides in the true scene: {state.violation}", (headline,))
    kind = PENDING
    if state.phase == ENDED:
        kind = VALID if record.step.kind == DONE else NO_MOTION
    lines = [record.step.reason]
    if record.step.policy and record.step.motion is not None:
        lines.append(f"{record.step.policy}: {PROMISES[record.step.policy]}")
    if record.step.confidence is not None:
        confidence = np.floor(1000 * record.step.confidence) / 10  # never rounded up to 100 %
        lines.append(f"stated confidence that it is free: {confidence:g} %")
    pause_text = ", paused" if state.mode == PAUSED and state.phase != ENDED else ""
    return Validity(kind, headline + pause_text, (*lines, *_shares(state)))


def _shares(state: ExplorationState) -> tuple[str, ...]:
    if state.known is None:
        return ()
    return ("of the map " + ", ".join(f"{value} {name}" for name, value in shares(state.known)),)


def _steps_html(steps: tuple[RecordedStep, ...]) -> str:
    rows = "".join(f"<div>{i}. {html.escape(title(record))}</div>" for i, record in enumerate(steps, 1))
    return f'<div style="margin: 0.4em 1em; font-size: 0.85em">{rows}</div>'


def _legend() -> str:
    colors = {
        "seen occupied": OBSERVED,
        "predicted occupied": ASSUMED,
        "boundary of unknown space": UNKNOWN,
        "next look, and what it is to show": LOOK_COLOR,
        "goal": GOAL,
    }
    mark = "display: inline-block; width: 0.8em; height: 0.8em; border-radius: 2px; margin-right: 0.5em"
    rows = (
        f'<div><span style="{mark}; background: rgb{color}"></span>{name}</div>'
        for name, color in colors.items()
    )
    return f'<div style="margin: 0.4em 1em; font-size: 0.85em">{"".join(rows)}</div>'
