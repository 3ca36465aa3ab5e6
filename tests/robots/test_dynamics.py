"""Torques compared with Pinocchio's own reading of the URDF and with a pendulum by hand; payloads of problems."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.example_robots import urdf_file
from helpers.heavy_arms import pendulum
from helpers.refusals import refuses
from robotdiffuse.core.transforms import rotation_about, transform
from robotdiffuse.problems.files import load_problem, problem_from_record, problem_record, save_problem
from robotdiffuse.robots.dynamics import GRAVITY, Dynamics
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.robots.robot_folder import read_robot_folder, write_robot_folder
from robotdiffuse.validation.validator import verify

pinocchio: Any = pytest.importorskip("pinocchio", reason="the extra `dynamics` (pin) is not installed")
PANDA = rd.load_robot("panda")
LOW = [-0.6, 0.2, 0, -1.2, 0, 2.2, 0.2]
FAR = [0.6, 0.6, 0, -1.0, 0, 2.2, 0.2]


def test_a_pendulum_by_hand() -> None:
    dynamics = Dynamics(pendulum(), rd.Payload(1.5, [0.0, 0.0, -1.0]))
    q, v, a = (np.array([[value]]) for value in (0.7, 1.3, 2.0))
    expected = (2 * 0.5 + 1.5) * GRAVITY * np.sin(0.7) + (2 / 12 + 2 * 0.25 + 1.5) * 2.0
    assert dynamics.torques(q, v, a)[0, 0] == pytest.approx(expected, abs=1e-9)
    lying = transform(np.zeros(3), rotation_about(np.array([0.0, 1.0, 0.0]), np.pi / 2))  # gravity along the base's x
    turned = Dynamics(pendulum(), rd.Payload(1.5, [0.0, 0.0, -1.0]), lying)
    assert abs(turned.holding_torques(np.zeros((1, 1)))[0, 0]) == pytest.approx(2.5 * GRAVITY, abs=1e-9)


@pytest.mark.parametrize("name", ["panda", "ur5", "xarm7"])
def test_torques_are_those_of_the_urdf(name: str, tmp_path: Path) -> None:
    robot = rd.load_robot(name)
    model = pinocchio.buildModelFromUrdf(str(urdf_file(name, tmp_path)))
    held = [model.getJointId(joint) for joint in model.names[1:] if joint not in robot.joint_names]
    model = pinocchio.buildReducedModel(model, held, pinocchio.neutral(model))
    robot = robot.with_locked({joint: 0.0 for joint in robot.locked})
    data = model.createData()
    ours = Dynamics(robot, rd.Payload(0.0))
    rng = np.random.default_rng(0)
    assert tuple(model.names[1:]) == robot.joint_names and np.allclose(ours.limits, model.effortLimit)
    for _ in range(50):
        q, v, a = rng.uniform(robot.lower, robot.upper), *rng.normal(size=(2, robot.dof))
        assert np.allclose(ours.torques(q[None], v[None], a[None])[0], pinocchio.rnea(model, data, q, v, a), atol=1e-6)


def test_bundles_keep_inertias_and_effort_limits(tmp_path: Path) -> None:
    robot = pendulum()
    write_robot_folder(robot, tmp_path, {})
    again = read_robot_folder(tmp_path)
    assert again.inertias["rod"].values == robot.inertias["rod"].values and again.effort == robot.effort


def test_motions_with_a_payload_are_slower_and_keep_the_limits() -> None:
    durations = []
    for mass in (0.0, 3.0):
        problem = rd.Problem(PANDA, rd.Scene(), LOW, FAR, payload=rd.Payload(mass, [0.0, 0.0, 0.1]))
        for jerk in (None, 300.0):
            motion = rd.plan(problem, time_limit=10.0, jerk=jerk).trajectory
            assert motion is not None and verify(problem, motion).valid
            dynamics = Dynamics(PANDA, rd.Payload(mass, [0.0, 0.0, 0.1]))
            torques = dynamics.torques(motion.positions, motion.velocities, motion.accelerations)
            assert (np.abs(torques) <= 1.01 * dynamics.limits).all()
            if jerk is None:
                durations.append(motion.duration)
    assert durations[0] < durations[1]


def test_the_validator_names_joint_torque_and_limit() -> None:
    free = rd.Problem(PANDA, rd.Scene(), LOW, FAR)
    result = rd.plan(free, time_limit=10.0)
    found = verify(replace(free, payload=rd.Payload(3.0, [0.0, 0.0, 0.1])), result.trajectory).violation
    assert found is not None and found.kind == "torque" and found.subject == "panda_joint2"
    assert found.message.endswith("N m, its effort limit is 87 N m, with the payload")
    # the limit is too low in the middle, where the rod is level
    weak = rd.Problem(pendulum(9.0), rd.Scene(), [0.3], [2.9], payload=rd.Payload(0.0))
    across = verify(weak, rd.Path(("hinge",), np.array([[0.3], [2.9]]))).violation
    assert across is not None and across.kind == "torque"
    assert across.message == "hinge needs 9.12 N m, its effort limit is 9 N m to hold the payload"


def test_what_cannot_be_held_is_told() -> None:
    for start, goal, status, where in (
        (LOW, FAR, rd.Status.INVALID_START, "start"),
        ([0.0, -1.5, 0.0, -2.9, 0.0, 1.6, 0.0], FAR, rd.Status.INVALID_GOAL, "goal"),
    ):
        result = rd.plan(rd.Problem(PANDA, rd.Scene(), start, goal, payload=rd.Payload(6.0, [0.0, 0.0, 0.1])), time_limit=5.0)
        assert result.status is status
        assert result.reason.startswith(f"the payload cannot be held at the {where}: panda_joint6 needs 1")


GOOD: dict[str, Any] = {"robot": "panda", "scene": [], "start": LOW, "goal": {"joints": FAR}}


def test_wrong_payloads_and_robots_without_inertias_are_one_line() -> None:
    for data, message in (
        ({"mass": -1}, "payload.mass is -1; it must be a number of kg from 0 to 10000"),
        ({"com": [0, 0, 0]}, "missing field of payload: mass|payload.*mass"),
        ({"mass": 1, "link": "hand"}, "unknown link in payload.link: 'hand'"),
        ({"mass": 1, "moments": [0.1, 0.1, 0.3]}, "payload.moments is .*; none may be larger than the other two together"),
        ({"mass": 1, "weight": 2}, "unknown field of payload: 'weight'"),
    ):
        refuses(message, problem_from_record, GOOD | {"payload": data})
    arm = rd.load_robot("iiwa14")
    middle = (arm.lower + arm.upper) / 2
    told = "joint joint_a1 of iiwa14 has no link with an inertia"
    refuses(told, rd.Problem, arm, rd.Scene(), middle, middle, payload=rd.Payload(1.0))


def test_frames_of_a_mobile_base_need_no_inertia() -> None:
    """The joints of a base with wheels are a chain of links without geometry; a link with geometry needs an inertia."""
    arm = pendulum()
    slide = Joint("x", "prismatic", "map", "base", np.eye(4), np.array([1.0, 0, 0]), -1.0, 1.0, 1.0, 4.0, 40.0, effort=99.0)
    cart = replace(arm, base="map", joints=(slide, *arm.joints))
    load, q = rd.Payload(1.5, [0.0, 0.0, -1.0]), np.array([[0.3, 0.7]])
    torques = Dynamics(cart, load).holding_torques(q)
    np.testing.assert_allclose(torques, [[0, Dynamics(arm, load).holding_torques(q[:, 1:])[0, 0]]], atol=1e-9)
    refuses("joint x .* no link with an inertia", Dynamics, replace(cart, meshes={"base": PANDA.meshes["panda_hand"]}), load)


def test_files_keep_payloads(tmp_path: Path) -> None:
    data = {"mass": 1.5, "com": [0.0, 0.0, 0.1], "link": "panda_hand", "moments": [0.01, 0.01, 0.02]}
    problem = problem_from_record(GOOD | {"payload": data})
    assert problem_record(problem)["payload"] == data
    save_problem(problem, tmp_path / "p.yaml")
    assert problem_record(load_problem(tmp_path / "p.yaml"))["payload"] == data
