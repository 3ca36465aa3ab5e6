"""Random numbers for compiled code."""

import numpy as np
from numpy import ndarray

from robotdiffuse.core.kernels import allocation_free


def random_state(seed: int, attempt: int = 0) -> ndarray:
    """State uint64[1] of the compiled random number generator, from a seed and the number of the attempt."""
    return np.random.SeedSequence([seed, attempt]).generate_state(1, np.uint64) | np.uint64(1)


@allocation_free()
def random(state):
    """A uniform random float32 in [0, 1); advances the state uint64[1] (xorshift64*, S. Vigna 2016)."""
    x = state[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    state[0] = x
    return np.float32((x * np.uint64(2685821657736338717)) >> np.uint64(40)) * np.float32(5.9604645e-08)
