"""The differentiable signed distance against the compiled kernel and finite differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.box_arm import box_arm
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.signed_distance import SignedDistance
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, PointCloud, Shape, Sphere

SHAPES: dict[str, list[Shape]] = {
    "nothing": [],
    "spheres": [Sphere((0.5, 0.3, 0.6), 0.2), Sphere((-0.3, 0.3, 0.2), 0.1)],
    "boxes": [
        Box((0.0, 0.6, 0.4), (0.2, 0.3, 0.2), (0.9, 0.1, 0.3, 0.1)),
        Box((0.0, 0.0, -0.05), (2.0, 2.0, 0.1)),
    ],
    "cylinders": [Cylinder((0.4, -0.4, 0.3), 0.08, 0.5, (0.9, 0.3, 0.0, 0.1))],
    "capsules": [Capsule((-0.4, -0.3, 0.5), 0.06, 0.5, (0.9, 0.3, 0.5, 0.1))],
}
SHAPES["all"] = [shape for shapes in SHAPES.values() for shape in shapes]
ROBOTS = {"panda": lambda: load_robot("panda"), "box_arm": box_arm}


def rows(robot: Robot, *batch: int) -> torch.Tensor:
    rng = np.random.default_rng(0)
    return torch.tensor(rng.uniform(robot.lower, robot.upper, (*batch, robot.dof)))


@pytest.mark.parametrize("robot_name", ROBOTS)
@pytest.mark.parametrize("shapes", SHAPES)
def test_the_same_as_the_kernel(robot_name: str, shapes: str) -> None:
    robot, scene = ROBOTS[robot_name](), Scene(SHAPES[shapes])
    checker, distance, q = CollisionChecker(robot, scene), SignedDistance(robot, scene), rows(robot, 200)
    assert (distance.links, distance.pairs) == (checker.links, checker.pairs)
    np.testing.assert_allclose(distance(q).numpy(), checker.link_clearances(q.numpy()), atol=1e-5)
    between = np.minimum(distance.self_distance(q).numpy(), 1.0)
    np.testing.assert_allclose(between, checker.pair_clearances(q.numpy()), atol=1e-5)


@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3), (2, 3, 4), (0,)])
def test_batch_shapes(batch: tuple[int, ...]) -> None:
    robot = load_robot("panda")
    distance, q = SignedDistance(robot, Scene(SHAPES["all"])), rows(robot, *batch)
    assert distance(q).shape == (*batch, len(distance.links))
    assert distance.self_distance(q).shape == (*batch, len(distance.pairs))
    flat = distance(q.reshape(-1, robot.dof)).reshape(*batch, len(distance.links))
    torch.testing.assert_close(distance(q), flat)


@pytest.mark.parametrize("robot_name", ROBOTS)
def test_gradients_are_finite_differences(robot_name: str) -> None:
    robot, step = ROBOTS[robot_name](), 1e-6
    distance = SignedDistance(robot, Scene(SHAPES["all"]), torch.float64)
    for measure in (distance, distance.self_distance):
        q = rows(robot, 40).requires_grad_()
        found = measure(q)
        assert found.dtype == torch.float64
        with torch.no_grad():
            moves = step * torch.eye(robot.dof, dtype=torch.float64)
            slopes = torch.stack([(measure(q + m) - measure(q - m)) / (2 * step) for m in moves], dim=-1)
        for k in range(found.shape[-1]):
            (gradient,) = torch.autograd.grad(found[:, k].sum(), q, retain_graph=True)
            # where two spheres or obstacles are equally near, the slope jumps
            wrong = ((gradient - slopes[:, k]).abs() > 1e-5).any(dim=-1)
            assert wrong.double().mean() < 0.06


def test_an_empty_scene_is_a_metre_away() -> None:
    robot = load_robot("panda")
    for scene in (Scene(), Scene([PointCloud(np.zeros((0, 3)))]), Scene([Sphere((50, 0, 0), 1.0)])):
        q = rows(robot, 4).requires_grad_()
        found = SignedDistance(robot, scene)(q)
        assert (found == 1).all()
        (gradient,) = torch.autograd.grad(found.sum(), q)
        assert (gradient == 0).all()


def test_a_point_cloud_is_exact_to_the_grid() -> None:
    robot, rng = load_robot("panda"), np.random.default_rng(0)
    scene = Scene([PointCloud(rng.uniform([0.3, -0.4, 0.2], [0.7, 0.4, 0.8], (100, 3)), 0.01)])
    q = rows(robot, 300)
    found = SignedDistance(robot, scene)(q).numpy()
    right = CollisionChecker(robot, scene).link_clearances(q.numpy())
    near = np.abs(right) < 0.1
    assert near.any()
    assert np.abs(found - right)[near].max() < 0.02
    assert np.abs(found - right)[near].mean() < 0.004


def test_gradients_of_a_point_cloud_lead_away() -> None:
    robot = load_robot("panda")
    distance = SignedDistance(robot, Scene([PointCloud([[0.45, 0.0, 0.5]], 0.05)]))
    q = rows(robot, 400).float().requires_grad_()
    found = distance(q).amin(-1)
    (gradient,) = torch.autograd.grad(found.sum(), q)
    near = (found.abs() < 0.05) & (gradient.norm(dim=-1) > 0.05)
    assert near.sum() > 5
    step = 0.02 * gradient / gradient.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    assert (distance(q + step).amin(-1) > found)[near].double().mean() > 0.9


def test_a_robot_without_spheres() -> None:
    robot = replace(box_arm(), spheres={})
    distance = SignedDistance(robot, Scene(SHAPES["all"]))
    assert distance(rows(robot, 2, 3)).shape == (2, 3, 0)
    assert distance.self_distance(rows(robot, 2, 3)).shape == (2, 3, 0)
