"""One call of a planner: its clock, its random numbers, and the results that it can end with."""

import time

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.errors import InputError
from robotdiffuse.paths.timing import time_parameterize
from robotdiffuse.problems.problem import Problem
from robotdiffuse.results import PlanResult
from robotdiffuse.types import Path, Status, Trajectory
from robotdiffuse.verify import Report, Verifier, VerifySettings, Violation, verifier


class Call:
    """One call of plan(); see the head of this file."""

    def __init__(self, planner: str, problem: Problem, time_limit: float, seed: int) -> None:
        """Starts the clock. Raises InputError for a time limit that is not positive or a negative seed."""
        self.started = time.perf_counter()
        if not 0 < time_limit < float("inf"):
            raise InputError(f"time_limit is {time_limit}; it must be a positive number of seconds")
        if seed < 0:
            raise InputError(f"seed is {seed}; it must be at least 0")
        self.planner, self.problem, self.time_limit, self.seed = planner, problem, time_limit, seed
        self.rng = np.random.default_rng(seed)
        self.notes = list(problem.notes)
        """What the result will say was changed or ignored; planners may add to it."""
        self._progress: list[tuple[float, float]] = []
        self._refused = ""

    def improved(self, length: float) -> None:
        """Note that a path of this joint-space length [rad] was just found; longer ones are passed over."""
        if not self._progress or length < self._progress[-1][1]:
            self._progress.append((self.elapsed, length))

    @property
    def elapsed(self) -> float:
        """Wall time since the call began [s]."""
        return time.perf_counter() - self.started

    @property
    def remaining(self) -> float:
        """Wall time left [s]; negative when it has run out."""
        return self.time_limit - self.elapsed

    def fail(self, status: Status, reason: str) -> PlanResult:
        """A result without a motion."""
        return PlanResult(
            status=status,
            reason=reason,
            planner=self.planner,
            robot=self.problem.robot.name,
            planning_time=self.elapsed,
            seed=self.seed,
            notes=tuple(self.notes),
            refused=self._refused,
        )

    def unsolved(self, reason: str = "") -> PlanResult:
        """A result without a path: TIMEOUT if time has run out, else NO_PATH, for a search that ended."""
        if self.remaining <= 0:
            tried = (
                f"no path was found in {self.elapsed:.2f} s; a longer time limit or another seed may find one"
            )
            return self.fail(Status.TIMEOUT, reason or tried)
        ended = f"the search ended after {self.elapsed:.2f} s without a path; another seed may find one"
        return self.fail(Status.NO_PATH, reason or ended)

    def finish(self, waypoints: Float[ndarray, "n dof"], stage: str, reason: str = "") -> PlanResult | None:
        """Judge the path through the waypoints and time it; None if it or its motion does not pass.

        `stage` is the part of the planner that the waypoints come from.
        """
        problem = self.problem
        path = Path(problem.robot.joint_names, np.asarray(waypoints, dtype=np.float64))
        judge = verifier(problem, VerifySettings())
        report = judge.path(path)
        if report.violation is not None:
            return self._refuse(report.violation)
        planning_time = self.elapsed
        motion = _TimedMotion(judge)
        trajectory = time_parameterize(problem.robot, path, motion.valid, judge.collision_free)
        timed = motion.report(trajectory)
        if timed.violation is not None:
            return self._refuse(timed.violation)
        scene = _least(report.scene_clearance, timed.scene_clearance)
        itself = _least(report.self_clearance, timed.self_clearance)
        # found when the search had it, if it noted that; what it had shorter was refused
        same = path.length * 1e-3
        longer = [(at, length) for at, length in self._progress if length > path.length + same]
        found = [at for at, length in self._progress if abs(length - path.length) <= same]
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
            notes=tuple(self.notes),
            progress=(*longer, (found[0] if found else planning_time, path.length)),
            refused=self._refused,
        )

    def _refuse(self, violation: Violation) -> None:
        self._refused = violation.kind


def _least(*clearances: float | None) -> float:
    return min(clearance for clearance in clearances if clearance is not None)


class _TimedMotion:
    """Judges trajectories and remembers the last verdict: the one that is kept was mostly just judged."""

    def __init__(self, judge: Verifier) -> None:
        self.judge = judge
        self.last: tuple[Trajectory, Report] | None = None

    def report(self, trajectory: Trajectory) -> Report:
        if self.last is None or self.last[0] is not trajectory:
            self.last = trajectory, self.judge.trajectory(trajectory)
        return self.last[1]

    def valid(self, trajectory: Trajectory) -> bool:
        return self.report(trajectory).valid
