"""Surfaces, traces and visual meshes."""

from dataclasses import replace
from pathlib import Path as FilePath

import numpy as np
import pytest

from helpers.three_bars import CORNERS, CUBE
from robotdiffuse.core.types import Path
from robotdiffuse.drawables import creased
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.visual_meshes import UNIT, VisualMesh, has_visual, load_visual
from robotdiffuse.visualization.arm import DrawnArm, dense, facts


def test_trace_follows_the_outer_end_of_the_tip(arm, motion):
    points = DrawnArm(arm).tool_points(motion.positions[::100])
    for q, point in zip(motion.positions[::100], points, strict=True):
        np.testing.assert_allclose(point, (link_pose(arm, q, "tip") @ [0, 0, 0.2, 1])[:3], atol=1e-12)


def test_creases_keep_edges_of_a_box_and_smooth_a_ball():
    import trimesh

    box = creased(CORNERS, CUBE, np.ones((12, 3)))
    assert len(box.vertices) == 24
    assert np.sort(np.abs(box.normals), axis=1)[:, :2].max() < 1e-12
    ball = trimesh.creation.icosphere(subdivisions=3)
    smooth = creased(
        ball.vertices.view(np.ndarray), ball.faces.view(np.ndarray), np.ones((len(ball.faces), 3))
    )
    assert len(smooth.vertices) == len(ball.vertices)
    assert (smooth.normals * smooth.vertices).sum(axis=1).min() > 0.999


def test_dense_steps_are_equal():
    q = dense(np.array([[0.0, 0], [1, 0], [1, 3]]), 41)
    np.testing.assert_allclose(np.linalg.norm(np.diff(q, axis=0), axis=1), 0.1, atol=1e-12)


def test_without_meshes_the_spheres_are_drawn(arm):
    drawn = load_visual(replace(arm, meshes={}))
    assert list(drawn) == ["tip"]
    assert np.linalg.norm(drawn["tip"][0].vertices - [0, 0, 0.1], axis=1).max() == pytest.approx(0.12)


def write_visual(visual: dict[str, VisualMesh], file: FilePath) -> None:
    """As in the bundles: vertices in units of UNIT, faces, a palette and its index by face."""
    arrays = {}
    for link, mesh in visual.items():
        palette, color = np.unique(mesh.colors, axis=0, return_inverse=True)
        arrays[f"{link}/vertices"] = np.round(mesh.vertices / UNIT).astype(np.int32)
        arrays[f"{link}/faces"] = mesh.faces.astype(np.uint16)
        arrays[f"{link}/palette"] = palette
        arrays[f"{link}/color"] = color.reshape(-1).astype(np.uint8)
    np.savez_compressed(file, **arrays)


def test_visual_meshes_survive_the_file_and_must_agree(arm, tmp_path, monkeypatch):
    colors = np.tile(np.array([[10, 20, 30], [200, 100, 0]], np.uint8), (6, 1))
    written = VisualMesh(arm.meshes["tip"][0].vertices, CUBE, colors)
    elsewhere = VisualMesh(written.vertices + 0.1, CUBE, colors)
    folder = tmp_path / "data" / arm.name
    folder.mkdir(parents=True)
    write_visual({"tip": written, "arm": elsewhere}, folder / "visual.npz")
    monkeypatch.setattr("robotdiffuse.robots.visual_meshes.files", lambda _: tmp_path)
    drawn = load_visual(arm)
    np.testing.assert_allclose(drawn["tip"][0].vertices, written.vertices, atol=2.5e-5)
    np.testing.assert_array_equal(drawn["tip"][0].faces, CUBE)
    np.testing.assert_array_equal(drawn["tip"][0].colors, colors)
    np.testing.assert_array_equal(drawn["arm"][0].vertices, arm.meshes["arm"][0].vertices)


@pytest.mark.parametrize("name", ["panda", "ur5", "ur5e", "ur10", "xarm7"])
def test_bundled_visual_meshes_are_drawn(name):
    robot = load_robot(name)
    assert has_visual(robot)
    plain = {
        link
        for link, drawn in load_visual(robot).items()
        if len(robot.meshes.get(link, ())) and len(drawn[0].faces) == len(robot.meshes[link][0].faces)
    }
    assert plain <= {"ee_link"}, "these links are drawn by their collision geometry"


def test_the_caption_says_that_collision_geometry_is_drawn():
    motion = Path(("a",), np.zeros((2, 1)))
    assert ("drawn by", "collision geometry") in facts(motion, None, load_robot("iiwa14"))
    assert ("drawn by", "collision geometry") not in facts(motion, None, load_robot("ur5e"))


@pytest.mark.parametrize("flat", [[[1, 1, 1]] * 3, [[1, 1, 1], [2, 2, 2], [3, 3, 3]]])
def test_meshes_without_area_are_drawn(flat: list[list[int]]) -> None:
    surface = creased(np.array(flat, np.float64), np.array([[0, 1, 2]]), np.ones((1, 3)))
    assert np.isfinite(surface.normals).all()
