"""Trained baselines in files: NAME.json and NAME.safetensors in a folder, all that planning needs."""

from functools import cache
from pathlib import Path as FilePath
from typing import Any

from robotdiffuse.errors import InputError
from robotdiffuse.learning.checkpoint import fill, load_tensors, save_module
from robotdiffuse.learning.networks import check_network, network_class
from robotdiffuse.learning.networks.base import BaselineNetwork, JointRanges
from robotdiffuse.learning.settings import settings_from_json, settings_to_json
from robotdiffuse.robots.robot import Robot

BUNDLED = FilePath(__file__).parent / "weights"
"""Weights that come with the package, one folder per robot."""


def save_baseline(
    name: str, network: BaselineNetwork, folder: str | FilePath, training: dict[str, Any]
) -> None:
    """Write NAME.safetensors and NAME.json. `training`: how it was trained, for the reader."""
    about = {
        "network": name,
        "robot": settings_to_json(network.ranges),
        "settings": settings_to_json(network.settings),
        "training": training,
    }
    save_module(network, FilePath(folder), name, about)


def load_baseline(name: str, folder: str | None, robot: Robot) -> BaselineNetwork:
    """The trained network of a folder, or the one that comes with the package for the robot, frozen.

    Raises InputError if there is none, naming the command that trains it, and for files that are damaged or
    made for another robot.
    """
    check_network(name)
    check_weights(name, folder)
    place = BUNDLED / robot.name if folder is None else FilePath(folder)
    if not (place / f"{name}.json").is_file():
        raise _untrained(name, f"no weights of {name} come with the package for {robot.name}")
    network = _load(name, place)
    network.ranges.check_robot(robot, f"{name} in {place}")
    return network


def check_weights(name: str, folder: str | None) -> None:
    """Raises InputError if a folder is given that holds no weights of this network."""
    if folder is not None and not (FilePath(folder) / f"{name}.json").is_file():
        raise _untrained(name, f"{folder} holds no {name}")


def _untrained(name: str, what: str) -> InputError:
    return InputError(f"{what}; train them: robotdiffuse train baseline {name} --data FOLDER --out FOLDER")


@cache
def _load(name: str, folder: FilePath) -> BaselineNetwork:
    tensors, about = load_tensors(folder, name)
    where, kind = str(folder / f"{name}.json"), network_class(name)
    ranges = settings_from_json(JointRanges, about.get("robot"), f"{where}: robot")
    network = kind(
        ranges, settings_from_json(kind.settings_class, about.get("settings"), f"{where}: settings")
    )
    fill(network, tensors, folder / f"{name}.safetensors")
    return network.requires_grad_(False).eval()
