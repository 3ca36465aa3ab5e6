"""Inverse kinematics: solutions reach the pose, lie within limits and differ; unreachable poses give none."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

import robotdiffuse as rd
from helpers.example_robots import TIPS, example_robot, planar_arm
from helpers.refusals import refuses
from robotdiffuse.core.transforms import rotation_angle, transform
from robotdiffuse.learning.training.losses import ForwardKinematics
from robotdiffuse.robots.inverse_kinematics import InverseKinematicsSettings, inverse_kinematics


def errors(robot: rd.Robot, frame: str, T: np.ndarray, q: np.ndarray) -> tuple[float, float]:
    """Largest position error [m] and orientation error [rad] of solutions, by the PyTorch kinematics."""
    T_base_frame = ForwardKinematics(robot, torch.float64)(torch.tensor(q)).numpy()
    poses = T_base_frame[:, robot.link_frame(frame)] @ robot.T_frame_link(frame)
    turns = [rotation_angle(pose[:3, :3] @ T[:3, :3].T) for pose in poses]
    return float(np.linalg.norm(poses[:, :3, 3] - T[:3, 3], axis=1).max()), max(turns)


@pytest.mark.parametrize("name", TIPS)
def test_solutions_are_exact_distinct_and_within_limits(name: str) -> None:
    robot = example_robot(name)
    rng = np.random.default_rng(3)
    for _ in range(25):
        T = robot.fk(rng.uniform(robot.lower, robot.upper))
        q = inverse_kinematics(robot, robot.tip, T, 10, rng=rng)
        assert 1 <= len(q) <= 10
        assert len(robot.chain(robot.tip)) < 7 or len(q) == 10
        position, rotation = errors(robot, robot.tip, T, q)
        assert position <= 2e-6 and rotation <= 3e-6  # 1e-6, and the margin of wrapped continuous joints
        assert (q > robot.lower).all() and (q < robot.upper).all()
        assert all(np.abs(one - other).max() > 0.1 for one, other in combinations(q, 2))


def test_a_joint_that_hardly_moves_stays_within_its_limits() -> None:
    """Regression: a range below twice the margin of the limits was turned around, and values were outside of it."""
    arm = example_robot("ur5")
    joints = tuple(replace(j, lower=0.5, upper=0.5 + 1e-6) if j.name == arm.joint_names[0] else j for j in arm.joints)
    robot = replace(arm, joints=joints)
    middle = (robot.lower + robot.upper) / 2 + 0.3 * (np.arange(robot.dof) > 0)
    q = robot.ik(robot.fk(middle), near=middle)
    assert len(q) and (q >= robot.lower).all() and (q <= robot.upper).all()


def test_ur5_has_at_most_eight_solutions() -> None:
    """A 6R arm with a nearly spherical wrist and joints of one turn has eight solutions."""
    robot = example_robot("ur5")
    rng = np.random.default_rng(5)
    counts = []
    for _ in range(20):
        T = robot.fk(rng.uniform(robot.lower, robot.upper), "tool0")
        counts.append(len(inverse_kinematics(robot, "tool0", T, 50, rng=rng)))
    assert max(counts) == 8


def test_planar_elbow_up_and_down() -> None:
    arm = planar_arm(1.0, 1.0)
    robot = replace(arm, joints=tuple(replace(joint, lower=-3.0, upper=3.0) for joint in arm.joints))
    settings = InverseKinematicsSettings(position_only=True)
    T = transform(np.array([1.0, 1.0, 0.0]))
    q = inverse_kinematics(robot, "tip", T, 10, rng=np.random.default_rng(0), settings=settings)
    np.testing.assert_allclose(q[np.argsort(q[:, 0])], [[0, np.pi / 2], [np.pi / 2, -np.pi / 2]], atol=1e-5)


@pytest.mark.parametrize("limit", ["lower", "upper"])
def test_poses_that_need_a_joint_at_its_limit(limit: str) -> None:
    robot = example_robot("panda")
    rng = np.random.default_rng(6)
    for joint in range(robot.dof):
        q = rng.uniform(robot.lower, robot.upper)
        q[joint] = getattr(robot, limit)[joint]
        assert len(inverse_kinematics(robot, "panda_hand", robot.fk(q, "panda_hand"), 3, rng=rng)) > 0


@given(st.integers(0, 2**32 - 1), st.floats(0.3, 0.6), st.floats(-0.4, 0.4), st.floats(0.2, 0.7))
def test_position_only(seed: int, x: float, y: float, z: float) -> None:
    robot = example_robot("panda")
    T = transform(np.array([x, y, z]))
    settings = InverseKinematicsSettings(position_only=True)
    q = inverse_kinematics(robot, "panda_link8", T, 10, rng=np.random.default_rng(seed), settings=settings)
    assert len(q) == 10
    assert errors(robot, "panda_link8", T, q)[0] <= 2e-6


@pytest.mark.parametrize("xyz", [(5.0, 0.0, 0.5), (0.85, 0.0, 0.6), (0.0, 0.0, -0.9)], ids=["far", "just too far", "below"])
def test_unreachable_poses_give_nothing(xyz: tuple[float, float, float]) -> None:
    T = transform(np.array(xyz))
    assert inverse_kinematics(example_robot("panda"), "panda_hand", T, rng=np.random.default_rng(0)).shape == (0, 7)


def test_a_narrow_range_of_acceptance_is_found() -> None:
    """Configurations near rejected ones are tried too: only a range of 0.02 rad of the elbow is accepted."""
    robot = example_robot("panda")
    rng = np.random.default_rng(8)
    T = robot.fk((robot.lower + robot.upper) / 2, "panda_hand")
    q = inverse_kinematics(robot, "panda_hand", T, 1, rng=rng, accept=lambda q: abs(q[:, 0] - 0.5) < 0.01)
    assert len(q) == 1


def test_bad_input() -> None:
    for frame, T, count, message in (
        ("wrist", np.eye(4), 1, "unknown link 'wrist'"),
        ("panda_link0", np.eye(4), 1, "no planned joint moves the link 'panda_link0'"),
        ("panda_hand", np.eye(4), 0, "count is 0"),
        ("panda_hand", np.full((4, 4), np.nan), 1, "finite"),
        ("panda_hand", 2 * np.eye(4), 1, "must be a homogeneous transform"),
    ):
        refuses(message, inverse_kinematics, example_robot("panda"), frame, T, count, rng=np.random.default_rng(0))
