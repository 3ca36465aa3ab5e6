"""RobotDiffuse, the hybrid planner: the paper's diffusion model and AORRTC in one anytime loop.

The straight line is returned if it is free. Otherwise a search finds a first path within milliseconds, then
shorter ones. A part of the work goes to batches of trajectories that the diffusion model samples under
collision guidance; where none of a batch is free, it is refined by more gradient steps. The model's network
inputs are the clearances of the links and, by default, no encoding of the scene (see the setting
`guidance_scale`). Paths of the batches are simplified like those of the search, and the shortest path of
either bounds the next round of search. The validator checks every path, and the result names the stage that
found it.

For an arm without weights the batches are smooth noise, refined by the same steps (`smooth_noise`). They
are drawn only once the search has a path: before that they solve fewer problems in the same time than search
does, see benchmarks/results/hard_arms.txt.

Under path constraints only the search runs: with batches for a quarter of 0.3 to 1 s, paths were a thousandth
shorter (the mean of 20 upright cups and of 20 lines; median: the same).

Smooth noise: the noise of the model that comes with the Panda has the covariance of its training trajectories
about the straight lines between their ends. Its eigenvectors are nearly sines of k half waves, its
eigenvalues fall as k^-3.5, and its standard deviation is an eighth of half the range of a joint. So the noise
has a closed form for any arm. Refined by many guidance steps, it replaces the samples of a network.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import islice
from typing import TYPE_CHECKING, Annotated

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import motions_free, path_length
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Count
from robotdiffuse.core.types import Configuration, Configurations
from robotdiffuse.learning.guidance import CollisionGuidance, Trajectories
from robotdiffuse.planning import CLEARANCE, PATH_CONSTRAINTS
from robotdiffuse.planning.context import PlanningContext, PlanRequest
from robotdiffuse.planning.diffusion import GuidedSamplingSettings, ModelSampler, encode
from robotdiffuse.planning.learned import nearest_goals
from robotdiffuse.planning.search.rrt import (
    AORRTC,
    IMPROVEMENT_STEP,
    AnytimeSearch,
    AORRTCSettings,
    anytime,
    plan_constrained,
)
from robotdiffuse.planning.start_goal import StartGoal, usable_start_goal
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot

if TYPE_CHECKING:
    from robotdiffuse.learning.motion_model import MotionModel

SPREAD = 0.127
"""Standard deviation over the waypoints, as a fraction of half a joint's range: the mean over the Panda's
joints."""
MAX_HALF_RANGE = np.pi
"""Half a joint's range counts as no more than this [rad]: continuous joints have no limits."""
WAVES = 8
"""Number of sines; more would add less than a hundredth."""
VARIANCE_EXPONENT = 3.5
"""The variance of the sine of k half waves falls as k to this power."""


def smooth_noise(
    start: Configuration,
    goals: Configurations,
    count: int,
    waypoints: int,
    robot: Robot,
    rng: np.random.Generator,
) -> Trajectories:
    """Straight lines from the start to the goals in turn, plus smooth noise; float32.

    All waypoints but the ends are clipped to the joint limits.
    """
    t = np.linspace(0.0, 1.0, waypoints)
    waves = np.arange(1, WAVES + 1)
    deviations = waves ** (-VARIANCE_EXPONENT / 2)
    deviations *= SPREAD * np.sqrt(2) / np.linalg.norm(deviations)  # a sine's mean square is a half
    basis = np.sin(np.pi * t[:, None] * waves) * deviations
    half = np.minimum(0.5 * (robot.upper - robot.lower), MAX_HALF_RANGE)
    lines = start + t[:, None] * (goals[np.arange(count) % len(goals), None] - start)
    q = lines + half * (basis @ rng.normal(size=(count, WAVES, len(start))))
    q = np.clip(q, robot.lower, robot.upper).astype(np.float32)
    q[:, 0] = lines[:, 0]
    q[:, -1] = lines[:, -1]
    return q


BATCH_WORK = 12_000
"""Iterations of search that take about as long as a batch of 16 samples in two steps, or as its
refinement."""
WAYPOINTS = 48
"""Waypoints of smooth noise: as many as the networks have."""
BATCH_SECONDS = 0.1
"""Expected time of a batch or its refinement before any was measured [s]: the first of a process is slow."""
BATCH_TIME_FACTOR = 2.0
"""A batch is begun if this many times the expected time is left: scenes differ."""
REFINEMENT_STEPS = 40
"""Gradient steps on batches that still collide."""
MAX_SIMPLIFIED = 6
"""Largest number of free trajectories of a batch that are simplified, the shortest ones."""


@dataclass(frozen=True)
class RobotDiffuseSettings(GuidedSamplingSettings, name="robotdiffuse"):
    sampling_steps: Count | None = 2
    """Calls of the denoiser per batch. With guidance, more calls solve no more problems, see
    benchmarks/results/guidance.txt."""
    guidance_scale: float = 0.0
    """Scale of classifier-free guidance. At 0 the condition is hidden, and the scene embedding is not
    computed: with it paths are as long, see benchmarks/results/network_inputs.txt. Weights that cannot do
    without their condition are then sampled with 1."""
    network_share: Annotated[float, Bound(least=0.0, below=1.0)] = 0.25
    """Part of the work that goes to batches, of the network or of smooth noise; a batch counts as BATCH_WORK
    iterations of search."""
    search: AORRTCSettings = field(default_factory=AORRTCSettings)


class RobotDiffuse(ModelSampler[RobotDiffuseSettings]):
    """AORRTC and the network's batches in one anytime loop; see the head of this file."""

    name = "robotdiffuse"
    settings_class = RobotDiffuseSettings
    supports = frozenset({PATH_CONSTRAINTS, CLEARANCE})
    follows_lines = True

    def prepare(self, robot: Robot) -> None:
        """Load the weights for the robot, if there are any."""
        self.model(robot)

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        settings = self.settings
        robot = context.problem.robot
        if context.problem.constraints:
            return plan_constrained(context, start_goal, settings.search)
        search = AnytimeSearch.of(context, start_goal, settings.search, AORRTC.name)
        model = self.model(robot)
        batches = _Batches(self, context, start_goal, search, model)

        def improve() -> None:
            if batches.due:
                batches.offer()
            else:
                search.improve(IMPROVEMENT_STEP)

        result = anytime(
            context,
            search,
            lambda: search.improves(settings.search.gain, settings.search.patience),
            improve,
            None if model is None else batches.offer,
        )
        if model is not None or result.stage == "straight_line":
            return result
        methods = "search and smooth noise" if batches.drawn else "search alone"
        note = f"there are no weights for {robot.name}; planned by {methods}"
        return replace(result, notes=(*result.notes, note))

    def code(
        self, model: "MotionModel", checker: CollisionChecker, rng: np.random.Generator
    ) -> Float[ndarray, "code"] | None:
        """The encoding z of the scene; None if the network's condition is hidden."""
        hidden = self.guidance_scale(model) == 0.0
        return None if hidden else encode(model, checker, self.settings.points, rng)

    def guidance_scale(self, model: "MotionModel") -> float:
        """The setting; 1 in place of 0 for weights that need their condition."""
        scale = self.settings.guidance_scale
        return 1.0 if scale == 0.0 and not model.settings.null_condition else scale

    def refine(self, checker: CollisionChecker, q: Trajectories) -> Trajectories:
        """Trajectories after REFINEMENT_STEPS gradient steps on the guidance costs; float32."""
        return CollisionGuidance(checker, self.settings.guidance)(q, REFINEMENT_STEPS)[0]

    def noise(
        self, checker: CollisionChecker, start: Configuration, goals: Configurations, rng: np.random.Generator
    ) -> Trajectories:
        """Smooth noise about the lines to the nearest goals, refined."""
        count = self.settings.samples
        goals = nearest_goals(start, goals, count)
        return self.refine(checker, smooth_noise(start, goals, count, WAYPOINTS, checker.robot, rng))


class _Batches:
    """Batches in the anytime loop of a call: of the network, refined where none is free; or, without one, of
    smooth noise, drawn once the search has a path."""

    def __init__(
        self,
        planner: RobotDiffuse,
        context: PlanningContext,
        start_goal: StartGoal,
        search: AnytimeSearch,
        model: "MotionModel | None",
    ) -> None:
        self.planner = planner
        self.context = context
        self.start_goal = start_goal
        self.search = search
        self.model = model
        self._spent = 0
        self._seconds = {"batch": BATCH_SECONDS, "refinement": BATCH_SECONDS}
        """Expected times [s]: that of the last one, or more if those before it took longer."""

    @property
    def due(self) -> bool:
        """Whether the batches had less than their part of the work, and there is time for another one."""
        batches = self._spent + BATCH_WORK
        share = self.planner.settings.network_share
        return batches <= share * (self.search.work + batches) and self._time_for("batch")

    @property
    def drawn(self) -> bool:
        """Whether there was a batch."""
        return self._spent > 0

    @cached_property
    def _code(self) -> Float[ndarray, "code"] | None:
        assert self.model is not None
        return self.planner.code(self.model, self.start_goal.checker, self.context.rng)

    def offer(self) -> None:
        """Draw a batch and offer its shortest free trajectories to the search, if there is time."""
        if not self._time_for("batch"):
            return
        planner = self.planner
        model = self.model
        checker = self.start_goal.checker
        ends = self.start_goal.rows()
        rng = self.context.rng
        with self._timed("batch"):
            if model is None:
                q = planner.noise(checker, *ends, rng)
            else:
                q = planner.draw(model, checker, self._code, *ends, rng)
        accepted = self._take(q, "smooth_noise" if model is None else "network")
        if model is not None and not accepted and self._time_for("refinement"):
            with self._timed("refinement"):
                q = planner.refine(checker, q)
            self._take(q, "refinement")

    def _time_for(self, part: str) -> bool:
        return self.context.remaining > BATCH_TIME_FACTOR * self._seconds[part]

    @contextmanager
    def _timed(self, part: str) -> Iterator[None]:
        """Count a batch or its refinement as work, and update its expected time."""
        began = self.context.elapsed
        yield
        took = self.context.elapsed - began
        self._spent = self._spent + BATCH_WORK
        self._seconds[part] = max(took, 0.5 * (self._seconds[part] + took))

    def _take(self, q: Trajectories, stage: str) -> bool:
        """Offer the shortest free trajectories to the search; returns whether there were any."""
        space = self.search.space
        ordered = sorted(np.ascontiguousarray(q, np.float32), key=path_length)
        paths = list(islice((path for path in ordered if motions_free(space, path).all()), MAX_SIMPLIFIED))
        for path in paths:
            if self.context.remaining > 0 or self.search.best is None:
                self.search.offer(path, stage)
        return bool(paths)


TIME_LIMIT = 1.0
"""For finding configurations of the goal [s]."""
PLACES_PER_SEGMENT = 4
"""Places at which clearances are measured, from one waypoint to the next."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """A batch of trajectories and their clearances."""

    source: str
    """"network", or "smooth_noise" for an arm without weights."""
    positions: Trajectories
    clearances: Float[ndarray, "count"]
    """Smallest signed distance of the covering spheres to the obstacles along each trajectory, sampled [m],
    at most 1 m; negative where spheres touch, though the meshes within may not."""


def draw_candidates(problem: Problem, seed: int = 0) -> Candidates:
    """Draw a batch as the planner `robotdiffuse` does.

    Raises InputError if the start or the goal cannot be used.
    """
    planner = _planner()
    model = planner.model(problem.robot)
    context = PlanningContext(planner.name, problem, PlanRequest(TIME_LIMIT, seed))
    start_goal = usable_start_goal(context)
    if isinstance(start_goal, PlanResult):
        raise InputError(f"nothing can be drawn: {start_goal.reason}")
    checker = start_goal.checker
    if model is None:
        q = planner.noise(checker, *start_goal.rows(), context.rng)
    else:
        code = planner.code(model, checker, context.rng)
        q = planner.draw(model, checker, code, *start_goal.rows(), context.rng)
    count, waypoints, dof = q.shape
    at = np.linspace(0, waypoints - 1, PLACES_PER_SEGMENT * (waypoints - 1) + 1)
    low = np.minimum(at.astype(int), waypoints - 2)
    share = (at - low)[:, None]
    dense = (1 - share) * q[:, low] + share * q[:, low + 1]
    distances = checker.link_clearances(dense.reshape(-1, dof)).reshape(count, -1)
    source = "smooth_noise" if model is None else "network"
    return Candidates(
        source, np.asarray(q, np.float64), distances.min(axis=1, initial=1.0).astype(np.float64)
    )


@cache
def _planner() -> RobotDiffuse:
    return RobotDiffuse()
