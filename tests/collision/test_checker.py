"""The compiled collision check against exact distances by hand, and against the exact meshes; points in a grid."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st
from numpy import ndarray
from scipy.ndimage import distance_transform_edt

import robotdiffuse as rd
from helpers import sphere_oracles as oracles
from helpers.box_arm import box_arm
from helpers.panda import PANDA
from helpers.refusals import refuses
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.batched_clearances import packed_clearances_and_gradients
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.collision.kernel_arrays import compile_robot, robot_groups
from robotdiffuse.collision.kernels.lane_clearance import block_clearances
from robotdiffuse.collision.kernels.lane_collision import block_hits, free_many
from robotdiffuse.collision.kernels.motions import motion_free
from robotdiffuse.collision.kernels.nearest_voxels import nearest_voxels
from robotdiffuse.collision.point_cloud_grid import THINNING, cover_triangles, thin_points
from robotdiffuse.learning import motion_model
from robotdiffuse.learning.training.config import PlannerTraining
from robotdiffuse.learning.training.losses import ArmDistance, ForwardKinematics
from robotdiffuse.problems.families.family import base_spheres
from robotdiffuse.problems.families.rop import ROP, ROP_DENSE
from robotdiffuse.scenes.packed_scenes import PackedScenes


@pytest.mark.parametrize("name", oracles.ROBOTS)
def test_clearances_are_exact(name: str) -> None:
    robot = oracles.with_spheres(name)
    scene = oracles.solids()
    checker = CollisionChecker(robot, scene)
    q = oracles.rows(robot, 150)
    right = oracles.link_distances(robot, scene, q)
    assert checker.link_clearances(q).shape == (150, len(checker.links))
    np.testing.assert_allclose(checker.link_clearances(q), right, atol=oracles.TOLERANCE)
    np.testing.assert_allclose(checker.link_clearances(q, limit=0.1), np.minimum(right, 0.1), atol=oracles.TOLERANCE)
    assert checker.pairs == robot.checked_pairs()
    np.testing.assert_allclose(checker.pair_clearances(q), oracles.pair_distances(robot, q), atol=oracles.TOLERANCE)


def free_padded(robot: rd.Robot, scene: rd.Scene, q: ndarray, padding: float) -> ndarray:
    checker = CollisionChecker(robot, scene)
    return free_many(checker.robot_arrays, checker.scene_arrays, q.astype(np.float32), np.float32(padding))


def check_free(robot: rd.Robot, scene: rd.Scene, q: ndarray, padding: float = 0.0) -> None:
    """Asserts that the check agrees with the sign of the oracles' smallest distances, and that both signs occur."""
    to_scene = oracles.link_distances(robot, scene, q).min(axis=1) - padding
    least = np.minimum(to_scene, oracles.pair_distances(robot, q).min(axis=1, initial=1))
    clear = np.abs(least) > oracles.TOLERANCE
    free = free_padded(robot, scene, q, padding)
    np.testing.assert_array_equal(free[clear], (least > 0)[clear])
    assert 0 < free.mean() < 1


@pytest.mark.parametrize("name", oracles.ROBOTS)
@pytest.mark.parametrize("padding", [0.0, 0.05])
def test_free_is_the_sign_of_the_clearance(name: str, padding: float) -> None:
    robot = oracles.with_spheres(name)
    check_free(robot, oracles.solids(), oracles.rows(robot, 500, seed=1), padding)


@given(kind=st.sampled_from(["sphere", "box", "cylinder", "capsule", "cloud"]), seed=st.integers(0, 2**32))
def test_every_shape_at_any_pose(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = rd.Scene([oracles.random_shape(kind, rng), oracles.random_shape(kind, rng)])
    q = rng.uniform(PANDA.lower, PANDA.upper, (33, PANDA.dof))
    checker = CollisionChecker(PANDA, scene)
    right = oracles.link_distances(PANDA, scene, q)
    found = checker.link_clearances(q)
    hit = (right < 0).any(axis=1) | (oracles.pair_distances(PANDA, q) < 0).any(axis=1)
    if kind == "cloud":
        # joined points reach further, by less than the diagonal of a thinning voxel
        radius = max(shape.point_radius for shape in scene.shapes if isinstance(shape, rd.PointCloud))
        blur = np.sqrt(3) * THINNING * radius
        near = right < 0.1
        assert (found <= right + oracles.TOLERANCE).all()
        assert (found[near] >= right[near] - blur - oracles.TOLERANCE).all() and not checker.free(q)[hit].any()
    else:
        np.testing.assert_allclose(found, right, atol=oracles.TOLERANCE)
        clear = np.abs(right).min(axis=1) > oracles.TOLERANCE
        np.testing.assert_array_equal(checker.free(q)[clear], np.logical_not(hit)[clear])


@pytest.mark.parametrize("count", [15, 16, 17, 70])
def test_any_number_of_obstacles(count: int) -> None:
    """Obstacles are processed in groups of sixteen."""
    rng = np.random.default_rng(count)
    shapes = [oracles.random_shape(("sphere", "box", "cylinder", "capsule")[i % 4], rng) for i in range(count)]
    far = [shape for shape in shapes if np.linalg.norm(shape.center) > 0.6]  # type: ignore[attr-defined]
    check_free(PANDA, rd.Scene(far), oracles.rows(PANDA, 600))


@pytest.mark.parametrize("count", [16, 17, 50])
def test_links_with_any_number_of_spheres(count: int) -> None:
    """Links with many spheres are divided into rows, each with its own bounding sphere."""
    arm = oracles.with_spheres("ur5")
    rng = np.random.default_rng(count)
    lowest, highest = [-0.06, -0.06, -0.06, 0.002], [0.06, 0.06, 0.06, 0.01]
    robot = replace(arm, spheres={link: rng.uniform(lowest, highest, (count, 4)) for link in arm.spheres})
    check_free(robot, oracles.solids(), oracles.rows(robot, 200, seed=2))
    check_free(robot, rd.Scene(), oracles.rows(robot, 200, seed=2))


def test_configurations_beyond_the_limits() -> None:
    """The tables of pairs of links do not cover these configurations, so the spheres decide."""
    check_free(PANDA, rd.Scene(), np.random.default_rng(0).uniform(2 * PANDA.lower, 2 * PANDA.upper, (4000, PANDA.dof)))


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17])
def test_any_number_of_configurations(count: int) -> None:
    checker = CollisionChecker(PANDA, oracles.solids())
    q = oracles.rows(PANDA, 17)
    np.testing.assert_array_equal(checker.free(q[:count]), checker.free(q)[:count])
    np.testing.assert_array_equal(checker.link_clearances(q[:count]), checker.link_clearances(q)[:count])
    assert checker.cost_gradients(q[:count], 0.05)[1].shape == (count, PANDA.dof)


@pytest.mark.parametrize("seed", range(4))
def test_free_by_spheres_is_free_by_mesh(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = (ROP if seed < 1 else ROP_DENSE).scene(rng, base_spheres(PANDA))
    shapes = [oracles.random_shape(kind, rng) for kind in ("cylinder", "capsule", "box", "cloud")]
    scene = rd.Scene([*scene.shapes, *shapes[: seed % 5]])
    q = rng.uniform(PANDA.lower, PANDA.upper, (600, PANDA.dof))
    free = CollisionChecker(PANDA, scene).free(q)
    assert not ExactCollision(PANDA, scene).collides(q[free]).any()
    # a cover that sticks out by a centimeter or two cannot refuse much more than this
    assert (~free & ~ExactCollision(PANDA, scene).collides(q)).mean() < 0.1


def test_locked_fingers_change_the_result() -> None:
    wide = PANDA.with_locked({"panda_finger_joint1": 0.065, "panda_finger_joint2": 0.065})
    scene = oracles.solids()
    q = oracles.rows(PANDA, 5000)
    one, other = (CollisionChecker(r, scene) for r in (PANDA, wide))
    right = oracles.link_distances(wide, scene, q[:50])
    np.testing.assert_allclose(other.link_clearances(q[:50]), right, atol=oracles.TOLERANCE)
    assert (one.free(q) != other.free(q)).any()


@pytest.mark.parametrize("size", [2.0, 1e3, 9.9e3])
def test_a_huge_floor_is_as_exact_as_a_small_one(size: float) -> None:
    q = oracles.rows(PANDA, 400)
    scene = rd.Scene([rd.Box((0.3, 0.1, -size / 2 - 0.05), (size + 4, size + 4, size))])
    lowest = [(c[..., 2] - r).min(axis=1) for c, r in zip(*oracles.sphere_centers(PANDA, q), strict=True)]
    right = np.stack(lowest[1:], axis=1) + 0.05
    np.testing.assert_allclose(CollisionChecker(PANDA, scene).link_clearances(q), np.minimum(right, 1), atol=3e-5)


def test_long_poles_keep_their_precision() -> None:
    q = oracles.rows(PANDA, 200)
    for make in (rd.Cylinder, rd.Capsule):
        short, long = (CollisionChecker(PANDA, rd.Scene([make((0.4, 0.3, 0.2), 0.05, h)])) for h in (6.0, 1e4))
        np.testing.assert_allclose(long.link_clearances(q), short.link_clearances(q), atol=oracles.TOLERANCE)


def test_a_robot_without_spheres_is_free() -> None:
    robot = replace(box_arm(), spheres={})
    checker = CollisionChecker(robot, rd.Scene([rd.Sphere((0, 0, 0), 5.0), rd.PointCloud([[0.0, 0, 0]])]))
    q = oracles.rows(robot, 5)
    assert checker.links == checker.pairs == ()
    assert checker.free(q).all() and (oracles.least_clearance(checker, q) == 1).all()
    assert not any(found.any() for found in checker.cost_gradients(q, 0.05))


def test_links_without_spheres_are_left_out_and_fixed_ones_do_not_count_against_the_scene() -> None:
    arm = box_arm()
    checker = CollisionChecker(replace(arm, spheres={"l1": arm.spheres["l1"], "l3": np.zeros((0, 4))}), rd.Scene())
    assert checker.links == ("l1",) and checker.pairs == () and checker.free(np.zeros((1, 3)))[0]
    checker = CollisionChecker(arm.with_locked({"j0": 0.0}), rd.Scene([rd.Sphere((0.2, 0, 0), 0.1)]))
    assert checker.links == ("l2", "l3") and checker.free(np.zeros((1, 2)))[0]


def test_wrong_configurations_are_refused() -> None:
    checker = CollisionChecker(box_arm(), rd.Scene())
    for call in (checker.free, checker.link_clearances, checker.pair_clearances):
        refuses("q has 4 columns; it must have the 3 planned joints", call, np.zeros((2, 4)))
        refuses("not finite", call, np.array([[0.0, np.nan, 0.0]]))


def test_adding_an_obstacle_compiles_nothing() -> None:
    q = oracles.rows(PANDA, 20)
    compiled = []
    mesh = rd.Mesh(*oracles.box_triangles((0.2, 0.2, 0.2)))
    many = [shape for shape in oracles.solids().shapes for _ in range(3)]  # rows of several
    for shapes in ([], many, [*oracles.solids().shapes, rd.PointCloud([[0.5, 0.5, 0.5]]), mesh]):
        checker = CollisionChecker(PANDA, rd.Scene(shapes))
        checker.free(q)
        oracles.least_clearance(checker, q)
        checker.cost_gradients(q, 0.05)
        compiled.append([len(f.signatures) for f in (free_many, block_hits, block_clearances, motion_free)])
    assert compiled[0] == compiled[1] == compiled[2]


def cost(robot: rd.Robot, scene: rd.Scene, q: ndarray, margin: float, self_margin: float) -> ndarray:
    """The squared hinge loss over all spheres and pairs of spheres, computed by the oracles."""
    index = {link: i for i, link in enumerate(robot_groups(robot))}
    centers, radii = oracles.sphere_centers(robot, q)
    total = np.zeros(len(q))
    for link, i in index.items():
        if robot.link_frame(link) > 0:
            nearest = np.min([oracles.distance(shape, centers[i]) for shape in scene.shapes], axis=0) - radii[i]
            total += 0.5 * (np.maximum(margin - nearest, 0) ** 2).sum(axis=1)
    for a, b in ((index[a], index[b]) for a, b in robot.checked_pairs()):
        gap = np.linalg.norm(centers[a][:, :, None] - centers[b][:, None], axis=-1)
        gap -= radii[a][:, None] + radii[b]
        total += 0.5 * (np.maximum(self_margin - gap, 0) ** 2).sum(axis=(1, 2))
    return total


@pytest.mark.parametrize("name", oracles.ROBOTS)
def test_cost_gradients_are_finite_differences(name: str) -> None:
    robot = oracles.with_spheres(name)
    scene = oracles.solids()
    step = 1e-6
    q = oracles.rows(robot, 60)
    costs, gradients = CollisionChecker(robot, scene).cost_gradients(q, 0.05, 0.02)
    np.testing.assert_allclose(costs, cost(robot, scene, q, 0.05, 0.02), rtol=1e-3, atol=1e-7)
    assert (costs > 0).any()
    for j in range(robot.dof):
        move = step * np.eye(robot.dof)[j]
        plus, minus = (cost(robot, scene, q + sign * move, 0.05, 0.02) for sign in (1, -1))
        slope = (plus - minus) / (2 * step)
        # deep inside a box the nearest face may change within the step: a kink, not an error
        assert (np.abs(gradients[:, j] - slope) > 2e-4 + 2e-3 * np.abs(slope)).mean() < 0.05


LIMIT = 0.4
MARGIN = 0.1


def test_inputs_are_the_same_in_training_and_planning() -> None:
    """In scenes of different size in one batch, whether or not gradients are computed too."""
    rng = np.random.default_rng(1)
    scenes = [family.scene(rng) for family in (ROP, ROP_DENSE, ROP_DENSE)]
    scenes.append(rd.Scene(scenes[0].shapes[:1]))
    packed = PackedScenes.pack(scenes, 12, floor=True)
    q = oracles.rows(PANDA, 60 * len(packed)).reshape(len(packed), 60, PANDA.dof).astype(np.float32)
    config = motion_model.MotionModelSettings(clearance_gradients=True)
    given = compile_robot(PANDA), packed, q, motion_model.MAX_CLEARANCE
    clearances, gradients = packed_clearances_and_gradients(*given, motion_model.GRADIENT_MARGIN)
    np.testing.assert_array_equal(clearances, packed_clearances_and_gradients(*given)[0])
    told = np.concatenate([clearances, gradients], axis=-1)
    for i, scene in enumerate(scenes):
        checker = CollisionChecker(PANDA, scene)
        np.testing.assert_allclose(motion_model.link_clearances(checker, config)(q[i : i + 1])[0], told[i], atol=1e-4)
        assert (gradients[i].any(axis=1) <= (clearances[i].min(axis=1) < motion_model.GRADIENT_MARGIN)).all()
    assert 0.3 < gradients.any(axis=-1).mean() < 0.9


def test_gradients_are_those_of_the_clearances() -> None:
    """Compares with automatic differentiation of the signed distance that training losses use."""
    q = oracles.rows(PANDA, 400)
    scene = rd.Scene(oracles.solids().shapes[:2])
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
    q = oracles.rows(PANDA, 600)
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
    assert free_padded(robot, scene, q, right - 0.001)[0]
    assert not free_padded(robot, scene, q, right + 0.001)[0]


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


def test_underflow_in_the_arrays_of_a_robot_is_harmless() -> None:
    """Regression: with `np.seterr(all="raise")`, a rounding error of 1e-20 m in the place of a held object was an error."""
    held = PANDA.attach(rd.Box([0, 0, 0.2], [0.1, 0.1, 0.15]), "panda_hand")
    with np.errstate(all="raise"):
        assert CollisionChecker(held, oracles.solids()).links
