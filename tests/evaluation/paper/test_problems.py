"""Problems with pose goals: the same scenes for both kinds of goal, lines to the nearest first."""

from pathlib import Path

import numpy as np

from robotdiffuse.evaluation.paper.problems import (
    JOINT,
    POSE,
    draw_problem,
    free_lines,
    goal_configurations,
    problem_file,
    write_problems,
)
from robotdiffuse.problems.goals import PoseGoal
from robotdiffuse.problems.held_out import CaseFile
from robotdiffuse.validation.tolerances import goal_error


def test_both_goals_are_of_one_problem() -> None:
    drawn = draw_problem(3)
    pose, joint = drawn[POSE], drawn[JOINT]
    assert isinstance(pose.goal, PoseGoal)
    np.testing.assert_array_equal(pose.start, joint.start)
    configuration = goal_configurations(joint)[0]
    assert goal_error(pose.robot, pose.goal, configuration) is None
    several = goal_configurations(pose)
    assert 2 <= len(several) <= 10
    assert all(goal_error(pose.robot, pose.goal, q) is None for q in several)
    lengths = [length for length in free_lines(pose, several) if length is not None]
    assert lengths == sorted(lengths)


def test_problems_are_written_once(tmp_path: Path) -> None:
    said: list[str] = []
    write_problems(tmp_path, 2, said.append)
    before = problem_file(tmp_path, POSE).read_bytes()
    write_problems(tmp_path, 2, said.append)
    assert len(said) == 1 and problem_file(tmp_path, POSE).read_bytes() == before
    cases = CaseFile(problem_file(tmp_path, POSE)).cases()
    assert [case.name for case in cases] == ["rop_pose/0", "rop_pose/1"]
    assert all(case.trivial == (case.reference is not None) for case in cases)
