"""Problem.is_free: whether a configuration is free, and why not."""

import numpy as np
import pytest

import robotdiffuse as rd
from robotdiffuse.robots.kinematics import link_pose

PANDA = rd.load_robot("panda")
Q = np.array([0.0, 0.3, 0, -1.8, 0, 2.1, 0.8])
HAND = link_pose(PANDA, Q, "panda_hand")[:3, 3]
PROBLEM = rd.Problem(PANDA, rd.Scene([rd.Sphere(HAND, 0.05, "ball")]), "ready", "extended")


def test_a_free_configuration_is_true_without_a_reason() -> None:
    for q in ("ready", PANDA.poses["ready"].values(), Q * [-1, 1, 1, 1, 1, 1, 1] + [1, 0, 0, 0, 0, 0, 0]):
        state = PROBLEM.is_free(q if isinstance(q, str) else list(q))
        assert state and state.reason == "" and state.links == ()


def test_the_reason_names_link_and_obstacle() -> None:
    state = PROBLEM.is_free(Q)
    assert not state and state.reason.startswith("panda_hand is ") and state.reason.endswith("inside ball")
    assert state.links[0] == "panda_hand"


def test_links_that_touch_each_other_are_named() -> None:
    state = rd.Problem(PANDA, rd.Scene(), Q, Q).is_free([0, 0, 0, -3.0, 0, 0, 0])
    assert not state and "overlap" in state.reason and len(state.links) >= 2


def test_out_of_limits_is_a_reason_and_a_wrong_shape_an_error() -> None:
    assert PROBLEM.is_free([9.0, *Q[1:]]).reason.startswith("panda_joint1 is 9 rad; its limits are")
    with pytest.raises(rd.InputError, match="q has 2 values"):
        PROBLEM.is_free([1, 2])
    with pytest.raises(rd.InputError, match="unknown pose in q: 'home'; known: extended, ready"):
        PROBLEM.is_free("home")


def test_it_agrees_with_the_validator() -> None:
    rng = np.random.default_rng(0)
    scene = rd.Scene([rd.Box([0.5, 0, 0.4], [0.3, 0.6, 0.05]), rd.Sphere([-0.3, 0.3, 0.6], 0.2)])
    states = []
    for q in rng.uniform(PANDA.lower, PANDA.upper, (60, 7)):
        problem = rd.Problem(PANDA, scene, q, q)
        report = rd.verify(problem, rd.Path(PANDA.joint_names, q[None]))
        states.append(bool(problem.is_free(q)))
        assert states[-1] == report.valid, report.violation
    assert 5 < sum(states) < 55


def test_named_poses_are_goals_among_others() -> None:
    T = link_pose(PANDA, Q, "panda_hand")
    both = rd.Problem(PANDA, rd.Scene(), "ready", ["extended", Q]).goal
    assert isinstance(both, rd.JointGoal) and len(both.positions) == 2
    mixed = rd.Problem(PANDA, rd.Scene(), "ready", ["extended", rd.PoseGoal("panda_hand", T), Q]).goal
    assert isinstance(mixed, rd.AnyGoal)
    assert [type(one) for one in mixed.goals] == [rd.JointGoal, rd.PoseGoal, rd.JointGoal]
    with pytest.raises(rd.InputError, match=r"unknown pose in goal\[1\]: 'home'"):
        rd.Problem(PANDA, rd.Scene(), "ready", [Q, "home"])
