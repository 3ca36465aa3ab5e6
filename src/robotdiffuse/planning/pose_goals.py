"""Goal configurations for poses of one link or of several links, sorted by their distance from the start."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy import ndarray

from robotdiffuse.core.deadline import check_time
from robotdiffuse.core.types import Configuration, Configurations, nearest_first
from robotdiffuse.problems.compiled_constraints import POSE_TOLERANCE, PathConstraints
from robotdiffuse.problems.problem import PoseGoal, PosesGoal, Problem, poses_of
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
"""Number of seed configurations of inverse kinematics in a round."""
ROUND = InverseKinematicsSettings(seeds_per_round=SEEDS, max_rounds=1)
"""Settings of one round of inverse kinematics for a pose without tolerances."""
# Number of rounds: at most MAX_ROUNDS. Once a configuration is found, rounds end after PATIENCE rounds in a
# row without a new one. If REACH_ROUNDS + 1 rounds find no configuration at the pose, the pose is given up.
MAX_ROUNDS = 64
PATIENCE = 2
REACH_ROUNDS = 16
GOAL_TOLERANCE_FRACTION = 0.9
"""Fraction of the tolerances of goal poses and path constraints that goal configurations use."""
MIN_DIFFERENCE = 0.1
"""Two configurations count as different if at least one joint differs by more than this [rad] or [m]."""
# A configuration is brought nearer to the start by steps: it is moved by the fraction PULL of the way to the
# start and projected onto the goal again. There are at most MAX_PULLS steps; they end when the distance to
# the start falls by less than the fraction MIN_PULL_GAIN.
PULL = 0.5
MAX_PULLS = 12
MIN_PULL_GAIN = 0.01
EXACT = POSE_TOLERANCE, POSE_TOLERANCE
"""Tolerances [m], [rad] of poses without tolerances of their own."""

Accept = Callable[[Configurations], ndarray]
"""Which of several configurations are acceptable, such as those free of collision: a boolean for each."""


def pose_configurations(
    problem: Problem,
    goal: PoseGoal | PosesGoal,
    rng: np.random.Generator,
    accept: Accept | None = None,
    count: int = GOAL_COUNT,
    rounds: int = MAX_ROUNDS,
    exact: tuple[float, float] = EXACT,
) -> Configurations:
    """At most `count` configurations that reach the goal within its tolerances and keep the problem's path
    constraints; those nearest to the problem's start first.

    The first seed is the start. A pose without tolerances is reached by inverse kinematics. Tolerances, path
    constraints and several poses are satisfied together, by damped Newton steps. Configurations are then
    moved towards the start, as far as the goal allows. Other arms of the robot stay at the start.

    Args:
        problem: The problem.
        goal: The goal.
        rng: Random generator of the seeds.
        accept: Which configurations are acceptable; None: all.
        count: Largest number of configurations.
        rounds: Largest number of rounds of seeds.
        exact: Tolerances [m], [rad] of poses without tolerances of their own.
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
        count_per_pose = count if k == 0 else SEEDS
        # Projection ends at the boundary of the tolerances; to find configurations inside, every other round
        # uses only a fraction of the tolerances.
        aims = poses
        if k % 2:
            fraction = rng.uniform()
            aims = [_tightened(pose, fraction) for pose in poses]
        new = [at_pose(problem, aim, count_per_pose, rng, exact) for aim in aims]
        solutions = [np.concatenate([earlier, more]) for earlier, more in zip(solutions, new, strict=True)]
        combined = new[0] if len(poses) == 1 else _combined(problem, poses, solutions, rng)
        if len(poses) > 1 or problem.constraints:
            combined = all_constraints.projected(np.vstack([start, combined]), GOAL_TOLERANCE_FRACTION)
        reached = reached or len(combined) > 0
        accepted = _accepted(robot.nearest_turns(combined, start), accept)
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
    return _distinct(nearest_first(candidates, start))[:count]


def at_pose(
    problem: Problem, pose: PoseGoal, count: int, rng: np.random.Generator, exact: tuple[float, float]
) -> Configurations:
    """At most `count` configurations for one pose, from one round of seeds. The first seed is the start; path
    constraints are ignored."""
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
    return pose_constraints.projected(seeds, GOAL_TOLERANCE_FRACTION, count)


def at_poses(
    problem: Problem, poses: Sequence[PoseGoal], count: int, rng: np.random.Generator
) -> Iterator[Configurations]:
    """At most `count` configurations for each of many poses, which are poses of one link without tolerances.
    All poses use the same seeds, of which the first is the start."""
    robot = problem.robot
    start = problem.start
    seeds = random_seeds(robot, robot.lower, robot.upper, SEEDS, rng, start)
    seeds[0] = start
    targets = [pose.T_base_frame for pose in poses]
    for configurations in each_pose(robot, poses[0].frame, targets, count, seeds, start):
        yield robot.nearest_turns(configurations, start)


def _tightened(pose: PoseGoal, fraction: float) -> PoseGoal:
    """The pose with its tolerances multiplied by `fraction`; an unconstrained angle stays unconstrained."""
    xyz = pose.xyz_tolerance
    rpy = pose.rpy_tolerance
    return replace(
        pose,
        xyz_tolerance=None if xyz is None else fraction * xyz,
        rpy_tolerance=None if rpy is None else np.where(rpy < np.pi, fraction * rpy, rpy),
    )


def _combined(
    problem: Problem, poses: Sequence[PoseGoal], solutions: Sequence[ndarray], rng: np.random.Generator
) -> Configurations:
    """Seeds for several poses: random combinations of `solutions`, which holds for each pose configurations
    that reach it, regardless of the other poses. A joint that moves several links takes its value from the
    configuration for one of their poses, chosen at random. No rows if some pose has no configuration."""
    seeds = np.tile(problem.start, (SEEDS if all(len(rows) for rows in solutions) else 0, 1))
    for k in rng.permutation(len(poses)):
        moving = ~on_other_arm(problem.robot, poses[k].frame)
        if len(seeds):
            seeds[:, moving] = solutions[k][rng.integers(len(solutions[k]), size=SEEDS)][:, moving]
    return seeds


def _pulled(constraints: PathConstraints, q: Configurations, start: Configuration) -> Configurations:
    """The configurations moved towards the start, as far as the goal and the constraints allow."""
    robot = constraints.robot
    nearest = q
    for _ in range(MAX_PULLS):
        moved, reached = constraints.project(nearest + PULL * (start - nearest), GOAL_TOLERANCE_FRACTION)
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
    """The configurations without those that differ from an earlier one by at most MIN_DIFFERENCE."""
    unique = q[:0]
    for row in q:
        if (np.abs(unique - row).max(axis=1, initial=0.0) > MIN_DIFFERENCE).all():
            unique = np.vstack([unique, row])
    return unique
