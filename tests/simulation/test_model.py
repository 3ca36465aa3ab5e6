"""Masses of the robot model for PyBullet."""

import numpy as np
import pytest

pytest.importorskip("pybullet")


from helpers.box_arm import box_mesh
from robotdiffuse.robots.robot import ConvexMesh
from robotdiffuse.simulation.world import mass_and_center

pytestmark = pytest.mark.sim


def test_the_model_s_masses_are_those_of_boxes() -> None:
    low = np.array([0.1, -0.1, 0.0])
    high = np.array([0.5, 0.1, 0.3])
    whole = box_mesh(low, high)
    inside_out = ConvexMesh(whole.vertices, whole.faces[:, ::-1].copy())
    halves = (box_mesh(low, np.array([0.3, 0.1, 0.3])), box_mesh(np.array([0.3, -0.1, 0.0]), high))
    a, b, c = high - low
    for meshes in ((whole,), (inside_out,), halves):
        mass, center = mass_and_center(meshes, 500.0)
        assert mass == pytest.approx(500 * a * b * c)
        assert center == pytest.approx((low + high) / 2)
