"""Draws docs/demo.gif: the problem of examples/upright_cup.yaml planned, and its motion at half speed.

python docs/draw_demo.py
"""

from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

import robotdiffuse as rd
from robotdiffuse.drawables import drawables
from robotdiffuse.visualization.picture import MARGINS, DrawnArm, PictureSettings, render, view_of_motion

ROOT = Path(__file__).parents[1]
SIZE = PictureSettings(width=720, height=450, ghosts=1)
FRAME_TIME = 0.05
"""How long a frame is shown [s]; a multiple of 10 ms, in which GIF counts."""
SLOWDOWN = 2.0
# How long the first and the last frame are shown [s].
FIRST_FRAME_TIME = 0.5
LAST_FRAME_TIME = 1.5
COLORS = 256


def frames(problem: rd.Problem, trajectory: rd.Trajectory) -> list[Image.Image]:
    """A frame for each moment: the arm, its start as a ghost, and the path of the cup so far."""
    robot, scene = problem.robot_and_scene_in_world()
    size = SIZE.width, SIZE.height
    camera = view_of_motion(DrawnArm(robot), drawables(scene), trajectory.positions, size, MARGINS)
    count = int(np.ceil(SLOWDOWN * trajectory.times[-1] / FRAME_TIME)) + 1
    pictures = []
    for time in np.linspace(0.0, trajectory.times[-1], count):
        so_far = max(1, int(np.searchsorted(trajectory.times, time, "right")))
        path = rd.Path(trajectory.joint_names, trajectory.positions[:so_far])
        pictures.append(Image.fromarray(render(robot, scene, path, SIZE, camera)))
    return pictures


def gif(pictures: list[Image.Image]) -> bytes:
    strip = Image.fromarray(np.concatenate([np.asarray(pictures[i]) for i in (0, len(pictures) // 2, -1)]))
    palette = strip.quantize(COLORS, method=Image.Quantize.MEDIANCUT)
    reduced = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    times = [FIRST_FRAME_TIME, *[FRAME_TIME] * (len(reduced) - 2), LAST_FRAME_TIME]
    content = BytesIO()
    durations = [round(1000 * time) for time in times]
    reduced[0].save(content, "GIF", save_all=True, append_images=reduced[1:], duration=durations, loop=0)
    return content.getvalue()


def main() -> None:
    problem = rd.load_problem(ROOT / "examples" / "upright_cup.yaml")
    result = rd.plan(problem, time_limit=5.0)
    assert result.trajectory is not None, result.reason
    content = gif(frames(problem, result.trajectory))
    (ROOT / "docs" / "demo.gif").write_bytes(content)
    print(f"wrote docs/demo.gif: {result.trajectory.duration:.2f} s, {len(content) / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
