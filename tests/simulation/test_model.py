"""Masses of the robot model for PyBullet."""

import numpy as np
import pytest

pytest.importorskip("pybullet")


from helpers.box_arm import box_mesh
from robotdiffuse.robots.robot import ConvexMesh
from robotdiffuse.simulation.world import mass_properties

pytestmark = pytest.mark.sim


def test_the_model_s_masses_are_those_of_boxes() -> None:
    low = np.array([0.1, -0.1, 0.0])
    high = np.array([0.5, 0.1, 0.3])
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
