"""Depth cameras, replay and pictures in PyBullet's world."""

import runpy
import sys
from pathlib import Path as FilePath

import numpy as np
import pytest
from PIL import Image, ImageSequence

pytest.importorskip("pybullet")

from dataclasses import replace

from helpers.box_arm import box_arm, box_mesh
from helpers.example_robots import example_robot
from robotdiffuse.cli import main
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.types import Path, Status, Trajectory
from robotdiffuse.problems.files import problem_record
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import ConvexMesh, Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, PointCloud, Shape, Sphere
from robotdiffuse.simulation import (
    DepthCamera,
    FilmSettings,
    PyBulletOracle,
    ReplaySettings,
    World,
    point_cloud,
    render,
    replay,
    write_gif,
    write_png,
)
from robotdiffuse.simulation.model import mass_properties
from robotdiffuse.simulation.replay import sample
from robotdiffuse.trajectories.timing import time_parameterize

pytestmark = pytest.mark.sim
EYE = (1.5, -1.2, 1.4)
CAMERA = DepthCamera(EYE, (0.0, 0.0, 0.4))
TURN = np.array([0.9, 0.3, 0.2, 0.1])
AWAY = np.array([2.5, 0.0, 0.0])
"""A configuration of the box arm that is out of the camera's way."""
PANDA_START = np.array([-0.6, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8])


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


def motion(robot: Robot, *waypoints: np.ndarray) -> Trajectory:
    path = Path(robot.joint_names, np.stack(waypoints))
    return time_parameterize(robot, path, lambda _: True, lambda _: True)


@pytest.mark.parametrize("kind", ["sphere", "box", "cylinder", "capsule"])
def test_points_lie_on_what_the_camera_sees_of_a_shape(kind: str) -> None:
    shape = shape_at(kind)
    with World(box_arm(), Scene([shape]), visuals=True) as world:
        world.place(AWAY)
        cloud = point_cloud(world, [CAMERA], np.random.default_rng(0), voxel=1e-4)
    assert len(cloud.points) > 1000
    # what is left is the facets of round shapes
    assert np.abs(signed_distance(shape, cloud.points)).max() < 4e-4
    # a little farther along its ray, a point is inside, or at a rim: only the near side is seen
    rays = cloud.points - EYE
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    assert (signed_distance(shape, cloud.points + 0.002 * rays) < 0).mean() > 0.98
    if isinstance(shape, Sphere):
        assert ((cloud.points - shape.center) @ (EYE - shape.center) > 0.25**2 - 1e-3).all()
        assert cloud.points.min(axis=0)[0] > shape.bounds[0, 0] + 0.05


def test_the_arm_is_not_in_the_cloud_but_hides_what_is_behind() -> None:
    robot, scene = box_arm(), Scene([Box([0.6, 0, -0.2], [1.5, 1, 0.02])])
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
        ({"width": 0}, "0 x 240 pixels"),
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


def test_the_model_s_masses_are_those_of_boxes() -> None:
    low, high = np.array([0.1, -0.1, 0.0]), np.array([0.5, 0.1, 0.3])
    whole = box_mesh(low, high)
    inside_out = ConvexMesh(whole.vertices, whole.faces[:, ::-1].copy())
    halves = (box_mesh(low, np.array([0.3, 0.1, 0.3])), box_mesh(np.array([0.3, -0.1, 0.0]), high))
    a, b, c = high - low
    for meshes in ((whole,), (inside_out,), halves):
        mass, center, inertia = mass_properties(meshes, 500.0)
        assert mass == pytest.approx(500 * a * b * c)
        assert center == pytest.approx((low + high) / 2)
        expected = mass / 12 * np.diag([b * b + c * c, a * a + c * c, a * a + b * b])
        assert inertia == pytest.approx(expected, abs=1.1e-4)


def test_samples_follow_positions_and_velocities() -> None:
    robot = box_arm()
    trajectory = motion(robot, np.zeros(3), np.array([1.0, -0.5, 0.3]), np.array([0.2, 0.6, 0.0]))
    assert np.allclose(sample(trajectory, trajectory.times), trajectory.positions, atol=1e-12)
    step = 1e-6
    inner = trajectory.times[1:-1]
    slopes = (sample(trajectory, inner + step) - sample(trajectory, inner - step)) / (2 * step)
    assert np.allclose(slopes, trajectory.velocities[1:-1], atol=1e-4)
    assert np.array_equal(sample(trajectory, np.array([99.0]))[0], trajectory.positions[-1])


def test_a_panda_tracks_a_timed_motion_the_better_the_finer_the_step() -> None:
    robot = load_robot("panda")
    trajectory = motion(robot, PANDA_START, PANDA_START + 0.4, PANDA_START + np.linspace(0.5, -0.3, 7))
    coarse = replay(robot, Scene([Sphere([0.0, 0.9, 0.6], 0.1)]), trajectory)
    fine = replay(robot, Scene(), trajectory, ReplaySettings(time_step=1 / 960))
    assert coarse.free and fine.free
    assert coarse.times[-1] >= trajectory.duration + 0.25
    assert coarse.max_errors.max() < 2e-3 and coarse.tip_errors.max() < 1e-3
    assert (coarse.rms_errors <= coarse.max_errors).all()
    assert 1e-7 < fine.max_errors.max() < coarse.max_errors.max() / 4
    assert coarse.positions[-1] == pytest.approx(trajectory.positions[-1], abs=1e-4)
    # the error of the tip against our own kinematics
    k = int(coarse.tip_errors.argmax())
    ends = [link_pose(robot, q[k], robot.tip)[:3, 3] for q in (coarse.positions, coarse.reference)]
    assert np.linalg.norm(ends[0] - ends[1]) == pytest.approx(coarse.tip_errors[k], abs=1e-6)


def test_weak_motors_sag_under_gravity() -> None:
    robot = load_robot("panda")
    stay = np.stack([PANDA_START, PANDA_START])
    trajectory = Trajectory(robot.joint_names, np.array([0.0, 0.5]), stay, 0 * stay, 0 * stay)
    weak = ReplaySettings(force=5.0)
    fallen = replay(robot, Scene(), trajectory, weak)
    assert fallen.tip_errors[-1] > 0.1
    assert fallen.max_errors[1] > 0.1
    assert replay(robot, Scene(), trajectory, replace(weak, gravity=0.0)).tip_errors.max() < 1e-6
    assert replay(robot, Scene(), trajectory).tip_errors.max() < 1e-3


def test_contact_is_reported_where_the_motion_runs_into_an_obstacle() -> None:
    robot, scene = box_arm(), Scene([Sphere([0.9, 0.55, 0], 0.15), Box([-0.9, 0, 0], [0.1, 0.1, 0.1])])
    trajectory = motion(robot, np.zeros(3), np.array([1.2, 0.0, 0.0]))
    run = replay(robot, scene, trajectory)
    with PyBulletOracle(robot, scene) as oracle:
        first = oracle.check_frames(run.reference, tolerance=0.0)
    assert first is not None and not run.free
    contact = run.contacts[0]
    assert (contact.link, contact.other) == ("l3", "sphere")
    assert contact.time == pytest.approx(run.times[int(first.at)], abs=0.02)
    assert -0.001 <= contact.depth < 0.05
    assert run.max_errors[0] > 0.1
    apart = Scene([Sphere([0.9, 0.55, 0.25], 0.15)])
    assert replay(robot, apart, trajectory).free


def test_links_that_touch_each_other_are_reported() -> None:
    robot = replace(
        box_arm(), allowed_collisions=frozenset({frozenset(("l1", "l2")), frozenset(("l2", "l3"))})
    )
    run = replay(robot, Scene(), motion(robot, np.zeros(3), np.array([0.0, 2.7, 2.0])))
    assert {(contact.link, contact.other) for contact in run.contacts} <= {("l1", "l3"), ("l3", "l1")}
    assert not run.free
    allowed = replace(robot, allowed_collisions=robot.allowed_collisions | {frozenset(("l1", "l3"))})
    assert replay(allowed, Scene(), motion(robot, np.zeros(3), np.array([0.0, 2.7, 2.0]))).free


def test_skew_axes_sliding_joints_and_a_branch() -> None:
    robot = example_robot("awkward")
    middle = (robot.lower + robot.upper) / 2
    run = replay(robot, Scene(), motion(robot, middle, middle + 0.2))
    assert run.free and run.max_errors.max() < 0.01


def test_what_cannot_be_replayed() -> None:
    robot = box_arm()
    trajectory = motion(robot, np.zeros(3), np.ones(3))
    with pytest.raises(InputError, match="the trajectory moves a, b, c; planar plans j0, j1, j2"):
        replay(robot, Scene(), replace(trajectory, joint_names=("a", "b", "c")))
    for name, value in (("time_step", 0.01), ("position_gain", 0.0), ("force", -1.0), ("settle", -1.0)):
        with pytest.raises(InputError, match=f"replay.{name} is {value}"):
            ReplaySettings(**{name: value})


def test_picture_and_film(tmp_path: FilePath) -> None:
    robot, scene = box_arm(), Scene([Sphere([0.5, -0.5, 0.1], 0.15)])
    run = replay(robot, scene, motion(robot, np.zeros(3), np.array([1.2, -0.3, 0.4])))
    settings = FilmSettings(width=160, height=120, rate=10.0)
    write_png(robot, scene, run, tmp_path / "a.png", settings)
    write_gif(robot, scene, run, tmp_path / "a.gif", settings)
    picture = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    assert picture.shape == (120, 160, 3)
    reddish = (picture[..., 0] - picture[..., 2] > 60).mean()
    assert 0.005 < reddish < 0.5 and (picture.min(axis=2) < 250).mean() > 0.05
    film = Image.open(tmp_path / "a.gif")
    frames, times = [], []
    for frame in ImageSequence.Iterator(film):
        frames.append(np.asarray(frame.convert("RGB")).astype(int))
        times.append(frame.info["duration"])
    # Pillow joins frames that are alike
    assert 5 < len(frames) <= 10 * run.times[-1] + 2 and frames[0].shape == (120, 160, 3)
    assert sum(times) / 1000 == pytest.approx(run.times[-1] + 1, abs=0.1)
    assert (np.abs(frames[0] - frames[-1]).max(axis=2) > 40).mean() > 0.01
    with pytest.raises(InputError, match=r"no_folder.a\.png cannot be written: No such file"):
        write_png(robot, scene, run, tmp_path / "no_folder" / "a.png", settings)


@pytest.mark.parametrize(
    "values", [{"width": 8}, {"oversampling": 0}, {"rate": 90.0}, {"field_of_view": 3.0}], ids=str
)
def test_films_that_cannot_be(values: dict) -> None:
    name, value = next(iter(values.items()))
    with pytest.raises(InputError, match=f"film.{name} is {value}"):
        FilmSettings(**values)


def result_file(folder: FilePath, scene: Scene) -> str:
    robot = load_robot("panda")
    goal = PANDA_START + 0.2
    trajectory = motion(robot, PANDA_START, goal)
    result = PlanResult(
        Status.SOLVED,
        "by hand",
        "none",
        "panda",
        0.0,
        0,
        path=Path(robot.joint_names, np.stack([PANDA_START, goal])),
        trajectory=trajectory,
        min_clearance=0.1,
    )
    problem = Problem(robot, scene, PANDA_START, JointGoal(goal[None]))
    file = folder / "result.json"
    result.save(file, problem_record(problem))
    return str(file)


def test_command(tmp_path: FilePath, capsys: pytest.CaptureFixture[str]) -> None:
    file = result_file(tmp_path, Scene([Sphere([0.0, 0.9, 0.6], 0.1)]))
    assert main(["simulate", file]) == 0
    printed = capsys.readouterr().out
    assert "panda: free" in printed and "panda_joint7" in printed and "mrad" in printed
    assert main(["simulate", file, "--out", str(tmp_path / "film.avi")]) == 2
    assert "known: .gif, .png" in capsys.readouterr().err
    end = link_pose(load_robot("panda"), PANDA_START + 0.2, "panda_hand")[:3, 3]
    file = result_file(tmp_path, Scene([Sphere(end, 0.05)]))
    assert main(["simulate", file]) == 1
    printed = capsys.readouterr().out
    assert "panda: contact" in printed and "panda_hand" in printed and "sphere" in printed


def test_example(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(FilePath(__file__).parents[2] / "examples" / "depth_camera.py"))
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(",")[0] for line in lines[::3]] == ["1 camera(s)", "2 camera(s)"]
    assert all("solved" in line for line in lines[::3])
    assert all(line.startswith("  in the whole scene: ") for line in lines[1::3])
    assert all(line.startswith("  in simulation: ") for line in lines[2::3])


def test_command_without_pybullet(
    tmp_path: FilePath, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = result_file(tmp_path, Scene())
    for name in [name for name in sys.modules if name.startswith("robotdiffuse.simulation")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pybullet", None)
    assert main(["simulate", file]) == 2
    assert "pip install 'robotdiffuse[sim]'" in capsys.readouterr().err
