"""Clearances as network inputs: training and planning agree, and gradients match finite differences."""

import numpy as np
import torch

import robotdiffuse as rd
from helpers.panda import PANDA
from helpers.refusals import refuses
from helpers.sphere_oracles import solids
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.batched_clearances import packed_clearances_and_gradients, packed_link_clearances
from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.learning import motion_model
from robotdiffuse.learning.training.config import PlannerTraining
from robotdiffuse.learning.training.losses import ArmDistance, ForwardKinematics
from robotdiffuse.problems.families.rop import ROP, ROP_DENSE
from robotdiffuse.scenes.scene_arrays import PackedScenes

LIMIT = 0.4
MARGIN = 0.1


def configurations(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(PANDA.lower, PANDA.upper, (*shape, PANDA.dof)).astype(np.float32)


def test_inputs_are_the_same_in_training_and_planning() -> None:
    """In scenes of different size in one batch, whether or not gradients are computed too."""
    rng = np.random.default_rng(1)
    scenes = [family.scene(rng) for family in (ROP, ROP_DENSE, ROP_DENSE)]
    scenes.append(rd.Scene(scenes[0].shapes[:1]))
    packed = PackedScenes.pack(scenes, 12, floor=True)
    q = configurations(len(packed), 60)
    config = motion_model.MotionModelSettings(clearance_gradients=True)
    given = compile_robot(PANDA), packed, q, motion_model.MAX_CLEARANCE
    clearances, gradients = packed_clearances_and_gradients(*given, motion_model.GRADIENT_MARGIN)
    np.testing.assert_array_equal(clearances, packed_link_clearances(*given))
    told = np.concatenate([clearances, gradients], axis=-1)
    for i, scene in enumerate(scenes):
        checker = CollisionChecker(PANDA, scene)
        np.testing.assert_allclose(motion_model.link_clearances(checker, config)(q[i : i + 1])[0], told[i], atol=1e-4)
        assert (gradients[i].any(axis=1) <= (clearances[i].min(axis=1) < motion_model.GRADIENT_MARGIN)).all()
    assert 0.3 < gradients.any(axis=-1).mean() < 0.9


def test_gradients_are_those_of_the_clearances() -> None:
    """Compares with automatic differentiation of the signed distance that training losses use."""
    q = configurations(400).astype(np.float64)
    scene = rd.Scene(solids().shapes[:2])
    checker = CollisionChecker(PANDA, scene)
    packed = PackedScenes.pack([scene] * len(q), 2)
    distance = ArmDistance(ForwardKinematics(PANDA, torch.float64))

    def too_close(at: torch.Tensor) -> torch.Tensor:
        return torch.relu(MARGIN - distance(at[:, None], packed)[:, 0]).square().sum(-1).sqrt()

    clearances, found = checker.clearances_and_gradients(q, LIMIT, MARGIN)
    np.testing.assert_array_equal(clearances, checker.link_clearances(q, LIMIT))
    at = torch.from_numpy(q).requires_grad_()
    too_close(at).sum().backward()
    assert at.grad is not None
    # where two obstacles are as near, or a margin is just touched, rounding decides
    near = too_close(at.detach()).numpy() > 1e-3
    far = clearances.min(axis=1) >= MARGIN
    assert near.sum() > 50 and far.sum() > 50
    assert np.isclose(found[near], at.grad.numpy()[near], atol=2e-3).all(axis=1).mean() > 0.95 and (found[far] == 0).all()


def test_gradients_of_a_cloud_are_those_of_what_it_covers() -> None:
    directions = np.random.default_rng(4).standard_normal((20_000, 3))
    surface = np.array([0.5, 0.1, 0.5]) + 0.195 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    solid = CollisionChecker(PANDA, rd.Scene([rd.Sphere((0.5, 0.1, 0.5), 0.2)]))
    cloud = CollisionChecker(PANDA, rd.Scene([rd.PointCloud(surface, 0.005)]))
    q = configurations(600).astype(np.float64)
    right, found = (checker.clearances_and_gradients(q, LIMIT, MARGIN) for checker in (solid, cloud))
    # deep inside, the surface's points push elsewhere than the solid does
    touched = (right[0].min(axis=1) > 0.0) & (right[0].min(axis=1) < 0.09)
    assert touched.sum() > 50
    assert np.isclose(found[1][touched], right[1][touched], atol=0.1).all(axis=1).mean() > 0.9


def test_gradients_need_clearances() -> None:
    alone = {"clearance_features": False, "clearance_gradients": True}
    message = "clearance_gradients is True and clearance_features is False"
    refuses(message, PlannerTraining, data="data", encoder="encoder", **alone)
    refuses("clearance_gradients", motion_model.MotionModelSettings, **alone)
