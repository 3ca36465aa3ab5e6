"""Writes 3D replays of motions: single HTML files that work offline in any browser with WebGL. There are
pages for a motion, for a problem without a motion, galleries of several motions, and replays in notebook
cells."""

import base64
import html
import io
import json
import re
import sys
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from robotdiffuse.core.errors import InputError, check_type, counted, shortened
from robotdiffuse.core.files import JsonObject, check_output, write_atomically
from robotdiffuse.core.transforms import IDENTITY, inverse, quaternion_from_rotation
from robotdiffuse.core.types import (
    Configuration,
    Configurations,
    Done,
    Path,
    PlanResult,
    Points,
    Pose,
    ResultFile,
    Trajectory,
    Values,
    frozen_dataclass,
    interpolated,
    unreported,
)
from robotdiffuse.drawables import (
    GOAL,
    START,
    Color,
    Drawable,
    Surface,
    creased,
    drawables,
    link_surfaces,
    painted,
    thinned,
)
from robotdiffuse.planning.pose_goals import pose_configurations
from robotdiffuse.problems.files import problem_from_record
from robotdiffuse.problems.problem import (
    JointGoal,
    Problem,
    StateValidity,
    check_problem,
    goals_of,
    poses_of,
)
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import MovingObstacle, Scene, added
from robotdiffuse.scenes.shapes import PointCloud, Sphere, Triangulated
from robotdiffuse.visualization.picture import (
    MARGINS,
    VERTICAL_FIELD,
    ClearSurface,
    DrawnArm,
    PictureSettings,
    check_motion_of,
    facts,
    linear,
    render,
    timed,
    tube,
    view_of_motion,
    write_captioned,
)

MAX_ROW_RATE = 60.0
"""Largest number of rows of the motion per second in a page, which interpolates between rows."""
TRACK_RATE = 30.0
"""Number of poses of a moving obstacle per second in a page."""
MAX_ROWS = 3000
"""Largest number of rows of the motion, and of poses of a moving obstacle, in a page."""
VIEW_SIZE = (1600, 1000)
"""Window size for which the first view is chosen [pixels]."""
VIEW_MARGINS = (0.09, 0.15)
"""The first view leaves these fractions of the window's height free for the panels above and below."""


def write_replay(
    robot: Robot,
    scene: Scene,
    motion: Path | Trajectory,
    file: str | FilePath,
    *,
    result: PlanResult | None = None,
    title: str | None = None,
    moving: Sequence[MovingObstacle] = (),
) -> None:
    """Write a replay of a motion as a self-contained .html file.

    `result` adds facts to the header. `moving` obstacles move while a timed motion is played. A path without
    times is played at constant speed in joint space. Raises InputError for a file name with another ending,
    or a file that cannot be written.
    """
    target = check_output(file, (".html", ".htm"))
    title = title or f"{robot.name} · {counted(len(scene.shapes) + len(moving), 'obstacle')}"
    write_atomically(target, page_text(title, page_data(robot, scene, motion, result, moving)))


def page_text(title: str, data: JsonObject, script: str = "") -> str:
    """The HTML text of a page with the data of `page_data`. `script` is the name of a file in the folder
    `page` that runs after `replay.js`."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)

    def content(name: str) -> str:
        return (files("robotdiffuse.visualization") / "page" / name).read_text("utf-8")

    parts = {
        "title": html.escape(title),
        "style": content("replay.css"),
        # in JSON '<' occurs only in strings; escaped, it cannot end the script element
        "data": text.replace("<", "\\u003c"),
        "three": content("three.min.js"),
        "script": content("replay.js"),
        "more": content(script) if script else "",
    }
    return _filled(content("replay.html"), parts)


def _filled(template: str, parts: dict[str, str]) -> str:
    """The template with each {{name}} replaced by the part of that name, in one pass."""
    return re.sub(r"\{\{(\w+)\}\}", lambda part: parts[part[1]], template)


def page_data(
    robot: Robot,
    scene: Scene,
    motion: Path | Trajectory,
    result: PlanResult | None = None,
    moving: Sequence[MovingObstacle] = (),
) -> JsonObject:
    """The data of a page, in the form that `replay.js` reads; for the arguments see `write_replay`."""
    check_motion_of(robot, motion)
    arm = DrawnArm(robot)
    obstacles = drawables(scene, moving)
    times, positions = _thinned(*timed(motion))
    camera = view_of_motion(arm, obstacles, motion.positions, VIEW_SIZE, VIEW_MARGINS)
    return {
        "robot": {
            "name": robot.name,
            "joints": list(robot.joint_names),
            "offsets": [_rounded(offset[:3].reshape(-1), 9) for offset in robot.frame_offsets],
            "parents": robot.parents.tolist(),
            "prismatic": robot.prismatic.tolist(),
            "frames": [_packed(surface) if len(surface.faces) else None for surface in arm.surfaces],
            "spheres": _spheres(robot),
            "tool": {"frame": arm.tool_frame, "point": _rounded(arm.tool_point, 5)},
        },
        "scene": [_shape(obstacle) for obstacle in obstacles if obstacle.moving is None],
        "moving": [
            {"shape": _shape(obstacle), "track": _track(obstacle, motion)}
            for obstacle in obstacles
            if obstacle.moving is not None
        ],
        "ground": round(
            float(min([obstacle.surface.vertices[:, 2].min(initial=0.0) for obstacle in obstacles] + [0.0])),
            4,
        ),
        "timed": isinstance(motion, Trajectory),
        "times": _rounded(times, 4),
        "positions": _rounded(positions, 5),
        "start_color": START,
        "goal_color": GOAL,
        "facts": facts(motion, result, robot),
        "camera": {
            "eye": _rounded(camera.eye, 4),
            "target": _rounded(camera.target, 4),
            "field": round(float(np.degrees(VERTICAL_FIELD)), 3),
            "aspect": VIEW_SIZE[0] / VIEW_SIZE[1],
        },
    }


def _thinned(times: Values, positions: Configurations) -> tuple[Values, Configurations]:
    """Resamples a motion to at most MAX_ROW_RATE rows per second and MAX_ROWS rows. Motions with fewer rows
    are not changed."""
    max_rows = int(min(MAX_ROWS, max(2, np.ceil(MAX_ROW_RATE * times[-1]) + 1)))
    if len(times) <= max_rows:
        return times, positions
    at = np.linspace(0, times[-1], max_rows)
    return at, interpolated(at, times, positions)


def _track(obstacle: Drawable, motion: Path | Trajectory) -> list[list[float]]:
    """The obstacle's motion relative to its pose at time 0, in the base frame: rows of x y z and wxyz at
    evenly spaced times of the robot's motion."""
    if not isinstance(motion, Trajectory):
        return [[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]
    count = int(min(MAX_ROWS, np.ceil(TRACK_RATE * motion.duration) + 1))
    T_shape_base = inverse(obstacle.frame())
    rows = []
    for time in np.linspace(0.0, motion.duration, count):
        T = obstacle.frame(time) @ T_shape_base
        rows.append(_rounded(np.concatenate([T[:3, 3], quaternion_from_rotation(T)]), 6))
    return rows


def _spheres(robot: Robot) -> list[list[float | int]]:
    """For each covering sphere: the index of its frame, and x, y, z and radius in this frame [m]."""
    rows = []
    for link in robot.spheres:
        spheres = _rounded(robot.frame_spheres(link), 4)
        rows += [[robot.link_frame(link), *sphere] for sphere in spheres]
    return rows


def page_shapes(scene: Scene) -> list[JsonObject]:
    """The obstacles of a scene, in the form that the page reads."""
    return [_shape(obstacle) for obstacle in drawables(scene)]


def _shape(obstacle: Drawable) -> JsonObject:
    """An obstacle in the form that the page reads: its fields, or packed geometry for meshes and point
    clouds."""
    shape = obstacle.shape
    color = obstacle.color
    if isinstance(shape, Triangulated):
        return page_surface(shape.name, obstacle.surface, color)
    record: JsonObject = {"kind": shape.kind, "name": shape.name, "color": color}
    if isinstance(shape, PointCloud):
        low, step, points = _quantized(thinned(shape.points))
        return record | {"radius": shape.point_radius, "low": low, "step": step, "points": points}
    for name in ("center", "size", "wxyz", "radius", "height"):
        if hasattr(shape, name):
            record[name] = _rounded(getattr(shape, name), 6)
    return record


def page_surface(name: str, surface: Surface, color: Color) -> JsonObject:
    """A surface in the base frame with one color, in the form that the page reads."""
    return {"kind": "mesh", "name": name, "color": color, "surface": _packed(surface, colored=False)}


def _packed(surface: Surface, colored: bool = True) -> JsonObject:
    """A surface as base64 texts: 16-bit vertices, 8-bit normals and colors, and faces."""
    low, step, vertices = _quantized(surface.vertices)
    wide_indices = len(surface.vertices) >= 2**16
    packed = {
        "low": low,
        "step": step,
        "vertices": vertices,
        "normals": in_base64(np.round(127 * surface.normals).astype(np.int8)),
        "faces": in_base64(surface.faces.astype("<u4" if wide_indices else "<u2")),
        "wide": wide_indices,
    }
    return (
        packed | {"colors": in_base64(np.round(255 * surface.colors).astype(np.uint8))} if colored else packed
    )


def _quantized(points: Points) -> tuple[list[float], float, str]:
    """The points' lower corner, a step [m], and the points relative to the corner as 16-bit multiples of the
    step in base64."""
    if len(points) == 0:
        return [0.0, 0.0, 0.0], 1.0, ""
    low = points.min(0)
    step = max(float(np.ptp(points, axis=0).max()), 1e-6) / 65535
    return low.tolist(), step, in_base64(np.round((points - low) / step).astype("<u2"))


def in_base64(array: np.ndarray) -> str:
    """The bytes of an array as text."""
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _rounded(values: np.ndarray | float, digits: int) -> Any:
    return np.round(values, digits).tolist()


COLLIDING = (0xD0, 0x1F, 0x2B)
"""sRGB color of links that collide."""
OFFSET = 0.0015
"""Distance by which the surfaces of colliding links are moved outwards, to hide the arm's own colors [m]."""
START_ALPHA = 0.5
"""Opacity of the arm at the start in pictures."""
AXES = ((0xC9, 0x3C, 0x3C), (0x3C, 0x9A, 0x4B), (0x3C, 0x64, 0xC9))
"""sRGB colors of the axes of goal poses."""
AXIS_LENGTH = 0.12
"""Length of the axes of goal poses [m]."""
UNREACHED = StateValidity("no configuration within the joint limits")


def write_problem(problem: Problem, file: str | FilePath, result: PlanResult | None = None) -> None:
    """Write a problem without a motion as .html or .png.

    The arm is drawn at the start and at the goal. One of the two is see-through: in pictures the arm at the
    start, on pages the arm at the goal. Colliding links are red, and goal poses are drawn as axes. Of
    several goals, the first free one is drawn; if none is free, the first one. Moving obstacles are drawn
    where they are at time 0. `result` gives the reason why there is no motion, shown if start and goal are
    free. Raises InputError for a file name with another ending, or a file that cannot be written.
    """
    target = check_output(file, (".html", ".htm", ".png"))
    goal_configuration, validity = _goal_state(problem)
    validities = {"start": problem.is_free(problem.start), "goal": validity}
    states = np.stack([problem.start] if goal_configuration is None else [problem.start, goal_configuration])
    robot, scene = problem.robot_and_scene_in_world()
    scene = added(scene, (moving.at(0.0) for moving in problem.moving_in_world))
    T_world_base = IDENTITY if problem.T_world_base is None else problem.T_world_base
    poses = (pose for goal in goals_of(problem.goal) for pose in poses_of(goal))
    T_world_poses = [T_world_base @ pose.T_base_frame for pose in poses]
    near_poses = [Sphere(T[:3, 3], AXIS_LENGTH) for T in T_world_poses]
    framed = added(scene, near_poses)  # the view includes goal poses
    arm = DrawnArm(robot)
    marks = [*_colliding_links(arm, states, list(validities.values())), *_axes(T_world_poses)]
    facts = [(label, state.reason or "free") for label, state in validities.items()]
    if result is not None and all(validities.values()):
        facts = [("reason", shortened(result.reason))]
    status = "" if result is None else f" · {result.status.value.replace('_', ' ')}"
    title = f"{robot.name}{status}"
    if target.suffix.lower() == ".png":
        settings = PictureSettings()
        size = settings.width, settings.height
        camera = view_of_motion(arm, drawables(framed), states, size, MARGINS)
        start = ClearSurface(arm.posed(states[0], 1), linear(START), START_ALPHA)
        ghost = [start] if len(states) > 1 else []
        end = Path(robot.joint_names, states[-1:])
        surfaces = [surface for surface, _ in marks]
        pixels = render(robot, scene, end, settings, camera, added=surfaces, clear=ghost)
        return write_captioned(pixels, target, title, facts)
    data = page_data(robot, framed, Path(robot.joint_names, states))
    data["scene"] = [*page_shapes(scene), *(page_surface("mark", *mark) for mark in marks)]
    data["times"] = [0.0] * len(states)  # nothing moves
    data["facts"] = facts
    return write_atomically(target, page_text(title, data))


def _goal_state(problem: Problem) -> tuple[Configuration | None, StateValidity]:
    """The first free goal configuration, or else the first goal configuration, and its validity; None and
    UNREACHED if no configuration that reaches the goal was found."""
    rng = np.random.default_rng(0)
    first = None
    for goal in goals_of(problem.goal):
        joints = isinstance(goal, JointGoal)
        for q in goal.positions if joints else pose_configurations(problem, goal, rng):
            validity = problem.is_free(q)
            if validity:
                return q, validity
            first = first or (q, validity)
    return first or (None, UNREACHED)


def _colliding_links(
    arm: DrawnArm, states: Configurations, validities: list[StateValidity]
) -> list[tuple[Surface, Color]]:
    """The surfaces of the colliding links at each of the configurations `states`, and their color."""
    robot = arm.robot
    links = link_surfaces(robot) if any(validity.links for validity in validities) else {}
    marks = []
    # not strict: if no configuration reaches the goal, `states` has only the start
    for q, validity in zip(states, validities, strict=False):
        for link in validity.links:
            marks.append((_raised(links[link]).moved(robot.fk(q, link)), COLLIDING))
    return marks


def _raised(surface: Surface) -> Surface:
    """The surface in the color of collisions, moved outwards by OFFSET."""
    import trimesh

    # sharp edges have a vertex for each face; trimesh merges the vertices at one point
    merged = trimesh.Trimesh(surface.vertices, surface.faces)
    vertices = np.array(merged.vertices) + OFFSET * merged.vertex_normals
    return creased(vertices, np.array(merged.faces), painted(COLLIDING, len(merged.faces)))


def _axes(poses: list[Pose]) -> list[tuple[Surface, Color]]:
    """The axes of poses as tubes, and their colors."""
    axes = []
    for T in poses:
        for axis, color in enumerate(AXES):
            ends = np.stack([T[:3, 3], T[:3, 3] + AXIS_LENGTH * T[:3, axis]])
            axes.append((tube(ends, color, color), color))
    return axes


THUMBNAIL = PictureSettings(480, 300, ghosts=3)

PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{title}}</title>
<style>
* { box-sizing: border-box; }
html, body { margin: 0; height: 100%; overflow: hidden; background: #eceef1; color: #222b38;
  font: 13px/1.4 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
body { display: flex; }
nav { flex: none; width: 262px; padding: 16px 14px; overflow-y: auto; background: #f7f8fa;
  border-right: 1px solid rgba(34, 43, 56, .1); }
h1 { margin: 2px 4px 13px; font-size: 17px; font-weight: 650; letter-spacing: -.01em; }
button { display: block; width: 100%; margin: 0 0 12px; padding: 0 0 8px; overflow: hidden; border: 0;
  border-radius: 12px; background: white; color: inherit; font: inherit; text-align: left; cursor: pointer;
  box-shadow: 0 0 0 1px rgba(34, 43, 56, .08), 0 3px 12px rgba(30, 40, 60, .06); }
button:hover { box-shadow: 0 0 0 1px rgba(34, 43, 56, .22), 0 3px 12px rgba(30, 40, 60, .1); }
button[aria-current=true] { box-shadow: 0 0 0 2.5px #10a37f, 0 3px 12px rgba(30, 40, 60, .1); }
img { display: block; width: 100%; aspect-ratio: 8 / 5; }
b { display: block; margin: 8px 12px 0; font-weight: 600; }
span { display: block; margin: 1px 12px 0; color: #6b7684; font-size: 12px;
  font-variant-numeric: tabular-nums; }
iframe { flex: 1; min-width: 0; height: 100%; border: 0; }
@media (max-width: 760px) { body { flex-direction: column; }
  nav { width: 100%; display: flex; gap: 10px; padding: 8px; overflow-x: auto; } h1 { display: none; }
  button { flex: none; width: 150px; margin: 2px; } }
</style>
</head>
<body>
<nav><h1>{{title}}</h1>{{buttons}}</nav>
<iframe title="replay"></iframe>
<script type="application/json" id="replays">{{replays}}</script>
<script>
const replays = JSON.parse(document.getElementById("replays").textContent);
const buttons = [...document.querySelectorAll("button")], frame = document.querySelector("iframe");
let shown = -1;
function show(i, scroll = true) {
  if (i === shown || !replays.pages[i]) return;
  shown = i;
  buttons.forEach((button, j) => button.setAttribute("aria-current", i === j));
  // not at first: in an iframe it would scroll the outer page
  if (scroll) buttons[i].scrollIntoView({ block: "nearest", inline: "nearest" });
  frame.srcdoc = replays.pages[i].map((part) => replays.parts[part]).join("");
}
buttons.forEach((button, i) => button.addEventListener("click", () => show(i)));
addEventListener("keydown", (event) => {
  const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
  if (step) { event.preventDefault(); show(shown + step); }
});
show(0, false);
</script>
</body>
</html>
"""


@frozen_dataclass
class GalleryEntry:
    """A motion in a gallery, with its scene."""

    title: str
    caption: str
    """One line below the title."""
    scene: Scene
    motion: Path | Trajectory
    moving: tuple[MovingObstacle, ...] = ()


def write_gallery(
    robot: Robot,
    entries: Sequence[GalleryEntry],
    file: str | FilePath,
    title: str,
    progress: Done = unreported,
) -> None:
    """Write a gallery of motions as a self-contained .html file.

    `progress` is called with the number of motions drawn so far and the total number. Raises InputError for a
    file name with another ending, or a file that cannot be written.
    """
    target = check_output(file, (".html", ".htm"))
    replays = []
    buttons = []
    for i, entry in enumerate(entries):
        data = page_data(robot, entry.scene, entry.motion, moving=entry.moving)
        replays.append(page_text(entry.title, data))
        buttons.append(
            f'<button><img alt="" src="data:image/jpeg;base64,{_thumbnail(robot, entry)}">'
            f"<b>{html.escape(entry.title)}</b><span>{html.escape(entry.caption)}</span></button>"
        )
        progress(i + 1, len(entries))
    # in JSON '<' occurs only in strings; escaped, it cannot end the script element
    data = json.dumps(_shared(replays)).replace("<", "\\u003c")
    parts = {"title": html.escape(title), "buttons": "".join(buttons), "replays": data}
    write_atomically(target, _filled(PAGE, parts))


def _shared(pages: list[str]) -> dict[str, list]:
    """Splits pages into parts and stores equal parts once, since all pages share the 3D library and the
    robot. Returns the parts, and for each page the indices of its parts."""
    split_pages = [re.split(r'(?=<script)|(?="scene":)', page) for page in pages]
    part_indices = {
        part: i for i, part in enumerate(dict.fromkeys(part for parts in split_pages for part in parts))
    }
    return {
        "parts": list(part_indices),
        "pages": [[part_indices[part] for part in parts] for parts in split_pages],
    }


def _thumbnail(robot: Robot, entry: GalleryEntry) -> str:
    """A small JPEG picture of a motion, in base64."""
    pixels = render(robot, entry.scene, entry.motion, THUMBNAIL, moving=entry.moving)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=88)
    return base64.b64encode(buffer.getvalue()).decode("ascii")


class Replay:
    """The output of a notebook cell: a replay in an iframe."""

    def __init__(self, page: str, height: int) -> None:
        self._page = page
        self._height = height

    def _repr_html_(self) -> str:
        style = "width: 100%; border: 0; border-radius: 8px"
        page = html.escape(self._page)
        return f'<iframe srcdoc="{page}" height="{self._height}" style="{style}"></iframe>'


def show(result: PlanResult | ResultFile, problem: Problem | None = None, height: int = 560) -> Replay:
    """Show the replay of a result, as the last line of a notebook cell.

    Elsewhere in a cell, use `display(rd.show(result))`. If the result has no motion, the start, the goal and
    colliding links are shown.

    Args:
        result: A result of `plan`, or a result file.
        problem: The problem, needed only if the result does not contain it. Results of `plan`, and files that
            were saved with their problem, contain it.
        height: Height of the replay [pixels].

    Returns:
        The replay, which notebooks display.

    Raises:
        InputError: Outside a notebook, for a result or problem of another type, and if the problem is
            unknown or cannot be read.

    Example:
        ```python
        rd.show(rd.plan(rd.load_problem("examples/ball.yaml")))
        ```
    """
    check_type("result", result, (PlanResult, ResultFile), "a result of rd.plan or rd.load_result")
    if problem is not None:
        check_problem(problem)
    if isinstance(result, ResultFile):
        if problem is None and result.problem is not None:
            problem = problem_from_record(result.problem)
        result = result.result
    problem = problem or result.problem
    if problem is None:
        raise InputError("the result does not contain its problem; use rd.show(result, problem)")
    if not _in_notebook():
        raise InputError(
            "rd.show is for notebooks; elsewhere save the result and use `robotdiffuse view`, or "
            "robotdiffuse.visualization.write_replay"
        )
    return Replay(result_page(problem, result), height)


def result_page(problem: Problem, result: PlanResult) -> str:
    """The HTML page of a result: the replay of its motion, or, if it has no motion, the problem."""
    motion = result.trajectory or result.path
    with TemporaryDirectory() as folder:
        file = FilePath(folder) / "replay.html"
        if motion is None:
            write_problem(problem, file, result)
        else:
            moving = problem.moving_in_world
            write_replay(*problem.robot_and_scene_in_world(), motion, file, result=result, moving=moving)
        return file.read_text("utf-8")


def _in_notebook() -> bool:
    """Whether this process is a Jupyter kernel; IPython is not imported for it."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel")
