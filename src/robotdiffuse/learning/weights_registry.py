"""Finds trained weights for a robot without loading them or PyTorch."""

import json
import os
from functools import lru_cache
from pathlib import Path as FilePath

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.input_files import is_file
from robotdiffuse.learning.networks import NETWORKS
from robotdiffuse.learning.robot_identity import RobotIdentity
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.user_data_dir import user_robots

BUNDLED = FilePath(__file__).parent / "weights"
"""Folder of the weights that come with the package; those for a robot are in a folder of its name."""


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
        file = place / f"{name}.json"
        try:
            changed = file.stat().st_mtime_ns
        except OSError:
            continue
        if not _identity(file, changed).difference(robot):
            return place
    return None


@lru_cache
def _identity(file: FilePath, _changed: int) -> RobotIdentity:
    try:
        about = json.loads(file.read_text(encoding="utf-8"))["robot"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{file} is damaged: {type(error).__name__}: {error}") from None
    return RobotIdentity.from_json(about, f"{file}: robot")


def check_weights(name: str, folder: str | FilePath | None) -> None:
    """Raises InputError if a folder is given that holds no weights of this network."""
    NETWORKS.entry(name)
    if folder is not None and not is_file(FilePath(folder) / f"{name}.json"):
        what = f"{folder} holds no {name}" if os.path.isdir(folder) else f"there are no weights {folder}"
        raise no_weights_error(name, what)


def no_weights_error(name: str, what: str) -> InputError:
    """The error for missing weights: `what` is missing, and the command that trains it."""
    how = NETWORKS[name].kind or f"baseline {name} --data FOLDER --out FOLDER"
    return InputError(f"{what}; train them: robotdiffuse train {how}")
