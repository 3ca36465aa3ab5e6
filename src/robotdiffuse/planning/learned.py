"""The base classes of planners with a network, which find and load the weights."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import Space, motions_free, path_length
from robotdiffuse.core.settings import Settings
from robotdiffuse.core.types import Configuration, Configurations, nearest_first
from robotdiffuse.learning import need_packages
from robotdiffuse.learning.weight_files import check_weights
from robotdiffuse.planning.planner import Planner
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.surface_points import VisibleRegion, sample_surface

SAMPLES_PER_GOAL = 4
"""Smallest number of samples per goal, when a batch of samples is divided among several goals."""


@dataclass(frozen=True)
class LearnedSettings(Settings):
    weights: str | None = None
    """Folder of trained weights. For `diffusion` also "panda_points": bundled weights of a network without
    clearances as inputs. None: weights that were trained on this machine for the robot, or else the robot's
    bundled weights."""


LearnedPlannerSettings = TypeVar("LearnedPlannerSettings", bound=LearnedSettings)


class LearnedPlanner(Planner[LearnedPlannerSettings]):
    """A planner that needs the weights of a network."""

    network_name: ClassVar[str]
    """Name of the network in `weight_files.NETWORKS`."""

    def __init__(self, settings: LearnedPlannerSettings | None = None) -> None:
        """Raises InputError if the folder in the setting `weights` holds no weights."""
        super().__init__(settings)
        check_weights(self.network_name, self.settings.weights)

    def network(self, robot: Robot) -> Any:
        """The trained network for a robot, as a PyTorch module.

        Raises InputError if there are no weights for the robot (the message names the command that trains
        them), or if PyTorch is not installed.
        """
        need_packages(f"the planner {self.name}", "torch")
        from robotdiffuse.learning.checkpoint import load_network

        return load_network(self.network_name, self.settings.weights, robot)

    def prepare(self, robot: Robot) -> None:
        """Load the network. Raises InputError if there are no weights for the robot."""
        self.network(robot)


class ExportedPlanner(LearnedPlanner[LearnedPlannerSettings]):
    """A planner with a diffusion model that ONNX Runtime runs, without PyTorch."""

    def network(self, robot: Robot) -> Any:
        """The trained network for a robot, as a `MotionModel`. Raises InputError if there is none."""
        from robotdiffuse.learning.exported_model import exported_model  # imports ONNX Runtime

        return exported_model(self.network_name, self.settings.weights, robot)


def nearest_goals(start: Configuration, goals: Configurations, samples: int) -> Configurations:
    """The goals among which a batch of `samples` samples is divided, the nearest to the start first: at
    most as many as can get SAMPLES_PER_GOAL samples each, but at least one."""
    return nearest_first(goals, start)[: max(samples // SAMPLES_PER_GOAL, 1)]


class Attempt(NamedTuple):
    """A path that a network proposed."""

    broken: int
    """Number of segments in collision."""
    length: float
    """Length of the path [rad]."""
    path: Configurations
    """Waypoints of the path."""


def ranked(space: Space, paths: Iterable[Configurations]) -> list[Attempt]:
    """The paths with the fewest segments in collision first; among paths with equally many, the shortest
    first."""
    attempts = [
        Attempt(int((~motions_free(space, path)).sum()), float(path_length(path)), path) for path in paths
    ]
    return sorted(attempts, key=lambda attempt: attempt[:2])


def scene_clouds(
    checker: CollisionChecker, region: VisibleRegion, points: int, count: int, rng: np.random.Generator
) -> Float32[ndarray, "count points 3"]:
    """`count` clouds of `points` random points on the surfaces of obstacles within the region [m]; all
    zeros if there is no surface in it."""
    clouds = np.zeros((count, points, 3), np.float32)
    for cloud in clouds:
        surface_points = sample_surface(checker.scene, points, rng, region)
        cloud[: len(surface_points)] = surface_points
    return clouds
