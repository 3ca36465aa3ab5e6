"""Reads and writes moving obstacles of problem files.

moving:
  - {sphere: {center: [0.5, -0.6, 0.5], radius: 0.1}, velocity: [0, 0.3, 0]}
  - {box: {center: [0.6, 0, 0.3], size: [0.2, 0.2, 0.2]}, times: [0, 2], poses: [{xyz: [0.6, 0, 0.3]}, {...}]}
  - {sphere: {center: [0.5, 0.6, 0.5], radius: 0.1, name: hand}, max_speed: 0.5}
"""

from pathlib import Path

from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.transforms import pose_entry
from robotdiffuse.problems.files.robot_setup import one_shape, read_pose
from robotdiffuse.scenes.files import SHAPES, scene_entries
from robotdiffuse.scenes.moving_obstacles import MovingObstacle
from robotdiffuse.scenes.scene import Scene

MOTION_FIELDS = ("velocity", "times", "poses", "max_speed")


def read_moving(entries: object, folder: Path) -> tuple[MovingObstacle, ...]:
    """The moving obstacles of a problem file. Raises InputError that names the field."""
    if not isinstance(entries, list):
        raise InputError(f"moving is {shown(entries)}; it must be a list of shapes with their motions")
    return tuple(_obstacle(f"moving[{i}]", entry, folder) for i, entry in enumerate(entries))


def _obstacle(where: str, entry: object, folder: Path) -> MovingObstacle:
    if not isinstance(entry, dict):
        raise InputError(
            f"{where} is {shown(entry)}; it must be a shape and its motion, e.g. "
            "{sphere: {...}, velocity: [0, 0.3, 0]}"
        )
    kinds = [name for name in entry if name in SHAPES]
    unknown = [name for name in entry if name not in SHAPES and name not in MOTION_FIELDS]
    if unknown or len(kinds) != 1:
        raise InputError(
            f"{where} has the fields {', '.join(map(str, entry))}; it must have one shape of "
            f"{', '.join(SHAPES)}, and a motion of {', '.join(MOTION_FIELDS)}"
        )
    [shape], _ = one_shape(where, {kinds[0]: entry[kinds[0]]}, folder)
    motion = {name: entry[name] for name in MOTION_FIELDS if name in entry}
    try:
        if "poses" in motion:
            if not isinstance(motion["poses"], list):
                raise InputError(f"poses is {shown(motion['poses'])}; it must be a list of {{xyz, wxyz}}")
            motion["poses"] = [read_pose(f"poses[{i}]", pose) for i, pose in enumerate(motion["poses"])]
        return MovingObstacle(shape, **motion)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def moving_entry(obstacle: MovingObstacle, folder: Path | None) -> dict[str, object]:
    """The entry of a moving obstacle, as `read_moving` reads it."""
    [shape] = scene_entries(Scene([obstacle.shape]), folder)
    entry: dict[str, object] = dict(shape)
    if obstacle.velocity is not None:
        return entry | {"velocity": obstacle.velocity.tolist()}
    if obstacle.times is not None and obstacle.poses is not None:
        return entry | {
            "times": obstacle.times.tolist(),
            "poses": [pose_entry(T) for T in obstacle.poses],
        }
    return entry | {"max_speed": obstacle.max_speed}
