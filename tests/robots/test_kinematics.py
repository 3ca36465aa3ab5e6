"""Forward kinematics and Jacobians: by hand, by finite differences, and against Pinocchio."""

from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.example_robots import TIPS, example_robot, planar_arm, urdf_file
from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.forward_kinematics import ForwardKinematics
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.kinematics import link_origins, link_pose
from robotdiffuse.robots.robot import Robot


def configurations(robot: Robot, count: int) -> torch.Tensor:
    return torch.tensor(np.random.default_rng(0).uniform(robot.lower, robot.upper, (count, robot.dof)))


class PinocchioArm:
    """Pinocchio's model of the same URDF, at the robot's planned joints and locked values."""

    def __init__(self, name: str, robot: Robot, folder: Path) -> None:
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
            full[joint.idx_q : joint.idx_q + joint.nq] = (
                value if joint.nq == 1 else [np.cos(value), np.sin(value)]
            )
        self.pin.computeJointJacobians(self.model, self.data, full)
        self.pin.updateFramePlacements(self.model, self.data)
        self.T_base_world = self.frame(self.robot.base).inverse()

    def frame(self, link: str):
        return self.data.oMf[self.model.getFrameId(link, self.pin.FrameType.BODY)]

    def pose(self, link: str) -> np.ndarray:
        return (self.T_base_world * self.frame(link)).homogeneous

    def jacobian(self, link: str) -> np.ndarray:
        frame = self.model.getFrameId(link, self.pin.FrameType.BODY)
        axes = self.pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        J = self.pin.getFrameJacobian(self.model, self.data, frame, axes)
        columns = [self.model.joints[self.model.getJointId(name)].idx_v for name in self.robot.joint_names]
        return np.kron(np.eye(2), self.T_base_world.rotation) @ J[:, columns]


def test_planar_arm_by_hand() -> None:
    fk = ForwardKinematics(planar_arm(2.0, 1.0), torch.float64)
    T = fk.link(torch.tensor([[np.pi / 2, -np.pi / 2], [0.0, np.pi / 2]], dtype=torch.float64), "tip")
    np.testing.assert_allclose(T[:, :3, 3], [[1, 2, 0], [2, 1, 0]], atol=1e-12)
    J = fk.jacobian(torch.tensor([0.0, np.pi / 2], dtype=torch.float64), "tip")
    np.testing.assert_allclose(J.T, [[-1, 2, 0, 0, 0, 1], [-1, 0, 0, 0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-5)])
@pytest.mark.parametrize("name", TIPS)
def test_links_match_pinocchio(name: str, dtype: torch.dtype, tolerance: float, tmp_path: Path) -> None:
    robot = example_robot(name)
    oracle = PinocchioArm(name, robot, tmp_path)
    q = configurations(robot, 20)
    T = ForwardKinematics(robot, dtype).links(q)
    for i in range(len(q)):
        oracle.update(q[i])
        for k, link in enumerate(robot.link_names):
            np.testing.assert_allclose(T[i, k], oracle.pose(link), rtol=0, atol=tolerance, err_msg=link)


@pytest.mark.parametrize("name", TIPS)
def test_jacobian_matches_pinocchio(name: str, tmp_path: Path) -> None:
    robot = example_robot(name)
    oracle = PinocchioArm(name, robot, tmp_path)
    q = configurations(robot, 5)
    for link in robot.link_names:
        J = ForwardKinematics(robot, torch.float64).jacobian(q, link)
        for i in range(len(q)):
            oracle.update(q[i])
            np.testing.assert_allclose(J[i], oracle.jacobian(link), rtol=0, atol=1e-9, err_msg=link)


@pytest.mark.parametrize("name", TIPS)
def test_jacobian_matches_finite_differences(name: str) -> None:
    robot = example_robot(name)
    fk = ForwardKinematics(robot, torch.float64)
    q, step = configurations(robot, 3), 1e-6
    steps = step * torch.eye(robot.dof, dtype=torch.float64)
    for link in robot.link_names:
        before, after = (fk.link(q[:, None] + sign * steps, link) for sign in (-1, 1))
        linear = (after - before)[..., :3, 3] / (2 * step)
        turn = (after[..., :3, :3] @ before[..., :3, :3].mT) / (4 * step)
        skew = turn - turn.mT
        angular = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
        numeric = torch.cat([linear, angular], dim=-1).mT
        # The error of central differences with this step: rounding, 1e-16 / 1e-6, and a margin.
        np.testing.assert_allclose(fk.jacobian(q, link), numeric, rtol=0, atol=1e-8, err_msg=link)


def test_gradients_of_poses_and_jacobians() -> None:
    robot = example_robot("awkward")
    fk = ForwardKinematics(robot, torch.float64)
    q = configurations(robot, 2).requires_grad_()
    assert torch.autograd.gradcheck(fk.links, (q,))
    assert torch.autograd.gradcheck(lambda q: fk.jacobian(q, robot.tip), (q,))
    assert torch.autograd.gradgradcheck(lambda q: fk.link(q, robot.tip), (q,))


@pytest.mark.parametrize("name", TIPS)
def test_frames_links_and_single_poses_agree(name: str) -> None:
    robot = example_robot(name)
    fk = ForwardKinematics(robot, torch.float64)
    q = configurations(robot, 1)[0]
    frames, links = fk(q), fk.links(q)
    for k, link in enumerate(robot.link_names):
        T = frames[robot.link_frame(link)].numpy() @ robot.T_frame_link(link)
        for same in (links[k], fk.link(q, link), link_pose(robot, q.numpy(), link)):
            np.testing.assert_allclose(same, T, rtol=0, atol=1e-12)
        origins = link_origins(robot, q.numpy()[None], link)
        np.testing.assert_allclose(origins, T[None, :3, 3], rtol=0, atol=1e-12)


@pytest.mark.parametrize("batch", [(), (0,), (1,), (2, 3)])
def test_batch_shapes(batch: tuple[int, ...]) -> None:
    robot = planar_arm(1.0, 1.0, 1.0)
    fk = ForwardKinematics(robot)
    q = torch.zeros((*batch, 3))
    assert fk(q).shape == (*batch, 4, 4, 4)
    assert fk.link(q, "l1").shape == (*batch, 4, 4)
    assert fk.links(q).shape == (*batch, 5, 4, 4)
    assert fk.jacobian(q, "l0").shape == (*batch, 6, 3)


def test_bad_input() -> None:
    robot = planar_arm(1.0, 1.0)
    fk = ForwardKinematics(robot)
    with pytest.raises(InputError, match=r"shape \(3,\).*2 planned joints"):
        fk.link(torch.zeros(3), "tip")
    with pytest.raises(InputError, match="unknown link 'hand'"):
        fk.link(torch.zeros(2), "hand")
    with pytest.raises(InputError, match="unknown link 'hand'"):
        link_pose(robot, np.zeros(2), "hand")


@pytest.mark.parametrize("name", TIPS)
def test_a_robot_s_own_kinematics_are_those_of_the_network_s_side(name: str) -> None:
    robot = example_robot(name)
    fk, q = ForwardKinematics(robot, torch.float64), configurations(robot, 5)
    for link in (None, robot.link_names[-1]):
        where = link or robot.tip
        np.testing.assert_allclose(robot.fk(q.numpy(), link), fk.link(q, where), atol=1e-12)
        np.testing.assert_allclose(robot.jacobian(q.numpy(), link), fk.jacobian(q, where), atol=1e-12)
        np.testing.assert_allclose(robot.fk(q[0].tolist(), link), fk.link(q[0], where), atol=1e-12)
        assert robot.jacobian(q[0].tolist(), link).shape == (6, robot.dof)


def test_inverse_kinematics_of_a_robot_nearest_first() -> None:
    panda = load_robot("panda")
    q = np.array([0.3, 0.2, 0.1, -1.8, 0.0, 2.1, 0.8])
    found = panda.ik(panda.fk(q), count=5, near=q)
    assert len(found) == 5 and np.abs(panda.fk(found) - panda.fk(q)).max() < 1e-5
    np.testing.assert_allclose(found[0], q, atol=1e-4)
    far = np.eye(4)
    far[0, 3] = 9.0
    assert panda.ik(far).shape == (0, 7)
    with pytest.raises(InputError, match=r"q is .* it must be 7 numbers, or rows of them: panda_joint1"):
        panda.fk([0.0, 1.0])
    with pytest.raises(InputError, match="unknown link 'moon'"):
        panda.jacobian(q, "moon")
