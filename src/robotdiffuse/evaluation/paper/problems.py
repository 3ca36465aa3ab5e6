"""The paper's problems as its authors draw them, with the pose of the tip or one configuration as the goal.

Start and goal points are uniform in a box; inverse kinematics of the position alone finds a start
configuration and a first goal configuration, whose pose is the goal. Planners find ten configurations for it,
and success is within 1 cm and 15 degrees.
"""

from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.types import Path
from robotdiffuse.evaluation.problem_sets import validator
from robotdiffuse.planning.pose_goals import GOAL_COUNT, pose_configurations
from robotdiffuse.problems.families.family import POSITION
from robotdiffuse.problems.families.rop import ROP, Rop
from robotdiffuse.problems.goals import JointGoal, PoseGoal
from robotdiffuse.problems.held_out import SEED, Case, CaseFile, Report
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import load_robot

POSE, JOINT = "rop_pose", "rop_joint"
"""Problem sets: the same scenes and starts, with a pose or one configuration as the goal."""
GOALS = {POSE: "a pose with ten configurations", JOINT: "one configuration"}
STREAM = 1_000
"""Of random numbers, beside those of the held-out problems of the families."""


def draw_problem(number: int) -> dict[str, Problem]:
    """The Panda's problem of this number, by problem set."""
    robot, rng = load_robot("panda"), np.random.default_rng([SEED, STREAM, number])
    drawn = ROP.draw(robot, rng, 1, POSITION)
    return {
        POSE: Problem(robot, drawn.scene, drawn.start, PoseGoal(robot.tip, drawn.T_base_tip)),
        JOINT: drawn.problem(robot),
    }


def goal_configurations(problem: Problem) -> Float[ndarray, "k dof"]:
    """The configurations of a problem's goal; for a pose at most ten free ones, those of a call with
    seed 0."""
    if isinstance(problem.goal, JointGoal):
        return problem.goal.positions
    assert isinstance(problem.goal, PoseGoal)
    checker = CollisionChecker(problem.robot, problem.scene)
    return pose_configurations(problem, problem.goal, np.random.default_rng(0), checker.free)


def free_lines(problem: Problem, goals: Float[ndarray, "k dof"]) -> list[float | None]:
    """Lengths of the straight lines from the start to goal configurations [rad], the nearest first; None for
    those that the validator refuses."""
    order = np.argsort(np.linalg.norm(goals - problem.start, axis=1))
    lines = [Path(problem.robot.joint_names, np.stack([problem.start, q])) for q in goals[order]]
    return [line.length if validator(problem, line) else None for line in lines]


def problem_file(out: FilePath, problem_set: str) -> FilePath:
    """The file of a problem set in the folder of a bench, which also names the set for `bench run`."""
    return out / "problems" / f"{problem_set}.jsonl"


def case_name(problem_set: str, number: int) -> str:
    """The name of a problem in its set."""
    return f"{problem_set}/{number}"


def write_problems(out: FilePath, count: int, report: Report) -> None:
    """Draw the first `count` problems of both sets into the folder of a bench, unless it has them."""
    files = {name: CaseFile(problem_file(out, name)) for name in GOALS}
    if min(map(len, files.values())) < count:
        cases: dict[str, list[Case]] = {name: [] for name in GOALS}
        for number in range(count):
            for name, problem in draw_problem(number).items():
                free = [x for x in free_lines(problem, goal_configurations(problem)) if x is not None]
                line = min(free, default=None)
                cases[name].append(Case(case_name(name, number), "rop", problem, bool(free), line, name))
        for name, file in files.items():
            file.fill(cases[name])
        report(f"problems: {count} of {', '.join(GOALS)}")


def straight_line_shares(count: int, family: Rop = ROP) -> dict[str, int]:
    """Of `count` problems with ten goal configurations by the position alone, as the authors draw them, the
    number with a free straight line: to the first, to the nearest, to any. family: the obstacles."""
    robot = load_robot("panda")
    names = ("a single goal", "the nearest of ten goals", "any of ten goals")
    found: dict[str, int] = dict.fromkeys(names, 0)
    for number in range(count):
        rng = np.random.default_rng([SEED, STREAM + 1, number])
        drawn = family.draw(robot, rng, GOAL_COUNT, POSITION)
        problem = drawn.problem(robot)
        lines = free_lines(problem, drawn.goals.astype(np.float64))
        single = free_lines(problem, drawn.goals[:1].astype(np.float64))
        for name, free in zip(
            found, (single[0], lines[0], min((x for x in lines if x), default=None)), strict=True
        ):
            found[name] += free is not None
    return found
