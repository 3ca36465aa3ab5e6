"""The arm, scene and motion that pictures and replays show."""

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.three_bars import CORNERS, CUBE, three_bars


@pytest.fixture(scope="session")
def arm() -> rd.Robot:
    return three_bars()


@pytest.fixture(scope="session")
def scene() -> rd.Scene:
    cloud = np.random.default_rng(3).uniform(-0.1, 0.1, (500, 3)) + np.array([0.2, 0.5, 0.6])
    tilted = np.array([0.9, 0.0, 0.1, 0.2])
    return rd.Scene(
        [
            rd.Sphere(np.array([-0.5, 0.4, 0.5]), 0.1),
            rd.Box(np.array([0.4, 0.4, 0.1]), np.array([0.1, 0.2, 0.2]), tilted),
            rd.Cylinder(np.array([-0.4, -0.4, 0.2]), 0.05, 0.4),
            rd.Capsule(np.array([0.4, -0.5, 0.3]), 0.05, 0.2, tilted),
            rd.PointCloud(cloud, 0.01),
            rd.Mesh(0.1 * CORNERS, CUBE, np.array([0.0, 0.7, 0.3])),
        ]
    )


@pytest.fixture(scope="session")
def motion(arm: rd.Robot) -> rd.Trajectory:
    t = np.linspace(0, 2.0, 501)
    q = np.stack([-1.2 + 1.2 * t, 0.3 + 0.2 * t, 0.1 * t], axis=1)
    return rd.Trajectory(arm.joint_names, t, q, np.gradient(q, t, axis=0), np.zeros_like(q))
