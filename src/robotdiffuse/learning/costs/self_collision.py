"""The sum of h^2 / 2 over pairs of links, with the hinge h of their distance."""

from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.costs.cost import Cost
from robotdiffuse.learning.guidance_kernel import OFF


def value(
    checker: CollisionChecker, q: Float[ndarray, "count waypoints dof"], margin: float
) -> Float[ndarray, "count"]:
    costs, _ = checker.cost_gradients(q.reshape(-1, q.shape[2]), float(OFF), margin)
    return costs.reshape(q.shape[:2]).sum(1)


SELF_COLLISION = Cost(value, setting="self_margin")
