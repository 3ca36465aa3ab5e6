"""EDMP: ensemble-of-costs-guided diffusion (Saha et al., ICRA 2024), one prior and many guides in parallel.

No single cost, and no single choice of its parameters, fits all scenes. So a batch is divided among an
ensemble of guides, and the best of all samples is the plan. The prior is unconditional (see `guided_prior`).

Settings and the paper's values:

| setting | here | there |
|---|---|---|
| guides | 12: waypoints or swept motion, 3 clearances, 2 of weight and start | 12, of the same kinds |
| trajectories per guide | 2 | 10, on a GPU |
| denoising steps | 30 of the 255 levels, for a CPU | 255 |
| gradient steps per denoising step | 1 | 1 |

Differences: distances of covering spheres replace volumes of boxes. The hinge of their signed distance at the
waypoints replaces the intersection volume of links and obstacles; the same at several places between
waypoints replaces the swept volume. Obstacles are expanded by a margin that falls with the noise, as in the
paper. Links must keep a distance to each other too, unlike in the paper. The parameters of the guides are
ours, as theirs have other units. Batches are repeated with new noise while there is time.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Bound, Count, Filled, Natural, NotNegative, Positive, Settings, Share
from robotdiffuse.learning.diffusion import NoiseSchedule
from robotdiffuse.learning.motion_model import MotionModel
from robotdiffuse.planning.baselines.guided_prior import (
    GuidedPrior,
    PriorSettings,
    collision_gradient,
    falling,
    limited,
    sample,
)


@dataclass(frozen=True)
class GuideSettings(Settings, name="edmp.guides"):
    """One guide of the ensemble."""

    between: Natural
    """Places between two waypoints at which the cost is evaluated: 0 for the intersection cost, more for the
    swept one."""
    far_margin: NotNegative
    """Margin by which obstacles are expanded at the first guided step [m]."""
    near_margin: NotNegative
    """Margin at the last step [m]; it falls linearly from one to the other."""
    weight: NotNegative
    """Weight of the cost [rad²/m]: a waypoint that is too close moves by about this times 0.5 m/rad."""
    guided_share: Share
    """Part of the denoising steps that are guided, the last ones."""

    def margin(self, left: int, steps: int) -> float | None:
        """The margin where `left` of `steps` denoising steps are still to come [m]; None: not guided yet."""
        guided = self.guided_share * steps
        if left >= guided:
            return None
        return self.near_margin + (self.far_margin - self.near_margin) * left / guided


ENSEMBLE = tuple(
    GuideSettings(between, far, near, weight, share)
    for between, (far, near), (weight, share) in product(
        (0, 2), ((0.02, 0.02), (0.08, 0.03), (0.15, 0.05)), ((0.1, 0.9), (0.2, 0.4))
    )
)
"""Twelve guides: two costs, three clearances, and two pairs of weight and start."""


@dataclass(frozen=True)
class EDMPSettings(PriorSettings, name="edmp"):
    samples: Count = 24
    """Trajectories per batch, divided evenly among the guides."""
    sampling_steps: Annotated[int, Bound(least=2.0)] = 30
    """Denoising steps, closer where there is little noise."""
    push: Positive = 0.15
    """Longest move of a waypoint in one gradient step [rad]."""
    guides: Annotated[tuple[GuideSettings, ...], Filled()] = ENSEMBLE

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.samples < len(self.guides):
            raise InputError(
                f"edmp.samples is {self.samples} and guides are {len(self.guides)}; each needs a sample"
            )

    def shares(self) -> list[slice]:
        """The rows of a batch for each guide."""
        cuts = np.linspace(0, self.samples, len(self.guides) + 1).round().astype(int).tolist()
        return [slice(a, b) for a, b in pairwise(cuts)]


class EDMP(GuidedPrior[EDMPSettings]):
    """The prior's samples under an ensemble of guides; see the head of this file."""

    name = "edmp"
    settings_class = EDMPSettings

    def draw(
        self,
        prior: MotionModel,
        checker: CollisionChecker,
        starts: Float[ndarray, "count dof"],
        goals: Float[ndarray, "count dof"],
        rng: np.random.Generator,
        stop: Callable[[], bool] = lambda: False,
    ) -> Float[ndarray, "count waypoints dof"] | None:
        """See `GuidedPrior.draw`."""
        levels = quadratic_levels(prior.schedule, self.settings.sampling_steps)

        def guide(q: ndarray, left: int) -> ndarray:
            return self.guided(checker, q, left)

        return sample(prior, starts, goals, levels, rng, guide, stop=stop)

    def guided(
        self, checker: CollisionChecker, q: Float[ndarray, "samples waypoints dof"], left: int
    ) -> Float[ndarray, "samples waypoints dof"]:
        """The batch after a gradient step of every guide on its rows; the ends of trajectories stay fixed."""
        settings, moved = self.settings, q.copy()
        for share, guide in zip(settings.shares(), settings.guides, strict=True):
            margin = guide.margin(left, settings.sampling_steps)
            if margin is None:
                continue
            _, gradient = collision_gradient(checker, q[share], margin, settings.self_margin, guide.between)
            moves = limited(-guide.weight * gradient, settings.push)
            moved[share, 1:-1] += moves[:, 1:-1]
        return moved


def quadratic_levels(schedule: NoiseSchedule, steps: int) -> Int[ndarray, "steps"]:
    """`steps` of the levels, falling from T, closer together where there is little noise (Song et al. 2021,
    D.2).

    Evenly spaced levels would end at a high noise level, and leave the network's error there in the samples.
    Raises InputError unless there are that many levels.
    """
    schedule.sampling_levels(steps)
    wanted = schedule.steps * (np.arange(1, steps + 1) / steps) ** 2
    return falling(np.maximum(wanted.round().astype(np.int64), 1), schedule.steps)
