"""What all planners around a network share: its weights."""

from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.settings import Settings
from robotdiffuse.learning.weights_registry import check_weights
from robotdiffuse.planning.planner import Planner
from robotdiffuse.robots.robot import Robot

SAMPLES_PER_GOAL = 4
"""So many samples are drawn at least for each goal that has a share of a batch."""


@dataclass(frozen=True)
class LearnedSettings(Settings):
    weights: str | None = None
    """Folder of trained weights; None: those that were trained here for the robot, or
    come with the package."""


Own = TypeVar("Own", bound=LearnedSettings)


class LearnedPlanner(Planner[Own]):
    """A planner that needs the weights of a network."""

    network_name: ClassVar[str]
    """In NETWORKS."""

    def __init__(self, settings: Own | None = None) -> None:
        """Raises InputError if the folder that the settings name holds no weights."""
        super().__init__(settings)
        check_weights(self.network_name, self.settings.weights)

    def network(self, robot: Robot) -> Any:
        """The trained network for a robot. Raises InputError, naming the command that trains it, without."""
        from robotdiffuse.learning.checkpoint import load_network  # which loads PyTorch

        return load_network(self.network_name, self.settings.weights, robot)

    def prepare(self, robot: Robot) -> None:
        """See `planning.planner.Planner`."""
        self.network(robot)


def nearest_goals(
    start: Float[ndarray, "dof"], goals: Float[ndarray, "k dof"], samples: int
) -> Float[ndarray, "n dof"]:
    """Those that have a share of a batch of so many samples, the nearest first."""
    order = np.argsort(np.linalg.norm(goals - start, axis=1))
    return goals[order[: max(samples // SAMPLES_PER_GOAL, 1)]]
