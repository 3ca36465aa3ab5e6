"""Guidance: steps down a sum of cost functions, on predicted trajectories (paper, Motion Guided Generation).

The same steps serve in two places: a few of them inside the sampler, on the predicted clean trajectory
(guidance), and more of them on its output (refinement). The costs of waypoints q_i, with the paper's hinge
h = max(S - D, 0) of a safe distance S and a distance D:

| cost           | formula                                                        | switched on by |
|----------------|----------------------------------------------------------------|----------------|
| collision      | sum of h^2 / 2 over covering spheres; D is theirs to the scene | margin (S)     |
| self_collision | sum of h^2 / 2 over their pairs; D is between two links        | self_margin    |
| limits         | sum of h^2 / 2 over joints; D is theirs to the nearer limit    | limit_margin   |
| smoothness     | sum of |q_(i-1) - 2 q_i + q_(i+1)|^2 / 2: accelerations        | smoothness     |
| length         | sum of |q_(i+1) - q_i|^2 / 2: velocities                       | length         |

The first three are of single waypoints, which are pushed by the least motion that clears a contact (a
Gauss-Newton step); a kernel spreads the pushes over the neighbouring waypoints, as the metric of CHOMP does
(Zucker et al., IJRR 2013), whose smoothness is our length. Our smoothness is that of STOMP (Kalakrishnan et
al., ICRA 2011). These two move one waypoint after the other towards its optimum between its neighbours.

Each is a file in `learning.costs` and a line in its table. A new one says its step down itself, and acts
where `extra_costs` gives it a strength; the steps of these five are compiled, in `guidance_kernel.descend`. The
cost of a problem's path constraints, `learning.costs.path_constraints`, comes with the problem.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import NotNegative, Positive, Settings, Share
from robotdiffuse.learning.costs import COSTS
from robotdiffuse.learning.costs.cost import Cost
from robotdiffuse.learning.guidance_kernel import OFF, Steps, descend


@dataclass(frozen=True)
class GuidanceSettings(Settings, name="guidance"):
    margin: NotNegative | None = 0.04
    """Distance to obstacles below which waypoints are pushed away [m]: the paper's safe distance S. It also
    covers what lies between two waypoints. None: obstacles have no cost."""
    self_margin: NotNegative | None = 0.01
    """The same between links [m]."""
    limit_margin: NotNegative | None = None
    """The same of joint values to their limits [rad]. The limits themselves are always kept."""
    push: Positive = 0.15
    """Longest push of a waypoint in one step [rad]."""
    width: Positive = 4.0
    """Waypoints over which a push spreads: the standard deviation of the kernel."""
    smoothness: Share = 0.0
    """Share by which waypoints move towards the least accelerations after the pushes; 0: it has no cost."""
    length: Share = 0.2
    """Share by which waypoints move towards the middle of their neighbours after that; 0: it has no cost."""
    extra_costs: dict[str, float] = field(default_factory=dict)
    """Strengths of costs that are not of these, by name in `learning.costs.COSTS`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.extra_costs:
            if COSTS.load(name).step is None:
                raise InputError(
                    f"guidance.extra_costs names {name}; it has a setting, {COSTS.load(name).setting}"
                )


class CollisionGuidance:
    """Moves trajectories of one problem out of collision, and down the other costs of its settings."""

    def __init__(
        self,
        checker: CollisionChecker,
        settings: GuidanceSettings | None = None,
        of_problem: Mapping[str, Cost] = MappingProxyType({}),
    ) -> None:
        """`of_problem`: costs that the problem brings along, by name; their strength is the longest push."""
        self.checker, self.settings = checker, settings or GuidanceSettings()
        each = {name: (COSTS.load(name), strength) for name, strength in self.settings.extra_costs.items()}
        self._further: dict[str, tuple[Cost, float]] = {
            **each,
            **{name: (cost, self.settings.push) for name, cost in of_problem.items()},
        }

    def __call__(
        self, q: Float[ndarray, "count waypoints dof"], steps: int, prefix: int = 1, suffix: int = 1
    ) -> tuple[Float[ndarray, "count waypoints dof"], Float[ndarray, "count"]]:
        """The trajectories after some steps, and the cost of their margins that the last step met.

        The first `prefix` and the last `suffix` waypoints stay where they are, and have no cost. Cost zero:
        no waypoint between is within the margins, or it was so before the last step. Such a trajectory is
        left as it is; only where no margin is on do smoothness and length act on all.
        """
        settings, checker = self.settings, self.checker
        if min(prefix, suffix) < 1:
            raise InputError(
                f"prefix and suffix of guidance are {prefix} and {suffix}; both must be at least 1"
            )
        index = np.arange(q.shape[1])
        kernel = np.exp(-0.5 * ((index[:, None] - index) / settings.width) ** 2).astype(np.float32)
        moved = np.array(q, np.float32)
        lower, upper = (limits.astype(np.float32) for limits in (checker.robot.lower, checker.robot.upper))
        compiled = Steps(
            margin=OFF if settings.margin is None else np.float32(settings.margin) + checker.padding,
            self_margin=OFF if settings.self_margin is None else np.float32(settings.self_margin),
            limit_margin=OFF if settings.limit_margin is None else np.float32(settings.limit_margin),
            push=np.float32(settings.push),
            kernel=kernel,
            smoothness=np.float32(settings.smoothness),
            length=np.float32(settings.length),
        )
        further = self._further.values()
        costs, free = np.zeros(len(q), np.float32), slice(prefix, q.shape[1] - suffix)
        # one round at a time only where not all of it is compiled
        for count in [1] * steps if further else [steps]:
            arrays = checker.robot_arrays, checker.scene_arrays
            costs = descend(*arrays, moved, lower, upper, compiled, prefix, suffix, count)
            for cost, strength in further:
                assert cost.step is not None  # by GuidanceSettings
                moved[:, free] = np.clip(cost.step(checker, moved, strength)[:, free], lower, upper)
        return moved, costs

    def costs(self, q: Float[ndarray, "count waypoints dof"]) -> dict[str, Float[ndarray, "count"]]:
        """The cost functions by name, all waypoints counted; those whose margin is None are left out.

        In rad² but for the collision costs, in m². Not what the steps compute with: the formulas as they
        are, to look at and to test against.
        """
        compiled = {name: cost for name in COSTS if (cost := COSTS.load(name)).setting}
        every = {name: (cost, getattr(self.settings, cost.setting)) for name, cost in compiled.items()}
        every.update(self._further)
        return {
            name: cost.value(self.checker, q, strength)
            for name, (cost, strength) in every.items()
            if strength is not None
        }
