"""Finds trained weights for a robot without loading them or PyTorch."""

import os
from functools import lru_cache
from pathlib import Path as FilePath

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.input_files import is_file, read_json
from robotdiffuse.learning.networks import NETWORKS
from robotdiffuse.learning.robot_identity import RobotIdentity
from robotdiffuse.learning.weight_files import stamp
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.user_data_dir import user_robots

BUNDLED = FilePath(__file__).parent / "weights"
"""Folder of the weights that come with the package; those for a robot are in a folder of its name."""
POINTS = "panda_points"
"""Weights of config `points` in that folder: without clearances as inputs."""


def user_weights(robot: Robot) -> FilePath:
    """The folder of weights that the user trained for a robot, in the user's data folder."""
    return user_robots() / robot.name / "weights"


def weights_for(name: str, robot: Robot) -> FilePath | None:
    """The folder with weights of a network (a name in NETWORKS) for exactly this robot; None if there is
    none.

    The user's weights take precedence over those of the package. Raises InputError, naming the file, for a
    damaged description.
    """
    for place in (user_weights(robot), BUNDLED / robot.name):
        written = stamp(place, name)
        if written and not _identity(place / f"{name}.json", written).difference(robot):
            return place
    return None


@lru_cache
def _identity(file: FilePath, _stamp: tuple[int, int]) -> RobotIdentity:
    try:
        about = read_json(file)["robot"]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file} is damaged: {type(error).__name__}: {error}") from None
    return RobotIdentity.from_json(about, f"{file}: robot")


def folder_of(folder: str | FilePath) -> FilePath:
    """The folder of weights; the name of one that comes with the package stands for it."""
    place = FilePath(folder)
    return place if os.path.exists(place) or not os.path.isdir(BUNDLED / folder) else BUNDLED / folder


def check_weights(name: str, folder: str | FilePath | None) -> None:
    """Raises InputError if a folder is given that holds no weights of this network."""
    NETWORKS.entry(name)
    if folder is not None and not is_file(folder_of(folder) / f"{name}.json"):
        what = f"{folder} holds no {name}" if os.path.isdir(folder) else f"there are no weights {folder}"
        raise no_weights_error(name, what)


def weights_folder(name: str, folder: str | FilePath | None, robot: Robot) -> FilePath:
    """The folder with weights of a network: the given one, or that of `weights_for`.

    Raises InputError if it holds none, naming the command that trains them.
    """
    check_weights(name, folder)
    if folder is not None:
        return folder_of(folder)
    found = weights_for(name, robot)
    if found is None and (BUNDLED / robot.name / f"{name}.json").is_file():
        return BUNDLED / robot.name  # made for another arm of that name, which the caller finds
    if found is None:
        raise no_weights_error(
            name, f"no weights of the network {name} come with the package for {robot.name}"
        )
    return found


def completion_folder(folder: str | FilePath | None) -> FilePath:
    """The folder with weights of the completion network; None: of those that come with the package.

    Raises InputError if it holds none, naming the command that trains them.
    """
    place = BUNDLED / "completion" if folder is None else FilePath(folder)
    if not (place / "completion.json").is_file():
        raise InputError(
            f"{place} holds no weights of the completion network; train them: robotdiffuse train completion "
            "--out FOLDER"
        )
    return place


def no_weights_error(name: str, what: str) -> InputError:
    """The error for missing weights: `what` is missing, and the command that trains it."""
    how = NETWORKS[name].kind or f"baseline {name} --data FOLDER --out FOLDER"
    return InputError(f"{what}; train them: robotdiffuse train {how}")
