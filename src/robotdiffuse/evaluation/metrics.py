"""Figures of motions, with intervals."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.robots.kinematics import ForwardKinematics
from robotdiffuse.robots.robot import Robot

RESAMPLES = 2000


class LinkPathLength:
    """The paper's path length: the sum over all moving links of the way that the origin travels [m]."""

    def __init__(self, robot: Robot) -> None:
        self._kinematics = ForwardKinematics(robot, torch.float64)
        self._links = [i for i, link in enumerate(robot.link_names) if robot.link_frame(link) > 0]

    def __call__(self, q: Float[ndarray, "n frames dof"]) -> Float[ndarray, "n"]:
        """Of motions through these configurations [rad]."""
        with torch.inference_mode():
            T = self._kinematics.links(torch.from_numpy(np.asarray(q, np.float64)))
        at = T[..., self._links, :3, 3].numpy()
        return np.linalg.norm(np.diff(at, axis=-3), axis=-1).sum(axis=(-2, -1))


def bootstrap_interval(
    values: Float[ndarray, "n"], statistic: Callable[[ndarray], float] = np.mean, seed: int = 0
) -> tuple[float, float]:
    """The 95 % interval of a statistic of independent values, by resampling them (B. Efron 1979)."""
    rng = np.random.default_rng(seed)
    draws = [statistic(values[rng.integers(0, len(values), len(values))]) for _ in range(RESAMPLES)]
    low, high = np.percentile(draws, (2.5, 97.5))
    return float(low), float(high)
