"""The sum of h^2 / 2 over joints, with the hinge h of their distance to the nearer limit."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.costs.cost import Cost


def value(
    checker: CollisionChecker, q: Float[ndarray, "count waypoints dof"], margin: float
) -> Float[ndarray, "count"]:
    lower, upper = checker.robot.lower, checker.robot.upper
    hinge = np.minimum(margin, (upper - lower) / 2) - np.minimum(q - lower, upper - q)
    return 0.5 * (np.maximum(hinge, 0.0) ** 2).sum((1, 2))


LIMITS = Cost(value, setting="limit_margin")
