"""What one camera sees of the scenes of a data set, for networks that are told no more than that."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Float16
from numpy import ndarray

from robotdiffuse.learning.completion.samples import camera_view
from robotdiffuse.learning.encoders.base import Encoder
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene_arrays import PackedScenes


def random_views(
    scenes: PackedScenes, robot: Robot, starts: Float[ndarray, "n dof"], rng: np.random.Generator
) -> Iterator[DepthView]:
    """A view of each scene, the arm at its start, from a place as the completing network learns from."""
    for i, start in enumerate(starts.astype(np.float64)):
        yield camera_view(scenes.scene(i), robot, start, rng)


def codes_of_views(
    encoder: Encoder,
    scenes: PackedScenes,
    robot: Robot,
    starts: Float[ndarray, "n dof"],
    rng: np.random.Generator,
) -> Float16[ndarray, "n code"]:
    """z of a random view of each scene."""
    codes = np.zeros((len(scenes), encoder.settings.code), np.float16)
    for code, view in zip(codes, random_views(scenes, robot, starts, rng), strict=True):
        code[:] = encoder.of_views([view], robot, starts[0]).float().numpy()
    return codes


def clouds_of_views(
    encoder: Encoder,
    scenes: PackedScenes,
    robot: Robot,
    starts: Float[ndarray, "n dof"],
    rng: np.random.Generator,
) -> Float16[ndarray, "n points 3"]:
    """The points that an encoder is told of a random view of each scene [m]; zeros where these are fewer."""
    clouds = np.zeros((len(scenes), encoder.settings.cloud, 3), np.float16)
    for cloud, view in zip(clouds, random_views(scenes, robot, starts, rng), strict=True):
        told = encoder.told_points([view], robot, starts[0])
        cloud[: len(told)] = told
    return clouds
