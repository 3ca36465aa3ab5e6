"""PyBullet, which shares no code with ours, must agree with Coal and with the validator."""

import numpy as np
import pytest
import trimesh

pytest.importorskip("pybullet")

from dataclasses import replace

from helpers.box_arm import box_arm
from helpers.example_robots import example_robot
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Path
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Mesh, PointCloud, Sphere
from robotdiffuse.simulation import PyBulletOracle
from robotdiffuse.simulation.world import World
from robotdiffuse.validation.validator import verify

pytestmark = pytest.mark.sim
TOLERANCE = 7e-4
"""Most distances agree to 5e-6 m; Bullet rounds the edges of its boxes and cylinders by up to 0.6 mm."""


def vector(*values: float) -> np.ndarray:
    return np.array(values, float)


def every_shape() -> Scene:
    torus = trimesh.creation.torus(0.2, 0.05, major_sections=16, minor_sections=8)
    return Scene(
        [
            Sphere(vector(0.5, 0.3, 0.6), 0.25),
            Box(vector(0, 0.6, 0.4), vector(0.2, 0.3, 0.2), vector(0.9, 0.1, 0.3, 0.1)),
            Cylinder(vector(0.4, -0.3, 0.2), 0.05, 0.4, vector(0.9, 0.3, 0, 0.1)),
            Capsule(vector(-0.4, -0.3, 0.5), 0.05, 0.4, vector(0.9, 0.3, 0.5, 0.1)),
            Mesh(
                np.asarray(torus.vertices),
                np.asarray(torus.faces),
                vector(-0.3, 0.4, 0.7),
                vector(0.5, 0.1, 0.2, 0.9),
            ),
        ]
    )


def far_pairs_only(robot: Robot) -> Robot:
    """The robot with pairs of links no more than two joints apart allowed to touch."""
    links = list(robot.meshes)
    near = [
        frozenset((a, b))
        for i, a in enumerate(links)
        for b in links[i + 1 :]
        if abs(robot.link_frame(a) - robot.link_frame(b)) <= 2
    ]
    return replace(robot, allowed_collisions=frozenset(near))


def solids(scene: Scene) -> Scene:
    return Scene([shape for shape in scene.shapes if not isinstance(shape, Mesh)])


@pytest.mark.parametrize(
    ("name", "locked"),
    [("panda", {}), ("xarm7", {}), ("panda", {"panda_joint2": 0.7, "panda_finger_joint1": 0.065})],
)
def test_distances_agree_with_coal(name: str, locked: dict[str, float]) -> None:
    robot = far_pairs_only(example_robot(name).with_locked(locked))
    scene = solids(every_shape())
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
    scene = Scene([Sphere(vector(0.7, 0.5, 0), 0.15), Box(vector(-0.5, -0.4, 0), vector(0.1, 0.2, 0.3))])
    verdicts = []
    with PyBulletOracle(robot, scene) as oracle:
        for _ in range(30):
            rows = rng.uniform(-1.5, 1.5, (1, 3)) + rng.uniform(-0.7, 0.7, (3, 3))
            path = Path(robot.joint_names, rows)
            report = verify(Problem(robot, scene, rows[0], JointGoal(rows[-1:])), path)
            found = oracle.check_path(path)
            verdicts.append(report.valid)
            if report.valid:
                assert found is None
            elif found is not None:
                assert report.violation is not None
                assert found.other == report.violation.other
                assert found.at == pytest.approx(report.violation.time, abs=0.05)
            else:
                assert report.violation is not None
                assert report.violation.excess is not None
                assert report.violation.excess < 0.01
    assert 5 < sum(verdicts) < 25


def test_a_single_waypoint_is_checked() -> None:
    robot = box_arm()
    with PyBulletOracle(robot, Scene([Sphere(vector(1.2, 0, 0), 0.1)])) as oracle:
        found = oracle.check_path(Path(robot.joint_names, np.zeros((1, 3))))
        with pytest.raises(InputError, match=r"tolerance is -0\.1; it must not be negative"):
            oracle.check_frames(np.zeros((1, 3)), -0.1)
    assert found is not None
    assert (found.link, found.other, found.at) == ("l3", "sphere", 0.0)
    assert found.distance == pytest.approx(-0.1, abs=0.001)


def test_frames_give_what_single_configurations_give() -> None:
    robot = far_pairs_only(example_robot("panda"))
    scene = every_shape()
    rng = np.random.default_rng(1)
    ends = rng.uniform(robot.lower, robot.upper, (12, robot.dof))
    hits = 0
    with PyBulletOracle(robot, scene) as oracle:
        for a, b in zip(ends[::2], ends[1::2], strict=True):
            frames = a + np.linspace(0, 1, 60)[:, None] * (b - a)
            for tolerance in (0.0, 0.001, 0.02):
                single = [oracle.collides(q, tolerance) for q in frames]
                found = oracle.check_frames(frames, tolerance)
                assert (found is not None) == any(single)
                if found is not None:
                    assert found.at == single.index(True)
                    hits += 1
    assert 4 < hits < 18


def test_scenes_are_replaced_and_the_robot_stays() -> None:
    robot = box_arm()
    q = np.zeros((1, 3))
    blocked = Scene([Sphere(vector(1.2, 0, 0), 0.1)])
    clear = Scene([Box(vector(0, 1, 0), vector(1, 0.1, 1))])
    with PyBulletOracle(robot, clear) as oracle:
        for _ in range(3):
            assert oracle.check_frames(q) is None
            oracle.set_scene(blocked)
            found = oracle.check_frames(q)
            assert found is not None and found.other == "sphere"
            oracle.set_scene(clear)
        oracle.set_scene(Scene([PointCloud(np.zeros((0, 3))), PointCloud(vector(1.2, 0, 0)[None])]))
        found = oracle.check_frames(q)
        assert found is not None and found.other == "point_cloud_2"


def test_obstacles_at_links_that_do_not_move_are_nothing() -> None:
    robot = far_pairs_only(example_robot("panda"))
    q = np.array([[0, -0.785, 0, -2.356, 0, 1.571, 0.785]])
    with PyBulletOracle(robot, Scene([Box(vector(0, 0, -0.05), vector(2, 2, 0.12), name="floor")])) as oracle:
        assert oracle.check_frames(q) is None
        assert oracle.nearest(q[0], 0.0) is None


def test_point_clouds_agree_with_coal() -> None:
    robot = far_pairs_only(example_robot("panda"))
    rng = np.random.default_rng(4)
    ball = rng.normal(size=(400, 3))
    points = vector(0.4, 0.2, 0.5) + 0.25 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    scene = Scene([PointCloud(points, 0.02)])
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
    """PyBullet keeps what it was given of a mesh, 0.15 kB a triangle, after its body is removed too."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    panda = load_robot("panda")
    home = np.zeros(7)
    with World(panda, Scene([])) as world, PyBulletOracle(panda, Scene([])) as oracle:
        for x in (0.6, 0.8, 0.6):
            scene = Scene([Mesh(ball.vertices, ball.faces, xyz=(x, 0.0, 0.4))])
            world.set_scene(scene)
            oracle.set_scene(scene)
            assert len(world.mesh_shapes) == 1
            with PyBulletOracle(panda, scene) as fresh:
                assert oracle.distance(home) == pytest.approx(fresh.distance(home), abs=1e-9)
        world.set_scene(Scene([Mesh(1.1 * ball.vertices, ball.faces)]))
        assert len(world.mesh_shapes) == 2
