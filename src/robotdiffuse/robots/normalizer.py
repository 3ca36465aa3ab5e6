"""Joint values in units of the joint limits."""

from typing import TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from robotdiffuse.core.errors import InputError

Joints = TypeVar("Joints", ndarray, Tensor)
"""[*batch, dof], an array or a tensor; results have the same kind, dtype and device."""


class JointNormalizer:
    """Maps lower limits to -1 and upper limits to 1, joint by joint; arrays are computed in float64."""

    def __init__(self, lower: Float[ndarray, "dof"], upper: Float[ndarray, "dof"]) -> None:
        """Limits [rad], [m] for prismatic joints. Raises InputError for an empty or infinite range."""
        for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
            if not (np.isfinite(low) and np.isfinite(high) and low < high):
                raise InputError(
                    f"limits of joint {i} are {low} and {high}; they must be finite, lower below upper"
                )
        self.middle, self.half_range = (upper + lower) / 2, (upper - lower) / 2

    def to_unit(self, q: Joints) -> Joints:
        """Joint values [rad] or [m] mapped to [-1, 1]."""
        if isinstance(q, Tensor):
            return (q - q.new_tensor(self.middle)) / q.new_tensor(self.half_range)
        return ((q - self.middle) / self.half_range).astype(q.dtype)

    def from_unit(self, x: Joints) -> Joints:
        """Joint values [rad] or [m] from values in [-1, 1]."""
        if isinstance(x, Tensor):
            return x * x.new_tensor(self.half_range) + x.new_tensor(self.middle)
        return (x * self.half_range + self.middle).astype(x.dtype)
