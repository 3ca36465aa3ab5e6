"""One call of a planner: its clock, its random numbers, and the results that it can end with."""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from numbers import Integral, Real
from typing import Annotated

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.kernels.compiled import compile_seconds
from robotdiffuse.core.bounds import MAX_COORDINATE
from robotdiffuse.core.deadline import OutOfTimeError, check_left, deadline
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, OneOf, Settings
from robotdiffuse.core.types import CONVERGED, UNTIL, Path, Status, Trajectory
from robotdiffuse.problems.problem import Problem, check_problem
from robotdiffuse.trajectories.speed_limits import (
    DEFAULT,
    NOTHING,
    Beside,
    Jerk,
    Pace,
    Scaling,
    TimingSettings,
)
from robotdiffuse.trajectories.timing import time_parameterize
from robotdiffuse.validation.validator import Report, Verifier, Violation, verifier

CLEARANCE = 0.01
"""What neither call nor problem says [m]."""

CLOSE_ROWS = 0.002
"""Time between the rows of motions under path constraints, whose corners are many and near to each other
[s]."""
AMPLE = 5.0
"""Times that a path could be validated and timed in the time left, where the first one found is at once."""
MOST_RESERVED = 0.5
"""Share of the time limit that is kept back at most before a path is validated."""
_finishing: dict[str, float] = {}
"""What validating and timing took of late, by robot [s]: so much of a call's time is kept back for it."""


@dataclass(frozen=True)
class Request(Settings):
    """What a call may ask for beyond its time limit and seed; see `planning.planner.Planner.plan`."""

    until: Annotated[str, OneOf(UNTIL)] = CONVERGED
    clearance: Annotated[float, Bound(least=0.0, most=MAX_COORDINATE)] | None = None
    velocity_scaling: Scaling = 1.0
    acceleration_scaling: Scaling = 1.0
    jerk: Jerk | None = None


@lru_cache
def _timing(request: Request, constrained: bool) -> TimingSettings:
    """Checked once for equal requests: it takes longer than to use them."""
    return TimingSettings(
        sample_time=CLOSE_ROWS if constrained else DEFAULT.sample_time,
        velocity_scale=request.velocity_scaling,
        acceleration_scale=request.acceleration_scaling,
        jerk=request.jerk,
    )


def check_asked(problem: object, time_limit: object, seed: object) -> None:
    """Raises InputError for what is no problem, a time limit that is not positive and a seed that is no
    whole number from 0 on."""
    check_problem(problem)
    if not isinstance(time_limit, Real) or not 0 < float(time_limit) < float("inf"):
        raise InputError(f"time_limit is {shown(time_limit)}; it must be a positive number of seconds")
    if not isinstance(seed, Integral) or seed < 0:
        raise InputError(f"seed is {shown(seed)}; it must be a whole number, at least 0")


class PlanningContext:
    """One call of plan(); see the head of this file."""

    def __init__(
        self,
        planner: str,
        problem: Problem,
        time_limit: float,
        seed: int,
        request: Request = Request(),
    ) -> None:
        """Starts the clock. Raises InputError as `check_asked`."""
        self.started, self._compiled = time.perf_counter(), compile_seconds()
        check_asked(problem, time_limit, seed)
        self.planner, self.problem, self.time_limit, self.seed = planner, problem, time_limit, seed
        self.until = request.until
        wanted = (request.clearance, problem.clearance, CLEARANCE)
        self.clearance = next(value for value in wanted if value is not None)
        """Distance to obstacles that is to be kept where it can be [m]."""
        self.timing = _timing(request, constrained=bool(problem.constraints))
        self._reserved = min(_finishing.get(problem.robot.name, 0.0), MOST_RESERVED * time_limit)
        self.validator = verifier(problem)
        self.notes = list(problem.notes)
        """What the result will say was changed or ignored; planners may add to it."""
        self._progress: list[tuple[float, float]] = []
        self._refused = ""
        self._ended: tuple[Status, str] | None = None

    @cached_property
    def rng(self) -> np.random.Generator:
        """Random numbers of what is not compiled."""
        return np.random.default_rng(self.seed)

    def improved(self, length: float) -> None:
        """Note that a path of this joint-space length [rad] was just found; longer ones are passed over."""
        if not self._progress or length < self._progress[-1][1]:
            self._progress.append((self.elapsed, length))

    @property
    def elapsed(self) -> float:
        """Wall time since the call began, less what compiling took, once on a machine [s]."""
        check_left()
        return time.perf_counter() - self.started - self._compiling

    @property
    def _compiling(self) -> float:
        return compile_seconds() - self._compiled

    @property
    def _all_notes(self) -> tuple[str, ...]:
        """With what was not counted."""
        if self._compiling == 0:
            return tuple(self.notes)
        spent = f"compiled for {self._compiling:.1f} s, once on this machine, which does not count as time"
        return (*self.notes, spent)

    @property
    def search_until(self) -> float:
        """When searching must end so that there is time left for `finish` [s since the call]."""
        return self.time_limit - self._reserved

    @property
    def ample(self) -> bool:
        """Whether validating a first path takes a small part of the time that is left."""
        return self._reserved > 0 and self.remaining > AMPLE * self._reserved

    @property
    def remaining(self) -> float:
        """Wall time left for searching [s]; negative when it has run out, or is too short for the validator."""
        return -1.0 if self._ended else self.search_until - self.elapsed

    def fail(self, status: Status, reason: str) -> PlanResult:
        """A result without a motion."""
        return PlanResult(
            status=status,
            reason=reason,
            planner=self.planner,
            robot=self.problem.robot.name,
            planning_time=self.elapsed,
            seed=self.seed,
            notes=self._all_notes,
            refused=self._refused,
        )

    def unsolved(self, reason: str = "") -> PlanResult:
        """A result without a path: TIMEOUT if time has run out, else NO_PATH, for a search that ended."""
        if self._ended:
            return self.fail(*self._ended)
        if self.remaining <= 0:
            tried = (
                f"no path was found in {self.elapsed:.2f} s; a longer time limit or another seed may find one"
            )
            return self.fail(Status.TIMEOUT, reason or tried)
        ended = f"the search ended after {self.elapsed:.2f} s without a path; another seed may find one"
        return self.fail(Status.NO_PATH, reason or ended)

    def deadline(self) -> AbstractContextManager[None]:
        """The call's time holds for steps far below while this lasts: they raise OutOfTimeError."""
        return deadline(lambda: self.time_limit - self.elapsed)

    def out_of_time(self, error: OutOfTimeError) -> PlanResult:
        """A result for a scene whose preparation, or a motion whose timing, takes longer than it may."""
        return self.fail(Status.TIMEOUT, self._too_short(error))

    def _too_short(self, error: OutOfTimeError) -> str:
        limit = f"the time limit of {self.time_limit:g} s is too short {error.what}"
        return f"{limit}: there was no time for {error}"

    @property
    def ended(self) -> bool:
        """Whether no path can be finished any more; `unsolved` says why."""
        return self._ended is not None

    def finish(
        self,
        waypoints: Float[ndarray, "n dof"],
        stage: str,
        reason: str = "",
        notes: tuple[str, ...] = (),
        keeps: Callable[[ndarray], bool] = lambda _: True,
        deviations: Float[ndarray, "n"] | None = None,
    ) -> PlanResult | None:
        """Validate the path through the waypoints and time it; None if it or its motion does not pass.

        `stage` is the part of the planner that the waypoints come from; `notes` are on this path alone;
        `keeps` and `deviations` as in `time_parameterize`.
        """
        began = self.elapsed
        try:
            with self.deadline():
                result = self._finished(waypoints, stage, reason, notes, keeps, deviations)
        except OutOfTimeError as error:
            self._ended = Status.TIMEOUT, self._too_short(error)
            return None
        took = self.elapsed - began
        before = _finishing.get(self.problem.robot.name, took)
        _finishing[self.problem.robot.name] = before + 0.5 * (took - before)
        self._reserved = max(self._reserved, took)
        return result

    def _finished(
        self,
        waypoints: Float[ndarray, "n dof"],
        stage: str,
        reason: str,
        notes: tuple[str, ...],
        keeps: Callable[[ndarray], bool],
        deviations: Float[ndarray, "n"] | None,
    ) -> PlanResult | None:
        problem = self.problem
        path = Path(problem.robot.joint_names, np.asarray(waypoints, dtype=np.float64))
        report = self.validator.path(path)
        if report.violation is not None:
            return self._refuse(report.violation)
        planning_time = self.elapsed
        motion = _TimedMotion(self.validator)
        trajectory = time_parameterize(
            problem.robot,
            path,
            motion.valid,
            self.validator.collision_free,
            self.timing,
            keeps,
            0.0 if problem.start_velocity is None else float(np.linalg.norm(problem.start_velocity)),
            self.beside,
            deviations,
        )
        timed = motion.report(trajectory)
        if timed.violation is not None:
            if timed.violation.kind == "time":  # too long to be validated, as any other motion here would be
                self._ended = Status.NO_PATH, timed.violation.message
            return self._refuse(timed.violation)
        scene = _least(report.scene_clearance, timed.scene_clearance)
        itself = _least(report.self_clearance, timed.self_clearance)
        # found when the search had it, if it noted that; what it had shorter was refused
        whole = path.length
        same = whole * 1e-3
        longer = [(at, length) for at, length in self._progress if length > whole + same]
        found = [at for at, length in self._progress if abs(length - whole) <= same]
        return PlanResult(
            status=Status.SOLVED,
            reason=reason or f"solved by {stage}",
            planner=self.planner,
            robot=problem.robot.name,
            planning_time=planning_time,
            seed=self.seed,
            stage=stage,
            path=path,
            trajectory=trajectory,
            min_clearance=min(scene, itself),
            scene_clearance=scene,
            self_clearance=itself,
            notes=(*self._all_notes, *notes),
            progress=(*longer, (found[0] if found else planning_time, whole)),
            refused=self._refused,
        )

    @property
    def beside(self) -> Beside:
        """The speeds that constraints bound, and the torques of a payload."""
        constraints, pace = self.validator.constraints, None
        if constraints is not None and len(constraints.paced):
            pace = Pace(constraints.speeds, constraints.most_speeds)
        if pace is None and self.validator.dynamics is None:
            return NOTHING
        return Beside(pace, self.validator.dynamics)

    def _refuse(self, violation: Violation) -> None:
        self._refused = violation.kind


def _least(*clearances: float | None) -> float:
    return min(clearance for clearance in clearances if clearance is not None)


class _TimedMotion:
    """Validates trajectories and remembers the last verdict: the one that is kept was mostly just validated."""

    def __init__(self, validator: Verifier) -> None:
        self.validator = validator
        self.last: tuple[Trajectory, Report] | None = None

    def report(self, trajectory: Trajectory) -> Report:
        if self.last is None or self.last[0] is not trajectory:
            self.last = trajectory, self.validator.trajectory(trajectory)
        return self.last[1]

    def valid(self, trajectory: Trajectory) -> bool:
        return self.report(trajectory).valid
