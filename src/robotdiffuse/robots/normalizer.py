"""Joint values in units of the joint limits."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError


class JointNormalizer:
    """Maps lower limits to -1 and upper limits to 1, joint by joint; computed in float64."""

    def __init__(self, lower: Float[ndarray, "dof"], upper: Float[ndarray, "dof"]) -> None:
        """`lower` and `upper` are joint limits [rad], [m] for prismatic joints. Raises InputError for an
        empty or infinite range."""
        for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
            if not (np.isfinite(low) and np.isfinite(high) and low < high):
                raise InputError(
                    f"limits of joint {i} are {low} and {high}; they must be finite, lower below upper"
                )
        self.middle = (upper + lower) / 2
        self.half_range = (upper - lower) / 2

    def to_unit(self, q: Float[ndarray, "*batch dof"]) -> Float[ndarray, "*batch dof"]:
        """Joint values [rad] or [m] mapped to [-1, 1], of the same dtype."""
        return ((q - self.middle) / self.half_range).astype(q.dtype)

    def from_unit(self, x: Float[ndarray, "*batch dof"]) -> Float[ndarray, "*batch dof"]:
        """Joint values [rad] or [m] from values in [-1, 1], of the same dtype."""
        return (x * self.half_range + self.middle).astype(x.dtype)
