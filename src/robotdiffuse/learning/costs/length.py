"""The sum of |q_(i+1) - q_i|^2 / 2, the smoothness of CHOMP (Zucker et al., IJRR 2013)."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.costs.cost import Cost


def value(
    _checker: CollisionChecker, q: Float[ndarray, "count waypoints dof"], _share: float
) -> Float[ndarray, "count"]:
    return 0.5 * (np.diff(q, axis=1) ** 2).sum((1, 2))


LENGTH = Cost(value, setting="length")
