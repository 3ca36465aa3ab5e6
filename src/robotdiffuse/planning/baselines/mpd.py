"""MPD: Motion Planning Diffusion (Carvalho et al., IROS 2023), a diffusion prior guided by cost gradients.

The prior is unconditional (see `guided_prior`); planning draws from the posterior given the costs: in the
last part of the denoising steps, the mean of each step is moved by some gradient steps on the cost

    collision (scene and links) + joint limits + Gaussian process prior of constant velocity,

and the shortest free sample of the batch is the plan (algorithm 1 there).

Settings and the paper's or its code's values:

| setting | here | there |
|---|---|---|
| trajectories per batch | 16 | 100 (50 in the code), on a GPU |
| denoising steps | 25 | 25 |
| steps without noise after them | 5 | 5 |
| part of them that is guided, the last | 0.25 | 0.25 |
| gradient steps per denoising step | 5 | 5 |
| factor of the noise of a step | 0.5 | 0.5 |
| places checked per waypoint by the collision cost | 2 | 1.5 |
| weights of the costs | below | for other units and distances |

Other differences: signed distances of covering spheres by our compiled kernel replace their grid. The
Gaussian process is that of the positions, with the velocities integrated out; its step is implicit, so that
long steps are stable. Batches are repeated with new noise while there is time.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import ceil

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.settings import Count, Natural, NotNegative, Share
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

EXPONENTIAL_BETAS = (1e-4, 1.0)
"""Variances that the first and the last step of MPD's exponential schedule add."""


@dataclass(frozen=True)
class MPDSettings(PriorSettings, name="mpd"):
    """Settings of MPD. The noise levels are spaced as in MPD's exponential schedule."""

    quiet_steps: Natural = 5
    """Number of final steps without noise."""
    guided_share: Share = 0.25
    """Part of the denoising steps that are guided, the last ones; the quiet steps always are."""
    guide_steps: Count = 5
    """Gradient steps at each guided denoising step."""
    noise_scale: NotNegative = 0.5
    """Factor on the standard deviation of the noise of a denoising step."""
    margin: NotNegative = 0.04
    """Spheres nearer to obstacles than this have a collision cost [m]."""
    limit_margin: NotNegative = 0.02
    """Joints nearer to their limits than this are moved away from them [rad]."""
    collision_weight: NotNegative = 0.1
    """Weight of the collision cost [rad²/m]: a waypoint that is too close moves by about this times 0.5
    m/rad."""
    prior_weight: NotNegative = 2.0
    """Weight of the Gaussian process cost, with waypoints one unit of time apart and a power spectrum of 1
    rad²."""
    between: Natural = 1
    """Places between two waypoints at which the collision cost is evaluated."""


class MPD(GuidedPrior[MPDSettings]):
    """The prior's samples under MPD's guidance; see the head of this file."""

    name = "mpd"
    settings_class = MPDSettings

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
        settings = self.settings
        guided = ceil(settings.guided_share * settings.sampling_steps)

        def guide(q: ndarray, left: int) -> ndarray:
            return self.guided(checker, q) if left < guided else q

        levels = exponential_levels(prior.schedule, settings.sampling_steps)
        return sample(
            prior, starts, goals, levels, rng, guide, settings.noise_scale, settings.quiet_steps, stop
        )

    def guided(
        self, checker: CollisionChecker, q: Float[ndarray, "count waypoints dof"]
    ) -> Float[ndarray, "count waypoints dof"]:
        """Trajectories after the gradient steps of one denoising step; their ends stay fixed."""
        settings, robot = self.settings, checker.robot
        gaussian = gaussian_process(q.shape[1])
        for _ in range(settings.guide_steps):
            _, gradient = collision_gradient(
                checker, q, settings.margin, settings.self_margin, settings.between
            )
            near = np.minimum(settings.limit_margin, (robot.upper - robot.lower) / 2)
            inside = np.clip(q, robot.lower + near, robot.upper - near)
            moves = limited(-settings.collision_weight * gradient, settings.push) + (inside - q)
            moves[:, [0, -1]] = 0.0
            q = gaussian.step((q + moves).astype(np.float32), settings.prior_weight)
        return q


def exponential_levels(schedule: NoiseSchedule, steps: int) -> Int[ndarray, "steps"]:
    """The levels nearest to those of MPD's exponential schedule in log signal-to-noise ratio, falling from T.

    Its betas grow by a constant factor; levels that would fall together are moved apart. Raises InputError
    unless there are that many levels.
    """
    schedule.sampling_levels(steps)
    betas = np.geomspace(*EXPONENTIAL_BETAS, steps)
    alpha_bar = np.cumprod(1 - betas)[:-1]
    wanted = 0.5 * np.log(alpha_bar / (1 - alpha_bar))
    nearest = np.abs(schedule.half_log_snr[1:, None] - wanted).argmin(0) + 1
    return falling(np.append(nearest, schedule.steps), schedule.steps)


@dataclass(frozen=True, eq=False)
class GaussianProcess:
    """The prior of constant velocity over trajectories (M. Mukadam et al., IJRR 2018, section 3).

    Its states (position, velocity) follow white noise on acceleration: between waypoints one unit of time
    apart,

        state' = F state + noise,  F = [[1, 1], [0, 1]],  covariance Q = [[1/3, 1/2], [1/2, 1]],

    for every joint alike, so the precision of all states is block tri-diagonal. Samples of the prior have no
    velocities; integrated out, they leave the precision of the positions, which is that Schur complement.
    The cost q P q / 2 is the least integral of squared accelerations through the waypoints over 2, so that of
    natural cubic splines; straight lines cost nothing.
    """

    precision: Float[ndarray, "waypoints waypoints"]
    """P, of the positions of one joint."""

    def costs(self, q: Float[ndarray, "count waypoints dof"]) -> Float[ndarray, "count"]:
        """The sum over the joints of q P q / 2 [rad²]."""
        return 0.5 * (q * self.gradient(q)).sum((1, 2))

    def gradient(self, q: Float[ndarray, "count waypoints dof"]) -> Float[ndarray, "count waypoints dof"]:
        """P q."""
        return self.precision.astype(q.dtype) @ q

    def step(
        self, q: Float[ndarray, "count waypoints dof"], weight: float
    ) -> Float[ndarray, "count waypoints dof"]:
        """One implicit gradient step down weight q P q / 2 on all waypoints but the ends.

        It solves x = q - weight P x, the minimum of |x - q|² / 2 + weight x P x / 2 with fixed ends.
        """
        inner, ends = _implicit(q.shape[1], weight)
        moved = q.copy()
        moved[:, 1:-1] = inner.astype(q.dtype) @ q[:, 1:-1] + ends.astype(q.dtype) @ q[:, [0, -1]]
        return moved


def state_precision(waypoints: int) -> Float[ndarray, "states states"]:
    """The precision of the states of one joint, (position, velocity) of each waypoint in turn: block
    tri-diagonal."""
    transition = np.array([[1.0, 1.0], [0.0, 1.0]])
    inverse = np.linalg.inv(np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]))
    precision = np.zeros((2 * waypoints, 2 * waypoints))
    error = np.hstack([-transition, np.eye(2)])
    for i in range(waypoints - 1):
        precision[2 * i : 2 * i + 4, 2 * i : 2 * i + 4] += error.T @ inverse @ error
    return precision


@cache
def gaussian_process(waypoints: int) -> GaussianProcess:
    """The prior over this number of waypoints."""
    every = state_precision(waypoints)
    position, velocity = slice(0, None, 2), slice(1, None, 2)
    mixed = every[position, velocity]
    return GaussianProcess(
        every[position, position] - mixed @ np.linalg.solve(every[velocity, velocity], mixed.T)
    )


@cache
def _implicit(
    waypoints: int, weight: float
) -> tuple[Float[ndarray, "inner inner"], Float[ndarray, "inner 2"]]:
    """The matrices that `GaussianProcess.step` multiplies the inner waypoints and the ends with."""
    precision = gaussian_process(waypoints).precision
    inverse = np.linalg.inv(np.eye(waypoints - 2) + weight * precision[1:-1, 1:-1])
    return inverse, -weight * inverse @ precision[1:-1][:, [0, -1]]
