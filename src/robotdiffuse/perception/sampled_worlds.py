"""Sampled worlds: unknown space filled at random, so that near voxels are filled together.

A voxel is occupied in a world where a smooth random field is below the voxel's probability. At each point the
field is uniform between 0 and 1 over the worlds, so each voxel keeps its probability; and as obstacles are
larger than voxels, so are the parts where the field is low. Independent voxels would call a motion through a
thousand of them, each free with a probability of 0.999, free with one of 0.37.
"""

from functools import cache

import numpy as np
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray

from robotdiffuse.core.loading import loading
from robotdiffuse.perception.observed_volume import VOXEL
from robotdiffuse.perception.sampled_worlds_kernel import TILE, count_free, highest_in_cells

CORRELATION_LENGTH = 0.25
"""Distance at which the field's correlation has fallen to exp(-1/2), before its values are made uniform [m].
Chosen on problems of `benchmarks/cameras.py` with even numbers."""
WORLDS = 256
"""Sampled worlds of a probability."""


def free_share(probability: Float32[ndarray, "nx ny nz"], voxels: Bool[ndarray, "nx ny nz"]) -> float:
    """The part of the sampled worlds in which all of these fine voxels are free.

    probability: that each fine voxel is occupied. The worlds are the same in every call.
    """
    return count_free(_field(), _shifts(), *highest_in_cells(probability, voxels)) / WORLDS


@cache
@loading()
def _field() -> Float32[ndarray, "n n n"]:
    """A periodic random field on coarse voxels; its values are evenly spread between 0 and 1."""
    white = np.random.default_rng(0).standard_normal((TILE, TILE, TILE))
    k = 2 * np.pi * np.fft.fftfreq(TILE, VOXEL)
    squared = k[:, None, None] ** 2 + k[:, None] ** 2 + k**2
    smooth = np.fft.ifftn(np.fft.fftn(white) * np.exp(-squared * CORRELATION_LENGTH**2 / 4)).real
    ranks = np.empty(smooth.size, np.float32)
    ranks[np.argsort(smooth, axis=None)] = (np.arange(smooth.size) + 0.5) / smooth.size
    return ranks.reshape(smooth.shape)


@cache
def _shifts() -> Int64[ndarray, "worlds 3"]:
    """How far the field is shifted in each world, in coarse voxels."""
    return np.random.default_rng(1).integers(TILE, size=(WORLDS, 3))
