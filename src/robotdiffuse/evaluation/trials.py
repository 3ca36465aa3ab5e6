"""What a network's samples are worth on held-out problems, kept in files."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from math import ceil
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.files import write_atomically
from robotdiffuse.learning.guidance import CollisionGuidance
from robotdiffuse.planners.robotdiffuse import RobotDiffuse, RobotDiffuseSettings, encode, unlearned_starts
from robotdiffuse.problems.held_out import goal_of
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import load_robot
from robotdiffuse.types import Path
from robotdiffuse.verify import Verifier, VerifySettings

NETWORK_ALONE = RobotDiffuseSettings(sampling_steps=6, guidance_steps=4)
"""How networks are sampled where they are looked at alone: without guidance, the planner's steps are few."""


@dataclass(frozen=True, eq=False)
class Tried:
    """Figures of a network, one value for each problem."""

    single: Float[ndarray, "n"]
    """Share of the sampled trajectories that passed the judge."""
    best: Float[ndarray, "n"]
    """1 where any of them did."""
    collided: Float[ndarray, "n"]
    """Share of the sampled trajectories in collision."""
    length: Float[ndarray, "n"]
    """Link path length of the shortest that passed [m]; nan where none did."""
    seconds: Float[ndarray, "n"]
    """CPU time of encoding and sampling, on one thread."""

    def save(self, file: FilePath, key: dict[str, Any]) -> None:
        """Write the figures, and beside them what they are of."""
        figures = {name: values.tolist() for name, values in asdict(self).items()}
        write_atomically(file, json.dumps({"key": key, **figures}), make_folder=True)

    @classmethod
    def load(cls, file: FilePath, key: dict[str, Any]) -> "Tried | None":
        """The figures of a file; None if there is none, or it is of something else."""
        if not file.is_file():
            return None
        found = json.loads(file.read_text())
        if found.pop("key") != key:
            return None
        return cls(**{name: np.array(values, np.float64) for name, values in found.items()})


def judged(
    problem: Problem, q: Float[ndarray, "n frames dof"]
) -> tuple[Bool[ndarray, "n"], Bool[ndarray, "n"]]:
    """Which trajectories pass the judge, and which are in collision."""
    judge, passed, hit = Verifier(problem, VerifySettings()), [], []
    for frames in q.astype(np.float64):
        frames[0], frames[-1] = problem.start, goal_of(problem)
        violation = judge.path(Path(problem.robot.joint_names, frames)).violation
        passed.append(violation is None)
        hit.append(violation is not None and violation.kind.endswith("collision"))
    return np.array(passed), np.array(hit)


Draw = Callable[[CollisionChecker, Problem, np.random.Generator], ndarray]
"""Candidates for a problem [candidates, frames, dof]."""


def from_network(settings: RobotDiffuseSettings) -> Draw:
    """Straight from the sampler: no refinement, no search, no shortcuts."""
    planner = RobotDiffuse(settings)
    model = planner.model(load_robot("panda"))
    assert model is not None

    def draw(checker: CollisionChecker, problem: Problem, rng: np.random.Generator) -> ndarray:
        code = encode(model, checker, settings.points, rng)
        return planner.sample(model, checker, code, problem.start, goal_of(problem)[None], rng).q

    return draw


def without_network(settings: RobotDiffuseSettings, frames: int) -> Draw:
    """The control: the line and random bumps, and as many gradient steps as a network's samples take, all of
    them one after the other."""
    assert settings.sampling_steps is not None
    steps = settings.guidance_steps * ceil(settings.guided_share * settings.sampling_steps)

    def draw(checker: CollisionChecker, problem: Problem, rng: np.random.Generator) -> ndarray:
        ends = problem.start, goal_of(problem)
        q = unlearned_starts(*ends, settings.samples, frames, problem.robot, rng)
        return CollisionGuidance(checker, settings.guidance)(q, steps)[0] if steps else q

    return draw
