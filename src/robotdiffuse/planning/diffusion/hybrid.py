"""RobotDiffuse, a hybrid: the paper's diffusion model and AORRTC in one anytime loop.

The straight line if it is free. Else a search for a first path, within milliseconds, then ever shorter ones;
and, for a share of the work, batches of trajectories sampled by the diffusion model under collision guidance,
or, where none of them is free, the same after more gradient steps (refinement). The model's inputs are
clearances and, by default, no code of the scene (see the setting `guidance_scale`). What the batches propose
is simplified by the same code as what search finds, and the shortest path of either bounds the next search.
Everything goes through the validator, and the result names the stage that its path comes from.

For an arm without weights the batches are smooth noise after as many such steps (see smooth_noise.py). They
are drawn only once search has a path: before that they solve less than search does in their time, see
benchmarks/results/hard_arms.txt.

Under path constraints it is search alone: with batches for a quarter of 0.3 to 1 s, paths were a thousandth
shorter (the mean of 20 upright cups and of 20 lines; median: the same).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Annotated

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import motions_free, path_length
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Count, Natural
from robotdiffuse.learning.guidance import CollisionGuidance
from robotdiffuse.learning.weights_registry import weights_for
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.diffusion.diffusion import GuidedSamplingSettings, ModelSampler, encode
from robotdiffuse.planning.diffusion.smooth_noise import smooth_noise
from robotdiffuse.planning.learned import nearest_goals
from robotdiffuse.planning.planner import CLEARANCE, CONSTRAINTS
from robotdiffuse.planning.search.anytime import AnytimeSearch, anytime
from robotdiffuse.planning.search.aorrtc import AORRTC, STEP, AORRTCSettings
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.robots.robot import Robot

if TYPE_CHECKING:
    from robotdiffuse.learning.motion_model import MotionModel

BATCH_WORK = 12_000
"""Iterations of search that take about as long as a batch of 16 samples in two steps, or its refinement."""
WAYPOINTS = 48
"""Of smooth noise: as many as the networks have."""
BATCH_SECONDS = 0.1
"""What a batch or its refinement takes, until it is known [s]: the first of a process is slow."""
LONGER = 2.0
"""A batch may take so many times what those before it took: scenes differ."""
LOAD_SECONDS = 3.0
"""A call that has so much time left loads PyTorch and the network, if it would use it [s]."""


@dataclass(frozen=True)
class RobotDiffuseSettings(GuidedSamplingSettings, name="robotdiffuse"):
    sampling_steps: Count | None = 2
    """Calls of the denoiser per batch. With guidance, more bring no more solved problems, see
    benchmarks/results/guidance.txt."""
    guidance_scale: float = 0.0
    """Scale of classifier-free guidance. At 0 the condition is hidden, and the scene's code is not computed:
    with it paths are as long, see benchmarks/results/network_inputs.txt. Weights that cannot do without their
    condition are then sampled with 1."""
    refinement_steps: Natural = 40
    """Most gradient steps on the sampled trajectories that still collide."""
    shortened: Count = 6
    """Most candidates of a batch that are simplified."""
    network_share: Annotated[float, Bound(least=0.0, below=1.0)] = 0.25
    """Share of the work that goes to batches, of the network or of smooth noise; a batch counts as BATCH_WORK
    iterations of search."""
    search: AORRTCSettings = field(default_factory=AORRTCSettings)


class RobotDiffuse(ModelSampler[RobotDiffuseSettings]):
    """AORRTC and the network's batches in one anytime loop; see the head of this file."""

    name = "robotdiffuse"
    settings_class = RobotDiffuseSettings
    keeps = frozenset({CONSTRAINTS, CLEARANCE})

    def __init__(self, settings: RobotDiffuseSettings | None = None) -> None:
        """Raises InputError if the folder that the settings name holds no weights."""
        super().__init__(settings)
        self.wanted: set[FilePath] = set()
        """Weights that a call would have used, had there been time to load them."""
        self.at_hand: set[FilePath] = set()
        """Those that are loaded."""
        self.seconds = {"batch": BATCH_SECONDS, "refinement": BATCH_SECONDS}
        """What they took of late [s]: the last one, or more if those before did."""

    def prepare(self, robot: Robot) -> None:
        """See `planning.planner.Planner`: given weights. Those of the package are loaded in a call's own
        time, if it has LOAD_SECONDS left for that, else by `warm_up` and `load_wanted`."""
        if self.settings.weights is not None:
            self._load(robot)

    def load_wanted(self, robot: Robot) -> None:
        """See `planning.planner.Planner`."""
        super().load_wanted(robot)
        if self.weights(robot) in self.wanted:
            self._load(robot)

    def _load_rarer(self, robot: Robot) -> None:
        super()._load_rarer(robot)
        self._load(robot)

    def weights(self, robot: Robot) -> FilePath | None:
        """The folder of those that are used for a robot; None if there are none."""
        given = self.settings.weights
        return weights_for(self.network_name, robot) if given is None else FilePath(given)

    def _load(self, robot: Robot) -> None:
        weights = self.weights(robot)
        if weights is not None:
            self.model(robot)
            self.at_hand.add(weights)

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        settings, robot = self.settings, context.problem.robot
        if context.problem.constraints:
            from robotdiffuse.planning.search.constrained import plan_constrained

            return plan_constrained(context, start_goal, settings.search)
        search = AnytimeSearch(context, start_goal, settings.search, AORRTC.name)
        weights, help_out = self.weights(robot), None
        if weights is not None:
            batches = _NetworkBatches(self, context, start_goal, search, weights)
            help_out = batches.offer
        else:
            batches = _Batches(self, context, start_goal, search)
            note = f"there are no weights for {robot.name}; planned by search and smooth noise"
            context.notes.append(note)

        def improve() -> None:
            if batches.due:
                batches.offer()
            else:
                search.improve(context.search_until, STEP)

        return anytime(
            context,
            start_goal,
            search,
            lambda: search.pays(settings.search.gain, settings.search.patience),
            improve,
            help_out,
        )

    def code(
        self, model: "MotionModel", checker: CollisionChecker, rng: np.random.Generator
    ) -> Float[ndarray, "code"] | None:
        """z of the scene; None if the network's condition is hidden."""
        hidden = self.guidance_scale(model) == 0.0
        return None if hidden else encode(model, checker, self.settings.points, rng)

    def guidance_scale(self, model: "MotionModel") -> float:
        """The setting; 1 in place of 0 for weights that cannot do without their condition."""
        scale = self.settings.guidance_scale
        return 1.0 if scale == 0.0 and not model.settings.null_condition else scale

    def refine(
        self, checker: CollisionChecker, q: Float[ndarray, "count waypoints dof"]
    ) -> Float[ndarray, "count waypoints dof"]:
        """More gradient steps on trajectories, whether sampled or not; float32."""
        return CollisionGuidance(checker, self.settings.guidance)(q, self.settings.refinement_steps)[0]


class _Batches:
    """Batches of smooth noise in the anytime loop of a call, once it has a path."""

    def __init__(
        self, planner: RobotDiffuse, context: PlanningContext, start_goal: StartGoal, search: AnytimeSearch
    ) -> None:
        self.planner, self.context, self.start_goal, self.search = planner, context, start_goal, search
        self._spent = 0

    @property
    def due(self) -> bool:
        """Whether the batches have had less than their share of the work, and there is time for one."""
        batches, share = self._spent + BATCH_WORK, self.planner.settings.network_share
        return batches <= share * (self.search.work + batches) and self._can()

    def offer(self) -> None:
        """Draw a batch and offer the shortest free ones to the search."""
        if self._can():
            self._draw()

    def _can(self) -> bool:
        """Whether there is time for a batch."""
        return self._time_for("batch")

    def _time_for(self, part: str) -> bool:
        return self.context.remaining > LONGER * self.planner.seconds[part]

    @contextmanager
    def _timed(self, part: str) -> Iterator[None]:
        """A batch or its refinement, which counts as work and whose time the next ones will know."""
        began = self.context.elapsed
        yield
        took, self._spent = self.context.elapsed - began, self._spent + BATCH_WORK
        self.planner.seconds[part] = max(took, 0.5 * (self.planner.seconds[part] + took))

    def _draw(self) -> None:
        planner, checker, count = self.planner, self.start_goal.checker, self.planner.settings.samples
        start, goals = self.start_goal.rows()
        goals = nearest_goals(start, goals, count)
        with self._timed("batch"):
            q = smooth_noise(start, goals, count, WAYPOINTS, checker.robot, self.context.rng)
            q = planner.refine(checker, q)
        self._take(q, "smooth_noise")

    def _take(self, q: Float[ndarray, "count waypoints dof"], stage: str) -> bool:
        """Offer the shortest ones that are free in the space of the search; whether there were any."""
        space, most = self.search.space, self.planner.settings.shortened
        ordered = sorted(np.ascontiguousarray(q, np.float32), key=path_length)
        paths = list(islice((path for path in ordered if motions_free(space, path).all()), most))
        for path in paths:
            if self.context.remaining > 0 or self.search.best is None:
                self.search.offer(path, stage)
        return bool(paths)


class _NetworkBatches(_Batches):
    """Batches of the network in its place, refined where none is free."""

    def __init__(
        self,
        planner: RobotDiffuse,
        context: PlanningContext,
        start_goal: StartGoal,
        search: AnytimeSearch,
        weights: FilePath,
    ) -> None:
        super().__init__(planner, context, start_goal, search)
        self._weights = weights

    def _can(self) -> bool:
        """Whether there is time for a batch, and for loading the network, which takes seconds once."""
        self.planner.wanted.add(self._weights)
        at_hand = self._weights in self.planner.at_hand or self.context.remaining > LOAD_SECONDS
        return at_hand and super()._can()

    @cached_property
    def _model(self) -> "MotionModel":
        model = self.planner.model(self.context.problem.robot)
        assert model is not None  # there are weights, or these were no batches of a network
        return model

    @cached_property
    def _code(self) -> Float[ndarray, "code"] | None:
        return self.planner.code(self._model, self.start_goal.checker, self.context.rng)

    def _draw(self) -> None:
        planner, checker, context = self.planner, self.start_goal.checker, self.context
        model = self._model
        planner.at_hand.add(self._weights)
        start, goals = self.start_goal.rows()
        with self._timed("batch"):
            sampled = planner.draw(model, checker, self._code, start, goals, context.rng)
        if not self._take(sampled, "network") and self._time_for("refinement"):
            with self._timed("refinement"):
                refined = planner.refine(checker, sampled)
            self._take(refined, "refinement")


def unlearned_starts(
    start: Float[ndarray, "dof"],
    goal: Float[ndarray, "dof"],
    count: int,
    waypoints: int,
    robot: Robot,
    rng: np.random.Generator,
) -> Float[ndarray, "count waypoints dof"]:
    """The straight line, and the line with random bumps: the control for what refinement owes to learning."""
    t = np.linspace(0.0, 1.0, waypoints)[:, None]
    q = np.repeat((start + t * (goal - start))[None], count, axis=0)
    for harmonic in (1, 2):
        bumps = np.sin(np.pi * harmonic * t) * rng.normal(0.0, 0.6 / harmonic, (count, 1, len(start)))
        q[1:] += bumps[1:]
    q = np.clip(q, robot.lower, robot.upper)
    q[:, 0], q[:, -1] = start, goal
    return q
