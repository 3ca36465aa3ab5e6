"""EDMP: ensemble-of-costs-guided diffusion (Saha et al., ICRA 2024), one prior and many guides in parallel.

No single cost and no single choice of its numbers fits all scenes. So a batch is split among an ensemble of
guides; each guides its share, and the best of all samples is the plan. The prior is unconditional
(`learning.networks.trajectory_prior`).

Settings and the paper's values:

| setting | here | there |
|---|---|---|
| guides | 12: frames or swept motion, 3 clearances, 2 of weight and start | 12, of the same kinds |
| trajectories per guide | 2 | 10, on a GPU |
| denoising steps | 30 of the 255 levels, for a CPU | 255 |
| gradient steps per denoising step | 1 | 1 |

Differences: distances of covering spheres stand in for the volumes of boxes: the hinge of their signed
distance at single frames for the intersection volume of links and obstacles, and the same at several places
between frames as well for the swept volume. Obstacles are expanded by a margin that falls with the noise, as
there. Links must keep a distance to each other too, which is not there. The numbers of the guides are ours,
for theirs are in other units. Batches are repeated with new noise while there is time.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.errors import InputError
from robotdiffuse.learning.networks.trajectory_prior import TrajectoryPrior, quadratic_levels
from robotdiffuse.planners.guided_prior import GuidedPrior, PriorSettings, collision_gradient, limited


@dataclass(frozen=True)
class GuideSettings:
    """One guide of the ensemble."""

    between: int
    """Places between two frames that the cost looks at: 0 is the intersection's cost, more that of the swept
    motion."""
    far_margin: float
    """By which obstacles are expanded at the first guided step [m]."""
    near_margin: float
    """The same at the last step [m]; it falls evenly from one to the other."""
    weight: float
    """Of the cost [rad²/m]: a frame that is too close moves by about this times 0.5 m/rad."""
    guided_share: float
    """Share of the denoising steps that are guided, the last ones."""

    def __post_init__(self) -> None:
        for name in ("between", "far_margin", "near_margin", "weight"):
            if not getattr(self, name) >= 0:
                raise InputError(f"edmp.guides: {name} is {getattr(self, name)}; it must be at least 0")
        if not 0 <= self.guided_share <= 1:
            raise InputError(f"edmp.guides: guided_share is {self.guided_share}; it must be between 0 and 1")

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
    samples: int = 24
    """Trajectories per batch, shared out evenly among the guides."""
    sampling_steps: int = 30
    """Denoising steps, closer where there is little noise."""
    self_margin: float = 0.01
    """Distance between links below which their cost arises [m], for all guides."""
    push: float = 0.15
    """Longest move of a frame in one gradient step [rad]."""
    guides: tuple[GuideSettings, ...] = ENSEMBLE

    def __post_init__(self) -> None:
        if not self.guides:
            raise InputError("edmp.guides is empty; there must be at least one")
        if self.samples < len(self.guides):
            raise InputError(
                f"edmp.samples is {self.samples} and guides are {len(self.guides)}; each needs a sample"
            )
        if self.sampling_steps < 2:
            raise InputError(f"edmp.sampling_steps is {self.sampling_steps}; it must be at least 2")
        if not self.self_margin >= 0:
            raise InputError(f"edmp.self_margin is {self.self_margin}; it must be at least 0")
        if not self.push > 0:
            raise InputError(f"edmp.push is {self.push}; it must be positive")

    def shares(self) -> list[slice]:
        """The rows of a batch that each guide has."""
        cuts = np.linspace(0, self.samples, len(self.guides) + 1).round().astype(int).tolist()
        return [slice(a, b) for a, b in pairwise(cuts)]


class EDMP(GuidedPrior[EDMPSettings]):
    """The prior's samples under an ensemble of guides; see the head of this file."""

    name = "edmp"
    settings_class = EDMPSettings

    def draw(
        self,
        prior: TrajectoryPrior,
        checker: CollisionChecker,
        starts: Float[ndarray, "count dof"],
        goals: Float[ndarray, "count dof"],
        rng: np.random.Generator,
        stop: Callable[[], bool] = lambda: False,
    ) -> Float[ndarray, "count frames dof"] | None:
        """See `GuidedPrior.draw`."""
        levels = quadratic_levels(prior.schedule, self.settings.sampling_steps)

        def guide(q: ndarray, left: int) -> ndarray:
            return self.guided(checker, q, left)

        return prior.sample(starts, goals, levels, rng, guide, stop=stop)

    def guided(
        self, checker: CollisionChecker, q: Float[ndarray, "samples frames dof"], left: int
    ) -> Float[ndarray, "samples frames dof"]:
        """The batch after a gradient step of every guide on its share; the ends of trajectories stay."""
        settings, moved = self.settings, q.copy()
        for share, guide in zip(settings.shares(), settings.guides, strict=True):
            margin = guide.margin(left, settings.sampling_steps)
            if margin is None:
                continue
            _, gradient = collision_gradient(checker, q[share], margin, settings.self_margin, guide.between)
            moves = limited(-guide.weight * gradient, settings.push)
            moved[share, 1:-1] += moves[:, 1:-1]
        return moved
