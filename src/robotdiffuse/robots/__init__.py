"""Robots: joints, limits, kinematics, collision spheres; bundled ones by name, any serial arm by its URDF."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from robotdiffuse.core.errors import InputError, unknown_name
from robotdiffuse.core.input_files import is_file
from robotdiffuse.robots.bodies import ConvexMesh
from robotdiffuse.robots.joints import Joint
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.robot_folder import MESH_FILE, ROBOT_FILE, read_robot_folder, read_source
from robotdiffuse.robots.user_data_dir import user_robots

__all__ = ["ROBOTS", "ConvexMesh", "Joint", "Robot", "load_robot"]

DATA = Path(__file__).parent / "data"
ROBOTS = tuple(sorted(file.parent.name for file in DATA.glob(f"*/{ROBOT_FILE}")))
"""Names of the bundled robots."""


def load_robot(name: str | Path, locked: dict[str, float] | None = None) -> Robot:
    """A robot by its bundled name, the name that `robotdiffuse robot add` gave it, its folder, or its URDF.

    A URDF is looked up by its content among the robots that were added; a new or changed one is fitted with
    spheres first, which takes about a minute, and kept. `locked` holds joints at values (see
    Robot.with_locked). The same robot is the same object, as long as its files stay as they are. Raises
    InputError for an unknown name or bad input.
    """
    text = str(name)
    if is_file(Path(name) / ROBOT_FILE):
        robot = _read(Path(name), str(Path(name).resolve()))
    elif isinstance(name, Path) or text.endswith((".urdf", ".xacro", ".xml")) or "/" in text or "\\" in text:
        robot = _from_urdf(Path(name))
    else:
        robot = _by_name(text)
    return robot.with_locked(locked or {})


def _by_name(name: str) -> Robot:
    if name in ROBOTS:
        return _read(DATA / name, None)
    added = _added()
    if name not in added:
        raise unknown_name("robot", name, known_robots())
    return _read(added[name], name)


def _read(folder: Path, source: str | None) -> Robot:
    """The robot in a folder; the one of the last time if its files are the same."""
    return _read_state(folder.resolve(), source, _state(folder / ROBOT_FILE), _state(folder / MESH_FILE))


def _state(file: Path) -> tuple[int, int, int] | None:
    """What changes when a file is written; None if there is none."""
    try:
        found = file.stat()
    except (OSError, ValueError):
        return None
    return found.st_mtime_ns, found.st_size, found.st_ino


@lru_cache
def _read_state(folder: Path, source: str | None, *_states: tuple[int, int, int] | None) -> Robot:
    return replace(read_robot_folder(folder), source=source)


@lru_cache
def _digest(folder: Path, _state: tuple[int, int, int] | None) -> str | None:
    """Of the URDF that the robot in a folder was made from."""
    return read_source(folder).get("sha256")


def known_robots() -> dict[str, Path]:
    """Folders of the bundled robots and of those that were added, by the names that problems use."""
    return _added() | {name: DATA / name for name in ROBOTS}


def _added() -> dict[str, Path]:
    return {file.parent.name: file.parent for file in sorted(user_robots().glob(f"*/{ROBOT_FILE}"))}


def _from_urdf(urdf: Path) -> Robot:
    from robotdiffuse.robots.fitting.add import add_robot
    from robotdiffuse.robots.parsing.urdf import UrdfTree

    tree, source = UrdfTree(urdf, {}), str(urdf.resolve())
    digest = tree.digest
    made: dict[str, Robot] = {}
    for name, folder in _added().items():
        try:
            if _digest(folder, _state(folder / ROBOT_FILE)) == digest:
                made[name] = _read(folder, source)
        except InputError:
            continue  # a damaged folder of another robot is no reason to fail
    if len({(robot.base, robot.joint_names) for robot in made.values()}) > 1:
        raise InputError(
            f"{urdf} is the robots {', '.join(made)}, which plan different joints; name one of them instead"
        )
    if made:
        return next(iter(made.values()))
    report = add_robot(urdf, out=user_robots() / f"{tree.name}-{digest[:8]}")
    note = f"spheres were fitted to {urdf.name} ({report.sphere_count}) and kept in {report.folder}"
    return replace(report.robot, notes=(*report.robot.notes, note), source=source)
