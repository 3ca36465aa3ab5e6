"""Files of trained networks, read without PyTorch.

NAME.json describes a network and holds the SHA-256 of its other files. NAME.safetensors holds the weights.
NAME.onnx, and further files that end in .onnx, hold the exported parts that planning runs without PyTorch.
"""

import hashlib
import os
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray
from safetensors import SafetensorError
from safetensors.numpy import load

from robotdiffuse.collision.kernel_arrays import robot_groups
from robotdiffuse.core.errors import InputError, joined, shortened
from robotdiffuse.core.files import JsonObject, is_file, read_bytes, read_json
from robotdiffuse.core.registry import Entry, Registry
from robotdiffuse.core.settings import Settings
from robotdiffuse.robots.kinematic_tree import JointNormalizer, once_per_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.robot_folder import user_robots

DIMENSION_TOLERANCE = 1e-3
"""Two robots count as the same if their dimensions [m] and the entries of their rotations differ by less than
this."""


@dataclass(frozen=True)
class RobotIdentity(Settings):
    """The robot that weights were trained for, as checkpoints describe it."""

    source: str
    """Name of a bundled robot, or path to the robot's URDF."""
    joint_names: tuple[str, ...]
    lower: tuple[float, ...]
    """Limits by which joint values are normalized [rad], [m] for prismatic joints. The weights can be used
    even if the robot now has other limits: validation uses the robot's own limits."""
    upper: tuple[float, ...]
    frame_offsets: tuple[tuple[tuple[float, ...], ...], ...]
    """`Robot.frame_offsets`, to distinguish robots with the same joint names but other dimensions."""
    links: tuple[str, ...]
    """Moving links with collision spheres, in the order of link clearances."""

    def __post_init__(self) -> None:
        super().__post_init__()
        dof = len(self.joint_names)
        for name in ("lower", "upper", "frame_offsets"):
            if len(getattr(self, name)) != dof:
                raise InputError(f"robot.{name} has {len(getattr(self, name))} entries for {dof} joints")
        if any([len(row) for row in T] != [4] * 4 for T in self.frame_offsets):
            raise InputError("robot.frame_offsets has an entry that is not 4 x 4 numbers")

    @staticmethod
    @once_per_robot
    def of(robot: Robot) -> "RobotIdentity":
        """The identity of a robot's bare arm, since attached bodies do not change the joints."""
        robot = robot.arm
        return RobotIdentity(
            source=robot.source or robot.name,
            joint_names=robot.joint_names,
            lower=tuple(robot.lower.tolist()),
            upper=tuple(robot.upper.tolist()),
            frame_offsets=tuple(tuple(tuple(row) for row in T) for T in robot.frame_offsets.tolist()),
            links=tuple(link for link in robot_groups(robot) if robot.link_frame(link) > 0),
        )

    @property
    def dof(self) -> int:
        return len(self.joint_names)

    def normalizer(self) -> JointNormalizer:
        return JointNormalizer(np.array(self.lower), np.array(self.upper))

    def difference(self, robot: Robot) -> str:
        """How the robot differs from this one; "" if it is the same."""
        identity = RobotIdentity.of(robot)
        if identity.joint_names != self.joint_names:
            return f"joints {joined(identity.joint_names)}"
        if not np.allclose(identity.frame_offsets, self.frame_offsets, atol=DIMENSION_TOLERANCE):
            return "other dimensions"
        if identity.links != self.links:
            return f"spheres on the links {joined(identity.links)}, not {joined(self.links)}"
        return ""

    def check(self, robot: Robot, where: str) -> None:
        """Raises InputError unless the weights are for this robot. where: name of the weights, for the
        message."""
        difference = self.difference(robot)
        if difference:
            raise InputError(
                f"{where} was trained for {shortened(self.source)} with joints {joined(self.joint_names)}; "
                f"the robot {robot.name} has {difference}"
            )


NETWORKS = Registry(
    "network",
    {
        "model": Entry(
            "robotdiffuse.learning.motion_network:MotionNetwork",
            "the diffusion model of motions",
            "robotdiffuse.learning.motion_model:MotionModelSettings",
            "planner --robot NAME",
        ),
        "mpnet": Entry(
            "robotdiffuse.learning.mpnet:MPNetNetwork",
            "MPNet: the next configuration on the way to the goal",
            "MPNetSettings",
        ),
        "mpinets": Entry(
            "robotdiffuse.learning.mpinets:MPiNetsNetwork",
            "MPiNets: a policy with points of scene, arm and target as its input",
            "MPiNetsNetworkSettings",
        ),
        "trajectory_prior": Entry(
            "robotdiffuse.learning.motion_network:MotionNetwork",
            "the diffusion model without an encoder, for MPD and EDMP",
            "robotdiffuse.learning.motion_model:MotionModelSettings",
            "planner --config trajectory_prior --data FOLDER --out FOLDER",
        ),
        "completion": Entry(
            "robotdiffuse.learning.completion_network:CompletionNetwork",
            "the occupancy of space that no camera saw",
            "robotdiffuse.learning.completion:CompletionSettings",
            "completion --out FOLDER",
        ),
    },
)
"""The kind of an entry, its fourth value, is what follows `robotdiffuse train` in the command that trains the
network. Entries without a fourth value are trained by `robotdiffuse train baseline NAME`."""


FORMAT = 2
"""Version of the format of NAME.json."""


def stamp(folder: Path, name: str) -> tuple[int, int] | None:
    """Modification time [ns] and inode of NAME.json, the file that training writes last; None if it is
    missing.

    A cached network is reused as long as these two numbers stay the same.
    """
    try:
        status = (folder / f"{name}.json").stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_ino


def kept_by_stamp(load: Callable[[str, Path], Any]) -> Callable[[str, Path], Any]:
    """Decorator of a function that loads a network by name and folder: caches the network until its
    NAME.json changes."""
    cached = lru_cache(maxsize=16)(lambda name, folder, _stamp: load(name, folder))
    return lambda name, folder: cached(name, folder, stamp(folder, name))


def read_description(folder: Path, name: str) -> JsonObject:
    """The contents of NAME.json. Raises InputError if it is missing or damaged."""
    file = folder / f"{name}.json"
    try:
        about = read_json(file)
    except InputError as error:
        if not os.path.lexists(file):
            raise InputError(f"{folder} holds no trained model: {file.name} is missing") from None
        raise InputError(f"{file} is damaged: {error}") from None
    version = about.get("format") if isinstance(about, dict) else None
    if version != FORMAT:
        raise InputError(
            f"{file} is no model description: format is {shortened(version)}; it must be {FORMAT}"
        )
    return about


def checked_bytes(file: Path, digest: object, description: str) -> bytes:
    """The contents of a file. Raises InputError if it cannot be read or its SHA-256 is not that of the
    description."""
    data = read_bytes(file, "weight file")
    if hashlib.sha256(data).hexdigest() != digest:
        raise InputError(f"{file} is damaged or does not belong to {description}: its SHA-256 differs")
    return data


def exported_files(folder: Path, name: str, about: JsonObject) -> dict[str, bytes]:
    """The exported parts of a network by their ending. Raises InputError if there are none or one is
    damaged."""
    digests = about.get("onnx_sha256")
    if not isinstance(digests, dict) or not digests:
        raise InputError(
            f"{folder} holds weights of the network {name} without the ONNX files that planning runs; write "
            f"them: robotdiffuse train export {folder}"
        )
    return {
        ending: checked_bytes(folder / f"{name}{ending}", digest, f"{name}.json")
        for ending, digest in digests.items()
    }


def read_arrays(folder: Path, name: str, about: JsonObject, keys: Iterable[str]) -> dict[str, ndarray]:
    """The tensors of NAME.safetensors with these names, without those that the file lacks. Raises InputError
    if the file cannot be read."""
    file = folder / f"{name}.safetensors"
    data = checked_bytes(file, about.get("weights_sha256"), f"{name}.json")
    try:
        tensors = load(data)
    except (SafetensorError, ValueError, struct.error) as error:
        raise InputError(f"{file} is no safetensors file: {str(error).splitlines()[0]}") from None
    return {key: tensors[key] for key in keys if key in tensors}


BUNDLED = Path(__file__).parent / "weights"
"""Folder of the weights that come with the package; a robot's weights are in the subfolder with its name."""
POINTS = "panda_points"
"""Subfolder with the weights of the config `points`, whose network has no clearances as inputs."""


def user_weights(robot: Robot) -> Path:
    """The folder of weights that the user trained for a robot, in the user's data folder."""
    return user_robots() / robot.name / "weights"


def weights_for(name: str, robot: Robot) -> Path | None:
    """The folder with weights of a network (a name in NETWORKS) for exactly this robot; None if there is
    none.

    The user's weights take precedence over the bundled weights. Raises InputError, naming the file, for a
    damaged description.
    """
    for place in (user_weights(robot), BUNDLED / robot.name):
        if stamp(place, name) and not identity(name, place).difference(robot):
            return place
    return None


@kept_by_stamp
def identity(name: str, folder: Path) -> RobotIdentity:
    """The robot that weights were trained for. Raises InputError for a damaged description."""
    about = read_description(folder, name)
    return RobotIdentity.from_json(about.get("robot"), f"{folder / name}.json: robot")


def folder_of(folder: str | Path) -> Path:
    """The folder that the argument denotes: an existing path, else the name of a bundled folder of
    weights."""
    place = Path(folder)
    return place if os.path.exists(place) or not os.path.isdir(BUNDLED / folder) else BUNDLED / folder


def check_weights(name: str, folder: str | Path | None) -> None:
    """Raises InputError if the given folder holds no weights of this network; None is accepted."""
    NETWORKS.entry(name)
    if folder is not None and not is_file(folder_of(folder) / f"{name}.json"):
        exists = os.path.isdir(folder_of(folder))
        message = f"{folder} holds no {name}" if exists else f"there are no weights {folder}"
        raise no_weights_error(name, message)


def weights_folder(name: str, folder: str | Path | None, robot: Robot) -> Path:
    """The folder with weights of a network: the given folder, else the folder from `weights_for`. If there is
    neither, the bundled folder of the robot's name: its weights are for another arm, as the caller reports.

    Raises InputError if there are no such weights, naming the command that trains them.
    """
    check_weights(name, folder)
    if folder is not None:
        return folder_of(folder)
    if fitting := weights_for(name, robot):
        return fitting
    bundled = BUNDLED / robot.name
    if (bundled / f"{name}.json").is_file():
        return bundled
    raise no_weights_error(name, f"no weights of the network {name} come with the package for {robot.name}")


def completion_folder(folder: str | Path | None) -> Path:
    """The folder with weights of the completion network, which belong to no robot: the given folder, or the
    package's.

    Raises InputError if it holds no such weights, naming the command that trains them.
    """
    place = BUNDLED / "completion" if folder is None else folder_of(folder)
    check_weights("completion", place)
    return place


def no_weights_error(name: str, what: str) -> InputError:
    """The error for missing weights: `what` names the missing weights; the message ends with the command that
    trains them."""
    command = NETWORKS[name].kind or f"baseline {name} --data FOLDER --out FOLDER"
    return InputError(f"{what}; train them: robotdiffuse train {command}")
