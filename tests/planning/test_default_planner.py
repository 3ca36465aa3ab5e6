"""The default planner: AORRTC for every robot, verified, without weights."""

from dataclasses import replace

import numpy as np
import pytest

from robotdiffuse import JointGoal, Problem, Scene, Sphere, Status, load_robot, verify
from robotdiffuse.planning import DEFAULT_PLANNER, load_planner
from robotdiffuse.problems.families.rop import ROP
from robotdiffuse.validation.validator import verify_trajectory

PANDA = load_robot("panda")
LEFT = np.array([0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
RIGHT = np.array([-0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
PROBLEM = Problem(PANDA, Scene([Sphere([0.5, 0.0, 0.4], 0.15, name="ball")]), LEFT, JointGoal(RIGHT[None]))
PLANNER = load_planner(DEFAULT_PLANNER)


@pytest.mark.parametrize("index", range(8))
def test_solved_means_verified(index: int) -> None:
    problem = ROP.draw(PANDA, np.random.default_rng([12, index])).problem(PANDA)
    result = PLANNER.plan(problem, time_limit=60.0, seed=index)
    if result.solved:
        assert result.path is not None and verify(problem, result.path).valid
    else:
        assert result.status is Status.TIMEOUT and result.reason


def test_motions_are_those_of_aorrtc() -> None:
    first, second = (
        load_planner(name).plan(PROBLEM, time_limit=60.0, seed=3) for name in (DEFAULT_PLANNER, "aorrtc")
    )
    assert first.path is not None and second.path is not None and first.trajectory is not None
    assert np.array_equal(first.path.positions, second.path.positions)
    assert (first.planner, second.planner) == (DEFAULT_PLANNER, "aorrtc") and first.stage == "aorrtc"
    assert verify_trajectory(PROBLEM, first.trajectory).valid


def test_a_free_straight_line_is_the_answer() -> None:
    result = PLANNER.plan(Problem(PANDA, Scene(), LEFT, JointGoal(RIGHT[None])), time_limit=60.0)
    assert result.stage == "straight_line" and result.path_length == pytest.approx(1.8)


def test_a_robot_without_weights_needs_none() -> None:
    stranger = replace(PROBLEM, robot=replace(PANDA, name="stranger"))
    result = PLANNER.plan(stranger, time_limit=60.0)
    assert result.solved and not result.notes
