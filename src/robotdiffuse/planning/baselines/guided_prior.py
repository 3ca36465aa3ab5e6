"""The base of MPD and EDMP: batches of guided samples of a trajectory prior, until one passes validation.

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
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import Space, motions_free, path_length
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Count, NotNegative, Positive
from robotdiffuse.learning.diffusion import reverse_process
from robotdiffuse.learning.motion_model import MotionModel
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.learned import LearnedPlanner, LearnedSettings, nearest_goals
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.robots.robot import Robot

SAMPLE_RESOLUTION = 0.02
"""No point of the arm moves further than this between two checks of a sample [m]."""
Guide = Callable[[ndarray, int], ndarray]
"""Maps the mean of a denoising step [count, waypoints, dof] [rad], and the number of steps to come (0 at the
last one and in the steps without noise after it), to the mean after gradient steps on the guide's costs."""


class Attempt(NamedTuple):
    """A sample that collides."""

    segments: int
    """Number of segments in collision."""
    length: float
    """[rad]"""
    path: Float[ndarray, "waypoints dof"]


@dataclass(frozen=True)
class PriorSettings(LearnedSettings):
    samples: Count = 16
    """Trajectories per batch."""
    sampling_steps: Annotated[int, Bound(least=2.0)] = 25
    """Denoising steps."""
    self_margin: NotNegative = 0.01
    """Links nearer to each other than this have a cost [m]."""
    push: Positive = 0.1
    """Longest move of a waypoint in one gradient step [rad]."""


GuidedPriorSettings = TypeVar("GuidedPriorSettings", bound=PriorSettings)


class GuidedPrior(LearnedPlanner[GuidedPriorSettings]):
    """A planner that samples batches from the prior under guidance.

    The free samples of a batch are validated, the shortest first. If none passes, the next batch is drawn
    from new noise, until time runs out. Nothing is searched, shortened or repaired.
    """

    network_name = "trajectory_prior"

    def network(self, robot: Robot) -> MotionModel:
        """See `LearnedPlanner`."""
        from robotdiffuse.learning.exported_model import exported_model  # imports ONNX Runtime

        return exported_model(self.network_name, self.settings.weights, robot)

    @abstractmethod
    def draw(
        self,
        prior: MotionModel,
        checker: CollisionChecker,
        starts: Float[ndarray, "count dof"],
        goals: Float[ndarray, "count dof"],
        rng: np.random.Generator,
        stop: Callable[[], bool] = lambda: False,
    ) -> Float[ndarray, "count waypoints dof"] | None:
        """A batch of guided samples, float32; None if `stop` returns True before they are complete."""

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        prior, samples = self.network(context.problem.robot), self.settings.samples
        start, goals = shared_out(*start_goal.rows(), samples)
        space = search_space(start_goal.checker, SAMPLE_RESOLUTION)
        closest: Attempt | None = None
        batches = 0
        while context.remaining > 0:
            drawn = self.draw(
                prior, start_goal.checker, start, goals, context.rng, lambda: context.remaining <= 0
            )
            if drawn is None:
                break
            batches += 1
            attempts = [_attempt(space, path) for path in np.ascontiguousarray(drawn, np.float32)]
            for attempt in sorted(attempts, key=lambda attempt: attempt[:2]):
                if attempt.segments:
                    if closest is None or attempt[:2] < closest[:2]:
                        closest = attempt
                    break
                result = context.finish(start_goal.complete(attempt.path), self.name)
                if result is not None:
                    return result
        if closest is not None:
            # so that the result says what is wrong with it; by the exact meshes it may even be free
            result = context.finish(start_goal.complete(closest.path), self.name)
            if result is not None:
                return result
        return context.unsolved(
            f"none of {batches * samples} samples of the network is free of collision"
            if batches
            else f"time ran out before the first {samples} samples were complete; use a longer time limit"
        )


class _StoppedError(Exception):
    """Time ran out while trajectories were sampled."""


def sample(
    prior: MotionModel,
    starts: Float[ndarray, "count dof"],
    goals: Float[ndarray, "count dof"],
    levels: Int[ndarray, "steps"],
    rng: np.random.Generator,
    guide: Guide,
    noise_scale: float = 1.0,
    quiet_steps: int = 0,
    stop: Callable[[], bool] = lambda: False,
) -> Float[ndarray, "count waypoints dof"] | None:
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
    q[:, 0], q[:, -1] = starts, goals
    return q


def falling(rising: Int[ndarray, "steps"], most: int) -> Int[ndarray, "steps"]:
    """Rising levels in reverse order, with equal ones moved apart, up to `most`."""
    at = np.arange(len(rising))
    apart = np.maximum.accumulate(rising - at) + at
    return np.minimum(apart, most - at[::-1])[::-1].copy()


def _attempt(space: Space, path: Float[ndarray, "waypoints dof"]) -> Attempt:
    return Attempt(int((~motions_free(space, path)).sum()), float(path_length(path)), path)


def shared_out(
    start: Float[ndarray, "dof"], goals: Float[ndarray, "k dof"], samples: int
) -> tuple[Float[ndarray, "samples dof"], Float[ndarray, "samples dof"]]:
    """The start and the goal of each sample: the nearest goals in turn."""
    nearest = nearest_goals(start, goals, samples)
    return np.repeat(start[None], samples, 0), nearest[np.arange(samples) % len(nearest)]


def collision_gradient(
    checker: CollisionChecker,
    q: Float[ndarray, "count waypoints dof"],
    margin: float,
    self_margin: float,
    between: int,
) -> tuple[Float[ndarray, "count"], Float[ndarray, "count waypoints dof"]]:
    """Collision cost of trajectories [m] and its gradient by their waypoints [m/rad], of the ends too.

    The cost of a configuration is the root of the sum of h² over the covering spheres and pairs of links,
    with the hinges h of their signed distances (see `learning.guidance`): how far the arm is within the
    margins. The cost of a trajectory is the sum over the waypoints, and over `between` places in each
    segment, which together count as one more waypoint.
    """
    count, waypoints, dof = q.shape
    shares = np.arange(1, between + 1, dtype=np.float32) / (between + 1)
    step = np.diff(q, axis=1)[:, :, None]
    inner = q[:, :-1, None] + shares[:, None] * step
    every = np.concatenate([q.reshape(-1, dof), inner.reshape(-1, dof)])
    squares, gradients = checker.cost_gradients(every, margin, self_margin)
    depth = np.sqrt(2 * squares)
    gradients = gradients / np.maximum(depth, np.float32(1e-6))[:, None]
    at_waypoints = count * waypoints
    costs, by_frame = (
        depth[:at_waypoints].reshape(q.shape[:2]).sum(1),
        gradients[:at_waypoints].reshape(q.shape),
    )
    if between:
        weight = np.float32(1 / between)
        costs = costs + weight * depth[at_waypoints:].reshape(count, -1).sum(1)
        by_place = weight * gradients[at_waypoints:].reshape(inner.shape)
        by_frame[:, :-1] += ((1 - shares)[:, None] * by_place).sum(2)
        by_frame[:, 1:] += (shares[:, None] * by_place).sum(2)
    return costs, by_frame


def limited(
    moves: Float[ndarray, "count waypoints dof"], most: float
) -> Float[ndarray, "count waypoints dof"]:
    """Moves of waypoints, none longer than `most` [rad, joint-space L2]."""
    lengths = np.linalg.norm(moves, axis=2, keepdims=True)
    return moves * np.minimum(1.0, most / np.maximum(lengths, 1e-9)).astype(moves.dtype)
