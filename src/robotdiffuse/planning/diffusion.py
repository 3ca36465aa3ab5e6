"""Planner `diffusion`: samples motions from the diffusion model under collision guidance, without a search.

An encoder embeds the scene's point cloud. Given this embedding, the diffusion model samples paths from start
to goal under collision guidance. The validator checks every sample, and the shortest valid path is returned.
If no sample is valid, the next batch is drawn from new noise, until time runs out. Paths are not simplified
and the straight line is not tried, so every solution comes from the network and its guidance.

The paper's method is samples=1, repeat=false and weights of config `paper`, which do not take clearances as
inputs. With guidance_steps=0 too, it is row JPC of the paper's Table 2: trained with losses on joints,
points and collision, and sampled without guidance.

Path constraints add a cost to guidance. Before validation, the inner waypoints of each sample are projected
onto the constraints; the validator proves that the constraints hold between waypoints as well. The network
was trained without constraints.

The sampler and the number of its steps are stored with the weights; settings may replace them.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.settings import Count, Natural, NotNegative
from robotdiffuse.core.types import Configuration, Configurations, Path, PlanResult
from robotdiffuse.learning.guidance import CollisionGuidance, GuidanceSettings, Trajectories
from robotdiffuse.learning.motion_model import ClearanceFn, MotionModel, SamplingSettings, link_clearances
from robotdiffuse.planning import PATH_CONSTRAINTS
from robotdiffuse.planning.context import TOLERANCE_FRACTION, PlanningContext
from robotdiffuse.planning.learned import ExportedPlanner, LearnedSettings, nearest_goals
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.problems.compiled_constraints import PathConstraints
from robotdiffuse.scenes.surface_points import sample_surface


@dataclass(frozen=True)
class DiffusionSettings(SamplingSettings, LearnedSettings, name="diffusion"):
    guidance_steps: Natural = 8
    """Number of guidance steps at each guided denoising step; 0: no guidance."""
    points: Count = 320
    """Number of points in the encoder's input cloud (paper: 1,400); ignored by encoders for clouds of a fixed
    size."""
    guidance: GuidanceSettings = field(default_factory=GuidanceSettings)
    optimize_time: NotNegative = 0.0
    """Time for further batches after the first batch with a valid sample [s]; the shortest valid path of all
    batches is returned."""
    repeat: bool = True
    """Whether more batches are drawn if the validator accepts no sample of the first batch (the paper:
    no)."""


def encode(
    model: MotionModel, checker: CollisionChecker, points: int, rng: np.random.Generator
) -> Float[ndarray, "embedding"]:
    """The embedding z of a scene: the output of the frozen encoder for `points` random points on the scene's
    surfaces. An encoder for clouds of a fixed size gets that number of points."""
    encoder_settings = model.settings.encoder_settings
    assert encoder_settings is not None  # only unconditional priors have no encoder
    count = points if encoder_settings.any_size else encoder_settings.cloud
    return model.encode(sample_surface(checker.scene, count, rng, encoder_settings.region), rng)


def _projected(constraints: PathConstraints, path: Configurations) -> Configurations:
    """The path with its inner waypoints projected onto the constraints. If a projection fails, the path is
    returned unchanged, and the validator refuses it."""
    between = constraints.projected(path[1:-1], TOLERANCE_FRACTION)
    return np.concatenate([path[:1], between, path[-1:]]) if len(between) == len(path) - 2 else path


class Diffusion(ExportedPlanner[DiffusionSettings]):
    """The diffusion model and its guidance as a planner; see the docstring of the module."""

    name = "diffusion"
    network_name = "model"
    settings_class = DiffusionSettings
    supports = frozenset({PATH_CONSTRAINTS})

    def draw(
        self,
        model: MotionModel,
        checker: CollisionChecker,
        embedding: Float[ndarray, "embedding"],
        start: Configuration,
        goals: Configurations,
        rng: np.random.Generator,
        clearances: ClearanceFn | None = None,
        constraints: PathConstraints | None = None,
    ) -> Trajectories:
        """A batch of samples under guidance, divided among the nearest goals.

        embedding: the scene embedding from `encode`.
        clearances: the function that computes the model's clearance inputs; None: from the checker's scene.
        constraints: path constraints, which add a cost to guidance.
        """
        settings = self.settings
        guidance = CollisionGuidance(checker, settings.guidance, constraints, TOLERANCE_FRACTION)
        goals = nearest_goals(start, goals, settings.samples)
        counts = [len(part) for part in np.array_split(np.arange(settings.samples), len(goals))]
        clearances = clearances or link_clearances(checker, model.settings)

        def guide(q: ndarray, _level: float) -> ndarray:
            return guidance(q, settings.guidance_steps)

        parts = [
            model.sample(
                start,
                goal,
                embedding,
                clearances,
                rng,
                replace(settings, samples=count),
                guide if settings.guidance_steps else None,
            )
            for goal, count in zip(goals, counts, strict=True)
        ]
        return np.concatenate(parts)

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        model = self.network(context.problem.robot)
        rng = context.rng
        start, goals = start_goal.leads()  # collision-free; `complete` adds the true start and goal
        embedding = encode(model, start_goal.checker, self.settings.points, rng)
        names = context.problem.robot.joint_names
        constraints = context.validator.constraints
        samples = list[Path]()
        valid = list[Path]()
        until = context.request.time_limit
        while not samples or (context.elapsed < until and (valid or self.settings.repeat)):
            began = context.elapsed
            batch = self.draw(
                model, start_goal.checker, embedding, start, goals, rng, constraints=constraints
            )
            if constraints is not None:
                batch = [_projected(constraints, q) for q in batch]
            paths = [Path(names, start_goal.complete(q)) for q in batch]
            passed = [path for path in paths if context.validator.path(path).valid]
            for path in passed:
                context.improved(path.length)
            if passed and not valid:
                until = context.elapsed + self.settings.optimize_time
            samples = samples + paths
            valid = valid + passed
            if valid:  # a further batch must leave time for timing the best path
                until = min(until, context.search_until - (context.elapsed - began))
        reason = f"{len(valid)} of {len(samples)} samples of the network are valid"
        # If no sample is valid, the last one is validated again, so that the result names its violation.
        for path in sorted(valid or samples[-1:], key=lambda path: path.length):
            solved_reason = f"solved by network: {reason}"
            result = context.finish(path.positions, "network", solved_reason, keeps=context.keeps_constraints)
            if result is not None:
                return result
        return context.unsolved(reason)
