"""Guidance: steps down a sum of cost functions, on predicted trajectories (paper, Motion Guided Generation).

The same steps serve in two places: a few of them inside the sampler, on the predicted clean trajectory
(guidance), and more of them on its output (refinement). The costs of frames q_i, with the paper's hinge
h = max(S - D, 0) of a safe distance S and a distance D:

| cost           | formula                                                        | switched on by |
|----------------|----------------------------------------------------------------|----------------|
| collision      | sum of h^2 / 2 over covering spheres; D is theirs to the scene | margin (S)     |
| self_collision | sum of h^2 / 2 over their pairs; D is between two links        | self_margin    |
| limits         | sum of h^2 / 2 over joints; D is theirs to the nearer limit    | limit_margin   |
| smoothness     | sum of |q_(i-1) - 2 q_i + q_(i+1)|^2 / 2: accelerations        | smoothness     |
| length         | sum of |q_(i+1) - q_i|^2 / 2: velocities                       | length         |

The first three are of single frames, which are pushed by the least motion that clears a contact (a
Gauss-Newton step); a kernel spreads the pushes over the neighbouring frames, as the metric of CHOMP does
(Zucker et al., IJRR 2013), whose smoothness is our length. Our smoothness is that of STOMP (Kalakrishnan et
al., ICRA 2011). These two move one frame after the other towards its optimum between its neighbours.

To add a cost: a formula in COSTS, a setting that switches it on, and its step in `guidance_kernel.descend`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.errors import InputError
from robotdiffuse.learning.guidance_kernel import OFF, Steps, descend


@dataclass(frozen=True)
class GuidanceSettings:
    margin: float | None = 0.04
    """Distance to obstacles below which frames are pushed away [m]: the paper's safe distance S. It also
    covers what lies between two frames. None: obstacles have no cost."""
    self_margin: float | None = 0.01
    """The same between links [m]."""
    limit_margin: float | None = None
    """The same of joint values to their limits [rad]. The limits themselves are always kept."""
    push: float = 0.15
    """Longest push of a frame in one step [rad]."""
    width: float = 4.0
    """Frames over which a push spreads: the standard deviation of the kernel."""
    smoothness: float = 0.0
    """Share by which frames move towards the least accelerations after the pushes; 0: it has no cost."""
    length: float = 0.2
    """Share by which frames move towards the middle of their neighbours after that; 0: it has no cost."""

    def __post_init__(self) -> None:
        for name in ("margin", "self_margin", "limit_margin"):
            margin = getattr(self, name)
            if margin is not None and not margin >= 0:
                raise InputError(f"guidance.{name} is {margin}; it must be None or at least 0")
        for name in ("push", "width"):
            if not getattr(self, name) > 0:
                raise InputError(f"guidance.{name} is {getattr(self, name)}; it must be positive")
        for name in ("smoothness", "length"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"guidance.{name} is {getattr(self, name)}; it must be between 0 and 1")


class CollisionGuidance:
    """Moves trajectories of one problem out of collision, and down the other costs of its settings."""

    def __init__(self, checker: CollisionChecker, settings: GuidanceSettings | None = None) -> None:
        self.checker, self.settings = checker, settings or GuidanceSettings()

    def __call__(
        self, q: Float[ndarray, "count frames dof"], steps: int, prefix: int = 1, suffix: int = 1
    ) -> tuple[Float[ndarray, "count frames dof"], Float[ndarray, "count"]]:
        """The trajectories after some steps, and the cost of their margins that the last step met.

        The first `prefix` and the last `suffix` frames stay where they are, and have no cost. Cost zero: no
        frame between is within the margins, or it was so before the last step. Such a trajectory is left as
        it is; only where no margin is on do smoothness and length act on all.
        """
        settings, checker = self.settings, self.checker
        if min(prefix, suffix) < 1:
            raise InputError(
                f"prefix and suffix of guidance are {prefix} and {suffix}; both must be at least 1"
            )
        index = np.arange(q.shape[1])
        kernel = np.exp(-0.5 * ((index[:, None] - index) / settings.width) ** 2).astype(np.float32)
        moved = np.array(q, np.float32)
        costs = descend(
            checker.robot_arrays,
            checker.scene_arrays,
            moved,
            checker.robot.lower.astype(np.float32),
            checker.robot.upper.astype(np.float32),
            Steps(
                margin=OFF if settings.margin is None else np.float32(settings.margin) + checker.padding,
                self_margin=OFF if settings.self_margin is None else np.float32(settings.self_margin),
                limit_margin=OFF if settings.limit_margin is None else np.float32(settings.limit_margin),
                push=np.float32(settings.push),
                kernel=kernel,
                smoothness=np.float32(settings.smoothness),
                length=np.float32(settings.length),
            ),
            prefix,
            suffix,
            steps,
        )
        return moved, costs

    def costs(self, q: Float[ndarray, "count frames dof"]) -> dict[str, Float[ndarray, "count"]]:
        """The cost functions by name, all frames counted; those whose margin is None are left out.

        In rad² but for the collision costs, in m². Not what the steps compute with: the formulas as they
        are, to look at and to test against.
        """
        strengths = {name: getattr(self.settings, cost.setting) for name, cost in COSTS.items()}
        return {
            name: cost.value(self.checker, q, strengths[name])
            for name, cost in COSTS.items()
            if strengths[name] is not None
        }


class Cost(NamedTuple):
    """A cost function of trajectories."""

    setting: str
    """The field of GuidanceSettings that says whether it acts and how strongly."""
    value: Callable[[CollisionChecker, Float[ndarray, "count frames dof"], float], Float[ndarray, "count"]]
    """Of trajectories, at what that field says."""


def collision(
    checker: CollisionChecker, q: Float[ndarray, "count frames dof"], margin: float
) -> Float[ndarray, "count"]:
    """See the table at the head of this file, here and below."""
    costs, _ = checker.cost_gradients(q.reshape(-1, q.shape[2]), margin, float(OFF))
    return costs.reshape(q.shape[:2]).sum(1)


def self_collision(
    checker: CollisionChecker, q: Float[ndarray, "count frames dof"], margin: float
) -> Float[ndarray, "count"]:
    costs, _ = checker.cost_gradients(q.reshape(-1, q.shape[2]), float(OFF), margin)
    return costs.reshape(q.shape[:2]).sum(1)


def limits(
    checker: CollisionChecker, q: Float[ndarray, "count frames dof"], margin: float
) -> Float[ndarray, "count"]:
    lower, upper = checker.robot.lower, checker.robot.upper
    hinge = np.minimum(margin, (upper - lower) / 2) - np.minimum(q - lower, upper - q)
    return 0.5 * (np.maximum(hinge, 0.0) ** 2).sum((1, 2))


def smoothness(
    _checker: CollisionChecker, q: Float[ndarray, "count frames dof"], _share: float
) -> Float[ndarray, "count"]:
    return 0.5 * (np.diff(q, 2, axis=1) ** 2).sum((1, 2))


def length(
    _checker: CollisionChecker, q: Float[ndarray, "count frames dof"], _share: float
) -> Float[ndarray, "count"]:
    return 0.5 * (np.diff(q, axis=1) ** 2).sum((1, 2))


COSTS: dict[str, Cost] = {
    "collision": Cost("margin", collision),
    "self_collision": Cost("self_margin", self_collision),
    "limits": Cost("limit_margin", limits),
    "smoothness": Cost("smoothness", smoothness),
    "length": Cost("length", length),
}
"""By name: the formulas of the table at the head of this file."""
