"""Start and goal configurations for a search, or the reason why there are none."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import Space
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.errors import counted
from robotdiffuse.core.loading import loading
from robotdiffuse.core.types import (
    Configuration,
    Configurations,
    Mask,
    PlanResult,
    Status,
    Values,
    nearest_first,
)
from robotdiffuse.perception.depth_view import SeenPoints
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.problems.problem import (
    AnyGoal,
    Goal,
    JointGoal,
    OneGoal,
    PoseGoal,
    PosesGoal,
    goals_of,
    poses_of,
)
from robotdiffuse.problems.units import arm_in_cloud_note
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.validation.tolerances import DEFAULT

if TYPE_CHECKING:
    from robotdiffuse.problems.compiled_constraints import PathConstraints

GOAL_TIME_FRACTION = 0.5
"""After this fraction of the time limit, no further goals of a list are tried. But the first pass over the
goals goes on until one is free, and the second pass tries at least one."""
NEAR_POSE_FRACTIONS = (0.1, 0.3, 0.9)
"""If no configuration reaches a pose exactly, some within these fractions of the validator's goal tolerances
are sought, in this order."""
NEAR_POSE_ROUNDS = 2
"""Number of rounds of seeds for each of NEAR_POSE_FRACTIONS."""
FIRST_TRY_COUNT = 3
"""Number of configurations to find for each of several poses in the first pass."""
MANY_GOALS = 8
"""If there are at least this many goals, all of them poses of one link without tolerances, and no path
constraints, the first pass uses the same seeds for all."""
# A configuration of a pose may be free although its covering spheres collide. At most MAX_EXACT_GOALS such
# configurations are checked with exact meshes, and at most MAX_GRAZING_GOALS of them become goals.
MAX_EXACT_GOALS = 20
MAX_GRAZING_GOALS = 3
END_MARGIN = 0.0005
"""Near a start or goal that is closer to obstacles than the requested clearance, paths keep the distance of
this start or goal minus this margin [m]."""
CLEARANCE_STEPS = 5
"""Number of steps of `falling_clearances`."""
RETREAT_STEP = 0.01
"""Length of the steps by which `retreat` moves the covering spheres out of contact [rad, joint-space L2]."""
RETREAT_STEPS = 100
"""Largest number of these steps."""
MAX_OVERTURN = np.pi / 2
"""How far a continuous joint may turn beyond the start and the goals in a search [rad]."""


class StartGoal:
    """The start and the goals of a search, each with a lead. A search plans from and to leads: a lead is a
    nearby configuration whose covering spheres are free. The lead of a free configuration is the
    configuration itself.

    Whole turns are removed from continuous joints of the start; `complete` adds them to the path. A search
    does not wrap angles, so each goal is replaced by copies with whole turns of its continuous joints
    (`turned_both_ways`); copies without a lead are dropped.
    """

    def __init__(
        self,
        checker: CollisionChecker,
        start: ndarray,
        goals: ndarray,
        constraints: "PathConstraints | None" = None,
    ) -> None:
        """Find the leads.

        Args:
            checker: Collision checks of the robot and the scene.
            start: The start [dof].
            goals: Goal configurations [n, dof].
            constraints: Path constraints that leads keep; None: no constraints.
        """
        robot = checker.robot
        self.checker = checker
        self._turns = robot.whole_turns(start)
        self.start = start - self._turns
        goal_copies = [
            copy for goal in goals for copy in robot.turned_both_ways(goal, self.start, robot.continuous)
        ]
        states = [self.start, *goal_copies]
        free = checker.free(np.stack(states))  # one batch, since most are free
        self.start_lead, *leads = (
            q.copy() if is_free and constraints is None else retreat(checker, q, constraints)
            for q, is_free in zip(states, free, strict=True)
        )
        self.goals = [goal for goal, lead in zip(goal_copies, leads, strict=True) if lead is not None]
        self.goal_leads = [lead for lead in leads if lead is not None]

    def leads(self) -> tuple[Configuration, Configurations]:
        """Give the leads to compiled code.

        Returns:
            The leads of the start [dof] and of the goals [n, dof], in float32.
        """
        assert self.start_lead is not None
        return self.start_lead.astype(np.float32), np.array(self.goal_leads, np.float32)

    def space(self, resolution: float, clearance: float) -> Space:
        """Make the space in which a search checks motions.

        A start or goal may be closer to obstacles than the clearance. Its own clearance then applies there,
        and the clearance grows with the distance from it (`collision.kernels.motions.padding_near`).

        Args:
            resolution: Largest travel of any point of the arm between two checks [m].
            clearance: Distance to obstacles [m].

        Returns:
            The robot and the scene for `collision.kernels.motions.motions_free`.
        """
        start, goals = self.leads()
        states = np.vstack([start, goals])
        space = padded_space(self.checker, states, resolution, clearance)
        # continuous joints are limited to MAX_OVERTURN beyond the range of start and goals
        continuous = self.checker.robot.continuous
        lower = np.where(continuous, np.maximum(space.lower, states.min(axis=0) - MAX_OVERTURN), space.lower)
        upper = np.where(continuous, np.minimum(space.upper, states.max(axis=0) + MAX_OVERTURN), space.upper)
        return space._replace(lower=lower.astype(np.float32), upper=upper.astype(np.float32))

    def complete(self, path: Configurations, direct: bool = False) -> Configurations:
        """Lead the path of a search to the exact start and goal.

        Where the path ends at a lead that differs from the start or goal, the start or goal is added;
        otherwise it replaces the path's end.

        Args:
            path: A path from the lead of the start to that of a goal [n, dof].
            direct: Whether the start and the goal always replace the ends.

        Returns:
            The path [n, dof], up to two rows longer, in float64.
        """
        assert self.start_lead is not None
        path = path.astype(np.float64)
        i = int(np.argmin([np.abs(path[-1] - lead).max() for lead in self.goal_leads]))
        rows = [self.start, path[1:-1], self.goals[i]]
        if not direct and not np.array_equal(self.goal_leads[i], self.goals[i]):
            rows.insert(2, self.goal_leads[i])
        if not direct and not np.array_equal(self.start_lead, self.start):
            rows.insert(1, self.start_lead)
        return np.vstack(rows) + self._turns if self._turns.any() else np.vstack(rows)


def padded_space(
    checker: CollisionChecker, states: Configurations, resolution: float, clearance: float
) -> Space:
    """The space for motions that keep a clearance [m], except near start and goal states that are closer to
    obstacles."""
    if clearance <= 0:
        return search_space(checker, resolution)
    own_clearances = checker.link_clearances(states).min(axis=1, initial=1.0)
    close = own_clearances < clearance + END_MARGIN
    near = np.column_stack([states[close], np.maximum(own_clearances[close] - END_MARGIN, 0.0)])
    return search_space(checker, resolution, clearance, near)


def falling_clearances(most: float, checker: CollisionChecker, states: Configurations) -> list[float]:
    """Clearances for a search to try, from `most` to zero in CLEARANCE_STEPS equal steps [m].

    In addition, if below `most`: the clearance of the start, states[0], and the clearance of the goal that is
    farthest from obstacles, each minus END_MARGIN.
    """
    clearances = checker.link_clearances(states).min(axis=1, initial=1.0)
    at_ends = {
        max(float(end) - END_MARGIN, 0.0) for end in (clearances[0], clearances[1:].max()) if end < most
    }
    return sorted(
        {most * step / CLEARANCE_STEPS for step in range(CLEARANCE_STEPS + 1)} | at_ends, reverse=True
    )


def usable_start_goal(context: PlanningContext) -> StartGoal | PlanResult:
    """The start and the goals for the search of a call; a failed result if there are none.

    A pose gives at most `pose_goals.GOAL_COUNT` configurations whose covering spheres are free. At most
    MAX_GRAZING_GOALS configurations whose covering spheres collide, but whose exact meshes are free, are
    added if they are nearer to the start than all of those. Then copies of all with whole turns are added.
    Of a JointGoal, configurations whose spheres collide but whose meshes are free are used only if no
    configuration has free spheres. Several goals are tried with little work each. If no goal is free, or the
    payload cannot be held at any that is, they are tried again with more work.
    """
    robot = context.problem.robot
    scene = context.problem.scene
    start = context.problem.start
    checker = CollisionChecker(robot, scene)
    if not checker.free(start[None])[0]:
        collision = _explained(robot, scene, start)
        if collision is not None:
            note = arm_in_cloud_note(robot, scene, start)
            if note:
                context.note(note)
            return context.fail(Status.INVALID_START, f"the start is in collision: {collision}")
    constraints = context.validator.constraints
    wrong = None if constraints is None else constraints.worst_violation(start)
    if wrong is not None:
        return context.fail(Status.INVALID_START, f"the start violates the constraints: {wrong.message}")
    heavy = _too_heavy(context, start)
    if heavy is not None:
        return context.fail(Status.INVALID_START, f"the payload cannot be held at the start: {heavy}")
    goals = _goals(context, context.problem.goal, checker)
    if isinstance(goals, PlanResult):
        return goals
    holdable = _holdable(context, goals)
    if not len(holdable):
        reason = f"the payload cannot be held at the goal: {_too_heavy(context, goals[0])}"
        return context.fail(Status.INVALID_GOAL, reason)
    start_goal = StartGoal(checker, start, holdable, constraints)
    if start_goal.start_lead is None:
        why = closeness(checker, start)
        return context.fail(Status.INVALID_START, f"the start is too close to contact to plan from: {why}")
    if not start_goal.goals:
        why = closeness(checker, holdable[0])
        reason = f"{_all_goals(holdable, 'is', 'are')} too close to contact to plan to: {why}"
        return context.fail(Status.INVALID_GOAL, reason)
    return start_goal


def retreat(
    checker: CollisionChecker, q: Configuration, constraints: "PathConstraints | None" = None
) -> Configuration | None:
    """A configuration near q whose covering spheres are free, found by descending the collision cost.

    Used for a start or goal whose exact meshes are free although the covering spheres collide. None if no
    free configuration is found within 1 rad, or if the configuration violates the constraints. The motion
    between q and the configuration is not checked here, but by the validator.
    """
    robot = checker.robot
    at = q.copy()
    for _ in range(RETREAT_STEPS):
        if checker.free(at[None])[0]:
            return at if constraints is None or constraints.satisfied(at[None])[0] else None
        gradient = checker.cost_gradients(at[None], margin=0.005)[1][0].astype(np.float64)
        norm = np.linalg.norm(gradient)
        if norm < 1e-9:
            return None
        at = np.clip(at - RETREAT_STEP * gradient / norm, robot.lower, robot.upper)
    return None


def closeness(checker: CollisionChecker, q: Configuration) -> str:
    """A message that says where the covering spheres of a configuration with free meshes penetrate
    deepest."""
    clearances = np.concatenate([checker.link_clearances(q[None])[0], checker.pair_clearances(q[None])[0]])
    deepest = int(clearances.argmin())
    link, partner = [*((link, None) for link in checker.links), *checker.pairs][deepest]
    exact = _loaded("collision.exact_meshes").ExactCollision(checker.robot, checker.scene)
    check = [frozenset(check) for check in exact.checks].index(frozenset((link, partner)))
    [distance], [obstacle] = exact.nearest(q[None], np.array([check]), np.array([np.inf]))
    hit = str(obstacle) if partner is None else f"those of {partner}"
    return (
        f"the covering spheres of {link} reach {-1e3 * float(clearances[deepest]):.1f} mm into {hit}, "
        f"though the meshes are {1e3 * float(distance):.1f} mm apart"
    )


def _holdable(context: PlanningContext, goals: Configurations) -> Configurations:
    """The configurations at which the arm can hold the problem's payload; all if it has none."""
    return goals[[_too_heavy(context, q) is None for q in goals]]


def _too_heavy(context: PlanningContext, q: Configuration) -> str | None:
    """A message that names a joint that cannot hold the problem's payload at q; None if every joint can."""
    return None if context.validator.dynamics is None else context.validator.dynamics.overload_message(q)


def _goals(context: PlanningContext, goal: Goal, checker: CollisionChecker) -> Configurations | PlanResult:
    """The free configurations of a goal, or of any of several goals; or the failed result if there are
    none."""
    if isinstance(goal, AnyGoal):
        return _any_goals(context, goal.goals, checker)
    if isinstance(goal, JointGoal):
        return _free_goals(context, goal, checker)
    return _pose_goals(context, goal, checker)


def _any_goals(
    context: PlanningContext, goals: Sequence[OneGoal], checker: CollisionChecker
) -> Configurations | PlanResult:
    """The free configurations of several goals. The first pass does little work for each goal; if no goal is
    free, or the payload cannot be held at any that is, the second pass does more."""
    until = GOAL_TIME_FRACTION * context.request.time_limit
    free = list[ndarray]()
    exact = [goal for goal in goals if isinstance(goal, PoseGoal) and not goal.tolerant]
    many = MANY_GOALS <= len(goals) == len(exact) and len({goal.frame for goal in exact}) == 1
    if many and not context.problem.constraints:
        batches = list[ndarray]()
        for configurations in _loaded("planning.pose_goals").at_poses(
            context.problem, exact, FIRST_TRY_COUNT, context.rng
        ):
            batches.append(configurations)
            if context.elapsed > until and checker.free(np.concatenate(batches)).any():
                break
        candidates = np.concatenate(batches)
        candidates = candidates[checker.free(candidates)]
        free = [_with_turns(context, candidates)] if len(candidates) else []
    else:
        for goal in goals:
            if free and context.elapsed > until:
                break
            result = _first_try(context, goal, checker)
            free += [result] if len(result) else []
    if free:
        holdable = _holdable(context, np.concatenate(free))
        if len(holdable):
            return holdable
        free = []
    failures = list[PlanResult]()
    for goal in goals:
        if (free or failures) and context.elapsed > until:
            break
        result = _goals(context, goal, checker)
        if isinstance(result, PlanResult):
            failures.append(result)
        else:
            free.append(result)
    if free:
        return np.concatenate(free)
    return replace(
        failures[0], reason=f"none of {len(goals)} goals can be reached, the first: {failures[0].reason}"
    )


def _first_try(context: PlanningContext, goal: OneGoal, checker: CollisionChecker) -> Configurations:
    """Free configurations of one of several goals, from one round of seeds; no rows if none was found."""
    if isinstance(goal, JointGoal):
        constraints = context.validator.constraints
        free = checker.free(goal.positions)
        return goal.positions[free if constraints is None else free & constraints.satisfied(goal.positions)]
    configurations = _loaded("planning.pose_goals").pose_configurations(
        context.problem, goal, context.rng, checker.free, count=FIRST_TRY_COUNT, rounds=1
    )
    return _with_turns(context, configurations) if len(configurations) else configurations


def _free_goals(
    context: PlanningContext, goal: JointGoal, checker: CollisionChecker
) -> Configurations | PlanResult:
    positions = goal.positions
    constraints = context.validator.constraints
    if constraints is not None:
        satisfied = constraints.satisfied(positions)
        if not satisfied.any():
            wrong = constraints.worst_violation(positions[0])
            assert wrong is not None
            reason = f"{_all_goals(positions, 'violates', 'violate')} the constraints: {wrong.message}"
            return context.fail(Status.INVALID_GOAL, reason)
        positions = positions[satisfied]
    free = checker.free(positions)
    if free.any():
        return positions[free]
    collisions = [_explained(context.problem.robot, context.problem.scene, q) for q in positions]
    usable = [q for q, collision in zip(positions, collisions, strict=True) if collision is None]
    if usable:
        return np.stack(usable)
    reason = f"{_all_goals(positions, 'is', 'are')} in collision: {collisions[0]}"
    excluded = len(goal.positions) - len(positions)
    if excluded:
        reason += f"; the constraints exclude {counted(excluded, 'other goal configuration')}"
    return context.fail(Status.INVALID_GOAL, reason)


def _all_goals(goals: Configurations, singular: str, plural: str) -> str:
    """The beginning of a sentence about all goal configurations, with its verb."""
    return f"the goal {singular}" if len(goals) == 1 else f"all {len(goals)} goal configurations {plural}"


def _pose_goals(
    context: PlanningContext, goal: PoseGoal | PosesGoal, checker: CollisionChecker
) -> Configurations | PlanResult:
    pose_configurations = _loaded("planning.pose_goals").pose_configurations
    problem = context.problem
    rng = context.rng
    robot = problem.robot
    scene = problem.scene
    start = problem.start
    rejected = np.zeros((0, robot.dof))

    def free(q: Configurations) -> Mask:
        nonlocal rejected
        is_free = checker.free(q)
        rejected = np.concatenate([rejected, q[~is_free]])
        return is_free

    def distances(q: Configurations) -> Values:
        return np.linalg.norm(q - start, axis=1)

    configurations = pose_configurations(problem, goal, rng, free)
    note = ""
    if not len(configurations) and not len(rejected):
        for part in NEAR_POSE_FRACTIONS:
            near = part * DEFAULT.goal_distance, part * DEFAULT.goal_angle
            configurations = pose_configurations(
                problem, goal, rng, free, rounds=NEAR_POSE_ROUNDS, exact=near
            )
            if len(configurations) or len(rejected):
                several = isinstance(problem.goal, AnyGoal)
                index = next((i for i, each in enumerate(goals_of(problem.goal)) if each is goal), 0)
                prefix = f"goal {index}: " if several else ""
                motion = "a motion to it" if several else "the motion"
                note = (
                    f"{prefix}no configuration reaches the goal pose exactly; {motion} ends within "
                    f"{1e3 * near[0]:g} mm and {np.degrees(near[1]):.2g} degrees of it"
                )
                break
    # Exact meshes may be free where the covering spheres collide. Distinct rejected configurations are
    # checked, nearest to the start first, if they are nearer to it than the nearest free one.
    rejected = rejected[np.unique(np.round(rejected, 1), axis=0, return_index=True)[1]]
    rejected = nearest_first(rejected, start)[:MAX_EXACT_GOALS]
    if len(configurations):
        rejected = rejected[distances(rejected) < distances(configurations[:1])]
    if len(rejected):
        meshes = _loaded("collision.exact_meshes").ExactCollision(robot, scene)
        grazing = rejected[~meshes.collides(rejected)][:MAX_GRAZING_GOALS]
        configurations = np.concatenate([grazing, configurations])
    if len(configurations):
        if note:
            context.note(note)
        return _with_turns(context, configurations)
    base = np.eye(4) if problem.T_world_base is None else problem.T_world_base
    place_of = dict[str, str]()
    for pose in poses_of(goal):
        x, y, z = (base @ pose.T_base_frame)[:3, 3]  # in the world, as in files and workspaces
        place_of[pose.frame] = f"({x:.3f}, {y:.3f}, {z:.3f}) m"
    of_poses = "the pose of " + " and of ".join(f"{frame} at {place}" for frame, place in place_of.items())
    if len(rejected):
        collision = _explained(robot, scene, rejected[0])
        return context.fail(
            Status.INVALID_GOAL,
            f"all {len(rejected)} configurations checked for {of_poses} are in collision, e.g. {collision}",
        )
    unconstrained = replace(problem, constraints=())
    if context.validator.constraints is not None:
        reached = pose_configurations(unconstrained, goal, rng)
        wrong = context.validator.constraints.worst_violation(reached[0]) if len(reached) else None
        if wrong is not None:
            prefix = f"no configuration was found for {of_poses} that keeps the"
            return context.fail(Status.INVALID_GOAL, f"{prefix} constraints, e.g. {wrong.message}")
    # of several poses, name those that cannot be reached even alone, or all
    several = poses_of(goal) if len(place_of) > 1 else ()
    unreachable = [pose.frame for pose in several if not len(pose_configurations(unconstrained, pose, rng))]
    frames = unreachable or place_of
    unreached = " and ".join(f"{frame} to the pose at {place_of[frame]}" for frame in frames)
    return context.fail(
        Status.UNREACHABLE_GOAL, f"no configuration within the joint limits brings {unreached}"
    )


def _loaded(name: str) -> ModuleType:
    """A module of the package, imported on first use because it imports compiled code or Coal; this takes no
    planning time."""
    with loading():
        return import_module(f"robotdiffuse.{name}")


def _with_turns(context: PlanningContext, goals: Iterable[ndarray]) -> Configurations:
    """The goals, and copies with whole turns of the joints whose limits allow more than a turn."""
    robot = context.problem.robot
    start = context.problem.start
    return np.concatenate([robot.equivalent_configurations(q, start) for q in goals])


def _explained(robot: Robot, scene: Scene, q: Configuration) -> str | None:
    """A message that says what collides at q, by `explain_collision`; None if the meshes are free."""
    message = _loaded("collision.exact_meshes").explain_collision(robot, scene, q)
    if message and any(isinstance(shape, SeenPoints) and shape.name in message for shape in scene.shapes):
        advice = "state the view's configuration, noise and pose_deviation"
        return f"{message}; these points may be the arm's own: {advice}"
    return message
