"""Exact distances against closed forms, also for the shapes that Coal represents indirectly."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, strategies as st

import robotdiffuse as rd
from helpers.box_arm import HALF_WIDTH, box_arm
from helpers.example_robots import example_robot
from helpers.sphere_oracles import distance, solids
from robotdiffuse.collision.exact_meshes import ExactCollision, explain_collision, forward_frames

Q0 = np.zeros(3)
coordinate = st.floats(-1.5, 1.5)


def least(exact: ExactCollision, q: np.ndarray) -> float:
    return min(d.distance for d in (*exact.link_distances(q), *exact.pair_distances(q)))


@given(coordinate, coordinate, st.floats(-0.5, 0.5), st.floats(0.01, 0.4))
def test_box_links_against_a_sphere_in_closed_form(x: float, y: float, z: float, radius: float) -> None:
    exact = ExactCollision(box_arm(), rd.Scene([rd.Sphere((x, y, z), radius)]))
    lows = np.array([[start, -HALF_WIDTH, -HALF_WIDTH] for start in (0, 0.5, 0.9)])
    highs = np.array([[end, HALF_WIDTH, HALF_WIDTH] for end in (0.5, 0.9, 1.2)])
    for found, low, high in zip(exact.link_distances(Q0), lows, highs, strict=True):
        right = float(distance(rd.Box((low + high) / 2, high - low), np.array([x, y, z]))) - radius
        # 1e-5: EPA, which finds the depth in an iteration, is left at Coal's own tolerance.
        assert found.distance == pytest.approx(right, abs=1e-6 if right > 0 else 1e-5)


def test_links_without_meshes_are_their_spheres() -> None:
    """An arm that has one sphere at each link's origin instead of meshes."""
    spheres = {f"l{i}": np.array([[0.0, 0.0, 0.0, 0.04]]) for i in (1, 2, 3)}
    obstacles = [
        rd.Box((0.5, 0.5, 0), (0.2, 0.3, 2)),
        rd.Capsule((0.9, -0.4, 0), 0.1, 0.6),
        rd.Cylinder((-0.6, 0, 0), 0.2, 1.0, (np.sqrt(0.5), np.sqrt(0.5), 0, 0)),
    ]
    found = ExactCollision(replace(box_arm(), meshes={}, spheres=spheres), rd.Scene(obstacles)).link_distances(Q0)
    assert [one.other for one in found] == ["cylinder", "box", "capsule"]
    assert [one.distance for one in found] == pytest.approx([0.6 - 0.2 - 0.04, 0.35 - 0.04, 0.4 - 0.1 - 0.04])


def test_pairs_of_links() -> None:
    exact = ExactCollision(box_arm(), rd.Scene())
    assert exact.pairs == (("l1", "l3"),)
    (folded,) = exact.pair_distances(np.array([0.3, np.pi / 2, 0]))
    assert folded.distance == pytest.approx(0.4 - HALF_WIDTH, abs=1e-6)
    (crossing,) = exact.pair_distances(np.array([1.0, 2.6, 2.6]))
    assert crossing.distance < 0 and crossing.other == "l3"


def test_a_point_cloud_is_many_spheres() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, -0.2], [1, 1, 0.2], (200, 3))
    cloud = ExactCollision(box_arm(), rd.Scene([rd.PointCloud(points, 0.02)]))
    spheres = ExactCollision(box_arm(), rd.Scene([rd.Sphere(point, 0.02) for point in points]))
    configurations = rng.uniform(-2.5, 2.5, (60, 3))
    hit = spheres.collides(configurations)
    assert 0.1 < hit.mean() < 0.9
    np.testing.assert_array_equal(cloud.collides(configurations), hit)
    for q in configurations:
        for a, b in zip(cloud.link_distances(q), spheres.link_distances(q), strict=True):
            assert a.distance == pytest.approx(b.distance, abs=1e-6) if b.distance > 0 else a.distance <= 0


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.zeros((500, 3)), np.tile([0.0, 0.0, 1.0], (3, 1))])
def test_degenerate_point_clouds(points: np.ndarray) -> None:
    exact = ExactCollision(box_arm(), rd.Scene([rd.PointCloud(points + np.array([0.2, 0.5, 0]), 0.01)]))
    right = np.hypot(0.5 - HALF_WIDTH, max(points[0, 2] - HALF_WIDTH, 0)) - 0.01
    assert exact.link_distances(Q0)[0].distance == pytest.approx(right, abs=1e-6)


def test_a_link_deep_in_a_point_cloud_and_an_empty_cloud() -> None:
    points = np.stack([np.full(21, 0.25), np.linspace(-0.02, 0.02, 21), np.zeros(21)], axis=1)
    exact = ExactCollision(box_arm(), rd.Scene([rd.PointCloud(points, 0.01)]))
    assert exact.link_distances(Q0)[0].distance == pytest.approx(-HALF_WIDTH - 0.01, abs=1e-5)
    exact = ExactCollision(box_arm(), rd.Scene([rd.PointCloud(np.zeros((0, 3)))]))
    assert exact.link_distances(Q0)[0] == ("l1", None, np.inf)
    assert not exact.collides(np.zeros((2, 3))).any()


def test_equal_points_are_one() -> None:
    """Regression: 150,000 equal points took the validator 10 s, since Coal computed the distance of each."""
    two = np.array([[1.0, 0.12, 0.0], [-0.0, 0.5, 0.3]])
    cloud = rd.PointCloud(np.repeat(two, 500, axis=0) * 1.0, 0.01)
    assert np.array_equal(cloud.distinct_points, two)
    once, often = (ExactCollision(box_arm(), rd.Scene([one])) for one in (rd.PointCloud(two, 0.01), cloud))
    assert once.link_distances(Q0) == often.link_distances(Q0)


def test_a_mesh_is_its_surface() -> None:
    mesh = trimesh.creation.box((0.2, 0.3, 0.4)).subdivide()
    solid = rd.Box((0.6, 0.6, 0.1), (0.2, 0.3, 0.4), (0.9, 0.1, 0.3, 0.2))
    q = np.array([0.2, 0.1, 0.3])
    surface = rd.Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), solid.center, solid.wxyz)
    a, b = (ExactCollision(box_arm(), rd.Scene([shape])) for shape in (solid, surface))
    assert least(a, q) == pytest.approx(least(b, q), abs=1e-6)
    rows = np.random.default_rng(1).uniform(-2.5, 2.5, (300, 3))
    np.testing.assert_array_equal(a.collides(rows), b.collides(rows))
    assert 0 < a.collides(rows).mean() < 1


def test_nearest_honors_cutoffs_and_stops() -> None:
    exact = ExactCollision(box_arm(), rd.Scene([rd.Sphere((0.2, 0.5, 0), 0.1)]))
    distances, names = exact.nearest(np.zeros((4, 3)), np.array([0, 0, 2, 0]), np.array([1.0, 0.2, 1.0, 1.0]), stop=0.3)
    assert distances[0] == pytest.approx(0.4 - HALF_WIDTH) and distances[1] == 0.2
    assert np.isnan(distances[2:]).all() and names == ["sphere", None, None, None]


def test_frames_agree_with_the_kinematics() -> None:
    robot = example_robot("awkward")
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (5, robot.dof))
    frames = forward_frames(robot, q)
    for i in range(5):
        T = frames[i, robot.link_frame("tool")] @ robot.T_frame_link("tool")
        np.testing.assert_allclose(T, robot.fk(q[i], "tool"), atol=1e-12)


def test_collides_is_the_sign_of_the_distance() -> None:
    robot = box_arm()
    exact = ExactCollision(robot, solids())
    q = np.random.default_rng(3).uniform(robot.lower, robot.upper, (200, 3))
    np.testing.assert_array_equal(exact.collides(q), [least(exact, row) <= 0 for row in q])
    assert exact.collides(np.zeros((0, 3))).shape == (0,)


def test_collisions_are_explained() -> None:
    for shapes, wanted in (
        ([rd.Sphere((0, 1, 0), 0.1), rd.Sphere((0.25, 0.1, 0), 0.1)], "l1 is 3.0 cm inside sphere_2"),
        ([rd.Sphere((0.25, 0.1275, 0), 0.1)], "l1 is 2.5 mm inside sphere"),
        ([], None),
    ):
        assert explain_collision(box_arm(), rd.Scene(shapes), Q0) == wanted
    crossing = explain_collision(box_arm(), rd.Scene(), np.array([1.0, 2.6, 2.6]))
    assert crossing is not None and crossing.startswith("l1 and l3 overlap by ")


def test_fixed_links_do_not_count_against_the_scene() -> None:
    exact = ExactCollision(box_arm().with_locked({"j0": 0.0}), rd.Scene([rd.Sphere((0.2, 0, 0), 0.1)]))
    assert exact.links == ("l2", "l3") and not exact.collides(np.zeros((1, 2)))[0]
