"""Pictures: what they show, their surfaces, traces and visual meshes, and errors for bad settings."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image

import robotdiffuse as rd
from helpers.refusals import refuses
from helpers.three_bars import CORNERS, CUBE
from robotdiffuse import Box, Path, Scene, load_robot
from robotdiffuse.drawables import creased, drawables
from robotdiffuse.robots.visual_meshes import has_visual, load_visual
from robotdiffuse.visualization import PictureSettings, write_comparison, write_picture
from robotdiffuse.visualization.picture import COMPARED, MARGINS, DrawnArm, drawn_by, render, view_of_motion

SMALL = PictureSettings(width=320, height=200, ghosts=2)


def test_picture_shows_the_tip_where_kinematics_puts_it(arm, motion, tmp_path):
    camera = view_of_motion(DrawnArm(arm), [], motion.positions, (320, 200), MARGINS)
    pixels = render(arm, Scene(), motion, SMALL, camera)
    middle_of_tip = arm.fk(motion.positions[-1], "tip") @ [0, 0, 0.1, 1]
    column, row, _ = camera.project(middle_of_tip[None, :3])[0].astype(int)
    away = render(arm, Scene(), Path(arm.joint_names, motion.positions[:1]), replace(SMALL, ghosts=0))
    assert away.shape == (200, 320, 3) and 0 < column < 320 and 0 < row < 200
    patch = pixels[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3).astype(int)
    assert np.ptp(patch, axis=1).max() < 60, "the arm is gray; the trace ends beyond the middle of the tip"
    assert np.abs(patch - pixels[3, 3].astype(int)).max() > 12
    write_picture(arm, Scene(), motion, tmp_path / "motion.png", settings=SMALL)
    with Image.open(tmp_path / "motion.png") as image:
        assert image.format == "PNG" and image.size == (320, 200)


def test_picture_shows_obstacles_in_their_color(arm, scene, motion):
    ball = Scene([scene.shapes[0]])
    camera = view_of_motion(DrawnArm(arm), drawables(ball), motion.positions, (320, 200), MARGINS)
    column, row, _ = camera.project(np.array([[-0.5, 0.4, 0.5]]))[0].astype(int)
    r, g, b = render(arm, ball, motion, SMALL, camera)[row, column].astype(int)
    assert r > g + 25 > b + 25


def test_a_wall_that_the_arm_passes_is_not_hidden_behind_the_arm():
    robot = load_robot("panda")
    wall = Box([0.55, 0.0, 0.25], [0.3, 0.04, 0.5], name="wall")
    obstacles = drawables(Scene([Box([0.5, 0.0, -0.05], [0.8, 1.2, 0.1], name="table"), wall]))
    q = np.tile([robot.poses["ready"][joint] for joint in robot.joint_names], (20, 1))
    q[:, 0] = np.linspace(-0.6, 0.6, 20)
    camera = view_of_motion(DrawnArm(robot), obstacles, q, (320, 200), MARGINS)
    in_front, _, _ = drawn_by(camera, obstacles[1].surface)
    arm, _, _ = drawn_by(camera, DrawnArm(robot).posed(q[-1]))
    assert (in_front > arm).sum() > 0.8 * (in_front > 0).sum()


def test_the_traces_of_all_motions_are_in_the_picture(arm):
    """Regression: the picture was framed for the first motion alone."""
    start = np.zeros(arm.dof)
    motions = [Path(arm.joint_names, np.array([start, end])) for end in (start + 0.1, start + 2 * np.eye(arm.dof)[0])]
    trace = DrawnArm(arm).trace(motions[1].positions)
    camera = view_of_motion(DrawnArm(arm), [], motions[0].positions, (320, 200), MARGINS, traces=[trace])
    x, y, _ = camera.project(trace).T
    assert (x > 0).all() and (x < 320).all() and (y > 0).all() and (y < 200).all()


def test_several_motions_have_traces_of_their_own_colors(arm, motion, tmp_path):
    back = Path(arm.joint_names, motion.positions[::-1].copy() * 0.7)
    few = replace(SMALL, ghosts=0)
    pixels = render(arm, Scene(), motion, few, others=[back])
    for color in COMPARED[:2]:
        wanted = np.array(color) / np.linalg.norm(color)
        unit = pixels / np.maximum(np.linalg.norm(pixels, axis=2, keepdims=True), 1.0)
        assert (unit @ wanted > 0.985).sum() > 5
    write_comparison(arm, Scene(), {"a": motion, "b": back}, tmp_path / "two.png", settings=few)
    with Image.open(tmp_path / "two.png") as image:
        assert image.size == (320, 200)
    many = {str(i): motion for i in range(len(COMPARED) + 1)}
    refuses("5 motions; a picture shows 1 to 4", write_comparison, arm, Scene(), many, tmp_path / "many.png")


def test_trace_follows_the_outer_end_of_the_tip(arm, motion):
    for q, point in zip(motion.positions[::100], DrawnArm(arm).tool_points(motion.positions[::100]), strict=True):
        np.testing.assert_allclose(point, (arm.fk(q, "tip") @ [0, 0, 0.2, 1])[:3], atol=1e-12)


def test_creases_keep_edges_of_a_box_and_smooth_a_ball():
    box = creased(CORNERS, CUBE, np.ones((12, 3)))
    assert len(box.vertices) == 24 and np.sort(np.abs(box.normals), axis=1)[:, :2].max() < 1e-12
    ball = trimesh.creation.icosphere(subdivisions=3)
    smooth = creased(ball.vertices.view(np.ndarray), ball.faces.view(np.ndarray), np.ones((len(ball.faces), 3)))
    assert len(smooth.vertices) == len(ball.vertices) and (smooth.normals * smooth.vertices).sum(axis=1).min() > 0.999


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
