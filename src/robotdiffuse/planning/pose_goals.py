"""Goal configurations for poses of one link, or of several links at once: those nearest to the start."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy import ndarray

from robotdiffuse.core.deadline import check_time
from robotdiffuse.core.types import Configuration, Configurations
from robotdiffuse.problems.compiled_constraints import POSE_TOLERANCE, PathConstraints
from robotdiffuse.problems.goals import PoseGoal, PosesGoal, poses_of
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.inverse_kinematics import (
    InverseKinematicsSettings,
    each_pose,
    inverse_kinematics,
    on_other_arm,
    random_seeds,
)

GOAL_COUNT = 10
"""Number of configurations to find for a pose (the paper's k)."""
SEEDS = 64
"""Number of seeds of a round."""
ROUND = InverseKinematicsSettings(seeds_per_round=SEEDS, max_rounds=1)
"""Settings of one round of inverse kinematics for a pose without tolerances."""
# Largest number of rounds; largest number of rounds in a row without a new configuration, once there is one;
# and number of rounds after which a pose is given up if no configuration reached it.
MAX_ROUNDS = 64
PATIENCE = 2
REACH_ROUNDS = 16
TOLERANCE_FRACTION = 0.9
"""Fraction of the tolerances of path constraints that goals keep."""
MIN_DIFFERENCE = 0.1
"""Two configurations count as different if at least one joint differs by more than this [rad] or [m]."""
# To bring a configuration nearer to the start, it is moved by a fraction PULL of the way there and projected
# onto the goal again, at most MAX_PULLS times, as long as its distance falls by the fraction MIN_PULL_GAIN.
PULL = 0.5
MAX_PULLS = 12
MIN_PULL_GAIN = 0.01
EXACT = POSE_TOLERANCE, POSE_TOLERANCE
"""Tolerances of poses that give none [m], [rad]."""

Accept = Callable[[Configurations], ndarray]


def pose_configurations(
    problem: Problem,
    goal: PoseGoal | PosesGoal,
    rng: np.random.Generator,
    accept: Accept | None = None,
    count: int = GOAL_COUNT,
    rounds: int = MAX_ROUNDS,
    exact: tuple[float, float] = EXACT,
) -> Configurations:
    """At most `count` configurations that bring links to their poses, or to poses within their tolerances,
    and keep the problem's path constraints; those nearest to the problem's start first.

    The first seed is the start. Poses without tolerances are reached by inverse kinematics; tolerances, path
    constraints and several poses by damped Newton steps for all of them together. Configurations are then
    drawn towards the start, as far as the goal allows. Other arms of the robot stay at the start.

    accept: which configurations are acceptable, such as those free of collision. rounds: largest number of
    rounds of seeds. exact: tolerances of poses that give none [m], [rad].
    """
    robot = problem.robot
    start = problem.start
    poses = poses_of(goal)
    all_constraints = PathConstraints(problem, poses, exact)
    solutions = [np.zeros((0, robot.dof))] * len(poses)
    configurations = np.zeros((0, robot.dof))
    reached = False
    stale_rounds = 0
    for k in range(rounds):
        check_time("configurations of the goal pose")
        seed_count = count if k == 0 else SEEDS
        # projection ends at the edges of the tolerances, so every other round uses only a part of the
        # tolerances
        aims = poses
        if k % 2:
            part = rng.uniform()
            aims = [_within(pose, part) for pose in poses]
        new = [at_pose(problem, aim, seed_count, rng, exact) for aim in aims]
        solutions = [np.concatenate([before, more]) for before, more in zip(solutions, new, strict=True)]
        seeds = new[0] if len(poses) == 1 else _combined(problem, poses, solutions, rng)
        if len(poses) > 1 or problem.constraints:
            seeds = all_constraints.projected(np.concatenate([start[None], seeds]), TOLERANCE_FRACTION)
        reached = reached or len(seeds) > 0
        accepted = _accepted(robot.nearest_turns(seeds, start), accept)
        before = len(configurations)
        configurations = _distinct(np.concatenate([configurations, accepted]))[:count]
        stale_rounds = 0 if len(configurations) > before else stale_rounds + 1
        if (
            len(configurations) >= count
            or (len(configurations) and stale_rounds >= PATIENCE)
            or (k >= REACH_ROUNDS and not reached)
        ):
            break
    nearer = _accepted(_pulled(all_constraints, configurations, start), accept)
    candidates = np.concatenate([nearer, configurations])
    nearest_first = np.argsort(np.linalg.norm(candidates - start, axis=1), kind="stable")
    return _distinct(candidates[nearest_first])[:count]


def at_pose(
    problem: Problem, pose: PoseGoal, count: int, rng: np.random.Generator, exact: tuple[float, float]
) -> Configurations:
    """At most `count` configurations for one pose from a round of seeds, of which the first is the start;
    without path constraints."""
    robot = problem.robot
    start = problem.start
    if not pose.tolerant and exact == EXACT:
        return inverse_kinematics(
            robot, pose.frame, pose.T_base_frame, count, rng=rng, settings=ROUND, near=start, rest=start
        )
    seeds = random_seeds(robot, robot.lower, robot.upper, SEEDS, rng, start)
    seeds = np.where(on_other_arm(robot, pose.frame), start, seeds)
    seeds[0] = start
    pose_constraints = PathConstraints(replace(problem, constraints=()), [pose], exact)
    return pose_constraints.projected(seeds, TOLERANCE_FRACTION, count)


def at_poses(
    problem: Problem, poses: Sequence[PoseGoal], count: int, rng: np.random.Generator
) -> Iterator[Configurations]:
    """At most `count` configurations for each of many poses of a link without tolerances, from the same
    seeds, of which the first is the start."""
    robot = problem.robot
    start = problem.start
    seeds = random_seeds(robot, robot.lower, robot.upper, SEEDS, rng, start)
    seeds[0] = start
    targets = [pose.T_base_frame for pose in poses]
    for configurations in each_pose(robot, poses[0].frame, targets, count, seeds, start):
        yield robot.nearest_turns(configurations, start)


def _within(pose: PoseGoal, part: float) -> PoseGoal:
    """The pose with its tolerances multiplied by `part`; angles that are free stay free."""
    xyz = pose.xyz_tolerance
    rpy = pose.rpy_tolerance
    return replace(
        pose,
        xyz_tolerance=None if xyz is None else part * xyz,
        rpy_tolerance=None if rpy is None else np.where(rpy < np.pi, part * rpy, rpy),
    )


def _combined(
    problem: Problem, poses: Sequence[PoseGoal], solutions: Sequence[ndarray], rng: np.random.Generator
) -> Configurations:
    """Random combinations of configurations for each pose alone; joints that several poses move take the
    values of one of them."""
    seeds = np.tile(problem.start, (SEEDS if all(len(alone) for alone in solutions) else 0, 1))
    for k in rng.permutation(len(poses)):
        moving = ~on_other_arm(problem.robot, poses[k].frame)
        if len(seeds):
            seeds[:, moving] = solutions[k][rng.integers(len(solutions[k]), size=SEEDS)][:, moving]
    return seeds


def _pulled(constraints: PathConstraints, q: Configurations, start: Configuration) -> Configurations:
    """The configurations drawn towards the start, as far as the goal allows."""
    robot = constraints.robot
    nearest = q
    for _ in range(MAX_PULLS):
        moved, reached = constraints.project(nearest + PULL * (start - nearest), TOLERANCE_FRACTION)
        moved = robot.nearest_turns(moved, start)
        before = np.linalg.norm(nearest - start, axis=1)
        nearer = reached & (np.linalg.norm(moved - start, axis=1) < (1 - MIN_PULL_GAIN) * before)
        if not nearer.any():
            break
        nearest = np.where(nearer[:, None], moved, nearest)
    return nearest


def _accepted(q: Configurations, accept: Accept | None) -> Configurations:
    return q if accept is None or not len(q) else q[accept(q)]


def _distinct(q: Configurations) -> Configurations:
    """The configurations without those that are close to an earlier one."""
    unique = q[:0]
    for row in q:
        if (np.abs(unique - row).max(axis=1, initial=0.0) > MIN_DIFFERENCE).all():
            unique = np.concatenate([unique, row[None]])
    return unique
