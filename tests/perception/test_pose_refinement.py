"""Camera poses refined by the images: errors that were added to true poses are found."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import robotdiffuse as rd
from robotdiffuse.perception.depth_filter import pose_error
from robotdiffuse.perception.depth_view import DepthNoise
from robotdiffuse.perception.pose_refinement import PoseRefinement
from robotdiffuse.perception.ray_caster import looking_at, ray_cast
from robotdiffuse.planning.exploration.simulated import measured, taken, wrist_camera

PANDA = rd.load_robot("panda")
HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
FLOOR = rd.Box((0, 0, -0.05), (4, 4, 0.1), name="floor")
SCENE = rd.Scene([FLOOR, rd.Box((0.6, 0.1, 0.1), (0.2, 0.3, 0.2)), rd.Box((0.2, -0.6, 0.2), (0.3, 0.1, 0.4))])
PROBLEM = rd.Problem(PANDA, SCENE, HOME, HOME)
NOISE = DepthNoise(spread=0.004, correlation=1.5, missing=0.01, zeros=True)
STATED = (0.005, float(np.radians(1.0)))
K = (460.0, 460.0, 319.5, 239.5)
BESIDE = looking_at(np.array([1.2, 1.0, 0.9]), np.array([0.2, 0.0, 0.4]))
CAMERA = wrist_camera(PANDA)
TURNS = [[0.0] * 7, [0.3, 0.2, 0, 0, 0, 0.3, 0], [-0.4, 0.3, 0.2, 0.2, 0, -0.3, 0.5], [0, 0.4, 0, 0.3, 0.4, 0.2, 0]]
POINTS = np.stack(np.meshgrid((-0.5, 0.0, 0.5), (-0.5, 0.0, 0.5), (0.1, 0.8)), axis=-1).reshape(-1, 3)


def off(view: rd.DepthView, seed: int) -> rd.DepthView:
    """The view with a pose error as large as stated."""
    rng = np.random.default_rng(seed)
    shift, axis = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    error = np.eye(4)
    error[:3, 3] = STATED[0] * shift
    error[:3, :3] = Rotation.from_rotvec(STATED[1] * axis).as_matrix()
    return replace(view, T_base_camera=view.T_base_camera @ error, pose_deviation=STATED, noise=NOISE)


def beside(q: np.ndarray, seed: int = 0) -> rd.DepthView:
    view = ray_cast(SCENE, BESIDE, K, (640, 480), PANDA, q)
    return measured(view, np.inf, NOISE, np.random.default_rng(seed))


def displaced(view: rd.DepthView, true: rd.DepthView) -> tuple[np.ndarray, np.ndarray]:
    """How far the pose error of a view displaces points around the arm, and the stated bound of the
    displacement [m]."""
    T = true.T_base_camera
    in_camera = (POINTS - T[:3, 3]) @ T[:3, :3]
    x = in_camera[(in_camera[:, 2] > 0.1) & (np.linalg.norm(in_camera, axis=1) < 2)]
    moved = x @ (view.T_base_camera[:3, :3] - T[:3, :3]).T + view.T_base_camera[:3, 3] - T[:3, 3]
    return np.linalg.norm(moved, axis=1), pose_error(view, np.linalg.norm(x, axis=1))


@pytest.mark.parametrize("seed", range(4))
def test_errors_of_poses_are_found_again(seed: int) -> None:
    poses = PoseRefinement(PANDA, rd.Scene([FLOOR]), [(CAMERA.link, CAMERA.T_link_camera)])
    rng = np.random.default_rng(seed)
    standing = beside(HOME, seed)
    first = poses.observe(off(standing, 10 + seed))
    error, stated = displaced(first, standing)
    before = displaced(off(standing, 10 + seed), standing)[1]
    assert (error < stated).all() and stated.max() < 0.7 * before.max(), "by the arm and the floor in one image"
    for turn in TURNS:
        true = taken(PROBLEM, CAMERA, HOME + turn, NOISE, rng)
        error, stated = displaced(poses.observe(off(true, 20 + seed)), true)
        assert (error < stated).all()
    assert error.max() < 0.005 and stated.max() < 0.012, "of the camera on the arm"
    error, now = displaced(poses.refined(off(standing, 10 + seed)), standing)
    assert (error < now).all() and now.max() < 1.05 * displaced(first, standing)[1].max()


def test_views_that_state_no_error_stay_as_they_are() -> None:
    poses = PoseRefinement(PANDA, rd.Scene([FLOOR]), [])
    view = beside(HOME)
    assert poses.observe(view) is view
    without_arm = replace(off(view, 0), configuration=None)
    assert poses.observe(without_arm) is without_arm
