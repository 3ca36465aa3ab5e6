"""Configurations of goals that are poses: of one link, or of several at once."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.problems.compiled_constraints import PathConstraints
from robotdiffuse.problems.constraints import PositionBox
from robotdiffuse.problems.goals import PoseGoal, PosesGoal
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.inverse_kinematics import InverseKinematicsSettings, beside, inverse_kinematics
from robotdiffuse.validation.tolerances import DEFAULT, goal_error

GOAL_COUNT = 10
"""Configurations that are looked for when the goal is a pose (the paper's k)."""
POSES, OF_EACH = 20, 2
"""Poses within the tolerances of a goal that are tried, and configurations that are looked for in each."""
SOME_ROUNDS = InverseKinematicsSettings(max_rounds=2, patience=1)
"""Of these: many may be out of reach."""
FEW_ROUNDS = InverseKinematicsSettings(max_rounds=8, patience=2)
"""Of these under path constraints: none may keep them; and of one of several poses."""
SHARE_AT_GOAL, LEAST_BOX = 0.9, 2e-4
"""Share of the tolerances that projected goals keep; half edges of the box that they are kept in [m]."""
SEEDS, ROUNDS, PATIENCE = 64, 8, 2
"""Of several poses: combinations of configurations of each that are tried at a time, how often, and how often
in vain."""
DISTINCT = 0.1
"""Their configurations differ by more than this in at least one joint [rad] or [m]."""

Accept = Callable[[Float[ndarray, "n dof"]], ndarray]


def reaching(
    problem: Problem,
    goal: PoseGoal | PosesGoal,
    constraints: PathConstraints | None,
    rng: np.random.Generator,
    accept: Accept | None = None,
) -> Float[ndarray, "k dof"]:
    """Configurations that bring links to their poses, at most GOAL_COUNT; where these have tolerances, to
    some poses within them. Other arms stay where they start. They keep the constraints, the problem's or
    none; `accept` as for `inverse_kinematics`."""
    if isinstance(goal, PosesGoal):
        return _reaching_together(problem, goal, rng, accept)
    if constraints is not None:
        return _reaching_constrained(problem, goal, constraints, rng, accept)
    robot, rest = problem.robot, problem.start
    if not goal.tolerant:
        return inverse_kinematics(
            robot, goal.frame, goal.T_base_frame, GOAL_COUNT, rng=rng, accept=accept, rest=rest
        )
    found = np.zeros((0, robot.dof))
    for i in range(POSES):
        T_base_frame = goal.draw(rng) if i else goal.T_base_frame
        few = inverse_kinematics(
            robot, goal.frame, T_base_frame, OF_EACH, rng=rng, accept=accept, settings=SOME_ROUNDS, rest=rest
        )
        found = np.concatenate([found, few])
        if len(found) >= GOAL_COUNT:
            break
    return found[:GOAL_COUNT]


def _reaching_constrained(
    problem: Problem,
    goal: PoseGoal,
    constraints: PathConstraints,
    rng: np.random.Generator,
    accept: Accept | None,
) -> Float[ndarray, "k dof"]:
    """The same of configurations that keep the constraints: those of a pose with tolerances are projected
    onto them, and kept where they are still within."""
    found = np.zeros((0, problem.robot.dof))

    def keeps(q: ndarray) -> ndarray:
        kept = constraints.satisfied(q)
        return kept if accept is None else kept & accept(q)

    def reached(T_base_frame: ndarray, count: int, accept: Accept | None) -> ndarray:
        robot, settings = problem.robot, FEW_ROUNDS
        return inverse_kinematics(
            robot,
            goal.frame,
            T_base_frame,
            count,
            rng=rng,
            accept=accept,
            settings=settings,
            rest=problem.start,
        )

    if not goal.tolerant:
        return reached(goal.T_base_frame, GOAL_COUNT, keeps)
    xyz = np.full(3, 0.5 * DEFAULT.goal_distance) if goal.xyz_tolerance is None else goal.xyz_tolerance
    half = np.maximum(xyz, LEAST_BOX)
    box = PositionBox(goal.frame, -half, half, goal.T_base_frame)
    within = PathConstraints(replace(problem, constraints=(*problem.constraints, box)))
    for i in range(POSES):
        few = reached(goal.draw(rng) if i else goal.T_base_frame, OF_EACH, None)
        few = np.concatenate([few[constraints.satisfied(few)], within.projected(few, SHARE_AT_GOAL)])
        at_goal = [goal_error(problem.robot, goal, q) is None for q in few]
        few = few[np.array(at_goal, bool)]
        found = np.concatenate([found, few if accept is None or not len(few) else few[accept(few)]])
        if len(found) >= GOAL_COUNT:
            break
    return found[:GOAL_COUNT]


def _reaching_together(
    problem: Problem, goal: PosesGoal, rng: np.random.Generator, accept: Accept | None
) -> Float[ndarray, "k dof"]:
    """The same of several poses, and of the problem's constraints with them."""
    found = np.zeros((0, problem.robot.dof))
    for i in range(POSES if goal.tolerant else 1):
        poses = [replace(pose, T_base_frame=pose.draw(rng)) if i else pose for pose in goal.poses]
        count = min(OF_EACH, GOAL_COUNT - len(found)) if goal.tolerant else GOAL_COUNT
        found = np.concatenate([found, _at_poses(problem, poses, count, rng, accept)])
        if len(found) >= GOAL_COUNT:
            break
    return found


def _at_poses(
    problem: Problem,
    poses: Sequence[PoseGoal],
    count: int,
    rng: np.random.Generator,
    accept: Accept | None,
) -> Float[ndarray, "k dof"]:
    """Configurations with all links at their very poses, by combining those of each alone.

    Arms that share no joint are solved so. Where they do, a combination has the shared joints as one of them
    needs, and Newton steps for all poses and constraints together lead from there.
    """
    robot, start = problem.robot, problem.start
    each = [
        inverse_kinematics(
            robot, pose.frame, pose.T_base_frame, GOAL_COUNT, rng=rng, settings=FEW_ROUNDS, rest=start
        )
        for pose in poses
    ]
    found = np.zeros((0, robot.dof))
    if not all(len(alone) for alone in each):
        return found
    together = PathConstraints(problem, poses)
    own = [~beside(robot, pose.frame) for pose in poses]
    idle = 0
    for _ in range(ROUNDS):
        seeds, before = np.tile(start, (SEEDS, 1)), len(found)
        for k in rng.permutation(len(poses)):
            seeds[:, own[k]] = each[k][rng.integers(len(each[k]), size=SEEDS)][:, own[k]]
        solved = together.projected(seeds, SHARE_AT_GOAL)
        if accept is not None and len(solved):
            solved = solved[accept(solved)]
        for q in solved:
            if len(found) < count and (np.abs(found - q).max(axis=1, initial=0.0) > DISTINCT).all():
                found = np.concatenate([found, q[None]])
        idle = 0 if len(found) > before else idle + 1
        if len(found) >= count or (len(found) and idle >= PATIENCE):
            break
    return found
