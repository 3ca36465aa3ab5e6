"""Surfaces, traces and visual meshes."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import robotdiffuse as rd
from helpers.three_bars import CORNERS, CUBE
from robotdiffuse.drawables import creased
from robotdiffuse.robots.visual_meshes import has_visual, load_visual
from robotdiffuse.visualization.arm import DrawnArm


def test_trace_follows_the_outer_end_of_the_tip(arm, motion):
    for q, point in zip(motion.positions[::100], DrawnArm(arm).tool_points(motion.positions[::100]), strict=True):
        np.testing.assert_allclose(point, (arm.fk(q, "tip") @ [0, 0, 0.2, 1])[:3], atol=1e-12)


def test_creases_keep_edges_of_a_box_and_smooth_a_ball():
    box = creased(CORNERS, CUBE, np.ones((12, 3)))
    assert len(box.vertices) == 24 and np.sort(np.abs(box.normals), axis=1)[:, :2].max() < 1e-12
    ball = trimesh.creation.icosphere(subdivisions=3)
    smooth = creased(ball.vertices.view(np.ndarray), ball.faces.view(np.ndarray), np.ones((len(ball.faces), 3)))
    assert len(smooth.vertices) == len(ball.vertices)
    assert (smooth.normals * smooth.vertices).sum(axis=1).min() > 0.999


def test_without_meshes_the_spheres_are_drawn(arm):
    drawn = load_visual(replace(arm, meshes={}))
    assert list(drawn) == ["tip"]
    assert np.linalg.norm(drawn["tip"][0].vertices - [0, 0, 0.1], axis=1).max() == pytest.approx(0.12)


def test_visual_meshes_that_are_elsewhere_than_the_collision_meshes_are_not_drawn():
    panda = rd.load_robot("panda")
    moved = {link: tuple(replace(m, vertices=m.vertices + 0.1) for m in of) for link, of in panda.meshes.items()}
    drawn = load_visual(replace(panda, meshes=moved))
    for link in ("panda_link5", "panda_hand"):
        np.testing.assert_array_equal(drawn[link][0].vertices, moved[link][0].vertices)


@pytest.mark.parametrize("name", ["panda", "ur5", "xarm7"])
def test_bundled_visual_meshes_are_drawn(name):
    robot = rd.load_robot(name)
    assert has_visual(robot)
    plain = {
        link
        for link, drawn in load_visual(robot).items()
        if len(robot.meshes.get(link, ())) and len(drawn[0].faces) == len(robot.meshes[link][0].faces)
    }
    assert plain <= {"ee_link"}, "these links are drawn by their collision geometry"


@pytest.mark.parametrize("flat", [[[1, 1, 1]] * 3, [[1, 1, 1], [2, 2, 2], [3, 3, 3]]])
def test_meshes_without_area_are_drawn(flat: list[list[int]]) -> None:
    assert np.isfinite(creased(np.array(flat, np.float64), np.array([[0, 1, 2]]), np.ones((1, 3))).normals).all()
