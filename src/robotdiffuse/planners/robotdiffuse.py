"""RobotDiffuse, a hybrid: the paper's diffusion model, and around it search, which makes it dependable.

The straight line if it is free. Else a quick search for a path to fall back on, within milliseconds; then a
batch of trajectories sampled by the diffusion model under collision guidance, or, where none of them is free,
the same after more gradient steps (refinement). The shortest of all is the answer; where there is none, a
longer search. Everything goes through the judge, and the result names the stage that its path comes from.
"""

from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import motions_free, path_length
from robotdiffuse.collision.motion import search_space
from robotdiffuse.errors import InputError
from robotdiffuse.learning.guidance import CollisionGuidance
from robotdiffuse.learning.motion_model import MotionModel
from robotdiffuse.paths.shortcut import shortcut
from robotdiffuse.planners.call import Call
from robotdiffuse.planners.diffusion import ModelSampler, SamplingSettings, encode
from robotdiffuse.planners.ends import Ends
from robotdiffuse.planners.rrt_connect.planner import RRTConnect, RRTConnectSettings
from robotdiffuse.results import PlanResult
from robotdiffuse.robots.robot import Robot
from robotdiffuse.types import Path


@dataclass(frozen=True)
class RobotDiffuseSettings(SamplingSettings, name="robotdiffuse"):
    planner: ClassVar[str] = "robotdiffuse"
    sampling_steps: int | None = 2
    """Calls of the denoiser per batch. With guidance, more bring no more solved problems, see
    benchmarks/results/guidance.txt."""
    refinement_steps: int = 40
    """Most gradient steps on the sampled trajectories that still collide."""
    shortened: int = 6
    """Most candidates that are shortened; the shortest one is kept."""
    shortcuts: int = 80
    """Attempts to shorten each of them."""
    resolution: float = 0.02
    """No point of the arm moves further than this between two checks of a candidate [m]."""
    search: RRTConnectSettings = field(default_factory=RRTConnectSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("refinement_steps", "shortcuts"):
            if getattr(self, name) < 0:
                raise InputError(f"robotdiffuse.{name} is {getattr(self, name)}; it must be at least 0")
        if self.shortened < 1:
            raise InputError(f"robotdiffuse.shortened is {self.shortened}; it must be at least 1")
        if not self.resolution > 0:
            raise InputError(f"robotdiffuse.resolution is {self.resolution}; it must be positive")


class Candidates(NamedTuple):
    """Trajectories between the ends of a problem, not yet judged."""

    q: Float[ndarray, "count frames dof"]
    free: Bool[ndarray, "count"]
    """Whether the compiled check at the planner's resolution calls them free."""
    stage: str


class RobotDiffuse(ModelSampler[RobotDiffuseSettings]):
    """Diffusion model, guidance, refinement; search where they fail."""

    name = "robotdiffuse"
    settings_class = RobotDiffuseSettings

    def prepare(self, robot: Robot) -> None:
        """See `planners.base.Planner`."""
        self.model(robot)

    def solve(self, call: Call, ends: Ends) -> PlanResult:
        """See `planners.base.Planner`."""
        robot = call.problem.robot
        model = self.model(robot)
        if model is None:
            call.notes.append(f"no weights come with the package for {robot.name}; planned by search")
        search = RRTConnect(self.settings.search)
        result = self._straight(call, ends)
        if result is None and model is not None:
            quick = search.first(call, ends)
            if quick is not None:
                call.improved(quick.length)
            if call.remaining > 0 or quick is None:
                result = self._learned(call, ends, model, quick)
            if result is None and quick is not None:
                result = call.finish(quick.positions, search.name)
        return result or search.solve(call, ends)

    def _straight(self, call: Call, ends: Ends) -> PlanResult | None:
        """The straight line to the nearest goal that it reaches: no path could be shorter."""
        space = search_space(ends.checker, self.settings.resolution)
        start, goals = ends.rows()
        for goal in sorted(goals, key=lambda goal: float(np.linalg.norm(goal - start))):
            line = np.stack([start, goal])
            if motions_free(space, line).all():
                result = call.finish(ends.complete(line), "straight_line")
                if result is not None:
                    return result
        return None

    def _learned(self, call: Call, ends: Ends, model: MotionModel, quick: Path | None) -> PlanResult | None:
        """The shortest of the network's motions and the quick path; None if none passes in time."""
        (start, goals), rng = ends.rows(), call.rng
        code = encode(model, ends.checker, self.settings.points, rng)
        sampled = self.sample(model, ends.checker, code, start, goals, rng)
        result = self._best(call, ends, sampled, quick) if sampled.free.any() else None
        if result is None and call.remaining > 0:
            result = self._best(call, ends, self.refine(ends.checker, sampled.q), quick)
        return result

    def sample(
        self,
        model: MotionModel,
        checker: CollisionChecker,
        code: Float[ndarray, "code"],
        start: Float[ndarray, "dof"],
        goals: Float[ndarray, "k dof"],
        rng: np.random.Generator,
    ) -> Candidates:
        """The network alone: a batch of samples under guidance."""
        return self.candidates(checker, self.draw(model, checker, code, start, goals, rng), "network")

    def refine(self, checker: CollisionChecker, q: Float[ndarray, "count frames dof"]) -> Candidates:
        """More gradient steps on trajectories, whether sampled or not."""
        moved, _ = CollisionGuidance(checker, self.settings.guidance)(q, self.settings.refinement_steps)
        return self.candidates(checker, moved, "refinement")

    def candidates(
        self, checker: CollisionChecker, q: Float[ndarray, "count frames dof"], stage: str
    ) -> Candidates:
        """Trajectories with the verdict of the compiled check."""
        space = search_space(checker, self.settings.resolution)
        q = np.ascontiguousarray(q, np.float32)
        return Candidates(q, np.array([motions_free(space, path).all() for path in q]), stage)

    def _best(self, call: Call, ends: Ends, candidates: Candidates, quick: Path | None) -> PlanResult | None:
        """The shortest that passes the judge of the free candidates, after shortcuts, and the quick path."""
        clearance = ends.kept_clearance(self.settings.search.clearance)
        space = search_space(ends.checker, self.settings.resolution, clearance)
        state = random_state(call.seed)
        paths = sorted(candidates.q[candidates.free], key=path_length)[: self.settings.shortened]
        short = [shortcut(space, path, self.settings.shortcuts, state) for path in paths]
        names = call.problem.robot.joint_names
        found = [(Path(names, ends.complete(path)), candidates.stage) for path in short]
        if quick is not None:
            found.append((quick, RRTConnect.name))
        for path, stage in sorted(found, key=lambda one: one[0].length):
            result = call.finish(path.positions, stage)
            if result is not None:
                return result
            if call.remaining <= 0 and quick is None:
                return None
        return None


def unlearned_starts(
    start: Float[ndarray, "dof"],
    goal: Float[ndarray, "dof"],
    count: int,
    frames: int,
    robot: Robot,
    rng: np.random.Generator,
) -> Float[ndarray, "count frames dof"]:
    """The straight line, and the line with random bumps: the control for what refinement owes to learning."""
    t = np.linspace(0.0, 1.0, frames)[:, None]
    q = np.repeat((start + t * (goal - start))[None], count, axis=0)
    for harmonic in (1, 2):
        bumps = np.sin(np.pi * harmonic * t) * rng.normal(0.0, 0.6 / harmonic, (count, 1, len(start)))
        q[1:] += bumps[1:]
    q = np.clip(q, robot.lower, robot.upper)
    q[:, 0], q[:, -1] = start, goal
    return q
