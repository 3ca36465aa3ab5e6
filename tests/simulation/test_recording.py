"""Pictures and films of replays."""

from pathlib import Path as FilePath

import numpy as np
import pytest
from PIL import Image, ImageSequence

pytest.importorskip("pybullet")


from helpers.box_arm import box_arm
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Sphere
from robotdiffuse.simulation import (
    FilmSettings,
    replay,
    write_gif,
    write_png,
)
from robotdiffuse.trajectories.timing import time_parameterize

pytestmark = pytest.mark.sim


def motion(robot: Robot, *waypoints: np.ndarray) -> Trajectory:
    path = Path(robot.joint_names, np.stack(waypoints))
    return time_parameterize(robot, path, lambda _: True, lambda _: True)


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
