"""PyBullet, which shares no code with ours, must agree with Coal and with the validator."""

import numpy as np
import pytest
import trimesh

pytest.importorskip("pybullet")

from dataclasses import replace
from itertools import combinations

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.example_robots import example_robot
from helpers.sphere_oracles import solids
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.simulation import PyBulletOracle
from robotdiffuse.simulation.world import World

pytestmark = pytest.mark.sim
TOLERANCE = 7e-4
"""Most distances agree to 5e-6 m; Bullet rounds the edges of its boxes and cylinders by up to 0.6 mm."""


def every_shape() -> rd.Scene:
    torus = trimesh.creation.torus(0.2, 0.05, major_sections=16, minor_sections=8)
    mesh = rd.Mesh(torus.vertices.view(np.ndarray), torus.faces, (-0.3, 0.4, 0.7), (0.5, 0.1, 0.2, 0.9))
    return rd.Scene([*solids().shapes, mesh])


def far_pairs_only(robot: rd.Robot) -> rd.Robot:
    """The robot with allowed contact between links that are at most two joints apart."""
    pairs = combinations(robot.meshes, 2)
    near = [frozenset(p) for p in pairs if abs(robot.link_frame(p[0]) - robot.link_frame(p[1])) <= 2]
    return replace(robot, allowed_collisions=frozenset(near))


@pytest.mark.parametrize(
    ("name", "locked"), [("panda", {}), ("xarm7", {}), ("panda", {"panda_joint2": 0.7, "panda_finger_joint1": 0.065})]
)
def test_distances_agree_with_coal(name: str, locked: dict[str, float]) -> None:
    robot = far_pairs_only(example_robot(name).with_locked(locked))
    scene = solids()
    exact = ExactCollision(robot, scene)
    with PyBulletOracle(robot, scene) as oracle:
        for q in np.random.default_rng(0).uniform(robot.lower, robot.upper, (40, robot.dof)):
            right = min(d.distance for d in (*exact.link_distances(q), *exact.pair_distances(q)))
            assert oracle.distance(q) == pytest.approx(right, abs=TOLERANCE)


def test_collisions_agree_with_coal_meshes_included() -> None:
    robot = far_pairs_only(example_robot("panda"))
    scene = every_shape()
    exact = ExactCollision(robot, scene)
    rng = np.random.default_rng(1)
    q = rng.uniform(robot.lower, robot.upper, (150, robot.dof))
    hits = exact.collides(q)
    assert 0.2 < hits.mean() < 0.8
    with PyBulletOracle(robot, scene) as oracle:
        for row, hit in zip(q, hits, strict=True):
            assert oracle.collides(row, -TOLERANCE) or not hit
            assert not oracle.collides(row, TOLERANCE) or hit


def test_paths_that_the_validator_accepts_or_refuses() -> None:
    robot = box_arm()
    rng = np.random.default_rng(5)
    scene = rd.Scene([rd.Sphere((0.7, 0.5, 0), 0.15), rd.Box((-0.5, -0.4, 0), (0.1, 0.2, 0.3))])
    verdicts = []
    with PyBulletOracle(robot, scene) as oracle:
        for _ in range(30):
            rows = rng.uniform(-1.5, 1.5, (1, 3)) + rng.uniform(-0.7, 0.7, (3, 3))
            path = rd.Path(robot.joint_names, rows)
            report = rd.verify(rd.Problem(robot, scene, rows[0], rd.JointGoal(rows[-1:])), path)
            found = oracle.check_path(path)
            verdicts.append(report.valid)
            if report.valid:
                assert found is None
                continue
            assert report.violation is not None and report.violation.excess is not None
            if found is None:
                assert report.violation.excess < 0.01
            else:
                assert found.other == report.violation.other
                assert found.at == pytest.approx(report.violation.time, abs=0.05)
    assert 5 < sum(verdicts) < 25


def test_a_single_waypoint_is_checked() -> None:
    robot = box_arm()
    with PyBulletOracle(robot, rd.Scene([rd.Sphere((1.2, 0, 0), 0.1)])) as oracle:
        found = oracle.check_path(rd.Path(robot.joint_names, np.zeros((1, 3))))
        with pytest.raises(rd.InputError, match=r"tolerance is -0\.1; it must not be negative"):
            oracle.check_frames(np.zeros((1, 3)), -0.1)
    assert found is not None and (found.link, found.other, found.at) == ("l3", "sphere", 0.0)
    assert found.distance == pytest.approx(-0.1, abs=0.001)


def test_scenes_are_replaced_and_the_robot_stays() -> None:
    ball = rd.Sphere((1.2, 0, 0), 0.1)
    clouds = [rd.PointCloud(np.zeros((0, 3))), rd.PointCloud(np.array([[1.2, 0, 0]]))]
    with PyBulletOracle(box_arm(), rd.Scene([rd.Box((0, 1, 0), (1, 0.1, 1))])) as oracle:
        for shapes, hit in ([ball], "sphere"), ([], None), ([ball], "sphere"), (clouds, "point_cloud_2"):
            oracle.set_scene(rd.Scene(shapes))
            found = oracle.check_frames(np.zeros((1, 3)))
            assert (found and found.other) == hit


def test_obstacles_at_links_that_do_not_move_are_nothing() -> None:
    robot = far_pairs_only(example_robot("panda"))
    q = np.array([[0, -0.785, 0, -2.356, 0, 1.571, 0.785]])
    with PyBulletOracle(robot, rd.Scene([rd.Box((0, 0, -0.05), (2, 2, 0.12), name="floor")])) as oracle:
        assert oracle.check_frames(q) is None and oracle.nearest(q[0], 0.0) is None


def test_point_clouds_agree_with_coal() -> None:
    robot = far_pairs_only(example_robot("panda"))
    rng = np.random.default_rng(4)
    ball = rng.normal(size=(400, 3))
    points = (0.4, 0.2, 0.5) + 0.25 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    scene = rd.Scene([rd.PointCloud(points, 0.02)])
    exact = ExactCollision(robot, scene)
    q = rng.uniform(robot.lower, robot.upper, (40, robot.dof))
    with PyBulletOracle(robot, scene) as oracle:
        for row in q:
            right = min(d.distance for d in (*exact.link_distances(row), *exact.pair_distances(row)))
            if right > 0:
                assert oracle.distance(row) == pytest.approx(right, abs=TOLERANCE)
            if abs(right) > TOLERANCE:
                assert (oracle.check_frames(row[None], 0.0) is not None) == (right < 0)


def test_a_mesh_that_comes_again_takes_no_memory_again() -> None:
    """PyBullet keeps 0.15 kB for each triangle of a mesh, even after the mesh's body is removed."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    panda = rd.load_robot("panda")
    home = np.zeros(7)
    with World(panda, rd.Scene([])) as world, PyBulletOracle(panda, rd.Scene([])) as oracle:
        for x in (0.6, 0.8, 0.6):
            scene = rd.Scene([rd.Mesh(ball.vertices, ball.faces, xyz=(x, 0.0, 0.4))])
            world.set_scene(scene)
            oracle.set_scene(scene)
            assert len(world.mesh_shapes) == 1
            with PyBulletOracle(panda, scene) as fresh:
                assert oracle.distance(home) == pytest.approx(fresh.distance(home), abs=1e-9)
        world.set_scene(rd.Scene([rd.Mesh(1.1 * ball.vertices, ball.faces)]))
        assert len(world.mesh_shapes) == 2
