"""What the networks of the learned baselines share: the robot that they are for, and how they are trained."""

from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor, nn

from robotdiffuse.errors import InputError
from robotdiffuse.learning.training.batches import TrajectoryData
from robotdiffuse.robots.robot import Robot

Joints = TypeVar("Joints", ndarray, Tensor)


@dataclass(frozen=True)
class JointRanges:
    """What a network keeps of the robot that it is trained for."""

    robot: str
    """Bundled name, or path to the URDF that it was read from."""
    joint_names: tuple[str, ...]
    lower: tuple[float, ...]
    """Joint limits [rad], [m] for prismatic joints."""
    upper: tuple[float, ...]

    @classmethod
    def of(cls, robot: Robot) -> "JointRanges":
        lower, upper = tuple(robot.lower.tolist()), tuple(robot.upper.tolist())
        return cls(robot.source or robot.name, robot.joint_names, lower, upper)

    def check_robot(self, robot: Robot, where: str) -> None:
        """Raises InputError unless the robot's joints are these. `where` names the network."""
        same = robot.joint_names == self.joint_names and all(
            np.allclose(own, its, atol=1e-3)
            for own, its in ((self.lower, robot.lower), (self.upper, robot.upper))
        )
        if not same:
            raise InputError(
                f"{where} was trained for {self.robot} with joints {', '.join(self.joint_names)}; "
                f"{robot.name} has other joints or other limits"
            )


class BaselineNetwork(nn.Module):
    """A network that `train_baseline` trains; `settings` are of its own class."""

    settings_class: ClassVar[type]
    """A dataclass with defaults."""
    training_defaults: ClassVar[dict[str, Any]] = {}
    """Its own defaults of fields of `BaselineTraining`, e.g. batch."""

    def __init__(self, ranges: JointRanges, settings: Any) -> None:
        super().__init__()
        self.ranges, self.settings = ranges, settings
        self.dof = len(ranges.joint_names)
        lower, upper = np.array(ranges.lower), np.array(ranges.upper)
        self._middle, self._half = (lower + upper) / 2, (upper - lower) / 2

    def fit_statistics(self, data: TrajectoryData) -> None:
        """Fill buffers from the trajectories for training; called before a run."""

    def loss(
        self, data: TrajectoryData, count: int, fraction: float, rng: np.random.Generator
    ) -> Float[Tensor, ""]:
        """The loss of `count` samples drawn from the data; `fraction` of the training is done, 0 to 1."""
        raise NotImplementedError

    def success(self, data: TrajectoryData, robot: Robot, rng: np.random.Generator) -> float | None:
        """What the network by itself solves of some of the held-out problems, as a share; None: not known."""
        return None

    def normalized(self, q: Joints) -> Joints:
        """Joint values as numbers that are -1 and 1 at the limits; any leading axes."""
        if isinstance(q, Tensor):
            return (q - self._like(self._middle, q)) / self._like(self._half, q)
        return ((q - self._middle) / self._half).astype(q.dtype)

    def joints(self, x: Joints) -> Joints:
        """Joint values [rad], the inverse of `normalized`."""
        if isinstance(x, Tensor):
            return x * self._like(self._half, x) + self._like(self._middle, x)
        return (x * self._half + self._middle).astype(x.dtype)

    def _like(self, values: Float[ndarray, "dof"], x: Tensor) -> Float[Tensor, "dof"]:
        return torch.from_numpy(values).to(x)
