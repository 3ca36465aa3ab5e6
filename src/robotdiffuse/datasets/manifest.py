"""The manifest of a data set: robot, scenes, settings and versions, in `manifest.json` in its folder."""

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path as FilePath
from typing import Any

from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.input_files import file_name, read_json
from robotdiffuse.core.output_files import write_atomically
from robotdiffuse.core.settings import Count, Natural, Settings
from robotdiffuse.robots.fingerprint import robot_fingerprint
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.shapes import Box

FORMAT = 1
MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Manifest(Settings):
    """Robot, scenes, settings and versions of a data set."""

    robot: str
    """A bundled name, or the path of a URDF."""
    robot_fingerprint: str
    joint_names: tuple[str, ...]
    lower: tuple[float, ...]
    """Limits [rad]."""
    upper: tuple[float, ...]
    waypoints: Count
    timing: str
    """How waypoints are spaced: "arc", evenly in joint-space length, or "time"."""
    families: dict[str, dict[str, Any]]
    """Settings of each family of scenes; their order gives the numbers of the array `family`."""
    floors: dict[str, dict[str, list[float]] | None]
    """`center` and `size` of the box that the scenes of each family stand on [m]; None without one."""
    slots: Natural
    """Most obstacles of a scene."""
    goals: Count
    """Most goal configurations of a problem."""
    trajectories: Natural
    """Number of trajectories of the whole set."""
    shard: Count
    """Rows per shard."""
    settings: dict[str, Any]
    """Settings of the generation."""
    versions: dict[str, str]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not len(self.joint_names) == len(self.lower) == len(self.upper) > 0:
            raise InputError(
                f"joint_names, lower and upper have {len(self.joint_names)}, {len(self.lower)} and "
                f"{len(self.upper)} entries; they must have as many as there are joints"
            )
        if self.timing not in ("arc", "time"):
            raise InputError(f"timing is {self.timing!r}; it must be arc or time")
        if self.floors.keys() != self.families.keys():
            raise InputError(f"floors are of {[*self.floors]}; they must be of {[*self.families]}")
        for i in range(len(self.families)):
            self.floor(i)

    @property
    def dof(self) -> int:
        return len(self.joint_names)

    def floor(self, family: int) -> Box | None:
        """The box that the scenes of a family stand on; None without one."""
        floor = list(self.floors.values())[family]
        return None if floor is None else Box(**floor, name="floor")

    def check_robot(self, robot: Robot) -> None:
        """Raise InputError if the data were made with another robot."""
        found = robot_fingerprint(robot)
        if found != self.robot_fingerprint:
            raise InputError(
                f"the data are of the robot {self.robot} with fingerprint {self.robot_fingerprint}; "
                f"{robot.name} has {found}; use the robot of the data"
            )


def floor_record(floor: Box | None) -> dict[str, list[float]] | None:
    """A floor in the form of `Manifest.floors`."""
    return None if floor is None else {"center": floor.center.tolist(), "size": floor.size.tolist()}


def write_manifest(folder: str | FilePath, manifest: Manifest) -> None:
    """Write manifest.json atomically, making the folder. Raises InputError if it cannot be written."""
    data = {"format": FORMAT, "dof": manifest.dof} | asdict(manifest)
    write_atomically(FilePath(folder) / MANIFEST, json.dumps(data, indent=1) + "\n", make_folder=True)


def read_manifest(folder: str | FilePath) -> Manifest:
    """Read manifest.json. Raises InputError if it is missing, damaged or of another version of the format."""
    file = file_name(folder, "folder") / MANIFEST
    if not os.path.lexists(file):
        raise InputError(f"no data set: there is no {file}; make one with: robotdiffuse data generate")
    try:
        data = read_json(file)
    except InputError as error:
        raise InputError(f"{file} is damaged: {error}") from None
    if not isinstance(data, dict) or "format" not in data:
        raise InputError(f"{file} is no manifest of a data set: it has no format")
    check_format(file, data.pop("format"))
    try:
        data.pop("dof")
        return Manifest.from_json(data, MANIFEST)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{file} is damaged: {error}") from None


def check_format(file: FilePath, found: object) -> None:
    """Raise InputError for another version of the format."""
    if found != FORMAT:
        raise InputError(f"{file}: format is {shown(found)}; this version reads {FORMAT}")
