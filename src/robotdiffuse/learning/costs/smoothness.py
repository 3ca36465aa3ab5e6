"""The sum of |q_(i-1) - 2 q_i + q_(i+1)|^2 / 2, as in STOMP (Kalakrishnan et al., ICRA 2011)."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.costs.cost import Cost


def value(
    _checker: CollisionChecker, q: Float[ndarray, "count waypoints dof"], _share: float
) -> Float[ndarray, "count"]:
    return 0.5 * (np.diff(q, 2, axis=1) ** 2).sum((1, 2))


SMOOTHNESS = Cost(value, setting="smoothness")
