"""Point clouds and meshes as covering spheres in a grid, against distances to all points."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

import robotdiffuse as rd
from helpers import sphere_oracles as oracles
from helpers.box_arm import box_arm
from helpers.panda import PANDA
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.collision.kernels.nearest_voxels import nearest_voxels
from robotdiffuse.collision.point_cloud_grid import cover_triangles, thin_points


def test_a_point_cloud_is_many_spheres() -> None:
    """The points are so far apart that thinning joins none of them."""
    points = np.random.default_rng(0).uniform([-0.8, -0.8, 0.0], [0.8, 0.8, 1.2], (60, 3))
    cloud = CollisionChecker(PANDA, rd.Scene([rd.PointCloud(points, 0.02)]))
    spheres = CollisionChecker(PANDA, rd.Scene([rd.Sphere(point, 0.02) for point in points]))
    q = oracles.rows(PANDA, 3000)
    np.testing.assert_array_equal(cloud.free(q), spheres.free(q))
    assert 0.05 < cloud.free(q).mean() < 0.95
    found = cloud.link_clearances(q)
    right = spheres.link_clearances(q)
    assert (found <= right + oracles.TOLERANCE).all()
    near = right < 0.08
    np.testing.assert_allclose(found[near], right[near], atol=oracles.TOLERANCE)
    # further out the grid alone answers: at most two voxels' diagonals of 2 cm less
    assert (found >= np.minimum(right, 0.2) - 0.08).all()


def test_the_nearest_of_a_dense_cloud() -> None:
    """The search in grid cells must not miss the nearest point."""
    robot = oracles.with_spheres("box_arm")
    points = np.random.default_rng(3).normal(size=(3000, 3))
    points = 0.4 * points / np.linalg.norm(points, axis=1, keepdims=True) + np.array([0.7, 0.5, 0])
    q = oracles.rows(robot, 200)
    right = CollisionChecker(robot, rd.Scene([rd.Sphere(c[:3], c[3]) for c in thin_points(points, 0.004, 2.0)]))
    found = CollisionChecker(robot, rd.Scene([rd.PointCloud(points, 0.004)]))
    np.testing.assert_array_equal(found.free(q), right.free(q))
    near = right.link_clearances(q) < 0.08
    np.testing.assert_allclose(found.link_clearances(q)[near], right.link_clearances(q)[near], atol=oracles.TOLERANCE)


def test_empty_and_distant_clouds_are_empty_scenes() -> None:
    q = oracles.rows(PANDA, 200)
    right = CollisionChecker(PANDA, rd.Scene()).free(q)
    for points in (np.zeros((0, 3)), np.full((5, 3), 50.0), np.array([[1e4, -1e4, 1e4], [-1e4, 0, 0]])):
        checker = CollisionChecker(PANDA, rd.Scene([rd.PointCloud(points, 0.01)]))
        np.testing.assert_array_equal(checker.free(q), right)
        assert (checker.link_clearances(q) == 1).all()


def test_points_just_beyond_the_reach_count() -> None:
    """These points limit the clearance of a stretched-out arm and, with padding, collide with it."""
    robot = oracles.with_spheres("box_arm")
    scene = rd.Scene([rd.PointCloud([[1.32, 0.0, 0.0]], 0.01)])
    q = np.zeros((1, 3))
    right = oracles.link_distances(robot, scene, q).min()
    assert 0.02 < right < 0.1
    assert oracles.least_clearance(CollisionChecker(robot, scene), q)[0] == pytest.approx(right, abs=oracles.TOLERANCE)
    assert CollisionChecker(robot, scene, right - 0.001).free(q)[0]
    assert not CollisionChecker(robot, scene, right + 0.001).free(q)[0]


@pytest.mark.parametrize("radius", [1e-9, 1e-4, 0.3])
def test_tiny_and_large_points(radius: float) -> None:
    scene = rd.Scene([rd.PointCloud(np.random.default_rng(0).uniform([-0.8, -0.8, 0.0], [0.8, 0.8, 1.2], (20, 3)), radius)])
    q = oracles.rows(PANDA, 500)
    hit = (oracles.link_distances(PANDA, scene, q) < -oracles.TOLERANCE).any(axis=1)
    assert not CollisionChecker(PANDA, scene).free(q)[hit].any()


def test_links_with_spheres_larger_than_the_grids_band() -> None:
    robot = replace(box_arm(), spheres={"l3": np.array([[0.2, 0, 0, 0.4]])}, meshes={})
    points = np.random.default_rng(0).uniform(-1.6, 1.6, (40, 3)) * (1, 1, 0.2)
    cloud = CollisionChecker(robot, rd.Scene([rd.PointCloud(points, 0.02)]))
    spheres = CollisionChecker(robot, rd.Scene([rd.Sphere(point, 0.02) for point in points]))
    q = oracles.rows(robot, 500)
    np.testing.assert_array_equal(cloud.free(q), spheres.free(q))
    free = cloud.free(q)
    assert 0 < free.mean() < 1 and ((oracles.least_clearance(cloud, q) > 0) == free).all()
    # no cost from points that are further away than the margin
    assert (cloud.cost_gradients(q[oracles.least_clearance(spheres, q) > 0.05], 0.04)[0] == 0).all()


def test_mesh_obstacles_against_the_exact_surface() -> None:
    vertices, faces = oracles.box_triangles((0.3, 0.4, 0.5))
    center = np.array([0.5, 0.1, 0.4])
    wxyz = np.array([0.9, 0.1, 0.2, 0.3])
    scene = rd.Scene([rd.Mesh(vertices, faces, center, wxyz)])
    q = np.random.default_rng(1).uniform(PANDA.lower, PANDA.upper, (1500, PANDA.dof))
    free = CollisionChecker(PANDA, scene).free(q)
    assert not ExactCollision(PANDA, scene).collides(q[free]).any()
    assert (free == CollisionChecker(PANDA, rd.Scene([rd.Box(center, (0.3, 0.4, 0.5), wxyz)])).free(q)).mean() > 0.97


def test_a_ground_of_huge_triangles_is_as_fine_as_a_small_one() -> None:
    far = 1e4
    spheres = cover_triangles(np.array([[-far, -far, -0.2], [far, -far, -0.2], [0.0, 2 * far, -0.2]])[None], 1.5)
    assert spheres[:, 3].max() < 0.03 and np.linalg.norm(spheres[:, :3], axis=1).max() < 2
    on_ground = np.array([[0.0, 0, -0.2], [1.2, 0.3, -0.2], [-0.5, -1.1, -0.2]])
    gap = np.linalg.norm(on_ground[:, None] - spheres[:, :3], axis=-1) - spheres[:, 3]
    assert (gap.min(axis=1) <= 0).all()


@pytest.mark.parametrize(("shape", "count"), [((9, 12, 7), 4), ((1, 1, 30), 2), ((30, 1, 1), 1), ((20, 17, 13), 900)])
def test_nearest_voxels_are_those_of_a_distance_transform(shape, count) -> None:
    run = np.full(shape, -1, np.int32)
    held = np.random.default_rng(0).choice(run.size, count, replace=False)
    run.ravel()[held] = np.arange(count)
    squares, holders = nearest_voxels(run)
    there = np.stack(np.unravel_index(held, shape), axis=-1)[holders]
    away = there - np.moveaxis(np.indices(shape), 0, -1)
    np.testing.assert_array_equal(squares, (away**2).sum(axis=-1))
    np.testing.assert_allclose(np.sqrt(squares), np.asarray(distance_transform_edt(run < 0)), rtol=1e-6)
