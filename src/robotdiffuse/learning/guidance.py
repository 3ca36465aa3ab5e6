"""Collision guidance: gradient steps on predicted trajectories (paper, section Motion Guided Generation).

The same steps serve in two places: a few of them inside the sampler, on the predicted clean trajectory
(guidance), and more of them on its output (refinement).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.errors import InputError
from robotdiffuse.learning.guidance_kernel import descend


@dataclass(frozen=True)
class GuidanceSettings:
    margin: float = 0.04
    """Distance to obstacles below which frames are pushed away [m]: the paper's safe distance S. It also
    covers what lies between two frames."""
    self_margin: float = 0.01
    """The same between links [m]."""
    push: float = 0.15
    """Longest push of a frame in one step [rad]."""
    width: float = 4.0
    """Frames over which a push spreads: the standard deviation of the kernel."""
    relax: float = 0.2
    """Share by which frames move towards the middle of their neighbours after each step."""

    def __post_init__(self) -> None:
        for name in ("margin", "self_margin"):
            if getattr(self, name) < 0:
                raise InputError(f"guidance.{name} is {getattr(self, name)}; it must not be negative")
        for name in ("push", "width"):
            if not getattr(self, name) > 0:
                raise InputError(f"guidance.{name} is {getattr(self, name)}; it must be positive")
        if not 0 <= self.relax <= 1:
            raise InputError(f"guidance.relax is {self.relax}; it must be between 0 and 1")


class CollisionGuidance:
    """Moves trajectories of one problem out of collision."""

    def __init__(self, checker: CollisionChecker, settings: GuidanceSettings | None = None) -> None:
        self.checker, self.settings = checker, settings or GuidanceSettings()

    def __call__(
        self, q: Float[ndarray, "count frames dof"], steps: int
    ) -> tuple[Float[ndarray, "count frames dof"], Float[ndarray, "count"]]:
        """The trajectories after some steps, and the collision cost that the last step met.

        Cost zero: no inner frame is within the margins, or it was so before the last step.
        """
        settings, checker = self.settings, self.checker
        index = np.arange(q.shape[1])
        kernel = np.exp(-0.5 * ((index[:, None] - index) / settings.width) ** 2).astype(np.float32)
        moved = np.array(q, np.float32)
        costs = descend(
            checker.robot_arrays,
            checker.scene_arrays,
            moved,
            checker.robot.lower.astype(np.float32),
            checker.robot.upper.astype(np.float32),
            kernel,
            np.float32(settings.margin) + checker.padding,
            np.float32(settings.self_margin),
            np.float32(settings.push),
            np.float32(settings.relax),
            steps,
        )
        return moved, costs
