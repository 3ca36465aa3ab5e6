"""Robots: joints, limits, kinematics and collision models, loaded by bundled name or from a URDF."""

import json
from dataclasses import replace
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import Any

from robotdiffuse.core.errors import InputError, check_name, check_type
from robotdiffuse.core.files import is_file
from robotdiffuse.robots.bodies import ConvexMesh
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.robots.robot import Robot, robot_fingerprint
from robotdiffuse.robots.robot_folder import (
    DATA,
    FILE_ENDINGS,
    MESH_FILE,
    ROBOT_FILE,
    ROBOTS,
    SURFACE_FILE,
    read_robot_folder,
    read_source,
    user_robots,
)

__all__ = ["ROBOTS", "ConvexMesh", "Joint", "Robot", "load_robot"]


def load_robot(name: str | Path, locked: dict[str, float] | None = None) -> Robot:
    """Load a robot by its bundled name, a name given to `robotdiffuse robot add`, its folder, or its URDF or
    MuJoCo model.

    A URDF or MuJoCo model is looked up by content among the added robots. If none was made from it, the robot
    is prepared, which takes about a minute, and stored. If several robots that differ were made from it, or
    its SRDF has changed since, an InputError says so. Calls return the same object as long as the robot's
    files are unchanged.

    Args:
        name: Name, robot folder, URDF, or MuJoCo model (.xml). Only `robot add` reads xacro files, since
            compiling a file runs the code in it.
        locked: Values at which joints are locked [rad] or [m] (see `Robot.with_locked`).

    Returns:
        The robot. All movable joints between its base and its tips are planned, except the locked ones.

    Raises:
        InputError: For an unknown name or bad input.

    Examples:
        >>> rd.load_robot("panda", locked={"panda_finger_joint1": 0.04}).dof
        7
    """
    check_type("robot", name, (str, PathLike), "its name, or the path of its folder, URDF or MuJoCo model")
    name = name if isinstance(name, str) else Path(name)
    path = Path(name)
    if not names_a_file(name):
        robots = known_robots()
        check_name("robot", name, robots)
        robot = _read(robots[str(name)], None if name in ROBOTS else str(name))
    elif is_file(path / ROBOT_FILE):
        robot = _read(path, str(path.resolve()))
    else:
        robot = _from_urdf(path)
    return robot.with_locked(locked or {})


def names_a_file(name: str | Path) -> bool:
    """Whether `load_robot` takes this name as the path of a file or folder; else it looks up a robot's
    name."""
    text = str(name)
    by_form = text.lower().endswith(FILE_ENDINGS) or "/" in text or "\\" in text
    folder = text not in ROBOTS and is_file(Path(name) / ROBOT_FILE)
    return by_form or isinstance(name, Path) or folder


def _read(folder: Path, source: str | None) -> Robot:
    """The robot in a folder: the cached object if the folder's files are unchanged."""
    states = (_state(folder / name) for name in (ROBOT_FILE, MESH_FILE, SURFACE_FILE))
    return _read_state(folder.resolve(), source, *states)


def _state(file: Path) -> tuple[int, int, int] | None:
    """Modification time, size and inode of a file, to detect changes; None if it does not exist."""
    try:
        status = file.stat()
    except (OSError, ValueError):
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


@lru_cache
def _read_state(folder: Path, source: str | None, *_states: tuple[int, int, int] | None) -> Robot:
    return replace(read_robot_folder(folder), source=source)


@lru_cache
def _source(folder: Path, _state: tuple[int, int, int] | None) -> dict[str, Any]:
    """`read_source`, cached."""
    return read_source(folder)


def known_robots() -> dict[str, Path]:
    """Folders of bundled and added robots, by the names that problems use."""
    return _added() | {name: DATA / name for name in ROBOTS}


def _added() -> dict[str, Path]:
    return {file.parent.name: file.parent for file in sorted(user_robots().glob(f"*/{ROBOT_FILE}"))}


def _from_urdf(urdf: Path) -> Robot:
    """The added robot with the content of a URDF or MuJoCo model; if there is none, the file is prepared and
    added."""
    from robotdiffuse.robots.fitting.preparation import add_robot
    from robotdiffuse.robots.parsing.urdf import UrdfTree

    tree = UrdfTree(urdf, {})
    source = str(urdf.resolve())
    digest = tree.digest
    srdf = tree.srdf_digest
    robots = dict[str, Robot]()
    outdated = list[str]()
    for name, folder in _added().items():
        try:
            made_from = _source(folder, _state(folder / ROBOT_FILE))
            if made_from.get("sha256") != digest:
                continue
            if made_from.get("srdf", srdf) == srdf:
                robots[name] = _read(folder, source)
            else:
                outdated.append(name)
        except InputError:
            continue  # another robot's damaged folder must not prevent loading this one
    differences = {
        (robot_fingerprint(robot), json.dumps([robot.poses, [joint.effort for joint in robot.joints]]))
        for robot in robots.values()
    }
    if len(differences) > 1:
        raise InputError(
            f"{urdf} was added as {', '.join(robots)}, which differ in joints, limits, spheres, allowed "
            f"pairs or poses; use one of these names instead, or delete the other robots in {user_robots()}"
        )
    if robots:
        return next(iter(robots.values()))
    if outdated:
        raise InputError(
            f"the SRDF of {urdf} has changed since robot {outdated[0]} was made. Load it by this name, or "
            f"make it again: robotdiffuse robot add {urdf} --name {outdated[0]}, with the options used then"
        )
    report = add_robot(urdf, out=user_robots() / f"{tree.name}-{digest[:8]}")
    note = f"{report.sphere_count} spheres were fitted to {urdf.name} and stored in {report.folder}"
    return replace(report.robot, notes=(*report.robot.notes, note), source=source)
