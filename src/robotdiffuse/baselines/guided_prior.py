"""MPD and EDMP: batches of guided samples of a trajectory prior, until one passes validation.

- *MPD*: J. Carvalho, A. Le, M. Baierl, D. Koert, J. Peters, "Motion Planning Diffusion: Learning and Planning
  of Robot Motions with Diffusion Models", IROS 2023.
- *EDMP*: K. Saha et al., "EDMP: Ensemble-of-costs-guided Diffusion for Motion Planning", ICRA 2024.

Both train the temporal U-Net of Diffuser (M. Janner et al., ICML 2022) to predict the noise. Its network
inputs are noisy trajectories and the noise level, but no scene. Both hold start and goal at their values in
every noisy trajectory (in-painting), and both consider the scene through gradients of costs on the mean of
every denoising step. So both use one trained network, the diffusion model in the configuration
`trajectory_prior`; levels, noise and guides of the sampling differ.

Differences from the papers, with their values:

- One network for both. Waypoints: 48, as all our data (MPD 64, EDMP 50). Joint positions alone as in EDMP
  (MPD adds velocities), scaled to the joint limits as in both.
- T = 255 levels of the cosine schedule, as EDMP; MPD trains with 25 levels of an exponential schedule. Its
  sampler takes the 25 of these levels that are nearest to it in signal-to-noise ratio.
- Width 32 at resolutions 1, 2, 4 (0.7 million numbers); MPD 32 at 1, 2, 4, 8 (about 4 million). It trains at
  1,200 samples/s on a core of a CPU. Our U-Net has layer norms over channels, and scale
  and shift by the condition, in place of group norms and an added time embedding.
- Trained on trajectories of all scenes mixed, as EDMP; MPD trains a prior per environment. A tenth of each
  batch are motions with a free straight line, and half of it is reversed, as for our own model.

**MPD**, a diffusion prior guided by cost gradients. Planning draws from the posterior given the costs: in the
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

**EDMP**, one prior and many guides in parallel.

No single cost, and no single choice of its parameters, fits all scenes. So a batch is divided among an
ensemble of guides, and the best of all samples is the plan.

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

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise, product
from math import ceil
from typing import Annotated, ClassVar, TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import motions_free, path_length
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Count, Filled, Natural, NotNegative, Positive, Settings, Share
from robotdiffuse.core.types import Configuration, Configurations, Values
from robotdiffuse.learning.diffusion import NoiseLevels, NoiseSchedule, reverse_process
from robotdiffuse.learning.guidance import Trajectories
from robotdiffuse.learning.motion_model import MotionModel
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.learned import ExportedPlanner, LearnedSettings, nearest_goals
from robotdiffuse.planning.start_goal import StartGoal

SAMPLE_RESOLUTION = 0.02
"""No point of the arm moves further than this between two checks of a sample [m]."""
Guide = Callable[[ndarray, int], ndarray]
"""Maps the mean of a denoising step [count, waypoints, dof] [rad], and the number of steps to come (0 at the
last one and in the steps without noise after it), to the mean after gradient steps on the guide's costs."""


@dataclass(frozen=True)
class PriorSettings(LearnedSettings):
    samples: Count = 16
    """Number of trajectories in a batch."""
    sampling_steps: Annotated[int, Bound(least=2.0)] = 25
    """Number of denoising steps."""
    self_margin: NotNegative = 0.01
    """Links whose distance from each other is below this have a cost [m]."""
    push: Positive = 0.1
    """Longest move of a waypoint in one gradient step [rad]."""


GuidedPriorSettings = TypeVar("GuidedPriorSettings", bound=PriorSettings)


class GuidedPrior(ExportedPlanner[GuidedPriorSettings]):
    """A planner that samples batches from the prior under guidance.

    The free samples of a batch are validated, the shortest first. If none passes, the next batch is drawn
    from new noise, until time runs out. Nothing is searched, shortened or repaired.
    """

    network_name = "trajectory_prior"
    noise_scale: ClassVar[float] = 1.0
    """Factor on the standard deviation of the noise of a denoising step."""
    quiet_steps: ClassVar[int] = 0
    """Number of final steps without noise."""

    @staticmethod
    @abstractmethod
    def levels(schedule: NoiseSchedule, steps: int) -> NoiseLevels:
        """The noise levels of the denoising steps, falling."""

    @abstractmethod
    def guided(self, checker: CollisionChecker, q: Trajectories, left: int) -> Trajectories:
        """The means of a denoising step after the gradient steps of its guides; see `Guide`."""

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        prior = self.network(context.problem.robot)
        samples = self.settings.samples
        start, goals = shared_out(*start_goal.rows(), samples)
        space = search_space(start_goal.checker, SAMPLE_RESOLUTION)
        closest: tuple[int, float, ndarray] | None = None
        """The best sample so far that collides: its segments in collision, length [rad] and waypoints."""
        batches = 0
        while context.remaining > 0:
            trajectories = sample(
                prior,
                start,
                goals,
                self.levels(prior.schedule, self.settings.sampling_steps),
                context.rng,
                partial(self.guided, start_goal.checker),
                self.noise_scale,
                self.quiet_steps,
                lambda: context.remaining <= 0,
            )
            if trajectories is None:
                break
            batches += 1
            attempts = [
                (int((~motions_free(space, path)).sum()), float(path_length(path)), path)
                for path in np.ascontiguousarray(trajectories, np.float32)
            ]
            for attempt in sorted(attempts, key=lambda attempt: attempt[:2]):
                if attempt[0]:
                    if closest is None or attempt[:2] < closest[:2]:
                        closest = attempt
                    break
                result = context.finish(start_goal.complete(attempt[2]), self.name)
                if result is not None:
                    return result
        # so that the result says what is wrong with it; by the exact meshes it may even be free
        result = None if closest is None else context.finish(start_goal.complete(closest[2]), self.name)
        return result or context.unsolved(
            f"none of {batches * samples} samples of the network is free of collision"
            if batches
            else f"time ran out before the first {samples} samples were complete; use a longer time limit"
        )


class _StoppedError(Exception):
    """Time ran out while trajectories were sampled."""


def sample(
    prior: MotionModel,
    starts: Configurations,
    goals: Configurations,
    levels: NoiseLevels,
    rng: np.random.Generator,
    guide: Guide,
    noise_scale: float = 1.0,
    quiet_steps: int = 0,
    stop: Callable[[], bool] = lambda: False,
) -> Trajectories | None:
    """A trajectory from each start to its goal, float32, within the limits but for the ends themselves.

    levels, noise_scale: see `reverse_process`.
    quiet_steps: additional steps at the last level, without noise (MPD: 5).
    stop: called before every step; None is returned if it returns True.
    """
    reference = prior.reference(starts, goals)
    condition = prior.condition(np.zeros((len(starts), 0), np.float32), starts, goals)
    predicted = prior.predictor(reference, condition, lambda _: np.zeros(0))

    def predict(x: ndarray, level: int) -> ndarray:
        if stop():
            raise _StoppedError
        return predicted(x, level)

    def move(x: ndarray, left: int) -> ndarray:
        mean = prior.joints(prior.hold_ends(x, reference), reference)
        return prior.normalize(guide(mean, left), reference)

    try:
        x = reverse_process(
            predict, prior.schedule, lambda: prior.draw_noise(len(starts), rng), levels, move, noise_scale
        )
        for _ in range(quiet_steps):
            x = move(predict(x, int(levels[-1])), 0)
    except _StoppedError:
        return None
    q = prior.joints(prior.clipped(x), reference)
    q[:, 0] = starts
    q[:, -1] = goals
    return q


def falling(rising: NoiseLevels, most: int) -> NoiseLevels:
    """Rising levels in reverse order, with equal ones moved apart, up to `most`."""
    at = np.arange(len(rising))
    spaced = np.maximum.accumulate(rising - at) + at
    return np.minimum(spaced, most - at[::-1])[::-1].copy()


def shared_out(
    start: Configuration, goals: Configurations, samples: int
) -> tuple[Configurations, Configurations]:
    """The start and the goal of each sample: the nearest goals in turn."""
    nearest = nearest_goals(start, goals, samples)
    return np.repeat(start[None], samples, 0), nearest[np.arange(samples) % len(nearest)]


def collision_gradient(
    checker: CollisionChecker,
    q: Trajectories,
    margin: float,
    self_margin: float,
    between: int,
) -> tuple[Values, Trajectories]:
    """Collision cost of trajectories [m] and its gradient by their waypoints [m/rad], of the ends too.

    The cost of a configuration is the root of the sum of h² over the covering spheres and pairs of links,
    with the hinges h of their signed distances (see `learning.guidance`): how far the arm is within the
    margins. The cost of a trajectory is the sum over the waypoints, and over `between` places in each
    segment, which together count as one more waypoint.
    """
    count, waypoints, dof = q.shape
    shares = np.arange(1, between + 1, dtype=np.float32) / (between + 1)
    step = np.diff(q, axis=1)[:, :, None]
    between_waypoints = q[:, :-1, None] + shares[:, None] * step
    every = np.concatenate([q.reshape(-1, dof), between_waypoints.reshape(-1, dof)])
    squares, gradients = checker.cost_gradients(every, margin, self_margin)
    depth = np.sqrt(2 * squares)
    gradients = gradients / np.maximum(depth, np.float32(1e-6))[:, None]
    at_waypoints = count * waypoints
    costs = depth[:at_waypoints].reshape(q.shape[:2]).sum(1)
    by_frame = gradients[:at_waypoints].reshape(q.shape)
    if between:
        weight = np.float32(1 / between)
        costs = costs + weight * depth[at_waypoints:].reshape(count, -1).sum(1)
        by_place = weight * gradients[at_waypoints:].reshape(between_waypoints.shape)
        by_frame[:, :-1] += ((1 - shares)[:, None] * by_place).sum(2)
        by_frame[:, 1:] += (shares[:, None] * by_place).sum(2)
    return costs, by_frame


def limited(moves: Trajectories, most: float) -> Trajectories:
    """Moves of waypoints, none longer than `most` [rad, joint-space L2]."""
    lengths = np.linalg.norm(moves, axis=2, keepdims=True)
    return moves * np.minimum(1.0, most / np.maximum(lengths, 1e-9)).astype(moves.dtype)


GUIDE_STEPS = 5
"""Number of gradient steps at each guided denoising step."""
LIMIT_MARGIN = 0.02
"""Joints nearer to their limits than this are moved away from them [rad]."""
COLLISION_WEIGHT = 0.1
"""Weight of the collision cost [rad²/m]: a waypoint that is too close moves by about this times 0.5
m/rad."""
PRIOR_WEIGHT = 2.0
"""Weight of the Gaussian process cost, with waypoints one unit of time apart and a power spectrum of 1
rad²."""
EXPONENTIAL_BETAS = (1e-4, 1.0)
"""Variances that the first and the last step of MPD's exponential schedule add."""


@dataclass(frozen=True)
class MPDSettings(PriorSettings, name="mpd"):
    """Settings of MPD. The noise levels are spaced as in MPD's exponential schedule."""

    guided_share: Share = 0.25
    """Fraction of the denoising steps that are guided: the last ones. The quiet steps are always guided."""
    margin: NotNegative = 0.04
    """Spheres whose distance to obstacles is below this have a collision cost [m]."""
    between: Natural = 1
    """Number of places between two waypoints at which the collision cost is evaluated."""


def exponential_levels(schedule: NoiseSchedule, steps: int) -> NoiseLevels:
    """The levels nearest to those of MPD's exponential schedule in log signal-to-noise ratio, falling from T.

    Its betas grow by a constant factor; levels that would fall together are moved apart. Raises InputError
    unless there are that many levels.
    """
    schedule.sampling_levels(steps)
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

    def guided(self, checker: CollisionChecker, q: Trajectories, left: int = 0) -> Trajectories:
        """Trajectories after the gradient steps of one denoising step; their ends stay fixed."""
        settings = self.settings
        if left >= ceil(settings.guided_share * settings.sampling_steps):
            return q
        robot = checker.robot
        for _ in range(GUIDE_STEPS):
            _, gradient = collision_gradient(
                checker, q, settings.margin, settings.self_margin, settings.between
            )
            near = np.minimum(LIMIT_MARGIN, (robot.upper - robot.lower) / 2)
            inside = np.clip(q, robot.lower + near, robot.upper - near)
            moves = limited(-COLLISION_WEIGHT * gradient, settings.push) + (inside - q)
            moves[:, [0, -1]] = 0.0
            q = implicit_step((q + moves).astype(np.float32), PRIOR_WEIGHT)
        return q


def state_precision(waypoints: int) -> Float[ndarray, "states states"]:
    """The precision of the states of one joint, (position, velocity) of each waypoint in turn, under the
    prior of constant velocity over trajectories (M. Mukadam et al., IJRR 2018, section 3).

    The states follow white noise on acceleration: between waypoints one unit of time apart,

        state' = F state + noise,  F = [[1, 1], [0, 1]],  covariance Q = [[1/3, 1/2], [1/2, 1]],

    for every joint alike, so the precision is block tri-diagonal.
    """
    transition = np.array([[1.0, 1.0], [0.0, 1.0]])
    inverse = np.linalg.inv(np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]))
    precision = np.zeros((2 * waypoints, 2 * waypoints))
    error = np.hstack([-transition, np.eye(2)])
    for i in range(waypoints - 1):
        precision[2 * i : 2 * i + 4, 2 * i : 2 * i + 4] += error.T @ inverse @ error
    return precision


def position_precision(waypoints: int) -> Float[ndarray, "waypoints waypoints"]:
    """P, the precision of the positions of one joint, with the velocities integrated out: a Schur complement.

    The cost q P q / 2 is the least integral of squared accelerations through the waypoints over 2, so that of
    natural cubic splines; straight lines cost nothing.
    """
    every = state_precision(waypoints)
    position = slice(0, None, 2)
    velocity = slice(1, None, 2)
    mixed = every[position, velocity]
    return every[position, position] - mixed @ np.linalg.solve(every[velocity, velocity], mixed.T)


def implicit_step(q: Trajectories, weight: float) -> Trajectories:
    """One implicit gradient step down weight q P q / 2 on all waypoints but the ends.

    It solves x = q - weight P x, the minimum of |x - q|² / 2 + weight x P x / 2 with fixed ends.
    """
    interior_map, end_map = _implicit(q.shape[1], weight)
    moved = q.copy()
    moved[:, 1:-1] = interior_map.astype(q.dtype) @ q[:, 1:-1] + end_map.astype(q.dtype) @ q[:, [0, -1]]
    return moved


@cache
def _implicit(waypoints: int, weight: float) -> tuple[ndarray, ndarray]:
    """The matrices that `implicit_step` multiplies the inner waypoints and the ends with."""
    precision = position_precision(waypoints)
    inverse = np.linalg.inv(np.eye(waypoints - 2) + weight * precision[1:-1, 1:-1])
    return inverse, -weight * inverse @ precision[1:-1][:, [0, -1]]


@dataclass(frozen=True)
class GuideSettings(Settings, name="edmp.guides"):
    """One guide of the ensemble."""

    between: Natural
    """Number of places between two waypoints at which the cost is evaluated: 0 for the intersection cost,
    more for the swept-volume cost."""
    far_margin: NotNegative
    """Margin by which obstacles are expanded at the first guided step [m]."""
    near_margin: NotNegative
    """Margin at the last guided step [m]; the margin falls linearly from `far_margin` to this."""
    weight: NotNegative
    """Weight of the cost [rad²/m]: a waypoint that is too close moves by about this times 0.5 m/rad."""
    guided_share: Share
    """Fraction of the denoising steps that are guided: the last ones."""

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
    """Number of trajectories in a batch, divided evenly among the guides."""
    sampling_steps: Annotated[int, Bound(least=2.0)] = 30
    """Number of denoising steps; the noise levels are closer together where there is little noise."""
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


def quadratic_levels(schedule: NoiseSchedule, steps: int) -> NoiseLevels:
    """`steps` of the levels, falling from T, closer together where there is little noise (Song et al. 2021,
    D.2).

    Evenly spaced levels would end at a high noise level, and leave the network's error there in the samples.
    Raises InputError unless there are that many levels.
    """
    schedule.sampling_levels(steps)
    targets = schedule.steps * (np.arange(1, steps + 1) / steps) ** 2
    return falling(np.maximum(targets.round().astype(np.int64), 1), schedule.steps)


class EDMP(GuidedPrior[EDMPSettings]):
    """The prior's samples under an ensemble of guides; see the head of this file."""

    name = "edmp"
    settings_class = EDMPSettings

    levels = staticmethod(quadratic_levels)

    def guided(self, checker: CollisionChecker, q: Trajectories, left: int) -> Trajectories:
        """The batch after a gradient step of every guide on its rows; the ends of trajectories stay fixed."""
        settings = self.settings
        moved = q.copy()
        for share, guide in zip(settings.shares(), settings.guides, strict=True):
            margin = guide.margin(left, settings.sampling_steps)
            if margin is None:
                continue
            _, gradient = collision_gradient(checker, q[share], margin, settings.self_margin, guide.between)
            moves = limited(-guide.weight * gradient, settings.push)
            moved[share, 1:-1] += moves[:, 1:-1]
        return moved
