"""The paper's losses: distances against the kernel, points against kinematics, gradients by differences."""

import numpy as np
import pytest
import torch

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.training import losses
from robotdiffuse.problems.families.rop import ROP, ROP_DENSE
from robotdiffuse.robots import load_robot
from robotdiffuse.scenes.packed_scenes import PackedScenes
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box

PANDA = load_robot("panda")
DOUBLE = losses.ForwardKinematics(PANDA, torch.float64)


def configurations(n: int, waypoints: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(PANDA.lower, PANDA.upper, (n, waypoints, 7)))


@pytest.mark.parametrize("floor", [True, False])
def test_distances_are_those_of_the_kernel(floor: bool) -> None:
    rng = np.random.default_rng(1)
    scenes = [Scene(family.scene(rng).shapes[1:]) for family in (ROP, ROP_DENSE, ROP_DENSE)]
    turned = rng.normal(size=4)
    scenes += [Scene([]), Scene([Box([0.4, 0.1, 0.5], [0.1, 0.3, 0.6], turned / np.linalg.norm(turned))])]
    scenes = [Scene([*([ROP.floor] if floor else []), *scene.shapes]) for scene in scenes]
    q = configurations(len(scenes), 20)
    distance = losses.ArmDistance(DOUBLE)(q, PackedScenes.pack(scenes, 12, floor)).numpy()
    for i, full in enumerate(scenes):
        expected = CollisionChecker(PANDA, full).link_clearances(q[i].numpy()).min(axis=1)
        # the floor's box is as wide as the arm reaches; deep in it the plane and the box differ
        checked = (expected > -0.05) & (expected < 0.8)
        assert checked.sum() > 5 or not full.shapes
        assert (distance[i].min(axis=1)[expected >= 0.8] > 0.8).all()
        np.testing.assert_allclose(distance[i].min(axis=1)[checked], expected[checked], atol=2e-5)


def test_the_hinge_and_its_gradient() -> None:
    rng = np.random.default_rng(2)
    scenes = PackedScenes.pack([ROP.scene(rng)], 2, floor=True)
    arm = losses.ArmDistance(DOUBLE)
    q = configurations(1, 6, 3).requires_grad_()

    def loss(at: torch.Tensor) -> torch.Tensor:
        return losses.hinge(arm(at, scenes), 0.2).square().mean()

    loss(q).backward()
    assert q.grad is not None and q.grad.abs().max() > 0
    direction = torch.from_numpy(rng.normal(size=q.shape))
    with torch.no_grad():
        slope = (loss(q + 1e-6 * direction) - loss(q - 1e-6 * direction)) / 2e-6
    np.testing.assert_allclose((q.grad * direction).sum(), slope, rtol=1e-4)
    assert torch.equal(losses.hinge(torch.tensor([-0.1, 0.05, 0.3]), 0.1), torch.tensor([0.2, 0.05, 0.0]))


def test_surface_points_move_with_their_links() -> None:
    q = configurations(2, 4, 5)
    placed = losses.SurfacePoints(DOUBLE, 3, np.random.default_rng(4))(q).numpy()
    links = [link for link, meshes in PANDA.meshes.items() if meshes and PANDA.link_frame(link) > 0]
    assert placed.shape == (2, 4, 3 * len(links), 3)
    for i, link in enumerate(links):
        T = PANDA.fk(q.reshape(-1, 7).numpy(), link)
        locals_ = (placed[:, :, 3 * i : 3 * i + 3].reshape(8, 3, 3) - T[:, None, :3, 3]) @ T[:, :3, :3]
        np.testing.assert_allclose(locals_, np.broadcast_to(locals_[0], (8, 3, 3)), atol=1e-9)
        corners = np.concatenate([mesh.vertices for mesh in PANDA.meshes[link]])
        assert (locals_[0] >= corners.min(0) - 1e-9).all() and (locals_[0] <= corners.max(0) + 1e-9).all()


def test_the_collision_loss_begins_as_scheduled() -> None:
    settings = losses.LossSettings(collision=2.0, begin=0.5)
    assert [settings.collision_weight(f) for f in (0.0, 0.5, 0.55, 0.6, 1.0)] == pytest.approx([0, 0, 1, 2, 2])
