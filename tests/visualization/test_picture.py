"""Pictures: what they show, and errors for bad settings."""

from dataclasses import replace

import numpy as np
from PIL import Image

from helpers.refusals import refuses
from robotdiffuse import Box, Path, Scene, load_robot
from robotdiffuse.drawables import drawables
from robotdiffuse.visualization import PictureSettings, write_comparison, write_picture
from robotdiffuse.visualization.arm import DrawnArm
from robotdiffuse.visualization.picture import COMPARED, MARGINS, drawn_by, render, view_of_motion

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
