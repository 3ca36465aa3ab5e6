"""Pictures: what they show, and errors for bad settings."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import transform
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import ConvexMesh, Joint, Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Mesh, PointCloud, Sphere
from robotdiffuse.visualization import PictureSettings, write_picture
from robotdiffuse.visualization.picture import render

SMALL = PictureSettings(width=320, height=200, ghosts=2)


CORNERS = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1, 1) for z in (-1, 1)])


FACES = "013 032 467 475 045 051 237 276 026 064 157 173"


CUBE = np.array([[int(corner) for corner in face] for face in FACES.split()])


def bar(length: float) -> ConvexMesh:
    """A square bar of 8 cm along z, from the origin."""
    return ConvexMesh(CORNERS * [0.04, 0.04, length / 2] + [0, 0, length / 2], CUBE)


@pytest.fixture(scope="module")
def arm() -> Robot:
    """Three bars: a turning pillar, a hinge with its axis off z, a slide."""
    quarter = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    z, y = np.array([0.0, 0, 1]), np.array([0.0, 1, 0])
    limits = (-3.0, 3.0, 2.0, 5.0, 50.0)
    joints = (
        Joint("turn", "revolute", "base", "pillar", transform(np.array([0, 0, 0.1])), z, *limits),
        Joint("hinge", "revolute", "pillar", "arm", transform(np.array([0, 0, 0.4]), quarter), y, *limits),
        Joint("slide", "prismatic", "arm", "tip", transform(np.array([0, 0, 0.3])), z, *limits),
    )
    meshes = {"base": (bar(0.1),), "pillar": (bar(0.4),), "arm": (bar(0.3),), "tip": (bar(0.2),)}
    spheres = {"tip": np.array([[0, 0, 0.1, 0.12]])}
    return Robot("three_bars", "base", "tip", joints, spheres, meshes)


@pytest.fixture(scope="module")
def scene() -> Scene:
    cloud = np.random.default_rng(3).uniform(-0.1, 0.1, (500, 3)) + np.array([0.2, 0.5, 0.6])
    tilted = np.array([0.9, 0.0, 0.1, 0.2])
    return Scene(
        [
            Sphere(np.array([-0.5, 0.4, 0.5]), 0.1),
            Box(np.array([0.4, 0.4, 0.1]), np.array([0.1, 0.2, 0.2]), tilted),
            Cylinder(np.array([-0.4, -0.4, 0.2]), 0.05, 0.4),
            Capsule(np.array([0.4, -0.5, 0.3]), 0.05, 0.2, tilted),
            PointCloud(cloud, 0.01),
            Mesh(0.1 * CORNERS, CUBE, np.array([0.0, 0.7, 0.3])),
        ]
    )


@pytest.fixture(scope="module")
def motion(arm: Robot) -> Trajectory:
    t = np.linspace(0, 2.0, 501)
    q = np.stack([-1.2 + 1.2 * t, 0.3 + 0.2 * t, 0.1 * t], axis=1)
    return Trajectory(arm.joint_names, t, q, np.gradient(q, t, axis=0), np.zeros_like(q))


def test_picture_shows_the_tip_where_kinematics_puts_it(arm, motion, tmp_path):
    pixels, camera = render(arm, Scene(), motion, SMALL)
    middle_of_tip = link_pose(arm, motion.positions[-1], "tip") @ [0, 0, 0.1, 1]
    column, row, _ = camera.project(middle_of_tip[None, :3])[0].astype(int)
    away, _ = render(arm, Scene(), Path(arm.joint_names, motion.positions[:1]), replace(SMALL, ghosts=0))
    assert away.shape == (200, 320, 3)
    assert 0 < column < 320 and 0 < row < 200
    patch = pixels[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3).astype(int)
    assert np.ptp(patch, axis=1).max() < 60, "the arm is grey; the trace ends beyond the middle of the tip"
    background = pixels[3, 3].astype(int)
    assert np.abs(patch - background).max() > 12

    write_picture(arm, Scene(), motion, tmp_path / "motion.png", settings=SMALL)
    with Image.open(tmp_path / "motion.png") as image:
        assert image.format == "PNG" and image.size == (320, 200)


def test_picture_shows_obstacles_in_their_colour(arm, scene, motion):
    pixels, camera = render(arm, Scene([scene.shapes[0]]), motion, SMALL)
    column, row, _ = camera.project(np.array([[-0.5, 0.4, 0.5]]))[0].astype(int)
    r, g, b = pixels[row, column].astype(int)
    assert r > g + 25 > b + 25


def test_picture_is_the_same_twice(arm, scene, motion):
    first, _ = render(arm, scene, motion, SMALL)
    second, _ = render(arm, scene, motion, SMALL)
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("settings", [{"width": 0}, {"height": 3}, {"ghosts": -1}])
def test_bad_settings(settings):
    with pytest.raises(InputError):
        PictureSettings(**settings)
