"""Forward kinematics and Jacobians: by hand and against Pinocchio; motion radii."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import robotdiffuse as rd
from helpers.example_robots import TIPS, example_robot, planar_arm, urdf_file
from helpers.refusals import refuses
from robotdiffuse.core.transforms import transform
from robotdiffuse.learning.training.losses import ForwardKinematics
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
    assert panda.ik(transform(np.array([9.0, 0.0, 0.0]))).shape == (0, 7)
    refuses(r"q is .* it must be 7 numbers, or rows of them: panda_joint1", panda.fk, [0.0, 1.0])
    refuses("unknown link 'moon'", panda.jacobian, q, "moon")


def with_spheres(robot: rd.Robot) -> rd.Robot:
    """The robot with three random spheres on each link but the second, which has none."""
    rng = np.random.default_rng(5)
    links = [link for link in robot.link_names if link != robot.link_names[1]]
    spheres = {link: np.hstack([rng.uniform(-0.1, 0.1, (3, 3)), rng.uniform(0, 0.05, (3, 1))]) for link in links}
    return replace(robot, spheres=spheres)


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
            origin = frames[:, j + 1, :3, 3]
            lever = np.linalg.norm(np.cross(axis[:, None], points - origin[:, None]), axis=-1)
            out[i, j] = 1.0 if robot.prismatic[j] else (lever + spheres[:, 3]).max()
    return out


@pytest.mark.parametrize("name", TIPS)
def test_never_below_and_close_to_sampled_maxima(name: str) -> None:
    robot = with_spheres(example_robot(name))
    radii = motion_radii(robot)
    sampled = sampled_radii(robot, 20_000)
    assert (radii >= sampled).all()
    assert ((radii > 0) == (sampled > 0)).all()
    # the bound itself is within 1 %; the rest is the gap between sampled and true maxima
    assert (radii <= 1.04 * sampled + 1e-3).all()
