"""The occupancy completion network's prediction for the voxels of a map."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from robotdiffuse.perception.observed_volume import ObservedVolume
from robotdiffuse.perception.occupancy_map import OccupancyMap
from robotdiffuse.perception.voxel_grid import LAYERS_BELOW
from robotdiffuse.robots.robot import Robot

PROBABILITY_BELOW = np.float32(0.1)
"""That a voxel below the volume that the network predicts is occupied, where the map does not know it: the
share of unknown voxels within reach that are."""


def predicted_occupancy(
    robot: Robot, known: OccupancyMap, volume: Callable[[], ObservedVolume]
) -> Float32[ndarray, "nx ny nz"] | None:
    """The probability that each voxel is occupied, 0 where the map knows it to be free; None if the network
    does not cover the arm's reach. volume: gives what views observed."""
    from robotdiffuse.learning.completion import covers, predict

    if not covers(robot):
        return None
    below = ((0, 0), (0, 0), (LAYERS_BELOW, 0))
    probability = np.pad(predict(volume()), below, constant_values=PROBABILITY_BELOW)
    return np.where(known.free, np.float32(0), probability)
