"""Guidance: steps down a sum of cost functions, on predicted trajectories (paper, Motion Guided Generation).

The same steps serve in two places: a few of them inside the sampler, on the predicted clean trajectory
(guidance), and more of them on its output (refinement). The costs of waypoints q_i, with the paper's hinge
h = max(S - D, 0) of a safe distance S and a distance D:

| cost           | formula                                                             | enabled by  |
|----------------|---------------------------------------------------------------------|-------------|
| collision      | sum of h^2 / 2 over covering spheres; D: from sphere to scene       | margin (S)  |
| self_collision | sum of h^2 / 2 over pairs of links; D: between the two links        | self_margin |
| limits         | sum of h^2 / 2 over joints; D: from joint value to the nearer limit | limit_margin|
| smoothness     | sum of |q_(i-1) - 2 q_i + q_(i+1)|^2 / 2: accelerations             | smoothness  |
| length         | sum of |q_(i+1) - q_i|^2 / 2: velocities                            | length      |

The first three concern single waypoints. Each waypoint is pushed by the smallest motion that clears a contact
(a Gauss-Newton step), and a kernel spreads the pushes over the neighbouring waypoints, as the metric of CHOMP
does (Zucker et al., IJRR 2013). Length is the smoothness of CHOMP, and smoothness that of STOMP (Kalakrishnan
et al., ICRA 2011); these two move one waypoint after the other towards its optimum between its neighbours.

The steps of these five are compiled, in `guidance_kernel.descend`. Further costs are in `learning.costs`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.settings import NotNegative, Positive, Settings, Share
from robotdiffuse.learning.costs import COSTS, CostStep
from robotdiffuse.learning.guidance_kernel import OFF, Steps, descend


@dataclass(frozen=True)
class GuidanceSettings(Settings, name="guidance"):
    margin: NotNegative | None = 0.04
    """Distance to obstacles below which waypoints are pushed away [m]: the paper's safe distance S. It also
    covers the motion between two waypoints. None: obstacles have no cost."""
    self_margin: NotNegative | None = 0.01
    """Distance between links below which they are pushed apart [m]; None: no cost."""
    limit_margin: NotNegative | None = None
    """Distance of joint values to their limits below which they are pushed back [rad]; None: no cost. The
    limits themselves are always kept."""
    push: Positive = 0.15
    """Longest push of a waypoint in one step [rad]."""
    width: Positive = 4.0
    """Waypoints over which a push spreads: the standard deviation of the kernel."""
    smoothness: Share = 0.0
    """After the pushes, waypoints move by this fraction towards the smallest accelerations; 0: no cost."""
    length: Share = 0.2
    """Then waypoints move by this fraction towards the middle of their neighbours; 0: no cost."""
    extra_costs: dict[str, float] = field(default_factory=dict)
    """Strengths of further costs, by name in `learning.costs.COSTS`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.extra_costs:
            COSTS.entry(name)


class CollisionGuidance:
    """Moves trajectories of one problem out of collision, and down the other costs of its settings."""

    def __init__(
        self,
        checker: CollisionChecker,
        settings: GuidanceSettings | None = None,
        problem_costs: Sequence[CostStep] = (),
    ) -> None:
        """problem_costs: costs of this problem alone; their strength is the setting `push`."""
        self.checker, self.settings = checker, settings or GuidanceSettings()
        extra = [(COSTS.load(name), strength) for name, strength in self.settings.extra_costs.items()]
        self._extra_costs: list[tuple[CostStep, float]] = extra + [
            (step, self.settings.push) for step in problem_costs
        ]

    def __call__(
        self, q: Float[ndarray, "count waypoints dof"], steps: int
    ) -> tuple[Float[ndarray, "count waypoints dof"], Float[ndarray, "count"]]:
        """The trajectories [rad] after some steps, and the costs of the margins that the last step found.

        The first and the last waypoint stay where they are, and have no cost. A cost of zero: no waypoint
        between them is within a margin, or none was before the last step. Such a trajectory is left as it is;
        smoothness and length act on every trajectory only where no margin is enabled.
        """
        settings, checker = self.settings, self.checker
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
        costs = np.zeros(len(q), np.float32)
        # one round at a time only if some of the steps are not compiled
        for rounds in [1] * steps if self._extra_costs else [steps]:
            arrays = checker.robot_arrays, checker.scene_arrays
            costs = descend(*arrays, moved, lower, upper, compiled, rounds)
            for step, strength in self._extra_costs:
                moved[:, 1:-1] = np.clip(step(checker, moved, strength)[:, 1:-1], lower, upper)
        return moved, costs
