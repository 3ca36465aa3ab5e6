"""Exact distances against closed forms; grazing links: where the convex parts of two links touch, their meshes decide."""

import errno
from dataclasses import replace
from functools import cache
from pathlib import Path
from unittest.mock import DEFAULT, MagicMock, Mock

import numpy as np
import pytest
import trimesh
from hypothesis import given, strategies as st

import robotdiffuse as rd
from helpers.box_arm import HALF_WIDTH, box_arm, boxes, surface
from helpers.example_robots import example_robot, planar_arm
from helpers.refusals import refuses
from helpers.sphere_oracles import distance, solids
from robotdiffuse.collision.exact_meshes import ExactCollision, explain_collision, forward_frames
from robotdiffuse.robots import robot_folder
from robotdiffuse.robots.fitting.convex_parts import convex_hull
from robotdiffuse.robots.fitting.covering_spheres import cover
from robotdiffuse.robots.robot_folder import SURFACE_FILE, read_robot_folder, write_robot_folder

Q0 = np.zeros(3)
coordinate = st.floats(-1.5, 1.5)


def least(exact: ExactCollision, q: np.ndarray) -> float:
    return min(d.distance for d in exact.distances(q))


@given(coordinate, coordinate, st.floats(-0.5, 0.5), st.floats(0.01, 0.4))
def test_box_links_against_a_sphere_in_closed_form(x: float, y: float, z: float, radius: float) -> None:
    exact = ExactCollision(box_arm(), rd.Scene([rd.Sphere((x, y, z), radius)]))
    lows = np.array([[start, -HALF_WIDTH, -HALF_WIDTH] for start in (0, 0.5, 0.9)])
    highs = np.array([[end, HALF_WIDTH, HALF_WIDTH] for end in (0.5, 0.9, 1.2)])
    for found, low, high in zip(exact.distances(Q0)[:3], lows, highs, strict=True):
        right = float(distance(rd.Box((low + high) / 2, high - low), np.array([x, y, z]))) - radius
        # 1e-5: EPA, which finds the depth in an iteration, is left at Coal's own tolerance.
        assert found.distance == pytest.approx(right, abs=1e-6 if right > 0 else 1e-5)


def test_links_without_meshes_are_their_spheres() -> None:
    spheres = {f"l{i}": np.array([[0.0, 0.0, 0.0, 0.04]]) for i in (1, 2, 3)}
    obstacles = [
        rd.Box((0.5, 0.5, 0), (0.2, 0.3, 2)),
        rd.Capsule((0.9, -0.4, 0), 0.1, 0.6),
        rd.Cylinder((-0.6, 0, 0), 0.2, 1.0, (np.sqrt(0.5), np.sqrt(0.5), 0, 0)),
    ]
    found = ExactCollision(replace(box_arm(), meshes={}, spheres=spheres), rd.Scene(obstacles)).distances(Q0)[:3]
    assert [one.other for one in found] == ["cylinder", "box", "capsule"]
    assert [one.distance for one in found] == pytest.approx([0.6 - 0.2 - 0.04, 0.35 - 0.04, 0.4 - 0.1 - 0.04])


def test_pairs_of_links() -> None:
    exact = ExactCollision(box_arm(), rd.Scene())
    assert [check for check in exact.checks if check.other] == [("l1", "l3")]
    folded = exact.distances(np.array([0.3, np.pi / 2, 0]))[-1]
    assert folded.distance == pytest.approx(0.4 - HALF_WIDTH, abs=1e-6)
    crossing = exact.distances(np.array([1.0, 2.6, 2.6]))[-1]
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
        for a, b in zip(cloud.distances(q)[:3], spheres.distances(q)[:3], strict=True):
            assert a.distance == pytest.approx(b.distance, abs=1e-6) if b.distance > 0 else a.distance <= 0


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.zeros((500, 3)), np.tile([0.0, 0.0, 1.0], (3, 1))])
def test_degenerate_point_clouds(points: np.ndarray) -> None:
    exact = ExactCollision(box_arm(), rd.Scene([rd.PointCloud(points + np.array([0.2, 0.5, 0]), 0.01)]))
    right = np.hypot(0.5 - HALF_WIDTH, max(points[0, 2] - HALF_WIDTH, 0)) - 0.01
    assert exact.distances(Q0)[0].distance == pytest.approx(right, abs=1e-6)


def test_a_link_deep_in_a_point_cloud_and_an_empty_cloud() -> None:
    points = np.stack([np.full(21, 0.25), np.linspace(-0.02, 0.02, 21), np.zeros(21)], axis=1)
    exact = ExactCollision(box_arm(), rd.Scene([rd.PointCloud(points, 0.01)]))
    assert exact.distances(Q0)[0].distance == pytest.approx(-HALF_WIDTH - 0.01, abs=1e-5)
    exact = ExactCollision(box_arm(), rd.Scene([rd.PointCloud(np.zeros((0, 3)))]))
    assert exact.distances(Q0)[0] == ("l1", None, np.inf)
    assert not exact.collides(np.zeros((2, 3))).any()


def test_equal_points_are_one() -> None:
    """Regression: 150,000 equal points took the validator 10 s, since Coal computed the distance of each."""
    two = np.array([[1.0, 0.12, 0.0], [-0.0, 0.5, 0.3]])
    cloud = rd.PointCloud(np.repeat(two, 500, axis=0) * 1.0, 0.01)
    assert np.array_equal(cloud.distinct_points, two)
    once, often = (ExactCollision(box_arm(), rd.Scene([one])) for one in (rd.PointCloud(two, 0.01), cloud))
    assert once.distances(Q0) == often.distances(Q0)


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
    assert [check.link for check in exact.checks if check.other is None] == ["l2", "l3"]
    assert not exact.collides(np.zeros((1, 2)))[0]


TURN = 0.6
BESIDE = np.array([TURN, -TURN])
"""The second link is parallel to the wall, with a gap of GAP between the meshes."""
GAP = 0.001
LIP = 0.003
EMPTY = rd.Scene(())


def arm(wall: trimesh.Trimesh, link: trimesh.Trimesh, grazing: bool = True) -> rd.Robot:
    """Two joints about z, 0.5 m apart; the wall is fixed to the base. One convex part per link."""
    robot = planar_arm(0.5, 0.3)
    surfaces = {"l0": surface(wall), "l2": surface(link)}
    meshes = {name: (convex_hull(of.vertices),) for name, of in surfaces.items()}
    limits = {"lower": -2.8, "upper": 2.8, "velocity": 2.0, "acceleration": 8.0, "jerk": 80.0}
    return replace(
        robot,
        joints=tuple(j if j.kind == "fixed" else replace(j, **limits) for j in robot.joints),
        meshes=meshes,
        spheres={name: cover(mesh) for name, (mesh,) in meshes.items()},
        surfaces=surfaces if grazing else {},
        grazing=frozenset({frozenset(surfaces)} if grazing else ()),
    )


@cache
def channel(grazing: bool = True) -> rd.Robot:
    """A plate with a lip of height LIP at each end. Its convex part also fills the hollow between the lips."""
    y = 0.5 * np.sin(TURN) + 0.02 + GAP
    plate = ((-0.6, y, -0.05), (0.9, y + 0.02, 0.05))
    lips = (((x, y - LIP, -0.05), (x + 0.02, y + 0.02, 0.05)) for x in (-0.62, 0.9))
    return arm(boxes(plate, *lips), boxes(((0.0, -0.02, -0.02), (0.3, 0.02, 0.02))), grazing)


def closer(gap: float) -> np.ndarray:
    """A configuration like BESIDE with another gap [m]."""
    turn = np.arcsin(np.sin(TURN) + (GAP - gap) / 0.5)
    return np.array([turn, -turn])


def between_links(robot: rd.Robot, q: np.ndarray) -> float:
    return ExactCollision(robot, EMPTY).distances(q)[-1].distance


@pytest.mark.parametrize("gap", [0.0002, 0.001, 0.0025, 0.0045])
def test_the_distance_of_grazing_links_is_that_of_their_meshes(gap: float) -> None:
    assert between_links(channel(False), closer(gap)) == pytest.approx(gap - LIP, abs=1e-6)
    assert between_links(channel(), closer(gap)) == pytest.approx(gap, abs=1e-6)
    assert ExactCollision(channel(), EMPTY).collides(closer(gap)[None]).tolist() == [False]


def test_meshes_that_touch_collide() -> None:
    q = closer(-0.0005)
    as_deep_as_convex_parts = -0.0005 - LIP
    assert between_links(channel(), q) == pytest.approx(as_deep_as_convex_parts, abs=1e-5)
    assert ExactCollision(channel(), EMPTY).collides(q[None]).tolist() == [True]
    assert explain_collision(channel(), EMPTY, q) is not None
    problem = rd.Problem(channel(), EMPTY, q, rd.JointGoal(np.zeros((1, 2))))
    assert rd.load_planner("rrt_connect").plan(problem, time_limit=5.0).status == rd.Status.INVALID_START
    assert not rd.verify(problem, rd.Path(channel().joint_names, np.stack([np.zeros(2), q]))).valid


def test_a_body_inside_another_and_deep_overlaps_of_convex_parts_collide() -> None:
    y = 0.5 * np.sin(TURN)
    wall = boxes(((-0.6, y - 0.003, -0.05), (0.9, y + 0.003, 0.05)))
    pin = boxes(((0.1, -0.001, -0.001), (0.102, 0.001, 0.001)))
    assert between_links(arm(wall, pin), BESIDE) == pytest.approx(-0.004, abs=1e-5)
    assert explain_collision(arm(wall, pin), EMPTY, BESIDE) == "l0 and l2 overlap by 4.0 mm"
    y = 0.5 * np.sin(TURN) + 0.02 + GAP
    deep = boxes(*(((x, y - 0.01, -0.05), (x + 0.02, y + 0.02, 0.05)) for x in (-0.62, 0.9)))
    assert between_links(arm(deep, boxes(((0.0, -0.02, -0.02), (0.3, 0.02, 0.02)))), BESIDE) < -0.005


@pytest.mark.parametrize("turned", [False, True])
def test_motions_out_of_and_into_grazing_are_planned_and_certified(turned: bool) -> None:
    ends = [BESIDE, np.array([-0.5, 0.3])]
    start, goal = ends[::-1] if turned else ends
    refused = rd.Problem(channel(False), EMPTY, start, rd.JointGoal(goal[None]))
    assert not rd.load_planner("rrt_connect").plan(refused, time_limit=5.0).solved
    problem = rd.Problem(channel(), EMPTY, start, rd.JointGoal(goal[None]))
    result = rd.load_planner("rrt_connect").plan(problem, time_limit=30.0)
    assert result.solved, result.reason
    report = rd.verify(problem, result.path)
    assert report.valid and report.self_clearance is not None and 0 < report.self_clearance <= GAP


def test_a_motion_within_grazing_is_certified_or_refused_as_the_meshes_are() -> None:
    """Start and goal are free in both motions; the second motion pushes the link into the wall on its way."""
    robot = channel()
    problem = rd.Problem(robot, EMPTY, closer(0.0005), rd.JointGoal(closer(0.004)[None]))
    along = np.stack([closer(0.0005), closer(0.0015), closer(0.004), [0.0, 0.0]])
    assert rd.verify(problem, rd.Path(robot.joint_names, along[:3])).valid
    mirrored = np.array([np.pi - TURN, TURN - np.pi])  # over the middle the arm reaches beyond the wall
    assert rd.verify(problem, rd.Path(robot.joint_names, np.stack([closer(0.0005), mirrored]))).violation is not None


def test_proofs_refuse_grazing_and_name_the_pair() -> None:
    problem = rd.Problem(channel(), EMPTY, BESIDE, rd.JointGoal(np.zeros((1, 2))))
    path = rd.Path(channel().joint_names, np.stack([BESIDE, np.zeros(2)]))
    assert rd.verify(problem, path).valid
    refuses("the exact surfaces of l2 and l0 are apart, but", rd.certify, problem, path)


def test_folders_keep_the_surfaces_and_refuse_those_of_other_meshes(tmp_path: Path) -> None:
    write_robot_folder(channel(), tmp_path, {})
    kept = read_robot_folder(tmp_path)
    assert kept.grazing == channel().grazing
    for link, written in channel().surfaces.items():
        np.testing.assert_allclose(kept.surfaces[link].vertices, written.vertices, atol=1e-7)
        np.testing.assert_array_equal(kept.surfaces[link].faces, written.faces)
    packed = (tmp_path / SURFACE_FILE).read_bytes()
    write_robot_folder(channel(False), tmp_path, {})
    assert not (tmp_path / SURFACE_FILE).exists() and not read_robot_folder(tmp_path).grazing
    other = replace(channel(False), meshes={"l0": channel().meshes["l2"], "l2": channel().meshes["l0"]})
    write_robot_folder(other, tmp_path, {})
    (tmp_path / SURFACE_FILE).write_bytes(packed)
    refuses(SURFACE_FILE, read_robot_folder, tmp_path)


def test_a_folder_without_its_surfaces_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regressions: robot.json was written first, so that after a full disk or a kill the arm was read without surfaces; later,
    a full disk removed an earlier robot."""
    full = OSError(errno.ENOSPC, "full")
    write_robot_folder(channel(False), tmp_path, {})
    monkeypatch.setattr(robot_folder, "TemporaryFile", MagicMock(side_effect=[full, DEFAULT]))
    monkeypatch.setattr(robot_folder, "write_atomically", Mock(side_effect=[None, full]))
    refuses("cannot be written: full", write_robot_folder, channel(), tmp_path, {})
    assert not read_robot_folder(tmp_path).grazing
    refuses("cannot be written: full", write_robot_folder, channel(), tmp_path, {})
    refuses("robot.json", read_robot_folder, tmp_path)


def test_baxters_torso_and_arms_graze_as_trimesh_finds_too() -> None:
    robot = rd.load_robot("baxter_left")
    q = np.array([-1.5766, -0.088, -0.5168, 1.6863, -2.2078, -0.4002, 1.5902])
    links = ("torso", "left_lower_forearm")
    assert explain_collision(robot, EMPTY, q) is None
    assert explain_collision(replace(robot, surfaces={}, grazing=frozenset()), EMPTY, q) is not None
    [found] = [d for d in ExactCollision(robot, EMPTY).distances(q) if {d.link, d.other} == {*links}]
    meshes = []
    for each in links:
        T = robot.fk(q, each)
        of = robot.surfaces[each]
        meshes.append(trimesh.Trimesh(of.vertices @ T[:3, :3].T + T[:3, 3], of.faces, process=False))
    nearest = []
    for one, other in (meshes, meshes[::-1]):
        points = np.concatenate([one.vertices, trimesh.sample.sample_surface(one, 3000, seed=0)[0]])
        nearest.append(trimesh.proximity.closest_point(other, points)[1].min())
    # of points on a surface: never nearer than the surfaces are, and about as near
    assert found.distance - 1e-7 <= min(nearest) <= found.distance + 0.0005
