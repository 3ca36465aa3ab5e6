"""PyBullet, which shares no code with ours: replays, the command `simulate`; distances and verdicts agree with Coal."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path as FilePath
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh

pytest.importorskip("pybullet")

import robotdiffuse as rd
from helpers.box_arm import box_arm, box_mesh
from helpers.commands import Said, python
from helpers.example_robots import example_robot
from helpers.panda import HOME, PANDA
from helpers.refusals import refuses
from helpers.sphere_oracles import solids
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.problems.files import problem_record
from robotdiffuse.robots.robot import ConvexMesh
from robotdiffuse.simulation import PyBulletOracle, ReplaySettings, replay, world
from robotdiffuse.simulation.world import World, mass_and_center
from robotdiffuse.trajectories.timing import time_parameterize

pytestmark = pytest.mark.sim
PANDA_START = np.array([-0.6, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8])


def motion(robot: rd.Robot, *waypoints: np.ndarray) -> rd.Trajectory:
    return time_parameterize(robot, rd.Path(robot.joint_names, np.stack(waypoints)), lambda _: True, lambda _: True).trajectory


def test_a_motion_of_one_row_holds_still() -> None:
    """Regression: positions of the simulated arm were NaN."""
    robot = box_arm()
    stay = np.full((1, 3), 0.1)
    run = replay(robot, rd.Scene(), rd.Trajectory(robot.joint_names, np.zeros(1), stay, 0 * stay, 0 * stay))
    assert run.free and run.max_errors.max() < 1e-3 and (run.reference == stay).all()


def test_a_panda_tracks_a_timed_motion_the_better_the_finer_the_step() -> None:
    trajectory = motion(PANDA, PANDA_START, PANDA_START + 0.4, PANDA_START + np.linspace(0.5, -0.3, 7))
    coarse = replay(PANDA, rd.Scene([rd.Sphere([0.0, 0.9, 0.6], 0.1)]), trajectory)
    fine = replay(PANDA, rd.Scene(), trajectory, ReplaySettings(time_step=1 / 960))
    assert coarse.free and fine.free and coarse.times[-1] >= trajectory.duration + 0.25
    # with Bullet's default of 50 solver iterations, tips are off by up to 0.6 mm
    assert coarse.max_errors.max() < 2e-5 and coarse.tip_errors.max() < 2e-5 and (coarse.rms_errors <= coarse.max_errors).all()
    assert 1e-7 < fine.max_errors.max() < coarse.max_errors.max() / 2
    assert coarse.positions[-1] == pytest.approx(trajectory.positions[-1], abs=1e-4)
    # the error of the tip against our own kinematics
    k = int(coarse.tip_errors.argmax())
    ends = [PANDA.fk(q[k])[:3, 3] for q in (coarse.positions, coarse.reference)]
    assert np.linalg.norm(ends[0] - ends[1]) == pytest.approx(coarse.tip_errors[k], abs=1e-6)


def test_weak_motors_sag_under_gravity() -> None:
    stay = np.stack([PANDA_START, PANDA_START])
    trajectory = rd.Trajectory(PANDA.joint_names, np.array([0.0, 0.5]), stay, 0 * stay, 0 * stay)
    weak = ReplaySettings(force=5.0)
    fallen = replay(PANDA, rd.Scene(), trajectory, weak)
    assert fallen.tip_errors[-1] > 0.1 and fallen.max_errors[1] > 0.1
    assert replay(PANDA, rd.Scene(), trajectory, replace(weak, gravity=0.0)).tip_errors.max() < 1e-6
    assert replay(PANDA, rd.Scene(), trajectory).tip_errors.max() < 1e-3


def test_contact_is_reported_where_the_motion_runs_into_an_obstacle() -> None:
    robot = box_arm()
    scene = rd.Scene([rd.Sphere([0.9, 0.55, 0], 0.15), rd.Box([-0.9, 0, 0], [0.1, 0.1, 0.1])])
    trajectory = motion(robot, np.zeros(3), np.array([1.2, 0.0, 0.0]))
    run = replay(robot, scene, trajectory)
    with PyBulletOracle(robot, scene) as oracle:
        first = oracle.check_rows(run.reference, tolerance=0.0)
    assert first is not None and not run.free
    contact = run.contacts[0]
    assert (contact.link, contact.other) == ("l3", "sphere")
    assert contact.time == pytest.approx(run.times[int(first.at)], abs=0.02)
    assert -0.001 <= contact.depth < 0.05 and run.max_errors[0] > 0.1
    assert replay(robot, rd.Scene([rd.Sphere([0.9, 0.55, 0.25], 0.15)]), trajectory).free


def test_links_that_touch_each_other_are_reported() -> None:
    robot = box_arm()
    folding = motion(robot, np.zeros(3), np.array([0.0, 2.7, 2.0]))
    run = replay(robot, rd.Scene(), folding)
    assert {(contact.link, contact.other) for contact in run.contacts} <= {("l1", "l3"), ("l3", "l1")} and not run.free
    allowed = replace(robot, allowed_collisions=robot.allowed_collisions | {frozenset(("l1", "l3"))})
    assert replay(allowed, rd.Scene(), folding).free


def test_skew_axes_sliding_joints_and_a_branch() -> None:
    robot = example_robot("awkward")
    middle = (robot.lower + robot.upper) / 2
    run = replay(robot, rd.Scene(), motion(robot, middle, middle + 0.2))
    assert run.free and run.max_errors.max() < 0.01


def test_what_cannot_be_replayed() -> None:
    robot = box_arm()
    renamed = replace(motion(robot, np.zeros(3), np.ones(3)), joint_names=("a", "b", "c"))
    refuses("the trajectory moves a, b, c; planar plans j0, j1, j2", replay, robot, rd.Scene(), renamed)
    for name, value in (("time_step", 0.01), ("force", -1.0), ("gravity", np.nan)):
        refuses(f"replay.{name} is {value}", ReplaySettings, **{name: value})


def result_file(folder: FilePath, scene: rd.Scene) -> str:
    goal = PANDA_START + 0.2
    rows = rd.Path(PANDA.joint_names, np.stack([PANDA_START, goal]))
    trajectory = motion(PANDA, PANDA_START, goal)
    result = rd.PlanResult(rd.Status.SOLVED, "by hand", "none", "panda", 0.0, 0, path=rows, trajectory=trajectory)
    result.save(folder / "result.json", problem_record(rd.Problem(PANDA, scene, PANDA_START, goal)))
    return str(folder / "result.json")


def test_a_world_that_fails_to_load_leaves_no_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    clients: list[int] = []
    connect = world.pybullet.connect
    monkeypatch.setattr(
        world.pybullet, "connect", lambda mode, **options: clients.append(connect(mode, **options)) or clients[0]
    )
    monkeypatch.setattr(world, "write_urdf", Mock(side_effect=OSError("no space left")))
    refuses("cannot be written: no space left", world.World, box_arm(), rd.Scene())
    assert not world.pybullet.isConnected(clients[0])


def test_command(tmp_path: FilePath, said: Said) -> None:
    file = result_file(tmp_path, rd.Scene([rd.Sphere([0.0, 0.9, 0.6], 0.1)]))
    printed = said(0, "simulate", file)
    assert "panda: free" in printed and "panda_joint7" in printed and "mrad" in printed
    assert "known: .html, .png" in said(2, "simulate", file, "--out", tmp_path / "film.avi")
    said(0, "simulate", file, "--out", tmp_path / "page.html")
    assert "panda_joint7" in (tmp_path / "page.html").read_text("utf-8")
    end = rd.load_robot("panda").fk(PANDA_START + 0.2, "panda_hand")[:3, 3]
    file = result_file(tmp_path, rd.Scene([rd.Sphere(end, 0.05)]))
    printed = said(1, "simulate", file)
    assert "panda: contact" in printed and "panda_hand" in printed and "sphere" in printed


def test_moving_obstacles_are_contacts_where_the_validator_refuses_the_motion() -> None:
    """Regression: `simulate` called a motion free that runs into a moving obstacle."""
    end = PANDA_START * [-1, 1, 1, 1, 1, 1, 1]
    trajectory = motion(PANDA, PANDA_START, end)
    free = []
    for side in (1, -1):  # meets the arm, and keeps away from it
        ball = rd.MovingObstacle(rd.Sphere([0.55, side * 0.45, 0.5], 0.12, name="ball"), velocity=[0, -0.3, 0])
        problem = rd.Problem(PANDA, rd.Scene(), PANDA_START, end, moving=[ball])
        report = rd.verify(problem, trajectory)
        run = replay(PANDA, rd.Scene(), trajectory, moving=problem.moving)
        assert run.free == report.valid
        if report.violation is not None:
            assert abs(run.contacts[0].time - report.violation.time) < 0.05
        free.append(run.free)
    assert free[0] is False


def test_the_model_s_masses_are_those_of_boxes() -> None:
    low = np.array([0.1, -0.1, 0.0])
    high = np.array([0.5, 0.1, 0.3])
    whole = box_mesh(low, high)
    inside_out = ConvexMesh(whole.vertices, whole.faces[:, ::-1].copy())
    halves = (box_mesh(low, np.array([0.3, 0.1, 0.3])), box_mesh(np.array([0.3, -0.1, 0.0]), high))
    a, b, c = high - low
    for meshes in ((whole,), (inside_out,), halves):
        mass, center = mass_and_center(meshes)
        assert mass == pytest.approx(1000 * a * b * c) and center == pytest.approx((low + high) / 2)


PYBULLET = """
import os
os.write(1, b"printed by another thread\\n")
for stream in (1, 2):
    os.write(stream, b"pybullet build time: now\\n")
"""


def test_a_simulation_prints_nothing() -> None:
    """Regression: each printed `argv[0]=`."""
    imports = "import robotdiffuse as rd; from robotdiffuse.simulation.world import World"
    ended = python(imports + "; World(rd.load_robot('so101'), rd.Scene()).close()")
    assert not ended.stdout + ended.stderr


def test_only_the_build_time_is_left_out(tmp_path: FilePath) -> None:
    (tmp_path / "pybullet.py").write_text(PYBULLET)
    ended = python(f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import robotdiffuse.simulation")
    assert ended.stdout == "printed by another thread\n" and ended.stderr == ""
    python("import os; os.close(1); import robotdiffuse.simulation")  # without standard output


TOLERANCE = 7e-4
"""Most distances agree to 5e-6 m; Bullet rounds the edges of its boxes and cylinders by up to 0.6 mm."""


def far_pairs_only(robot: rd.Robot) -> rd.Robot:
    """The robot with allowed contact between links that are at most two joints apart."""
    near = [frozenset(p) for p in combinations(robot.meshes, 2) if abs(robot.link_frame(p[0]) - robot.link_frame(p[1])) <= 2]
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
            right = min(d.distance for d in exact.distances(q))
            assert oracle.distance(q.tolist()) == pytest.approx(right, abs=TOLERANCE)
        refuses("q is", oracle.distance, q * np.nan)


def test_collisions_agree_with_coal_meshes_included() -> None:
    robot = far_pairs_only(example_robot("panda"))
    torus = trimesh.creation.torus(0.2, 0.05, major_sections=16, minor_sections=8)
    mesh = rd.Mesh(torus.vertices.view(np.ndarray), torus.faces, (-0.3, 0.4, 0.7), (0.5, 0.1, 0.2, 0.9))
    scene = rd.Scene([*solids().shapes, mesh])
    q = np.random.default_rng(1).uniform(robot.lower, robot.upper, (150, robot.dof))
    hits = ExactCollision(robot, scene).collides(q)
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
                assert found.other == report.violation.other and found.at == pytest.approx(report.violation.time, abs=0.05)
    assert 5 < sum(verdicts) < 25


def test_a_single_waypoint_is_checked() -> None:
    robot = box_arm()
    with PyBulletOracle(robot, rd.Scene([rd.Sphere((1.2, 0, 0), 0.1)])) as oracle:
        found = oracle.check_path(rd.Path(robot.joint_names, np.zeros((1, 3))))
        refuses(r"tolerance is -0\.1; it must not be negative", oracle.check_rows, np.zeros((1, 3)), -0.1)
    assert found is not None and (found.link, found.other, found.at) == ("l3", "sphere", 0.0)
    assert found.distance == pytest.approx(-0.1, abs=0.001)


def test_scenes_are_replaced_and_obstacles_at_links_that_do_not_move_are_nothing() -> None:
    ball = rd.Sphere((1.2, 0, 0), 0.1)
    clouds = [rd.PointCloud(np.zeros((0, 3))), rd.PointCloud(np.array([[1.2, 0, 0]]))]
    with PyBulletOracle(box_arm(), rd.Scene([rd.Box((0, 1, 0), (1, 0.1, 1))])) as oracle:
        for shapes, hit in ([ball], "sphere"), ([], None), ([ball], "sphere"), (clouds, "point_cloud_2"):
            oracle.set_scene(rd.Scene(shapes))
            found = oracle.check_rows(np.zeros((1, 3)))
            assert (found and found.other) == hit
    floor = rd.Box((0, 0, -0.05), (2, 2, 0.12), name="floor")
    with PyBulletOracle(far_pairs_only(example_robot("panda")), rd.Scene([floor])) as oracle:
        assert oracle.check_rows(HOME[None]) is None and oracle.nearest(HOME, 0.0) is None


def test_point_clouds_agree_with_coal() -> None:
    robot = far_pairs_only(example_robot("panda"))
    rng = np.random.default_rng(4)
    ball = rng.normal(size=(400, 3))
    points = (0.4, 0.2, 0.5) + 0.25 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    scene = rd.Scene([rd.PointCloud(points, 0.02)])
    exact = ExactCollision(robot, scene)
    with PyBulletOracle(robot, scene) as oracle:
        for row in rng.uniform(robot.lower, robot.upper, (40, robot.dof)):
            right = min(d.distance for d in exact.distances(row))
            if right > 0:
                assert oracle.distance(row) == pytest.approx(right, abs=TOLERANCE)
            if abs(right) > TOLERANCE:
                assert (oracle.check_rows(row[None], 0.0) is not None) == (right < 0)


def test_a_mesh_that_comes_again_takes_no_memory_again() -> None:
    """PyBullet keeps 0.15 kB for each triangle of a mesh, even after the mesh's body is removed."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    home = np.zeros(7)
    with World(PANDA, rd.Scene([])) as world, PyBulletOracle(PANDA, rd.Scene([])) as oracle:
        for x in (0.6, 0.8, 0.6):
            scene = rd.Scene([rd.Mesh(ball.vertices, ball.faces, xyz=(x, 0.0, 0.4))])
            world.set_scene(scene)
            oracle.set_scene(scene)
            assert len(world.mesh_shapes) == 1
            with PyBulletOracle(PANDA, scene) as fresh:
                assert oracle.distance(home) == pytest.approx(fresh.distance(home), abs=1e-9)
        world.set_scene(rd.Scene([rd.Mesh(1.1 * ball.vertices, ball.faces)]))
        assert len(world.mesh_shapes) == 2


def test_names_with_slashes_equal_names_and_joints_that_turn_on() -> None:
    robot = PANDA.attach(rd.Box([0, 0, 0.12], [0.03] * 3, name="objects/cup"), "panda_hand")
    static, *others = (rd.Sphere([0.5, 0.1 * i, 2.0], 0.15) for i in range(3))
    moving = [rd.MovingObstacle(shape, velocity=[0, 0, -1.4]) for shape in others]
    with PyBulletOracle(robot, rd.Scene([static]), moving) as oracle:
        assert "objects/cup" in oracle.links and [*oracle.obstacles] == ["sphere", "sphere_2", "sphere_3"]
    gen3 = rd.load_robot("gen3")
    q = np.array([[10.0, 0, 0, 0, 0, 0, 0]])
    assert replay(gen3, rd.Scene(), rd.Trajectory(gen3.joint_names, np.zeros(1), q, 0 * q, 0 * q)).max_errors.max() < 1e-4
