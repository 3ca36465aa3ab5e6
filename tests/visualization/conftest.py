"""The arm, scene and motion that pictures and replays show."""

import numpy as np
import pytest

from helpers.three_bars import CORNERS, CUBE, three_bars
from robotdiffuse.core.types import Trajectory
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Mesh, PointCloud, Sphere


@pytest.fixture(scope="session")
def arm() -> Robot:
    return three_bars()


@pytest.fixture(scope="session")
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


@pytest.fixture(scope="session")
def motion(arm: Robot) -> Trajectory:
    t = np.linspace(0, 2.0, 501)
    q = np.stack([-1.2 + 1.2 * t, 0.3 + 0.2 * t, 0.1 * t], axis=1)
    return Trajectory(arm.joint_names, t, q, np.gradient(q, t, axis=0), np.zeros_like(q))
