"""Writes 3D replays of motions as single HTML files, for any browser with WebGL, offline."""

import base64
import html
import json
import re
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.output_files import check_output, write_atomically
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.transforms import inverse, quaternion_from_rotation
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.drawables import GOAL, START, Color, Drawable, Surface, drawables, thinned
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.moving_obstacles import MovingObstacle
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import PointCloud, Triangulated
from robotdiffuse.visualization.arm import DrawnArm, facts, interpolated, timed
from robotdiffuse.visualization.camera import VERTICAL_FIELD, view_of_motion

MAX_ROW_RATE = 60.0
"""Most rows of the motion per second; the page interpolates between them."""
TRACK_RATE = 30.0
"""Poses of moving obstacles per second."""
MAX_ROWS = 3000
"""Most rows of the motion."""
VIEW_SIZE = (1600, 1000)
"""Window size for which the first view is chosen [pixels]."""
VIEW_MARGINS = (0.09, 0.15)
"""Fractions of the window's height that the first view leaves free for the panels."""


def write_replay(
    robot: Robot,
    scene: Scene,
    motion: Path | Trajectory,
    file: str | FilePath,
    *,
    result: PlanResult | None = None,
    title: str | None = None,
    candidates: Sequence[Path] = (),
    moving: Sequence[MovingObstacle] = (),
) -> None:
    """Write a replay of a motion as a self-contained .html file.

    `result` adds its figures to the header. For `candidates`, other paths of the same robot, the traces of
    the tool are shown. `moving` obstacles move along with a timed motion. A path without times plays at
    constant speed in joint space. Raises InputError for another ending or a file that cannot be written.
    """
    target = check_output(file, (".html", ".htm"))
    count = len(scene.shapes) + len(moving)
    title = title or f"{robot.name} · {count} obstacle{'' if count == 1 else 's'}"
    data = page_data(robot, scene, motion, result, candidates, moving)
    write_atomically(target, page_text(title, data))


def page_text(title: str, data: dict[str, Any], script: str = "") -> str:
    """A page with the data of `page_data`. script: name of a file that runs after `replay.js`."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    page = files("robotdiffuse.visualization") / "page"
    parts = {
        "title": html.escape(title),
        "style": (page / "replay.css").read_text("utf-8"),
        # in JSON '<' occurs only in strings; escaped, it cannot end the script element
        "data": text.replace("<", "\\u003c"),
        "three": (page / "three.min.js").read_text("utf-8"),
        "script": (page / "replay.js").read_text("utf-8"),
        "more": (page / script).read_text("utf-8") if script else "",
    }
    template = (page / "replay.html").read_text("utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda part: parts[part[1]], template)


def page_data(
    robot: Robot,
    scene: Scene,
    motion: Path | Trajectory,
    result: PlanResult | None = None,
    candidates: Sequence[Path] = (),
    moving: Sequence[MovingObstacle] = (),
) -> dict[str, Any]:
    """What the page reads; see `write_replay`."""
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
            "prismatic": list(robot.prismatic),
            "frames": [_packed(surface) if len(surface.faces) else None for surface in arm.surfaces],
            "spheres": _spheres(robot),
            "tool": {"frame": arm.tool_frame, "point": _rounded(arm.tool_point, 5)},
        },
        "scene": [_shape(one) for one in obstacles if one.moving is None],
        "moving": [
            {"shape": _shape(one), "track": _track(one, motion)}
            for one in obstacles
            if one.moving is not None
        ],
        "ground": round(
            float(min([one.surface.vertices[:, 2].min(initial=0.0) for one in obstacles] + [0.0])), 4
        ),
        "timed": isinstance(motion, Trajectory),
        "times": _rounded(times, 4),
        "positions": _rounded(positions, 5),
        "candidates": [_rounded(arm.trace(path.positions), 4) for path in candidates],
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


def _thinned(
    times: Float[ndarray, "n"], positions: Float[ndarray, "n dof"]
) -> tuple[Float[ndarray, "m"], Float[ndarray, "m dof"]]:
    """At most MAX_ROW_RATE rows per second and MAX_ROWS in all; shorter motions stay unchanged."""
    max_rows = int(min(MAX_ROWS, max(2, np.ceil(MAX_ROW_RATE * times[-1]) + 1)))
    if len(times) <= max_rows:
        return times, positions
    at = np.linspace(0, times[-1], max_rows)
    return at, interpolated(at, times, positions)


def _track(obstacle: Drawable, motion: Path | Trajectory) -> list[list[float]]:
    """How the obstacle has moved from its first pose at equal steps of the motion's time: x y z, and the
    quaternion wxyz."""
    if not isinstance(motion, Trajectory):
        return [[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]
    count = int(min(MAX_ROWS, np.ceil(TRACK_RATE * motion.duration) + 1))
    T_shape_base = inverse(obstacle.frame())
    rows = []
    for time in np.linspace(0.0, motion.duration, count):
        T = obstacle.frame(time) @ T_shape_base
        rows.append(_rounded(np.concatenate([T[:3, 3], quaternion_from_rotation(T[:3, :3])]), 6))
    return rows


def _spheres(robot: Robot) -> list[list[float | int]]:
    """Frame, x, y, z and radius of each covering sphere."""
    rows = []
    for link, spheres in robot.spheres.items():
        T = robot.T_frame_link(link)
        rows += [
            [robot.link_frame(link), *_rounded(T[:3, :3] @ s[:3] + T[:3, 3], 4), round(float(s[3]), 4)]
            for s in spheres
        ]
    return rows


def page_shapes(scene: Scene) -> list[dict[str, Any]]:
    """The obstacles for the page."""
    return [_shape(one) for one in drawables(scene)]


def _shape(obstacle: Drawable) -> dict[str, Any]:
    """An obstacle for the page: its fields, or packed geometry."""
    shape = obstacle.shape
    color = obstacle.color
    if isinstance(shape, Triangulated):
        return page_surface(shape.name, obstacle.surface, color)
    record: dict[str, Any] = {"kind": shape.kind, "name": shape.name, "color": color}
    if isinstance(shape, PointCloud):
        low, step, points = _quantized(thinned(shape.points))
        return record | {"radius": shape.point_radius, "low": low, "step": step, "points": points}
    for name in ("center", "size", "wxyz", "radius", "height"):
        if hasattr(shape, name):
            record[name] = _rounded(getattr(shape, name), 6)
    return record


def page_surface(name: str, surface: Surface, color: Color) -> dict[str, Any]:
    """A surface in the base frame for the page, in one color."""
    return {"kind": "mesh", "name": name, "color": color, "surface": _packed(surface, colored=False)}


def _packed(surface: Surface, colored: bool = True) -> dict[str, Any]:
    """Geometry in base64: 16-bit vertices, 8-bit normals and colors."""
    low, step, vertices = _quantized(surface.vertices)
    wide_indices = len(surface.vertices) >= 2**16
    packed = {
        "low": low,
        "step": step,
        "vertices": vertices,
        "normals": _base64(np.round(127 * surface.normals).astype(np.int8)),
        "faces": _base64(surface.faces.astype("<u4" if wide_indices else "<u2")),
        "wide": wide_indices,
    }
    return (
        packed | {"colors": _base64(np.round(255 * surface.colors).astype(np.uint8))} if colored else packed
    )


def _quantized(points: Float[ndarray, "n 3"]) -> tuple[list[float], float, str]:
    """Lowest corner, step and the points as 16-bit multiples of the step in base64."""
    if len(points) == 0:
        return [0.0, 0.0, 0.0], 1.0, ""
    low = points.min(0)
    step = max(float(np.ptp(points, axis=0).max()), 1e-6) / 65535
    return low.tolist(), step, _base64(np.round((points - low) / step).astype("<u2"))


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _rounded(values: np.ndarray | float, digits: int) -> Any:
    return np.round(values, digits).tolist()
