"""The voxels of the completion network and its settings; without PyTorch."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.core.settings import Count, Settings
from robotdiffuse.perception.observed_volume import LOW, SHAPE, VOXEL

SHOULDER = (0.0, 0.0, 0.33)
"""Of a Panda, in the base frame [m]."""
REACH = 1.0
"""Voxels count within this distance of the shoulder [m]: no point of a Panda gets farther."""


@dataclass(frozen=True)
class CompletionSettings(Settings, name="completion"):
    """Sizes of the network."""

    channels: tuple[Count, Count, Count] = (32, 64, 128)
    """Features of cells of 8, 16 and 32 cm."""
    blocks: tuple[Count, Count, Count] = (1, 1, 2)
    """Residual blocks at each size: as many on the way down as on the way up; those of the last size occur
    once."""


def voxel_centers() -> Float[ndarray, "56 56 32 3"]:
    """Centres of the voxels of an observed volume [m]."""
    axes = [(np.arange(n) + 0.5) * VOXEL + low for n, low in zip(SHAPE, LOW, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def reachable() -> Bool[ndarray, "56 56 32"]:
    """The voxels that the arm can reach."""
    return np.linalg.norm(voxel_centers() - SHOULDER, axis=-1) <= REACH
