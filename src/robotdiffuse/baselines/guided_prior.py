"""MPD and EDMP: planners that draw batches of guided samples from a trajectory prior until a sample passes
validation.

- *MPD*: J. Carvalho, A. Le, M. Baierl, D. Koert, J. Peters, "Motion Planning Diffusion: Learning and Planning
  of Robot Motions with Diffusion Models", IROS 2023.
- *EDMP*: K. Saha et al., "EDMP: Ensemble-of-costs-guided Diffusion for Motion Planning", ICRA 2024.

Both papers train the temporal U-Net of Diffuser (M. Janner et al., ICML 2022) to predict the noise. The
network's inputs are a noisy trajectory and the noise level; it does not see the scene. In every noisy
trajectory, start and goal are set to their true values (in-painting). The scene enters through gradients of
costs: they move the mean of a denoising step. Here, both planners use the same trained network, the diffusion
model in the configuration `trajectory_prior`. They differ in the noise levels, the noise and the guides of
sampling.

Differences from the papers, with the papers' values:

- One network for both. It has 48 waypoints, as all our data (MPD 64, EDMP 50). Inputs are joint positions, as
  in EDMP (MPD adds velocities), scaled to the joint limits, as in both.
- T = 255 levels of the cosine schedule, as EDMP. MPD trains with 25 levels of an exponential schedule; its
  sampler here takes the 25 of our levels that are nearest to them in signal-to-noise ratio.
- 32, 64 and 128 channels at three resolutions (0.7 million parameters); MPD has 256 at a fourth one, too
  (about 4 million).
  Our network trains at 1,200 samples/s on a CPU core. It has layer norms over channels, and the condition
  scales and shifts the features; the papers have group norms and add a time embedding.
- Trained on trajectories of all scenes, as EDMP; MPD trains a prior per environment. A tenth of each batch
  are motions with a free straight line, and half of each batch is reversed in time, as for our own model.

**MPD**, a diffusion prior guided by cost gradients. Planning draws from the posterior given the costs: in the
last part of the denoising steps, the mean of each step is moved by some gradient steps on the cost

    collision (scene and links) + joint limits + Gaussian process prior of constant velocity.

The shortest free sample of the batch is the plan (the paper's algorithm 1).

Settings here, and in the paper or its code:

| setting | here | paper |
|---|---|---|
| trajectories per batch | 16 | 100 (50 in the code), on a GPU |
| denoising steps | 25 | 25 |
| further steps without noise | 5 | 5 |
| guided fraction of the denoising steps (the last ones) | 0.25 | 0.25 |
| gradient steps per denoising step | 5 | 5 |
| factor on the noise of a step | 0.5 | 0.5 |
| configurations per waypoint in the collision cost | 2 | 1.5 |
| weights of the costs | constants below | others, for other units and distances |

Other differences: our compiled kernel computes signed distances of covering spheres; the paper uses a
distance grid. Our Gaussian process is over positions, with the velocities integrated out, and its gradient
step is implicit, so that long steps are stable. Batches are repeated with new noise until time runs out.

**EDMP**, one prior and many guides in parallel.

No single cost, and no single choice of its parameters, fits all scenes. So a batch is divided among an
ensemble of guides, and the best of all samples is the plan.

Settings here and in the paper:

| setting | here | paper |
|---|---|---|
| guides: cost x margins x (weight, guided fraction) | 2 x 3 x 2 = 12 | 12, of the same kinds |
| trajectories per guide | 2 | 10, on a GPU |
| denoising steps | 30 of the 255 levels, for a CPU | 255 |
| gradient steps per denoising step | 1 | 1 |

Other differences: the paper's costs are volumes of boxes, ours are hinges of the signed distances of covering
spheres. Hinges at the waypoints replace the intersection volume of links and obstacles. Hinges at several
configurations between waypoints replace the swept volume. As in the paper, obstacles are expanded by a margin
that falls with the noise. Unlike in the paper, the links' distances to each other have a cost too. The
parameters of the guides are ours, since those of the paper have other units. Batches are repeated with new
noise until time runs out.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise, product
from math import ceil
from typing import Annotated, ClassVar, TypeVar

import numpy as np
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.deadline import OutOfTimeError, check_time, deadline
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import (
    AtLeastTwo,
    Count,
    Filled,
    Natural,
    NotNegative,
    Positive,
    Settings,
    Share,
)
from robotdiffuse.core.types import Configurations, PlanResult
from robotdiffuse.learning.diffusion import NoiseLevels, NoiseSchedule, reverse_process
from robotdiffuse.learning.guidance import Trajectories
from robotdiffuse.learning.motion_model import MotionModel
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.learned import Attempt, ExportedPlanner, LearnedSettings, nearest_goals, ranked
from robotdiffuse.planning.start_goal import StartGoal

SAMPLE_RESOLUTION = 0.02
"""No point of the arm moves further than this between neighboring checked configurations of a sample [m]."""
Guide = Callable[[ndarray, int], ndarray]
"""Takes the mean of a denoising step, as joint positions [count, waypoints, dof], and the number of denoising
steps that follow. This number is 0 at the last denoising step and in the steps without noise. Returns the
mean after gradient steps on the guide's costs."""


@dataclass(frozen=True)
class PriorSettings(LearnedSettings):
    samples: Count = 16
    """Number of trajectories in a batch."""
    sampling_steps: AtLeastTwo = 25
    """Number of denoising steps."""
    self_margin: NotNegative = 0.01
    """Distance between links below which there is a cost [m]."""
    push: Positive = 0.1
    """Longest move of a waypoint in one gradient step [rad, joint-space L2]."""


GuidedPriorSettings = TypeVar("GuidedPriorSettings", bound=PriorSettings)


class GuidedPrior(ExportedPlanner[GuidedPriorSettings]):
    """A planner that samples batches of trajectories from the prior under guidance.

    The free samples of a batch are validated, the shortest first. If none passes, the next batch is drawn
    from new noise, until time runs out. There is no search, and samples are not shortened or repaired.
    """

    network_name = "trajectory_prior"
    noise_scale: ClassVar[float] = 1.0
    """Factor on the standard deviation of the noise of a denoising step."""
    quiet_steps: ClassVar[int] = 0
    """Number of final steps without noise."""

    @staticmethod
    @abstractmethod
    def levels(schedule: NoiseSchedule, steps: int) -> NoiseLevels:
        """The noise levels of the denoising steps, in falling order."""

    @abstractmethod
    def guided(self, checker: CollisionChecker, q: Trajectories, left: int) -> Trajectories:
        """The means `q` of a denoising step after gradient steps; `left` more denoising steps follow. See
        `Guide`."""

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        prior = self.network(context.problem.robot)
        samples = self.settings.samples
        start, goals = start_goal.leads()
        goals = nearest_goals(start, goals, samples)
        ends = np.repeat(start[None], samples, 0), goals[np.arange(samples) % len(goals)]
        levels = self.levels(prior.schedule, self.settings.sampling_steps)
        guide = partial(self.guided, start_goal.checker)
        space = search_space(start_goal.checker, SAMPLE_RESOLUTION)
        colliding = list[Attempt]()
        """The best colliding sample of each batch."""
        batches = 0
        while context.remaining > 0:
            try:
                with deadline(lambda: context.remaining):
                    trajectories = sample(
                        prior, *ends, levels, context.rng, guide, self.noise_scale, self.quiet_steps
                    )
            except OutOfTimeError:
                break
            batches += 1
            for attempt in ranked(space, np.ascontiguousarray(trajectories, np.float32)):
                if attempt.broken:
                    colliding.append(attempt)
                    break
                result = context.finish(start_goal.complete(attempt.path), self.name)
                if result is not None:
                    return result
        # validates the best colliding sample, so that `refused` of the result says what is wrong with it; the
        # sample was checked by covering spheres, so the exact meshes may even be free
        closest = min(colliding, key=lambda attempt: attempt[:2], default=None)
        result = None if closest is None else context.finish(start_goal.complete(closest.path), self.name)
        return result or context.unsolved(
            f"none of {batches * samples} samples of the network is valid"
            if batches
            else f"time ran out before the first {samples} samples were complete; use a longer time limit"
        )


def sample(
    prior: MotionModel,
    starts: Configurations,
    goals: Configurations,
    levels: NoiseLevels,
    rng: np.random.Generator,
    guide: Guide,
    noise_scale: float = 1.0,
    quiet_steps: int = 0,
) -> Trajectories:
    """A trajectory from each start to its goal, float32. Inner waypoints are within the joint limits.

    Args:
        prior: The trajectory prior.
        starts: Start of each trajectory.
        goals: Goal of each trajectory.
        levels: See `reverse_process`.
        rng: Source of the noise.
        guide: Moves the mean of each denoising step.
        noise_scale: See `reverse_process`.
        quiet_steps: Additional steps at the last level, without noise (MPD: 5).

    Returns:
        The trajectories.

    Raises:
        OutOfTimeError: If no time is left before a step, see `core.deadline`.
    """
    reference = prior.reference(starts, goals)
    condition = prior.condition(np.zeros((len(starts), 0), np.float32), starts, goals)
    predicted = prior.predictor(reference, condition, lambda _: np.zeros(0))

    def predict(x: ndarray, level: int) -> ndarray:
        check_time("sampling trajectories")
        return predicted(x, level)

    def move(x: ndarray, left: int) -> ndarray:
        mean = prior.joints(prior.hold_ends(x, reference), reference)
        return prior.normalize(guide(mean, left), reference)

    x = reverse_process(
        predict, prior.schedule, lambda: prior.draw_noise(len(starts), rng), levels, move, noise_scale
    )
    for _ in range(quiet_steps):
        x = move(predict(x, int(levels[-1])), 0)
    q = prior.joints(prior.clipped(x), reference)
    q[:, 0] = starts
    q[:, -1] = goals
    return q


def falling(rising: NoiseLevels, most: int) -> NoiseLevels:
    """Rising levels in reverse order, at most `most`. Equal levels are moved apart, so that all are
    distinct."""
    at = np.arange(len(rising))
    spaced = np.maximum.accumulate(rising - at) + at
    return np.minimum(spaced, most - at[::-1])[::-1].copy()


def collision_gradient(
    checker: CollisionChecker,
    q: Trajectories,
    margin: float,
    self_margin: float,
    between: int,
) -> Trajectories:
    """The gradient of the collision cost of trajectories by all waypoints [m/rad], including start and goal.

    The cost of a configuration is sqrt(sum of h²) over the covering spheres and pairs of links, where h is
    the hinge of a signed distance (see `learning.guidance`). It measures how far the arm violates the
    margins. The cost of a trajectory is the sum of the costs of its waypoints, plus, for each segment, the
    mean cost of `between` configurations on it.
    """
    waypoints = q.shape[1]
    # all configurations are weighted means of waypoints: their weights [configurations, waypoints]
    numbers = np.arange((waypoints - 1) * (between + 1) + 1)
    offsets = numbers[:, None] / (between + 1) - np.arange(waypoints)
    weights = np.maximum(1 - np.abs(offsets), 0).astype(np.float32)
    all_q = weights @ q
    squares, gradients = checker.cost_gradients(all_q.reshape(-1, q.shape[2]), margin, self_margin)
    gradients /= np.maximum(np.sqrt(2 * squares), np.float32(1e-6))[:, None]
    weights[numbers % (between + 1) > 0] /= max(between, 1)  # each segment counts the mean of its costs
    return weights.T @ gradients.reshape(all_q.shape)


def limited(moves: Trajectories, most: float) -> Trajectories:
    """Moves of waypoints, shortened to at most `most` [rad, joint-space L2]."""
    lengths = np.linalg.norm(moves, axis=2, keepdims=True)
    return moves * np.minimum(1.0, most / np.maximum(lengths, 1e-9)).astype(moves.dtype)


GUIDE_STEPS = 5
"""Number of gradient steps at each guided denoising step."""
LIMIT_MARGIN = 0.02
"""Joints closer than this to a limit are moved away from it to this distance [rad]."""
COLLISION_WEIGHT = 0.1
"""Weight of the collision cost [rad²/m]. A waypoint that violates a margin moves by about this times the
cost's gradient, 0.5 m/rad."""
PRIOR_WEIGHT = 2.0
"""Weight of the Gaussian process cost, for waypoints one unit of time apart and a power spectral density of 1
rad²."""
EXPONENTIAL_BETAS = (1e-4, 1.0)
"""Variances of the noise that the first and the last step of MPD's exponential schedule add."""


@dataclass(frozen=True)
class MPDSettings(PriorSettings, name="mpd"):
    """Settings of MPD. The noise levels are spaced as in the paper's exponential schedule."""

    guided_share: Share = 0.25
    """Fraction of the denoising steps that are guided: the last ones. The steps without noise are guided
    too, unless this is 0."""
    margin: NotNegative = 0.04
    """Distance of spheres to obstacles below which there is a collision cost [m]."""
    between: Natural = 1
    """Number of configurations between two waypoints at which the collision cost is evaluated."""


def exponential_levels(schedule: NoiseSchedule, steps: int) -> NoiseLevels:
    """The levels of `schedule` that are nearest to MPD's exponential schedule in log signal-to-noise ratio,
    in falling order from T.

    The betas of an exponential schedule grow by a constant factor. Levels that would coincide are moved
    apart. Raises InputError if the schedule has fewer levels than `steps`.
    """
    schedule.sampling_levels(steps)  # only for the check that there are enough levels
    betas = np.geomspace(*EXPONENTIAL_BETAS, steps)
    alpha_bar = np.cumprod(1 - betas)[:-1]
    target_log_snr = 0.5 * np.log(alpha_bar / (1 - alpha_bar))
    nearest = np.abs(schedule.half_log_snr[1:, None] - target_log_snr).argmin(0) + 1
    return falling(np.append(nearest, schedule.steps), schedule.steps)


class MPD(GuidedPrior[MPDSettings]):
    """The prior's samples under MPD's guidance; see the head of this file."""

    name = "mpd"
    settings_class = MPDSettings

    noise_scale = 0.5
    quiet_steps = 5

    levels = staticmethod(exponential_levels)

    def guided(self, checker: CollisionChecker, q: Trajectories, left: int) -> Trajectories:
        """Trajectories after the gradient steps of one denoising step. Start and goal stay fixed."""
        settings = self.settings
        if left >= ceil(settings.guided_share * settings.sampling_steps):
            return q
        robot = checker.robot
        for _ in range(GUIDE_STEPS):
            gradient = collision_gradient(checker, q, settings.margin, settings.self_margin, settings.between)
            within_limits = np.clip(q, *robot.narrowed_limits(LIMIT_MARGIN))
            moves = limited(-COLLISION_WEIGHT * gradient, settings.push) + (within_limits - q)
            moves[:, [0, -1]] = 0.0
            q = implicit_step((q + moves).astype(np.float32), PRIOR_WEIGHT)
        return q


def position_precision(waypoints: int) -> ndarray:
    """P, the precision matrix of one joint's positions under the Gaussian process prior of constant velocity
    (M. Mukadam et al., IJRR 2018, section 3), for waypoints one unit of time apart.

    The acceleration is white noise, and the velocities are integrated out. Therefore the cost q P q / 2 is
    half the least integral of squared acceleration over all curves through the waypoints, which the natural
    cubic spline attains (P. Green and B. Silverman, "Nonparametric Regression and Generalized Linear Models",
    1993, section 2.1). Straight lines cost nothing.
    """
    second_differences = np.diff(np.eye(waypoints), 2, axis=0)
    count = waypoints - 2
    spline = 2 / 3 * np.eye(count) + (np.eye(count, k=1) + np.eye(count, k=-1)) / 6
    return second_differences.T @ np.linalg.solve(spline, second_differences)


def implicit_step(q: Trajectories, weight: float) -> Trajectories:
    """One implicit gradient step on the cost weight q P q / 2; first and last waypoint stay fixed.

    The result x solves x = q - weight P x: it minimizes |x - q|² / 2 + weight x P x / 2.
    """
    interior_map, end_map = _implicit(q.shape[1], weight)
    moved = q.copy()
    moved[:, 1:-1] = interior_map.astype(q.dtype) @ q[:, 1:-1] + end_map.astype(q.dtype) @ q[:, [0, -1]]
    return moved


@cache
def _implicit(waypoints: int, weight: float) -> tuple[ndarray, ndarray]:
    """The matrices by which `implicit_step` multiplies the inner waypoints, and the first and last
    waypoint."""
    precision = position_precision(waypoints)
    inverse = np.linalg.inv(np.eye(waypoints - 2) + weight * precision[1:-1, 1:-1])
    return inverse, -weight * inverse @ precision[1:-1][:, [0, -1]]


@dataclass(frozen=True)
class GuideSettings(Settings, name="edmp.guides"):
    """One guide of the ensemble."""

    between: Natural
    """Number of configurations between two waypoints at which the cost is evaluated: 0 for the intersection
    cost, more for the swept-volume cost."""
    far_margin: NotNegative
    """Margin by which obstacles are expanded just before the first guided step [m]."""
    near_margin: NotNegative
    """Margin at the last guided step [m]. The margin falls linearly from `far_margin` to `near_margin`."""
    weight: NotNegative
    """Weight of the cost [rad²/m]. A waypoint that violates the margin moves by about this times the cost's
    gradient, 0.5 m/rad."""
    guided_share: Share
    """Fraction of the denoising steps that are guided: the last ones."""


ENSEMBLE = tuple(
    GuideSettings(between, far, near, weight, share)
    for between, (far, near), (weight, share) in product(
        (0, 2), ((0.02, 0.02), (0.08, 0.03), (0.15, 0.05)), ((0.1, 0.9), (0.2, 0.4))
    )
)
"""Twelve guides: two costs, three pairs of margins, and two pairs of weight and guided fraction."""


@dataclass(frozen=True)
class EDMPSettings(PriorSettings, name="edmp"):
    samples: Count = 24
    """Number of trajectories in a batch, divided evenly among the guides."""
    sampling_steps: AtLeastTwo = 30
    """Number of denoising steps; the noise levels are closer together where there is little noise."""
    push: Positive = 0.15
    """Longest move of a waypoint in one gradient step [rad, joint-space L2]."""
    guides: Annotated[tuple[GuideSettings, ...], Filled()] = ENSEMBLE
    """The ensemble of guides. Each guide moves its own part of the batch."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.samples < len(self.guides):
            raise InputError(
                f"edmp.samples is {self.samples}; it must be at least {len(self.guides)}, one for each guide"
            )

    def shares(self) -> list[slice]:
        """The rows of a batch for each guide."""
        cuts = np.linspace(0, self.samples, len(self.guides) + 1).round().astype(int).tolist()
        return [slice(a, b) for a, b in pairwise(cuts)]


def quadratic_levels(schedule: NoiseSchedule, steps: int) -> NoiseLevels:
    """`steps` levels of the schedule in falling order from T, closer together where there is little noise
    (Song et al. 2021, D.2).

    Evenly spaced levels would end at a high noise level, so that the network's error at that level would stay
    in the samples. Raises InputError if the schedule has fewer levels than `steps`.
    """
    schedule.sampling_levels(steps)  # only for the check that there are enough levels
    targets = schedule.steps * (np.arange(1, steps + 1) / steps) ** 2
    return falling(np.maximum(targets.round().astype(np.int64), 1), schedule.steps)


class EDMP(GuidedPrior[EDMPSettings]):
    """The prior's samples under an ensemble of guides; see the head of this file."""

    name = "edmp"
    settings_class = EDMPSettings

    levels = staticmethod(quadratic_levels)

    def guided(self, checker: CollisionChecker, q: Trajectories, left: int) -> Trajectories:
        """The batch after one gradient step of each guide on the guide's rows. Start and goal stay fixed."""
        settings = self.settings
        moved = q.copy()
        for share, guide in zip(settings.shares(), settings.guides, strict=True):
            guided_steps = guide.guided_share * settings.sampling_steps
            if left >= guided_steps:
                continue
            margin = guide.near_margin + (guide.far_margin - guide.near_margin) * left / guided_steps
            gradient = collision_gradient(checker, q[share], margin, settings.self_margin, guide.between)
            moves = limited(-guide.weight * gradient, settings.push)
            moved[share, 1:-1] += moves[:, 1:-1]
        return moved
