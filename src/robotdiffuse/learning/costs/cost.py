"""What a cost function of guidance is."""

from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker

Value = Callable[[CollisionChecker, Float[ndarray, "count waypoints dof"], float], Float[ndarray, "count"]]
Step = Callable[
    [CollisionChecker, Float[ndarray, "count waypoints dof"], float], Float[ndarray, "count waypoints dof"]
]


class Cost(NamedTuple):
    """A cost function of trajectories, and how it is descended; both at the strength that settings give."""

    value: Value
    """Of trajectories [rad], each by itself."""
    step: Step | None = None
    """The trajectories after one step down; what moves beyond limits, or of the ends, is put back. None: the
    step is compiled, in `guidance_kernel.descend`."""
    setting: str = ""
    """The field of GuidanceSettings that has the strength of a compiled one."""
