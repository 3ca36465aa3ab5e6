"""Pictures: what they show, and errors for bad settings."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Path
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.visualization import PictureSettings, write_picture
from robotdiffuse.visualization.picture import render

SMALL = PictureSettings(width=320, height=200, ghosts=2)


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
