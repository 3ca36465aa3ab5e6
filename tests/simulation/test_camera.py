"""Depth images and point clouds of simulated cameras."""

import numpy as np
import pytest

pytest.importorskip("pybullet")

from dataclasses import replace

from helpers.box_arm import box_arm
from robotdiffuse.core.errors import InputError
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, PointCloud, Shape, Sphere
from robotdiffuse.simulation import (
    DepthCamera,
    World,
    point_cloud,
    render,
)

pytestmark = pytest.mark.sim


EYE = (1.5, -1.2, 1.4)


CAMERA = DepthCamera(EYE, (0.0, 0.0, 0.4))


TURN = np.array([0.9, 0.3, 0.2, 0.1])


AWAY = np.array([2.5, 0.0, 0.0])
"""A configuration of the box arm that is out of the camera's way."""


def shape_at(kind: str) -> Shape:
    center = np.array([0.1, 0.0, 0.5])
    shapes = {
        "sphere": Sphere(center, 0.25),
        "box": Box(center, np.array([0.3, 0.2, 0.4]), TURN),
        "cylinder": Cylinder(center, 0.15, 0.4, TURN),
        "capsule": Capsule(center, 0.15, 0.3, TURN),
    }
    return shapes[kind]


def signed_distance(shape: Shape, points: np.ndarray) -> np.ndarray:
    """By hand, in the shape's own frame; exact on the surface."""
    if isinstance(shape, Sphere):
        return np.linalg.norm(points - shape.center, axis=1) - shape.radius
    assert isinstance(shape, Box | Cylinder | Capsule)
    own = np.abs((points - shape.center) @ shape.rotation)
    if isinstance(shape, Box):
        return (own - shape.size / 2).max(axis=1)
    round_ = np.linalg.norm(own[:, :2], axis=1)
    along = own[:, 2] - shape.height / 2
    if isinstance(shape, Cylinder):
        return np.maximum(round_ - shape.radius, along)
    return np.hypot(round_, np.maximum(along, 0)) - shape.radius


@pytest.mark.parametrize("kind", ["sphere", "box", "cylinder", "capsule"])
def test_points_lie_on_what_the_camera_sees_of_a_shape(kind: str) -> None:
    shape = shape_at(kind)
    with World(box_arm(), Scene([shape]), visuals=True) as world:
        world.place(AWAY)
        cloud = point_cloud(world, [CAMERA], np.random.default_rng(0), voxel=1e-4)
    assert len(cloud.points) > 1000
    # what is left is the facets of round shapes
    assert np.abs(signed_distance(shape, cloud.points)).max() < 1e-3
    # a little farther along its ray, a point is inside, or at a rim: only the near side is seen
    rays = cloud.points - EYE
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    assert (signed_distance(shape, cloud.points + 0.002 * rays) < 0).mean() > 0.98
    if isinstance(shape, Sphere):
        assert ((cloud.points - shape.center) @ (EYE - shape.center) > 0.25**2 - 1e-2).all()
        assert cloud.points.min(axis=0)[0] > shape.bounds[0, 0] + 0.05


def test_the_arm_is_not_in_the_cloud_but_hides_what_is_behind() -> None:
    robot = box_arm()
    scene = Scene([Box([0.6, 0, -0.2], [1.5, 1, 0.02])])
    above = DepthCamera((0.6, 0.0, 1.5), (0.6, 0.0, 0.0), up=(1.0, 0.0, 0.0))
    with World(robot, scene, visuals=True) as world:
        world.place(np.zeros(3))
        image = render(world, above)
        cloud = point_cloud(world, [above], np.random.default_rng(0), voxel=1e-4)
    assert image.names == ("planar", "box")
    assert (image.labels == 0).sum() > 1000
    assert len(cloud.points) == (image.labels == 1).sum()
    assert image.depth[image.labels == 0].min() == pytest.approx(1.5 - 0.03, abs=1e-3)
    assert np.isinf(image.depth[image.labels == -1]).all()
    assert np.allclose(cloud.points[:, 2], -0.19, atol=1e-3)
    # the arm lies along x from 0 to 1.2, 6 cm wide
    along = (cloud.points[:, 0] > 0.1) & (cloud.points[:, 0] < 1.1)
    assert np.abs(cloud.points[along, 1]).min() > 0.03


def test_noise_lies_along_the_ray_and_dropout_is_a_share() -> None:
    scene = Scene([Box([-0.5, 0, 0.5], [0.02, 4, 4])])
    camera = DepthCamera((1.5, 0.0, 0.5), (0.0, 0.0, 0.5))
    noisy = replace(camera, noise=0.005, dropout=0.25)
    with World(box_arm(), scene, visuals=True) as world:
        world.place(AWAY)
        clouds = [
            point_cloud(world, [c], np.random.default_rng(s), voxel=1e-5).points
            for c, s in ((camera, 0), (noisy, 0), (noisy, 0), (noisy, 1))
        ]
    clean, first, again, other = clouds
    assert np.array_equal(first, again) and len(first) != len(other)
    assert len(first) / len(clean) == pytest.approx(0.75, abs=0.01)
    rays = first - camera.position
    error = np.linalg.norm(rays, axis=1) * (1 - 1.99 / np.abs(rays[:, 0]))
    assert error.std() == pytest.approx(0.005, rel=0.03)
    assert abs(error.mean()) < 2e-4


def test_cameras_are_merged_and_thinned_and_obstacles_left_out() -> None:
    floor = Box([0, 0, -0.5], [3, 3, 0.02], name="floor")
    scene = Scene([Sphere([0, 0, 0.5], 0.25), floor])
    across = replace(CAMERA, position=(-1.5, 1.2, 1.4))
    with World(box_arm(), scene, visuals=True) as world:
        world.place(AWAY)
        rng = np.random.default_rng(0)
        one = point_cloud(world, [CAMERA], rng, without=["floor"]).points
        two = point_cloud(world, [CAMERA, across], rng, without=["floor"], point_radius=0.02)
        whole = point_cloud(world, [CAMERA], rng).points
        with pytest.raises(InputError, match="obstacle in without: 'flor'; known: floor, sphere"):
            point_cloud(world, [CAMERA], rng, without=["flor"])
        assert len(point_cloud(world, [], rng).points) == 0
    assert isinstance(two, PointCloud) and two.point_radius == 0.02
    assert one[:, 2].min() > 0.2 and whole[:, 2].min() < -0.45
    # the cap that one camera sees is less than half of the sphere; from both sides nearly all is seen
    assert np.ptp(one @ [0.78, -0.62, 0]) < 0.35 < 0.45 < np.ptp(two.points @ [0.78, -0.62, 0])
    assert len(np.unique(np.floor(two.points / 0.01), axis=0)) == len(two.points)
    problem = Problem(box_arm(), Scene([two]), AWAY, JointGoal(AWAY[None]))
    assert problem.scene.shapes == (two,)


def test_a_point_cloud_is_seen_as_points() -> None:
    points = np.array([[0.0, 0.1, 0.4], [0.0, -0.1, 0.5], [0.2, 0.0, 0.3]])
    cloud = PointCloud(points, 0.03)
    with World(box_arm(), Scene([cloud]), visuals=True) as world:
        world.place(AWAY)
        seen = point_cloud(world, [CAMERA], np.random.default_rng(0), voxel=1e-4).points
    nearest = np.linalg.norm(seen[:, None] - points, axis=2)
    assert set(nearest.argmin(axis=1)) == {0, 1, 2}
    assert nearest.min(axis=1).max() < 0.0301


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"up": (1.5, -1.2, 1.0)}, "up is .* must not lie along the line of sight"),
        ({"target": EYE}, "must not lie along the line of sight"),
        ({"target": (0.0, np.nan, 0.0)}, "target is .* 3 finite numbers"),
        ({"width": 0}, "width is 0; it must be between 1 and 4096"),
        ({"field_of_view": 3.2}, "field_of_view is 3.2"),
        ({"near": 5.0}, "near is 5.0 and far 4.0"),
        ({"noise": -0.1}, "noise is -0.1"),
        ({"dropout": 1.0}, "dropout is 1.0"),
    ],
)
def test_cameras_that_cannot_be(values: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(CAMERA, **values)


def test_a_world_without_surfaces_cannot_be_looked_at() -> None:
    with (
        World(box_arm(), Scene()) as world,
        pytest.raises(InputError, match=r"World\(\.\.\., visuals=True\)"),
    ):
        render(world, CAMERA)
