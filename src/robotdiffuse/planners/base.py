"""What all planners share: the protocol, the ends of a problem, and the way from waypoints to a result."""

import time
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact import explain_collision
from robotdiffuse.errors import InputError
from robotdiffuse.paths.timing import time_parameterize
from robotdiffuse.problem import JointGoal, PoseGoal, Problem
from robotdiffuse.robots.inverse_kinematics import inverse_kinematics
from robotdiffuse.types import Path, PlanResult, Status, Trajectory
from robotdiffuse.verify import Report, Verifier, VerifySettings, verifier

GOAL_COUNT = 10
"""Configurations that are looked for when the goal is a pose (the paper's k)."""


@runtime_checkable
class Planner(Protocol):
    def plan(self, problem: Problem, time_limit: float = 1.0, seed: int = 0) -> PlanResult:
        """Plan a motion within `time_limit` [s] of wall time, less what verifying and timing it take.

        The same seed gives the same path, as long as time does not run out. A result with status SOLVED holds
        a path and a trajectory that passed `verify`; any other status comes with a reason.
        """
        ...


class Call:
    """One call of plan(): its clock, and the results that it can end with."""

    def __init__(self, planner: str, problem: Problem, time_limit: float, seed: int) -> None:
        """Starts the clock. Raises InputError for a time limit that is not positive or a negative seed."""
        self.started = time.perf_counter()
        if not 0 < time_limit < float("inf"):
            raise InputError(f"time_limit is {time_limit}; it must be a positive number of seconds")
        if seed < 0:
            raise InputError(f"seed is {seed}; it must be at least 0")
        self.planner, self.problem, self.time_limit, self.seed = planner, problem, time_limit, seed
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

    def timeout(self, reason: str = "") -> PlanResult:
        """A result for time that ran out, or for a search that ended without a path."""
        default = (
            f"no path was found in {self.elapsed:.2f} s; a longer time limit or another seed may find one"
        )
        return self.fail(Status.TIMEOUT, reason or default)

    def finish(self, waypoints: Float[ndarray, "n dof"], stage: str, reason: str = "") -> PlanResult | None:
        """Judge the path through the waypoints and time it; None if it or its motion does not pass.

        `stage` is the part of the planner that the waypoints come from.
        """
        problem = self.problem
        path = Path(problem.robot.joint_names, np.asarray(waypoints, dtype=np.float64))
        judge = verifier(problem, VerifySettings())
        report = judge.path(path)
        if report.violation is not None or report.min_clearance is None:
            return self._refuse(report)
        planning_time = self.elapsed
        motion = _TimedMotion(judge)
        trajectory = time_parameterize(problem.robot, path, motion.valid, judge.collision_free)
        timed = motion.report(trajectory)
        if timed.violation is not None or timed.min_clearance is None:
            return self._refuse(timed)
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
            min_clearance=min(report.min_clearance, timed.min_clearance),
            notes=tuple(self.notes),
            progress=(*longer, (found[0] if found else planning_time, path.length)),
            refused=self._refused,
        )

    def _refuse(self, report: Report) -> None:
        assert report.violation is not None  # by Report
        self._refused = report.violation.kind


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


def usable_goals(
    call: Call, checker: CollisionChecker, rng: np.random.Generator, count: int = GOAL_COUNT
) -> Float[ndarray, "k dof"] | PlanResult:
    """The goal configurations to plan to, or the result that says why there can be no plan.

    For a pose, up to `count` configurations by inverse kinematics. Configurations that the covering spheres
    call free come alone; where there are none, those that the exact meshes call free.
    """
    robot, scene, start = call.problem.robot, call.problem.scene, call.problem.start
    if not checker.free(start[None])[0]:
        collision = explain_collision(robot, scene, start)
        if collision is not None:
            return call.fail(Status.INVALID_START, f"the start is in collision: {collision}")
    goal = call.problem.goal
    if isinstance(goal, PoseGoal):
        return _pose_goals(call, goal, checker, rng, count)
    return _free_goals(call, goal, checker)


def _free_goals(
    call: Call, goal: JointGoal, checker: CollisionChecker
) -> Float[ndarray, "k dof"] | PlanResult:
    free = checker.free(goal.positions)
    if free.any():
        return goal.positions[free]
    collisions = [explain_collision(call.problem.robot, call.problem.scene, q) for q in goal.positions]
    kept = [q for q, collision in zip(goal.positions, collisions, strict=True) if collision is None]
    if kept:
        return np.stack(kept)
    what = "the goal is" if len(collisions) == 1 else f"all {len(collisions)} goal configurations are"
    return call.fail(Status.INVALID_GOAL, f"{what} in collision: {collisions[0]}")


def _pose_goals(
    call: Call, goal: PoseGoal, checker: CollisionChecker, rng: np.random.Generator, count: int
) -> Float[ndarray, "k dof"] | PlanResult:
    robot, scene = call.problem.robot, call.problem.scene
    found = inverse_kinematics(robot, goal.frame, goal.T_base_frame, count, rng=rng, accept=checker.free)
    if len(found):
        return found
    reached = inverse_kinematics(robot, goal.frame, goal.T_base_frame, count, rng=rng)
    xyz = ", ".join(f"{value:.3f}" for value in goal.T_base_frame[:3, 3])
    if not len(reached):
        return call.fail(
            Status.UNREACHABLE_GOAL,
            f"no configuration within the joint limits brings {goal.frame} to the pose at ({xyz}) m",
        )
    collisions = [explain_collision(robot, scene, q) for q in reached]
    kept = [q for q, collision in zip(reached, collisions, strict=True) if collision is None]
    if kept:
        return np.stack(kept)
    return call.fail(
        Status.INVALID_GOAL,
        f"all {len(reached)} configurations found for the pose of {goal.frame} at ({xyz}) m are in "
        f"collision, e.g. {collisions[0]}",
    )
