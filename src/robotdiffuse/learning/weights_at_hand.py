"""Which weights there are, told without loading them or PyTorch."""

import json
from functools import cache
from pathlib import Path as FilePath

from robotdiffuse.errors import InputError
from robotdiffuse.learning.networks import NETWORKS
from robotdiffuse.learning.robot_identity import RobotIdentity
from robotdiffuse.robots.robot import Robot

BUNDLED = FilePath(__file__).parent / "weights"
"""Weights that come with the package, one folder per robot."""


def comes_with_package(name: str, robot: Robot) -> bool:
    """Whether there are weights of a network, as NETWORKS names it, for this very robot."""
    identity = _bundled_for(name, robot.name)
    return identity is not None and not identity.difference(robot)


@cache
def _bundled_for(name: str, robot_name: str) -> RobotIdentity | None:
    file = BUNDLED / robot_name / f"{name}.json"
    if not file.is_file():
        return None
    return RobotIdentity.from_json(json.loads(file.read_text(encoding="utf-8"))["robot"], f"{file}: robot")


def check_weights(name: str, folder: str | FilePath | None) -> None:
    """Raises InputError if a folder is given that holds no weights of this network."""
    NETWORKS.entry(name)
    if folder is not None and not (FilePath(folder) / f"{name}.json").is_file():
        raise untrained(name, f"{folder} holds no {name}")


def untrained(name: str, what: str) -> InputError:
    """What to do where there are no weights."""
    how = NETWORKS[name].kind or f"baseline {name} --data FOLDER"
    return InputError(f"{what}; train them: robotdiffuse train {how} --out FOLDER")
