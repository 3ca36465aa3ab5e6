"""Where a motion begins and may end: goals of a pose, ends that touch, and why there can be no plan."""

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import Space
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.types import Status
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.problems.goals import AnyGoal, Goal, JointGoal, PoseGoal, PosesGoal, poses_of
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

if TYPE_CHECKING:
    from robotdiffuse.problems.compiled_constraints import PathConstraints

ROUNDS, LOOKING = 100, 0.5
"""How often others are tried, by the exact meshes, as long as none is free; the share of the time left."""
END_MARGIN = 0.0005
"""What an end that is closer than the wanted clearance keeps less than it has [m]."""
RETREAT_STEP = 0.01
"""Step of the way out of contact of the covering spheres [rad]."""
RETREAT_STEPS = 100
BEYOND_ENDS = np.pi / 2
"""How far a continuous joint may turn beyond start and goals in a search [rad]."""


class StartGoal:
    """Start and goals that the spheres call free, with the ends near contact that they stand for.

    A continuous joint begins within half a turn here; `complete` adds the whole turns that it really has. A
    goal stands for its images, see `images`.
    """

    def __init__(
        self,
        checker: CollisionChecker,
        start: ndarray,
        goals: ndarray,
        constraints: "PathConstraints | None" = None,
    ) -> None:
        robot = self._robot = checker.robot
        self.checker = checker
        self._turns = robot.whole_turns(start)
        self.start = start - self._turns
        ways = [image for goal in goals for image in images(robot, self.start, goal)]
        every = [self.start, *ways]
        free = checker.free(np.stack(every))  # all at once: most are
        self.start_lead, *leads = (
            q.copy() if at_once and constraints is None else retreat(checker, q, constraints)
            for q, at_once in zip(every, free, strict=True)
        )
        self.goals = [goal for goal, lead in zip(ways, leads, strict=True) if lead is not None]
        self.goal_leads = [lead for lead in leads if lead is not None]

    def rows(self) -> tuple[Float[ndarray, "dof"], Float[ndarray, "k dof"]]:
        """Where a search begins and where it may end, in float32."""
        assert self.start_lead is not None
        return self.start_lead.astype(np.float32), np.array(self.goal_leads, np.float32)

    def kept_clearance(self, wanted: float) -> float:
        """The distance that a path can keep to obstacles: as wanted, or half of what the ends have [m]."""
        start, goals = self.rows()
        leads = np.concatenate([start[None], goals])
        return min(wanted, 0.5 * float(self.checker.link_clearances(leads).min(initial=wanted)))

    def space(self, resolution: float, clearance: float) -> Space:
        """What searches between the ends check motions in, `clearance` [m] away from obstacles.

        Around an end that is closer itself, it is what that end has, and more with the distance from it
        (`collision.kernels.motions.padding_near`).
        """
        start, goals = self.rows()
        start_goal = np.concatenate([start[None], goals])
        if clearance <= 0:
            return self._within(search_space(self.checker, resolution), start_goal)
        has = self.checker.link_clearances(start_goal).min(axis=1, initial=1.0)
        close = has < clearance + END_MARGIN
        near = np.column_stack([start_goal[close], np.maximum(has[close] - END_MARGIN, 0.0)])
        return self._within(search_space(self.checker, resolution, clearance, near), start_goal)

    def _within(self, space: Space, start_goal: Float[ndarray, "k dof"]) -> Space:
        """The space with continuous joints kept within BEYOND_ENDS of what the ends take up."""
        turning = self._robot.continuous
        lower = np.where(turning, np.maximum(space.lower, start_goal.min(axis=0) - BEYOND_ENDS), space.lower)
        upper = np.where(turning, np.minimum(space.upper, start_goal.max(axis=0) + BEYOND_ENDS), space.upper)
        return space._replace(lower=lower.astype(np.float32), upper=upper.astype(np.float32))

    def complete(self, path: Float[ndarray, "n dof"]) -> Float[ndarray, "m dof"]:
        """The path with its exact ends in float64 in place of, or before and after, those of the search."""
        assert self.start_lead is not None
        path = path.astype(np.float64)
        errors = [np.abs(path[-1] - lead).max() for lead in self.goal_leads]
        i = int(np.argmin(errors))
        rows = [self.start[None], path[1:-1], self.goals[i][None]]
        if self.goal_leads[i] is not self.goals[i] and not np.array_equal(self.goal_leads[i], self.goals[i]):
            rows.insert(2, self.goal_leads[i][None])
        if not np.array_equal(self.start_lead, self.start):
            rows.insert(1, self.start_lead[None])
        return np.concatenate(rows) + self._turns if self._turns.any() else np.concatenate(rows)


def images(
    robot: Robot, start: Float[ndarray, "dof"], goal: Float[ndarray, "dof"]
) -> list[Float[ndarray, "dof"]]:
    """The values that stand for a goal in joint space, where continuous joints do not wrap.

    First those nearest to the start, then those with one of the continuous joints the other way round: an
    obstacle may block the short way.
    """
    nearest = goal - robot.whole_turns(goal - start)
    found = [nearest]
    for j in np.flatnonzero(robot.continuous):
        other = nearest.copy()
        other[j] -= np.copysign(2 * np.pi, nearest[j] - start[j])
        found.append(other)
    return found


def usable_start_goal(context: PlanningContext) -> StartGoal | PlanResult:
    """The ends that a search of this call can begin and end at, or the result that says why it cannot.

    For poses, up to `poses.GOAL_COUNT` configurations by inverse kinematics. Configurations that the covering
    spheres call free come alone; where there are none, those that the exact meshes call free.
    """
    checker = CollisionChecker(context.problem.robot, context.problem.scene)
    goals = _usable_goals(context, checker)
    if isinstance(goals, PlanResult):
        return goals
    start_goal = StartGoal(checker, context.problem.start, goals, context.validator.constraints)
    if start_goal.start_lead is None:
        why = closeness(checker, context.problem.start)
        return context.fail(Status.INVALID_START, f"the start is too close to contact to plan from: {why}")
    if not start_goal.goals:
        what = "the goal is" if len(goals) == 1 else f"all {len(goals)} goal configurations are"
        why = closeness(checker, goals[0])
        return context.fail(Status.INVALID_GOAL, f"{what} too close to contact to plan to: {why}")
    return start_goal


def retreat(
    checker: CollisionChecker, q: Float[ndarray, "dof"], constraints: "PathConstraints | None" = None
) -> Float[ndarray, "dof"] | None:
    """A configuration nearby that the covering spheres call free, down the gradient of the collision cost.

    For a start or goal that the exact meshes call free while the spheres, which stick out, do not. None if no
    free configuration was found within 1 rad, or it does not keep the constraints. The validator decides on the
    motion there.
    """
    robot, at = checker.robot, q.copy()
    for _ in range(RETREAT_STEPS):
        if checker.free(at[None])[0]:
            return at if constraints is None or constraints.kept(at[None])[0] else None
        gradient = checker.cost_gradients(at[None], margin=0.005)[1][0].astype(np.float64)
        norm = np.linalg.norm(gradient)
        if norm < 1e-9:
            return None
        at = np.clip(at - RETREAT_STEP * gradient / norm, robot.lower, robot.upper)
    return None


def closeness(checker: CollisionChecker, q: Float[ndarray, "dof"]) -> str:
    """Where the covering spheres touch deepest, in words, for a configuration that the meshes call free."""
    clearances = np.concatenate([checker.link_clearances(q[None])[0], checker.pair_clearances(q[None])[0]])
    worst = int(clearances.argmin())
    link, other = [*((link, None) for link in checker.links), *checker.pairs][worst]
    from robotdiffuse.collision.exact_meshes import ExactCollision  # and Coal, which most calls do not need

    exact = ExactCollision(checker.robot, checker.scene)
    check = [frozenset(check) for check in exact.checks].index(frozenset((link, other)))
    [distance], [obstacle] = exact.nearest(q[None], np.array([check]), np.array([np.inf]))
    spheres = str(obstacle) if other is None else f"those of {other}"
    return (
        f"the covering spheres of {link} reach {-1e3 * float(clearances[worst]):.1f} mm into {spheres}, "
        f"though the meshes are {1e3 * float(distance):.1f} mm apart"
    )


def _usable_goals(
    context: PlanningContext, checker: CollisionChecker
) -> Float[ndarray, "k dof"] | PlanResult:
    robot, scene, start = context.problem.robot, context.problem.scene, context.problem.start
    if not checker.free(start[None])[0]:
        collision = _explained(robot, scene, start)
        if collision is not None:
            return context.fail(Status.INVALID_START, f"the start is in collision: {collision}")
    constraints = context.validator.constraints
    wrong = None if constraints is None else constraints.worst(start)
    if wrong is not None:
        return context.fail(Status.INVALID_START, f"the start does not keep the constraints: {wrong.message}")
    heavy = _too_heavy(context, start)
    if heavy is not None:
        return context.fail(Status.INVALID_START, f"the payload cannot be held at the start: {heavy}")
    goals = _goals(context, context.problem.goal, checker)
    if isinstance(goals, PlanResult):
        return goals
    held = [q for q in goals if _too_heavy(context, q) is None]
    if not held:
        reason = f"the payload cannot be held at the goal: {_too_heavy(call, goals[0])}"
        return context.fail(Status.INVALID_GOAL, reason)
    return goals if len(held) == len(goals) else np.stack(held)


def _too_heavy(context: PlanningContext, q: Float[ndarray, "dof"]) -> str | None:
    """Which joint cannot hold the problem's payload there."""
    return None if context.validator.dynamics is None else context.validator.dynamics.overload_message(q)


def _goals(
    context: PlanningContext, goal: Goal, checker: CollisionChecker
) -> Float[ndarray, "k dof"] | PlanResult:
    """Configurations of a goal that are free, of any of several goals; or why there are none."""
    if isinstance(goal, AnyGoal):
        each = [_goals(context, one, checker) for one in goal.goals]
        found = [goals for goals in each if not isinstance(goals, PlanResult)]
        if found:
            return np.concatenate(found)
        none = next(result for result in each if isinstance(result, PlanResult))
        return replace(none, reason=f"none of {len(each)} goals can be reached, the first: {none.reason}")
    if isinstance(goal, JointGoal):
        return _free_goals(context, goal, checker)
    return _pose_goals(context, goal, checker)


def _free_goals(
    context: PlanningContext, goal: JointGoal, checker: CollisionChecker
) -> Float[ndarray, "k dof"] | PlanResult:
    positions, constraints = goal.positions, context.validator.constraints
    if constraints is not None:
        kept = constraints.kept(positions)
        if not kept.any():
            what = "the goal does" if len(kept) == 1 else f"all {len(kept)} goal configurations do"
            wrong = constraints.worst(positions[0])
            assert wrong is not None
            reason = f"{what} not keep the constraints: {wrong.message}"
            return context.fail(Status.INVALID_GOAL, reason)
        positions = positions[kept]
    free = checker.free(positions)
    if free.any():
        return positions[free]
    collisions = [_explained(context.problem.robot, context.problem.scene, q) for q in positions]
    kept = [q for q, collision in zip(positions, collisions, strict=True) if collision is None]
    if kept:
        return np.stack(kept)
    what = "the goal is" if len(collisions) == 1 else f"all {len(collisions)} goal configurations are"
    return context.fail(Status.INVALID_GOAL, f"{what} in collision: {collisions[0]}")


def _pose_goals(
    context: PlanningContext, goal: PoseGoal | PosesGoal, checker: CollisionChecker
) -> Float[ndarray, "k dof"] | PlanResult:
    from robotdiffuse.planning.pose_goals import (
        reaching,  # and inverse kinematics, which most calls do not need
    )

    problem, robot, scene = context.problem, context.problem.robot, context.problem.scene
    constraints, rng = context.validator.constraints, context.rng
    found = reaching(problem, goal, constraints, rng, checker.free)
    if len(found):
        return _by_turns(context, found)
    until, collisions = context.elapsed + LOOKING * context.remaining, list[str | None]()
    for _ in range(ROUNDS):
        reached = reaching(problem, goal, constraints, rng)
        found = [_explained(robot, scene, q) for q in reached]
        kept = [q for q, collision in zip(reached, found, strict=True) if collision is None]
        if kept:
            return _by_turns(context, kept)
        collisions += found
        if not goal.tolerant or context.elapsed > until:
            break
    places = [", ".join(f"{value:.3f}" for value in pose.T_base_frame[:3, 3]) for pose in poses_of(goal)]
    named = {pose.frame: f"({xyz}) m" for pose, xyz in zip(poses_of(goal), places, strict=True)}
    of_poses = "the pose of " + " and of ".join(f"{frame} at {place}" for frame, place in named.items())
    if not collisions and constraints is not None:
        any_of_it = reaching(replace(problem, constraints=()), goal, None, rng)
        wrong = constraints.worst(any_of_it[0]) if len(any_of_it) else None
        if wrong is not None:
            what = f"no configuration was found for {of_poses} that keeps the"
            return context.fail(Status.INVALID_GOAL, f"{what} constraints, e.g. {wrong.message}")
    if not collisions:
        several = poses_of(goal) if len(named) > 1 else ()
        alone = [pose.frame for pose in several if not len(reaching(problem, pose, None, rng))]
        brought = " and ".join(f"{frame} to the pose at {named[frame]}" for frame in alone or named)
        return context.fail(
            Status.UNREACHABLE_GOAL, f"no configuration within the joint limits brings {brought}"
        )
    return context.fail(
        Status.INVALID_GOAL,
        f"all {len(collisions)} configurations found for {of_poses} are in collision, e.g. {collisions[0]}",
    )


def _by_turns(context: PlanningContext, goals: Iterable[ndarray]) -> Float[ndarray, "k dof"]:
    """Goals of a pose, which does not say how often a joint turns."""
    robot, start = context.problem.robot, context.problem.start
    return np.concatenate([robot.equivalent_configurations(q, start) for q in goals])


def _explained(robot: Robot, scene: Scene, q: Float[ndarray, "dof"]) -> str | None:
    """See `explain_collision`, which imports Coal."""
    from robotdiffuse.collision.exact_meshes import explain_collision

    return explain_collision(robot, scene, q)
