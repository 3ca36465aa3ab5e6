"""Writes an exploration as a 3D replay in one HTML file: the arm, and what was known at each time."""

import base64
from collections import Counter
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from robotdiffuse.core.output_files import check_output
from robotdiffuse.core.types import Trajectory
from robotdiffuse.perception.occupancy_map import MAP
from robotdiffuse.planning.exploration.recorded import RecordedExplorer
from robotdiffuse.planning.exploration.steps import DONE, LOOK
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.visualization import style
from robotdiffuse.visualization.exploration import (
    LOOK_COLOR,
    READING_TIME,
    UNKNOWN,
    Moment,
    ShownVoxels,
    frustum,
    in_known_scene,
    moments,
    shown_voxels,
    title,
)
from robotdiffuse.visualization.replay_page import page_data, page_shapes, write_page
from robotdiffuse.visualization.voxel_faces import faces_between

LAYERS = (
    {"name": "Occupied", "color": style.OBSERVED, "opacity": 1.0, "order": 0},
    {"name": "Predicted", "color": style.ASSUMED, "opacity": 0.6, "order": 1},
    {"name": "Unknown", "color": UNKNOWN, "opacity": 0.28, "order": 20},
)
"""Sets of voxels on the page, in the order in which see-through ones are drawn."""


def write_exploration(explorer: RecordedExplorer, scene: Scene, file: str | FilePath) -> None:
    """Write an exploration as a self-contained .html file, with what was known after each view.

    scene: the true one, which the page can show. Raises InputError for another ending or a file that cannot
    be written.
    """
    target, found = check_output(file, (".html", ".htm")), moments(explorer)
    robot = explorer.robot
    motion = _whole_motion(explorer)
    data = page_data(robot, scene, motion)
    data["exploration"] = {
        "shape": MAP.shape,
        "low": MAP.low,
        "edge": MAP.edge,
        "layers": LAYERS,
        "look_color": LOOK_COLOR,
        "known": _known(explorer),
        "acts": [_act(explorer, moment) for moment in found],
        "true_scene": data["scene"],
    }
    data["scene"] = page_shapes(explorer.scene)
    data["facts"] = _facts(explorer)
    write_page(target, f"{robot.name} · exploration", data, "exploration.js")


def _page_time(time: float, act: int) -> float:
    """The time on the page of a time during an act."""
    return round(time + READING_TIME * (act + 1), 4)


def _whole_motion(explorer: RecordedExplorer) -> Trajectory:
    """All motions with the pauses between them."""
    times, positions = [], []
    for number, act in enumerate(explorer.acts):
        times.append(np.array([_page_time(act.begins, number - 1)]))
        positions.append(act.configuration[None])
        if act.trajectory is not None:
            times.append(_page_time(act.begins, number) + act.trajectory.times)
            positions.append(act.trajectory.positions)
    q = np.concatenate(positions)
    return Trajectory(explorer.robot.joint_names, np.concatenate(times), q, 0 * q, 0 * q)


def _known(explorer: RecordedExplorer) -> list[dict[str, Any]]:
    """Times, and the faces of each layer that come or go, after each view and each prediction."""
    known_scene = in_known_scene(explorer)
    before = [np.zeros(0, np.int64) for _ in LAYERS]
    states = []
    for number, act in enumerate(explorer.acts):
        views = [view for view in explorer.views if view.act == number]
        earlier = [view for view in explorer.views if view.act < number]
        times = [_page_time(view.time, number) for view in views]
        for time, view in zip(
            (_page_time(act.begins, number - 1), *times), (*earlier[-1:], *views), strict=True
        ):
            after = _faces(shown_voxels(view, act, known_scene))
            changed = [np.setxor1d(a, b) for a, b in zip(before, after, strict=True)]
            states.append({"time": time, "layers": [_packed(faces) for faces in changed]})
            before = after
    return states


def _faces(shown: ShownVoxels) -> list[Int[ndarray, "n"]]:
    """The faces of each layer."""
    return [faces_between(*pair)[0] for pair in shown.layers]


def _packed(numbers: Int[ndarray, "n"]) -> str:
    """Ascending numbers in base64: the differences from one to the next, in groups of 7 bits, the lowest
    first, of which all but the last are marked."""
    steps = np.diff(numbers, prepend=0)
    groups = np.stack([steps >> shift & 127 for shift in (0, 7, 14, 21)], axis=1)
    used = np.stack([np.ones(len(steps), bool), *(steps >= 1 << shift for shift in (7, 14, 21))], axis=1)
    marked = np.concatenate([used[:, 1:], np.zeros((len(steps), 1), bool)], axis=1)
    return base64.b64encode((groups + 128 * marked)[used].astype(np.uint8).tobytes()).decode("ascii")


def _act(explorer: RecordedExplorer, moment: Moment) -> dict[str, Any]:
    act = moment.act
    motion = act.step.motion
    end = motion.path.positions[-1] if act.step.kind == LOOK and motion and motion.path else None
    return {
        "time": _page_time(act.begins, moment.number - 2),
        "title": f"{moment.number}  {title(moment.act)}",
        "reason": act.step.reason,
        "known": ", ".join(f"{value} {name}" for name, value in moment.shares),
        "look": [np.round(edge, 4).tolist() for edge in frustum(explorer, act)],
        "end": None if end is None else np.round(end, 5).tolist(),
    }


def _facts(explorer: RecordedExplorer) -> list[tuple[str, str]]:
    last, kinds = explorer.acts[-1].step, Counter(act.step.kind for act in explorer.acts)
    return [
        ("status", "solved" if last.kind == DONE else last.kind),
        ("policy", explorer.settings.policy.replace("_", " ")),
        ("looks", str(kinds[LOOK])),
        ("views", str(len(explorer.views))),
        ("time in motion", f"{explorer.duration:.1f} s"),
    ]
