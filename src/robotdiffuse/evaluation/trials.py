"""Held-out ROP problems, and what a network's samples are worth on them; both kept in files."""

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
from robotdiffuse.planners.rrt_connect.planner import RRTConnect
from robotdiffuse.problems.families.rop import ROP
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.problems.rop_problems import sample_problem
from robotdiffuse.robots import load_robot
from robotdiffuse.types import Path
from robotdiffuse.verify import Verifier, VerifySettings

SEED = 20261121
"""Of the held-out problems; data are drawn from other seed sequences."""
SEARCH_TIME = 10.0
"""Problems that this much search does not solve are left out [s]."""


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


def problem_number(index: int) -> Problem:
    """Each number is a problem, trivial and unsolvable ones among them."""
    return sample_problem(load_robot("panda"), ROP, np.random.default_rng([SEED, index]))


def held_out_problems(count: int, file: FilePath) -> list[Problem]:
    """Problems that the straight line does not solve and search does; the file keeps their numbers."""
    known = json.loads(file.read_text()) if file.is_file() else {"drawn": 0, "numbers": []}
    while len(known["numbers"]) < count:
        problem = problem_number(known["drawn"])
        line = Path(problem.robot.joint_names, np.stack([problem.start, goal_of(problem)]))
        trivial = Verifier(problem, VerifySettings()).path(line).valid
        if not trivial and RRTConnect().plan(problem, SEARCH_TIME, seed=1).solved:
            known["numbers"].append(known["drawn"])
        known["drawn"] += 1
        write_atomically(file, json.dumps(known), make_folder=True)
    return [problem_number(number) for number in known["numbers"][:count]]


def goal_of(problem: Problem) -> Float[ndarray, "dof"]:
    """The goal configuration."""
    assert isinstance(problem.goal, JointGoal)
    return problem.goal.positions[0]


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
