"""An exploration that happens while it is watched: its state, and the thread that runs it. Independent of
browsers.

One thread chooses steps and executes them at the motion's speed; visitors only say whether it may go on.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, shortened
from robotdiffuse.perception.depth_noise import DepthNoise
from robotdiffuse.planning.exploration.recorded import RecordedAct, RecordedExplorer, RecordedView
from robotdiffuse.planning.exploration.simulated import explore, simulated_explorer
from robotdiffuse.planning.exploration.steps import ExplorerSettings
from robotdiffuse.problems.problem import Problem
from robotdiffuse.visualization.exploration import READING_TIME
from robotdiffuse.visualization.live.latest_task import LatestTask
from robotdiffuse.visualization.live.player import FRAME_RATE

WAITING, CHOOSING, MOVING, ENDED = "waiting", "choosing", "moving", "ended"
"""Phases: at rest until a visitor lets it go on, choosing a step, executing it, and after the last step."""
PAUSED, STEPPING, RUNNING = "paused", "stepping", "running"
"""What visitors want: a pause, one step and then a pause, or all steps."""


@dataclass(frozen=True, eq=False)
class ExplorationState:
    """Everything that the page shows at one moment."""

    settings: ExplorerSettings
    noise: bool
    configuration: Float[ndarray, "dof"]
    mode: str = PAUSED
    phase: str = WAITING
    speed: float = 1.0
    """Of motions, as a multiple of their own."""
    explorer: RecordedExplorer | None = None
    """Of which others read the cameras and the known scene; its thread changes the rest."""
    acts: tuple[RecordedAct, ...] = ()
    """Steps so far; while moving the last one is under way."""
    known: RecordedView | None = None
    """The latest view, and what is known after it."""
    violation: str = ""
    """Why the validator refuses the last motion in the true scene."""
    failure: str = ""
    """Why the exploration cannot go on, in one line."""


class _OutdatedError(Exception):
    """The exploration was restarted or closed."""


class ExplorationSession:
    """The state of the exploration and its thread. `on_change` is called after each change, by any thread."""

    def __init__(
        self, problem: Problem, settings: ExplorerSettings, noise: bool, seed: int, speed: float = 1.0
    ) -> None:
        """Begins paused, at the problem's start."""
        self.problem, self._seed = problem, seed
        self.on_change: Callable[[], None] = lambda: None
        self._changed, self._run = threading.Condition(), 0
        self._state = ExplorationState(settings, noise, problem.start, speed=speed)
        self._task = LatestTask(self._explore, "explore")

    @property
    def state(self) -> ExplorationState:
        """The current state."""
        return self._state

    def set_mode(self, mode: str) -> None:
        """Pause, take one step (the one under way, if there is one), or run."""
        with self._changed:
            self._state = replace(self._state, mode=mode)
            if self._run == 0:
                self._run = 1
                self._task.submit(self._run)
            self._changed.notify_all()
        self.on_change()

    def set_speed(self, speed: float) -> None:
        """Change the speed of motions."""
        with self._changed:
            self._state = replace(self._state, speed=speed)
        self.on_change()

    def restart(self, policy: str | None = None, noise: bool | None = None) -> None:
        """Begin anew, with another policy or noise if given. Raises InputError for an unknown policy."""
        with self._changed:
            old = self._state
            settings = old.settings if policy is None else replace(old.settings, policy=policy)
            noise = old.noise if noise is None else noise
            start = self.problem.start
            self._state = ExplorationState(settings, noise, start, old.mode, speed=old.speed)
            self._run += 1
            self._task.submit(self._run)
            self._changed.notify_all()
        self.on_change()

    def close(self) -> None:
        """End the thread as soon as the step that it may be choosing is found."""
        with self._changed:
            self._run += 1
            self._changed.notify_all()
        self._task.close()

    # Work of the thread

    def _explore(self, run: int) -> None:
        try:
            self._take_steps(run)
        except _OutdatedError:
            pass
        except Exception as error:  # the page survives any error
            kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
            with self._changed:
                if run == self._run:
                    failure = kind + shortened(str(error))
                    self._state = replace(self._state, phase=ENDED, failure=failure)
            self.on_change()

    def _take_steps(self, run: int) -> None:
        state = self._update(run, phase=CHOOSING)
        noise = DepthNoise() if state.noise else None
        explorer = simulated_explorer(self.problem, state.settings, noise, self._seed)
        self._update(run, explorer=explorer, known=explorer.views[-1])
        events = explore(self.problem, explorer, noise, self._seed)
        ended = False
        while not ended:
            if self._state.mode == PAUSED:
                self._update(run, phase=WAITING)
            self._wait_while_paused(run)
            self._update(run, phase=CHOOSING)
            event = next(events)
            self._execute(run, explorer)
            ended = event.step.motion is None or not event.free
            with self._changed:
                mode = PAUSED if self._state.mode == STEPPING else self._state.mode
                self._update(
                    run,
                    mode=mode,
                    phase=ENDED if ended else CHOOSING,
                    violation=event.violation,
                    known=explorer.views[-1],
                )

    def _execute(self, run: int, explorer: RecordedExplorer) -> None:
        """Execute the last step, in which the views are those that were taken during its motion."""
        act, number = explorer.acts[-1], len(explorer.acts) - 1
        before = [view for view in explorer.views if view.act < number]
        views = [*before[-1:], *(view for view in explorer.views if view.act == number)]
        self._update(run, phase=MOVING, acts=tuple(explorer.acts), known=views[0])
        at, last = -READING_TIME, time.perf_counter()
        while act.trajectory is not None and at < act.duration:
            if self._wait_while_paused(run):
                last = time.perf_counter()
            time.sleep(1 / FRAME_RATE)
            now = time.perf_counter()
            speed = self._state.speed if at >= 0 else max(self._state.speed, 1.0)
            at, last = min(at + speed * (now - last), act.duration), now
            if at > 0:
                taken = [view for view in views if view.time <= act.begins + at]
                q = act.trajectory.at(at).positions
                self._update(run, configuration=q, known=taken[-1])

    def _update(self, run: int, **changes: Any) -> ExplorationState:
        with self._changed:
            if run != self._run:
                raise _OutdatedError
            self._state = state = replace(self._state, **changes)
        self.on_change()
        return state

    def _wait_while_paused(self, run: int) -> bool:
        """Whether it was paused."""
        with self._changed:
            paused = self._state.mode == PAUSED
            self._changed.wait_for(lambda: run != self._run or self._state.mode != PAUSED)
            if run != self._run:
                raise _OutdatedError
        return paused
