"""The diffusion model alone: encoder, sampling, guidance, without search.

The scene's point cloud is encoded; trajectories from start to goal are sampled by the diffusion model, under
collision guidance; every sample goes to the validator, and the shortest valid one is returned. If none is
valid, the next batch is drawn from new noise, until time runs out. There is no straight line, no search, no
refinement, and nothing is shortened: what this planner solves, the network and its guidance solve. With the
settings samples=1, repeat=false and weights of config `paper`, which do not take clearances as inputs, it
does only what the paper says; with guidance_steps=0 too, it is the row JPC of the paper's Table 2, which has
no guidance.

Path constraints are one more cost of guidance. Before validation, the inner waypoints of each sample are
projected onto the constraints; the validator proves that the constraints hold between the waypoints too. The
network was trained without constraints.

The sampler and the number of its steps are those stored with the weights, unless the settings give others.
With guidance_steps=0 the network runs without guidance.
"""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Count, Natural, NotNegative
from robotdiffuse.core.types import Configuration, Configurations, Path
from robotdiffuse.learning.guidance import CollisionGuidance, GuidanceSettings, Trajectories
from robotdiffuse.learning.motion_model import SamplingSettings
from robotdiffuse.planning import PATH_CONSTRAINTS
from robotdiffuse.planning.context import TOLERANCE_FRACTION, PlanningContext
from robotdiffuse.planning.learned import ExportedPlanner, LearnedSettings, nearest_goals
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.problems.compiled_constraints import PathConstraints
from robotdiffuse.scenes.surface_points import sample_surface

if TYPE_CHECKING:
    from robotdiffuse.learning.motion_model import ClearanceFn, MotionModel


@dataclass(frozen=True)
class DiffusionSettings(SamplingSettings, LearnedSettings, name="diffusion"):
    guidance_steps: Natural = 8
    """Number of gradient steps at each guided denoising step."""
    points: Count = 320
    """Number of points in the encoder's input cloud (paper: 1,400); ignored if the encoder needs a fixed
    number."""
    guidance: GuidanceSettings = field(default_factory=GuidanceSettings)
    optimize_time: NotNegative = 0.0
    """Time for more batches after the first one with a valid sample [s]; the shortest of all is returned."""
    repeat: bool = True
    """Whether more batches are drawn if the validator accepts no sample of the first one (the paper: no)."""


def encode(
    model: "MotionModel", checker: CollisionChecker, points: int, rng: np.random.Generator
) -> Float[ndarray, "code"]:
    """The embedding z of a scene: a cloud of `points` points on its surfaces, or as many as the encoder
    needs, encoded by the frozen encoder."""
    of_encoder = model.settings.encoder_settings
    assert of_encoder is not None  # unconditional priors are not used by these planners
    count = points if of_encoder.any_size else of_encoder.cloud
    return model.encode(sample_surface(checker.scene, count, rng, of_encoder.region), rng)


def _projected(constraints: PathConstraints, path: Configurations) -> Configurations:
    """The path with its inner waypoints projected onto the constraints. If the projection of a waypoint
    fails, the path itself, which the validator will refuse."""
    between = constraints.projected(path[1:-1], TOLERANCE_FRACTION)
    return np.concatenate([path[:1], between, path[-1:]]) if len(between) == len(path) - 2 else path


class Diffusion(ExportedPlanner[DiffusionSettings]):
    """The diffusion model and its guidance as a planner; see the head of this file."""

    name = "diffusion"
    network_name = "model"
    settings_class = DiffusionSettings
    supports = frozenset({PATH_CONSTRAINTS})

    def draw(
        self,
        model: "MotionModel",
        checker: CollisionChecker,
        code: Float[ndarray, "code"],
        start: Configuration,
        goals: Configurations,
        rng: np.random.Generator,
        clearances: "ClearanceFn | None" = None,
        constraints: PathConstraints | None = None,
    ) -> Trajectories:
        """A batch of samples under guidance, divided among the nearest goals.

        code: the scene embedding of `encode`.
        clearances: the model's clearance inputs; None: the true ones of the checker's scene.
        constraints: of the path, one more cost of the guidance.
        """
        from robotdiffuse.learning.motion_model import link_clearances

        settings = self.settings
        guidance = CollisionGuidance(checker, settings.guidance, constraints, TOLERANCE_FRACTION)
        goals = nearest_goals(start, goals, settings.samples)
        counts = [len(part) for part in np.array_split(np.arange(settings.samples), len(goals))]
        clearances = clearances or link_clearances(checker, model.settings)

        def guide(q: ndarray, _level: float) -> ndarray:
            return guidance(q, settings.guidance_steps)[0]

        parts = [
            model.sample(
                start,
                goal,
                code,
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
        start, goals = start_goal.rows()
        code = encode(model, start_goal.checker, self.settings.points, rng)
        names = context.problem.robot.joint_names
        constraints = context.validator.constraints
        every = list[Path]()
        valid = list[Path]()
        until = context.request.time_limit
        while not every or (context.elapsed < until and (valid or self.settings.repeat)):
            batch = self.draw(model, start_goal.checker, code, start, goals, rng, constraints=constraints)
            if constraints is not None:
                batch = [_projected(constraints, q) for q in batch]
            paths = [Path(names, start_goal.complete(q)) for q in batch]
            passed = [path for path in paths if context.validator.path(path).valid]
            for path in passed:
                context.improved(path.length)
            if passed and not valid:
                until = min(context.elapsed + self.settings.optimize_time, context.request.time_limit)
            every = every + paths
            valid = valid + passed
        reason = f"{len(valid)} of {len(every)} samples of the network are valid"
        # where none is, the validator is asked about one once more, so that the result says what is wrong
        # with it
        for path in sorted(valid or every[-1:], key=lambda path: path.length):
            solved_reason = f"solved by network: {reason}"
            result = context.finish(path.positions, "network", solved_reason, keeps=context.keeps_constraints)
            if result is not None:
                return result
        return context.unsolved(reason)
