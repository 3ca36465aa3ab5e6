"""The request and the context of a planning call: its arguments, clock, random numbers and results."""

import time
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Annotated, Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy import ndarray

from robotdiffuse.core.deadline import OutOfTimeError, check_cancelled, deadline
from robotdiffuse.core.loading import loading_seconds
from robotdiffuse.core.settings import Bound, Natural, OneOf, Settings
from robotdiffuse.core.types import (
    CONVERGED,
    OBJECTIVES,
    TIME,
    UNTIL,
    Configurations,
    Path,
    PlanResult,
    Status,
    Trajectory,
    Values,
)
from robotdiffuse.problems.problem import MAX_CLEARANCE, Problem, check_problem
from robotdiffuse.problems.units import unit_notes
from robotdiffuse.scenes.scene import contact_notes
from robotdiffuse.trajectories.speed_limits import (
    DEFAULT,
    ExtraLimits,
    FrameSpeedLimits,
    Jerk,
    Scaling,
    TimingSettings,
)
from robotdiffuse.trajectories.timing import time_parameterize
from robotdiffuse.validation.report import Report, Violation
from robotdiffuse.validation.validator import verifier

DEFAULT_CLEARANCE = 0.01
"""Clearance if neither the request nor the problem sets one [m]."""
CONSTRAINED_SAMPLE_TIME = 0.002
"""Time between the rows of motions under path constraints [s]. It is short, because the corners of such paths
are close together."""
EARLY_VALIDATION_FACTOR = 5.0
"""Without path constraints, a path is validated during the search if the time left for searching is more than
this multiple of the time reserved for validating and timing a path. Under path constraints, the multiple
is 1."""
TOLERANCE_FRACTION = 0.95
"""Fraction of each tolerance of path constraints that planners use; the remainder is a safety margin."""
MAX_RESERVED_FRACTION = 0.5
"""Largest fraction of the time limit that is reserved for the first validation and timing."""
RESERVED_FACTOR = 3.0
"""Time that is reserved for validating and timing a path, as a multiple of the longest time that this call
has spent on one path."""
EXPECTED_VALIDATION_TIME = 0.003
"""Time that is reserved for validating and timing the first path of a call [s]."""
STOPS_NOTE = "the motion stops on its way, at "
"""Beginning of the note on stops that nobody asked for; the times of the stops [s] follow."""
MIN_TIME_LIMIT = 1e-3
"""Smallest time limit that `time_left` returns, even if the call's time has run out [s]."""


@dataclass(frozen=True)
class PlanRequest(Settings):
    """The arguments of a planning call besides its problem; `rd.plan` documents the fields."""

    time_limit: Annotated[float, Bound(above=0.0, most=1e9)] = 1.0
    seed: Natural = 0
    until: Annotated[str, OneOf(UNTIL)] = CONVERGED
    clearance: Annotated[float, Bound(least=0.0, most=MAX_CLEARANCE)] | None = None
    velocity_scaling: Scaling = 1.0
    acceleration_scaling: Scaling = 1.0
    jerk: Jerk | None = None
    objective: Annotated[str, OneOf(OBJECTIVES)] = TIME


@runtime_checkable
class Solver(Protocol):
    """The part of a planner that `planning/pipeline` calls; every `Planner` is a Solver."""

    name: ClassVar[str]

    def attempt(self, problem: Problem, request: PlanRequest) -> PlanResult:
        """Plan from the problem's start to its goal; `planning/pipeline` handles its waypoints, moving
        obstacles, start velocity and views."""
        ...


def clock() -> float:
    """The time of a clock that stops while this thread loads code, see `core/loading.py` [s]."""
    return time.perf_counter() - loading_seconds()


def time_left(time_limit: float, began: float) -> float:
    """Time that is left [s] of a call's time limit; `began` is the `clock` at the call's beginning.

    At least MIN_TIME_LIMIT, or the time limit itself if it is less.
    """
    return min(time_limit, max(time_limit - (clock() - began), MIN_TIME_LIMIT))


def requested_clearance(problem: Problem, clearance: float | None) -> float:
    """The clearance of a call [m]: `clearance`, else the problem's, else DEFAULT_CLEARANCE."""
    if clearance is None:
        clearance = problem.clearance
    return DEFAULT_CLEARANCE if clearance is None else clearance


@lru_cache
def _timing(
    velocity_scaling: float, acceleration_scaling: float, jerk: float | None, constrained: bool, segments: int
) -> TimingSettings:
    """The timing settings of a request, cached because checking them takes longer than using them."""
    return TimingSettings(
        sample_time=CONSTRAINED_SAMPLE_TIME if constrained else DEFAULT.sample_time,
        velocity_scale=velocity_scaling,
        acceleration_scale=acceleration_scaling,
        jerk=jerk,
        line_intervals=segments * DEFAULT.line_intervals,
    )


class PlanningContext:
    """One call of a planner: the problem, the request, the clock, and the ways to end with a result.

    A planner reads `remaining`, draws from `rng`, reports lengths to `improved`, and returns the result of
    `finish` for a path or of `unsolved` without one.
    """

    def __init__(
        self, planner_name: str, problem: Problem, request: PlanRequest = PlanRequest(), segments: int = 1
    ) -> None:
        """Start the clock.

        Args:
            planner_name: Name of the planner, for the result.
            problem: The problem.
            request: The other arguments of the call.
            segments: Number of planned paths that are joined into one motion. The timing's `line_intervals`
                of a single path are multiplied by this number.

        Raises:
            InputError: If `problem` is not a Problem.
        """
        self.started = clock()
        check_problem(problem)
        self.planner_name = planner_name
        self.problem = problem
        self.request = request
        self.clearance = requested_clearance(problem, request.clearance)
        """Distance to obstacles that paths keep where possible [m]."""
        scalings = request.velocity_scaling, request.acceleration_scaling
        self.timing = _timing(*scalings, request.jerk, bool(problem.constraints), segments)
        self._reserved = min(EXPECTED_VALIDATION_TIME, MAX_RESERVED_FRACTION * request.time_limit)
        self.validator = verifier(problem)
        self.notes = (*unit_notes(problem), *contact_notes(problem.scene), *problem.notes)
        """Notes of the result: what was changed or ignored."""
        self._prepared = 0.0
        """When the search began [s since the call]; 0 before."""
        self._progress = list[tuple[float, float]]()
        self._refused = ""
        self.refused_at = 0.0, ""
        """The first violation of the last motion that was refused: where it is, as a fraction of the motion,
        and its message."""
        self._ended: tuple[Status, str] | None = None
        """Status and reason of the result, after `finish` found that no motion can be finished any more; None
        before."""

    @cached_property
    def rng(self) -> np.random.Generator:
        """The random generator of this call, for code that is not compiled."""
        return np.random.default_rng(self.request.seed)

    def begin_search(self) -> None:
        """Record that the search begins now, after start and goal states were found."""
        self._prepared = self.elapsed

    def note(self, text: str) -> None:
        """Add a note to the result.

        Args:
            text: What was changed or ignored.
        """
        self.notes = self.notes_with([text])

    def notes_with(self, more: Iterable[str]) -> tuple[str, ...]:
        """Join the notes of this call and others.

        Args:
            more: The other notes.

        Returns:
            Each note once, those of the call first.
        """
        return tuple(dict.fromkeys((*self.notes, *more)))

    def keeps_constraints(self, q: Configurations) -> bool:
        """Check a polyline, such as a rounded corner, against the path constraints.

        Args:
            q: Its configurations [n, dof].

        Returns:
            Whether it deviates from the constraints by at most TOLERANCE_FRACTION of their tolerances.
        """
        constraints = self.validator.constraints
        return constraints is None or not constraints.first_violation(
            q if len(q) > 1 else np.repeat(q, 2, axis=0), tolerance_fraction=TOLERANCE_FRACTION
        )

    @property
    def first_path_at(self) -> float:
        """When the first path was found [s since the call]; infinite without one."""
        return self._progress[0][0] if self._progress else np.inf

    def improved(self, length: float) -> None:
        """Record that a path was just found, if it is the shortest so far.

        Args:
            length: Its length in joint space [rad].
        """
        if not self._progress or length < self._progress[-1][1]:
            self._progress.append((self.elapsed, length))

    @property
    def elapsed(self) -> float:
        """Wall time since the call began, without the time for loading (see `core/loading.py`) [s]."""
        check_cancelled()
        return clock() - self.started

    @property
    def search_until(self) -> float:
        """When the search must end, so that time is left for `finish` [s since the call]."""
        return self.request.time_limit - self._reserved

    @property
    def validates_early(self) -> bool:
        """Whether enough time is left to validate a path during the search."""
        if self.problem.constraints:  # a search under constraints finds few paths and times each of them
            return self.remaining > self._reserved
        return self.remaining > EARLY_VALIDATION_FACTOR * self._reserved

    @property
    def remaining(self) -> float:
        """Wall time left for searching [s]; at most 0 once it has run out, and -1 after `ended`."""
        return -1.0 if self._ended else self.search_until - self.elapsed

    def fail(self, status: Status, reason: str) -> PlanResult:
        """End the call without a motion.

        Args:
            status: Any status but SOLVED.
            reason: A sentence that says why there is no motion.

        Returns:
            The failed result.
        """
        return self._result(status, reason, self.elapsed, notes=self.notes)

    def _result(self, status: Status, reason: str, planning_time: float, **more: Any) -> PlanResult:
        return PlanResult(
            status,
            reason,
            self.planner_name,
            self.problem.robot.name,
            planning_time,
            self.request.seed,
            refused=self._refused,
            **more,
        )

    def unsolved(self, reason: str = "") -> PlanResult:
        """End a search that found no path.

        Args:
            reason: Why there is no path; ignored if the call has `ended`. Empty: the result says that
                time ran out, or that the search ended.

        Returns:
            A failed result. If `finish` has `ended` the call, the result has the status and reason that
            `finish` recorded. Otherwise its status is TIMEOUT if time has run out, and NO_PATH if not.
        """
        if self._ended:
            return self.fail(*self._ended)
        if self.remaining <= 0:
            default_reason = (
                f"no path was found in {self.elapsed:.2f} s; a longer time limit or another seed may find one"
            )
            return self.fail(Status.TIMEOUT, reason or default_reason)
        ended = f"the search ended after {self.elapsed:.2f} s without a path; another seed may find one"
        return self.fail(Status.NO_PATH, reason or ended)

    def deadline(self) -> AbstractContextManager[None]:
        """Limit the steps that call `check_time` or `check_timing` (see core/deadline.py) to the call's time.

        Returns:
            A context manager within which these steps raise OutOfTimeError when time runs out.
        """
        return deadline(lambda: self.request.time_limit - self.elapsed)

    def out_of_time(self, error: OutOfTimeError) -> PlanResult:
        """End a call that ran out of time while preparing the scene or timing a motion.

        Args:
            error: What `deadline` raised.

        Returns:
            A result with status TIMEOUT.
        """
        return self.fail(Status.TIMEOUT, self._too_short(error))

    def _too_short(self, error: OutOfTimeError) -> str:
        before = (
            f"the search began after {self._prepared:.2f} s" if self._prepared else "the search had not begun"
        )
        first_path_note = f", its first path came after {self.first_path_at:.2f} s" if self._progress else ""
        return (
            f"the time limit is too short {error.what}: there was no time "
            f"for {error} after {self.elapsed:.2f} s; {before}{first_path_note}"
        )

    @property
    def ended(self) -> bool:
        """Whether no path can be finished any more, usually for lack of time; `unsolved` gives the reason."""
        return self._ended is not None

    def finish(
        self,
        waypoints: Configurations,
        stage: str,
        reason: str = "",
        notes: tuple[str, ...] = (),
        keeps: Callable[[ndarray], bool] = lambda _: True,
        deviations: Values | None = None,
        trajectory: Trajectory | None = None,
    ) -> PlanResult | None:
        """Validate the path through the waypoints, time it, and validate the motion.

        Args:
            waypoints: The path [n, dof] [rad] or [m].
            stage: The part of the planner that found the path.
            reason: The result's reason; empty: "solved by" and the stage.
            notes: Notes on this path, added to those of the call.
            keeps: As in `time_parameterize`.
            deviations: As in `time_parameterize`; None: the corner deviation of `timing`.
            trajectory: The motion along the path, if it is timed already.

        Returns:
            The solved result; None if the validator refuses the path or the motion, or if time runs out.
        """
        problem = self.problem
        began = self.elapsed
        waypoints = np.asarray(waypoints, dtype=np.float64)
        if deviations is None:
            deviations = np.full(len(waypoints), self.timing.corner_deviation)
        turns = np.flatnonzero(problem.robot.wraps(waypoints).any(axis=1))
        # A controller that wraps angles could take a step of nearly a whole turn for a small step back, so
        # such a step gets a waypoint at its middle.
        if len(turns):
            middles = 0.5 * (waypoints[turns] + waypoints[turns + 1])
            waypoints = np.insert(waypoints, turns + 1, middles, axis=0)
            deviations = np.insert(deviations, turns + 1, self.timing.corner_deviation)
        path = Path(problem.robot.joint_names, waypoints)
        # Timing usually returns the last motion that it validated; thanks to the cache, this motion is not
        # validated again.
        report_of = lru_cache(maxsize=1)(self.validator.trajectory)
        try:
            with self.deadline():
                report = self.validator.path(path)
                if report.violation is not None:
                    return self._refuse(report.violation, float(len(waypoints) - 1))
                planning_time = self.elapsed
                if trajectory is None:
                    velocity = problem.start_velocity
                    trajectory = time_parameterize(
                        problem.robot,
                        path,
                        lambda motion: report_of(motion).valid,
                        self.validator.collision_free,
                        self.timing,
                        keeps,
                        0.0 if velocity is None else float(np.linalg.norm(velocity)),
                        self.extra_limits,
                        deviations,
                    ).trajectory
                timed = report_of(trajectory)
        except OutOfTimeError as error:
            self._ended = Status.TIMEOUT, self._too_short(error)
            return None
        finally:
            self._reserved = max(self._reserved, RESERVED_FACTOR * (self.elapsed - began))
        if timed.violation is not None:
            if timed.violation.kind == "time":  # every motion of this problem would take too long to validate
                self._ended = Status.NO_PATH, timed.violation.message
            return self._refuse(timed.violation, trajectory.duration)
        # Progress ends with the returned path, at the time when the search recorded its length. Shorter
        # recorded paths are left out: they were refused, or a longer path gives a faster motion.
        tolerance = path.length * 1e-3
        longer = [(at, length) for at, length in self._progress if length > path.length + tolerance]
        times = [at for at, length in self._progress if abs(length - path.length) <= tolerance]
        return self._result(
            Status.SOLVED,
            reason or f"solved by {stage}",
            planning_time,
            stage=stage,
            path=path,
            trajectory=trajectory,
            corner_deviations=tuple(deviations.tolist()),
            **least_clearances(report, timed),
            notes=self.notes_with(notes),
            progress=(*longer, (times[0] if times else planning_time, path.length)),
        )

    @property
    def extra_limits(self) -> ExtraLimits:
        """Limits on timing in addition to the joint limits: speed limits of constraints, and torque limits
        with a payload."""
        constraints = self.validator.constraints
        frame_speeds = None
        if constraints is not None and len(constraints.speed_limited):
            frame_speeds = FrameSpeedLimits(constraints.speeds, constraints.speed_limits)
        return ExtraLimits(frame_speeds, self.validator.dynamics)

    def _refuse(self, violation: Violation, end: float) -> None:
        """Record the violation of a refused path or motion. end: the value that `violation.time` has at the
        end of the motion: the last index of a path, or the duration of a motion [s]."""
        self._refused = violation.kind
        self.refused_at = violation.time / end, violation.message


def least_clearances(*motions: Report | PlanResult) -> dict[str, Any]:
    """The smallest clearances [m] of valid motions, as fields of a `PlanResult`."""
    scene = min(motion.scene_clearance for motion in motions)  # type: ignore[type-var]
    itself = min(motion.self_clearance for motion in motions)  # type: ignore[type-var]
    return {"scene_clearance": scene, "self_clearance": itself, "min_clearance": min(scene, itself)}
