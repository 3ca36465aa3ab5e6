"""Forward kinematics and Jacobians by hand and against Pinocchio; motion radii; inverse kinematics is exact or finds none."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

import robotdiffuse as rd
from helpers.example_robots import TIPS, example_robot, planar_arm, urdf_file
from helpers.refusals import refuses
from helpers.sphere_oracles import with_spheres
from robotdiffuse.core.transforms import rotation_angle, transform
from robotdiffuse.learning.training.losses import ForwardKinematics
from robotdiffuse.robots.inverse_kinematics import InverseKinematicsSettings, inverse_kinematics
from robotdiffuse.robots.motion_bounds import motion_radii


def configurations(robot: rd.Robot, count: int) -> torch.Tensor:
    return torch.tensor(np.random.default_rng(0).uniform(robot.lower, robot.upper, (count, robot.dof)))


class PinocchioArm:
    """Pinocchio's model of the same URDF, at the robot's planned joints and locked values."""

    def __init__(self, name: str, robot: rd.Robot, folder: Path) -> None:
        self.pin = pytest.importorskip("pinocchio")
        self.robot = robot
        self.model = self.pin.buildModelFromUrdf(str(urdf_file(name, folder)))
        self.data = self.model.createData()

    def update(self, q: torch.Tensor) -> None:
        values = self.robot.locked | dict(zip(self.robot.joint_names, q.tolist(), strict=True))
        full = self.pin.neutral(self.model)
        for name, value in values.items():
            joint = self.model.joints[self.model.getJointId(name)]
            # Pinocchio describes a continuous joint by the cosine and sine of its angle.
            full[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else [np.cos(value), np.sin(value)]
        self.pin.computeJointJacobians(self.model, self.data, full)
        self.pin.updateFramePlacements(self.model, self.data)
        self.T_base_world = self.frame(self.robot.base).inverse()

    def frame(self, link: str):
        return self.data.oMf[self.model.getFrameId(link, self.pin.FrameType.BODY)]

    def pose(self, link: str) -> np.ndarray:
        return (self.T_base_world * self.frame(link)).homogeneous

    def jacobian(self, link: str) -> np.ndarray:
        axes = self.pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        J = self.pin.getFrameJacobian(self.model, self.data, self.model.getFrameId(link, self.pin.FrameType.BODY), axes)
        columns = [self.model.joints[self.model.getJointId(name)].idx_v for name in self.robot.joint_names]
        return np.kron(np.eye(2), self.T_base_world.rotation) @ J[:, columns]


def test_planar_arm_by_hand() -> None:
    robot = planar_arm(2.0, 1.0)
    T = robot.fk(np.array([[np.pi / 2, -np.pi / 2], [0.0, np.pi / 2]]), "tip")
    np.testing.assert_allclose(T[:, :3, 3], [[1, 2, 0], [2, 1, 0]], atol=1e-12)
    J = robot.jacobian(np.array([0.0, np.pi / 2]), "tip")
    np.testing.assert_allclose(J.T, [[-1, 2, 0, 0, 0, 1], [-1, 0, 0, 0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
@pytest.mark.parametrize("name", TIPS)
def test_frames_of_the_networks_are_those_of_the_robot(name: str, dtype: torch.dtype, tolerance: float) -> None:
    robot = example_robot(name)
    q = configurations(robot, 20)
    T_base_frame = ForwardKinematics(robot, dtype)(q).numpy()
    for link in robot.link_names:
        T = T_base_frame[:, robot.link_frame(link)] @ robot.T_frame_link(link)
        np.testing.assert_allclose(T, robot.fk(q.numpy(), link), rtol=0, atol=tolerance, err_msg=link)


@pytest.mark.parametrize("name", TIPS)
def test_poses_and_jacobians_match_pinocchio(name: str, tmp_path: Path) -> None:
    robot = example_robot(name)
    oracle = PinocchioArm(name, robot, tmp_path)
    q = configurations(robot, 5).numpy()
    for link in robot.link_names:
        T = robot.fk(q, link)
        J = robot.jacobian(q, link)
        for i in range(len(q)):
            oracle.update(q[i])
            np.testing.assert_allclose(T[i], oracle.pose(link), rtol=0, atol=1e-9, err_msg=link)
            np.testing.assert_allclose(J[i], oracle.jacobian(link), rtol=0, atol=1e-9, err_msg=link)
            np.testing.assert_allclose(robot.fk(q[i], link), T[i], rtol=0, atol=1e-12)
    np.testing.assert_allclose(robot.fk(q[0].tolist()), robot.fk(q[0], robot.tip), atol=1e-12)


def test_inverse_kinematics_of_a_robot_nearest_first() -> None:
    panda = rd.load_robot("panda")
    q = np.array([0.3, 0.2, 0.1, -1.8, 0.0, 2.1, 0.8])
    found = panda.ik(panda.fk(q), count=5, near=q)
    assert len(found) == 5 and np.abs(panda.fk(found) - panda.fk(q)).max() < 1e-5
    np.testing.assert_allclose(found[0], q, atol=1e-4)
    refuses("seed is -1; it must be at least 0", panda.ik, np.eye(4), seed=-1)
    refuses("near is .*; it must be 7 finite numbers", panda.ik, np.eye(4), near=[q, q])
    assert panda.ik(transform(np.array([9.0, 0.0, 0.0]))).shape == (0, 7)
    refuses(r"q is .* it must be 7 numbers, or rows of them: panda_joint1", panda.fk, [0.0, 1.0])
    refuses("unknown link 'moon'", panda.jacobian, q, "moon")


def sampled_radii(robot: rd.Robot, count: int) -> np.ndarray:
    """Largest distances over random configurations, many of them with joints at a limit."""
    rng = np.random.default_rng(1)
    q = rng.uniform(robot.lower, robot.upper, (count, robot.dof))
    q = np.where(rng.random(q.shape) < 0.3, np.where(rng.random(q.shape) < 0.5, robot.lower, robot.upper), q)
    frames = ForwardKinematics(robot, torch.float64)(torch.tensor(q)).numpy()
    out = np.zeros((len(robot.spheres), robot.dof))
    for i, link in enumerate(link for link in robot.link_names if link in robot.spheres):
        T_base_link = frames[:, robot.link_frame(link)] @ robot.T_frame_link(link)
        spheres = robot.spheres[link]
        points = np.einsum("nik,sk->nsi", T_base_link[:, :3, :3], spheres[:, :3]) + T_base_link[:, None, :3, 3]
        for j in robot.chain(link):
            axis = frames[:, j + 1, :3, 2]
            lever = np.linalg.norm(np.cross(axis[:, None], points - frames[:, j + 1, None, :3, 3]), axis=-1)
            out[i, j] = 1.0 if robot.prismatic[j] else (lever + spheres[:, 3]).max()
    return out


@pytest.mark.parametrize("name", TIPS)
def test_never_below_and_close_to_sampled_maxima(name: str) -> None:
    robot = with_spheres(name)
    radii = motion_radii(robot)
    sampled = sampled_radii(robot, 20_000)
    assert (radii >= sampled).all() and ((radii > 0) == (sampled > 0)).all()
    # the bound itself is within 1 %; the rest is the gap between sampled and true maxima
    assert (radii <= 1.04 * sampled + 1e-3).all()


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
    assert len(q) == 10 and errors(robot, "panda_link8", T, q)[0] <= 2e-6


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


def test_solutions_near_a_place_beyond_the_limits_keep_the_limits_and_a_huge_count_means_all() -> None:
    robot = rd.load_robot("ur5")
    q = np.array([0.3, -1, 1, 0.2, 0.5, 0.1])
    solutions = robot.ik(robot.fk(q), near=[20, *q[1:]], count=10**20)
    assert 1 <= len(solutions) <= 8 * 2**5 and (robot.limit_excess(solutions) <= 0).all()
