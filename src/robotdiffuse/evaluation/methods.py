"""Methods for `runs`: planners, and samplers of trajectories, which are networks or controls (baselines
without a network). Each method yields the fields of its records, including the validator's verdict.

The time of a planner's call includes its validation; the time of sampling does not include validation.
"""

import hashlib
import json
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy import ndarray

from robotdiffuse.baselines.controls import Control, ControlSettings
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.types import Mask, Path, Status, Values
from robotdiffuse.evaluation.metrics import measured
from robotdiffuse.evaluation.runs import (
    ENDED_EARLY,
    RAISED,
    RESTARTABLE,
    SHORTEST_FACTOR,
    SOLVED,
    Clock,
    Fields,
    Method,
    Run,
)
from robotdiffuse.learning.guidance import Trajectories
from robotdiffuse.planning.diffusion import Diffusion, DiffusionSettings, encode
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems.held_out import goal_of
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.validation.report import Report
from robotdiffuse.validation.validator import VerifySettings, verifier

if TYPE_CHECKING:
    from robotdiffuse.learning.motion_model import ClearanceFn

NETWORK_ALONE = DiffusionSettings(sampling_steps=6, guidance_steps=4)
"""Planner settings for measuring single samples of networks, without search."""
UNSOLVED = Status.NO_PATH.value


# Planners


def planned(planner: Planner, **request: Any) -> Method:
    """A method that calls a planner in this process; `request` are further arguments of `Planner.plan`."""

    def call(run: Run) -> Iterator[Fields]:
        yield from planner_calls(planner, run.problem, run.seed, run.limit, False, request)

    return call


def planner_calls(
    planner: Planner,
    problem: Problem,
    seed: int,
    limit: float,
    restarts: bool,
    request: Mapping[str, Any],
) -> Iterator[Fields]:
    """Yields the fields of a call's record. With `restarts`, if the call ended early, it also yields the
    fields of the record of all calls together (`restarted`). An exception gives a record too."""
    began = time.perf_counter()
    try:
        with Clock() as clock:
            result = planner.plan(problem, time_limit=limit, seed=seed, **request)
        yield {"cpu": clock.fields["cpu"], **fields_of(result, problem.robot)}
        if restarts and result.status.value in RESTARTABLE and result.planning_time < ENDED_EARLY * limit:
            count, result = restarted(planner, problem, seed, limit, result, request)
            yield {"restarts": count, **fields_of(result, problem.robot)}
    except (Exception, SystemExit) as error:
        traceback.print_exc()
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        yield {"status": RAISED, "reason": reason, "time": time.perf_counter() - began}


def restarted(
    planner: Planner,
    problem: Problem,
    seed: int,
    limit: float,
    first: PlanResult,
    request: Mapping[str, Any],
) -> tuple[int, PlanResult]:
    """Call a planner again with new seeds until less time is left than its shortest call took.

    Returns the number of further calls and the result with the shortest path. Its `progress` has the times at
    which shorter paths were found, over all calls. Stops early if no shorter path can exist.
    Time-parametrizing each call's path is not counted.
    """
    straight = 0.0
    if isinstance(problem.goal, JointGoal):
        differences = problem.goal.positions - problem.start
        differences -= problem.robot.whole_turns(differences)
        straight = float(np.linalg.norm(differences, axis=1).min())
    best = first
    spent = first.planning_time
    shortest_call = spent
    count = 0
    progress = list(first.progress)
    while limit - spent > shortest_call and _length(best) > SHORTEST_FACTOR * straight:
        count += 1
        call_seed = int(np.random.SeedSequence([seed, count]).generate_state(1)[0])
        result = planner.plan(problem, time_limit=limit - spent, seed=call_seed, **request)
        for at, length in result.progress:
            if not progress or length < progress[-1][1]:
                progress.append((spent + at, length))
        spent += result.planning_time
        shortest_call = min(shortest_call, result.planning_time)
        best = min(best, result, key=_length)
    return count, replace(best, planning_time=spent, progress=tuple(progress))


def _length(result: PlanResult) -> float:
    """Length of the path [rad]; infinite if there is no path."""
    return np.inf if result.path_length is None else result.path_length


def fields_of(result: PlanResult, robot: Robot) -> Fields:
    """The fields of the record of a planner's result."""
    record: dict[str, Any] = {
        "status": result.status.value,
        "reason": result.reason,
        "time": round(result.planning_time, 6),
        "refused": result.refused,
        "stage": result.stage,
        "progress": [[round(at, 6), round(length, 6)] for at, length in result.progress],
    }
    if result.path is not None and result.trajectory is not None:
        record |= measured(robot, result.path, result.trajectory, result)
        record["positions"] = np.round(result.path.positions, 9).tolist()
    return record


# Sampled trajectories


Draw = Callable[[Run, CollisionChecker], ndarray]
"""A function that returns a batch of trajectories [count, waypoints, dof] for a run."""


class Validated(NamedTuple):
    """The validator's verdict on a batch."""

    passed: Mask
    hit: Mask
    """Which trajectories are in collision."""
    reports: list[Report]
    waypoints: Trajectories
    """The trajectories, with exact start and goal as first and last waypoint."""


def validated(problem: Problem, q: Trajectories) -> Validated:
    """Validate trajectories without repairing them; only first and last waypoint are set to the exact start
    and goal."""
    validator = verifier(problem, VerifySettings())
    exact = q.astype(np.float64)
    exact[:, 0], exact[:, -1] = problem.start, goal_of(problem)
    reports = [validator.path(Path(problem.robot.joint_names, waypoints)) for waypoints in exact]
    kinds = ["" if report.violation is None else report.violation.kind for report in reports]
    passed = [not kind for kind in kinds]
    hit = [kind.endswith("collision") for kind in kinds]
    return Validated(np.array(passed), np.array(hit), reports, exact)


def path_lengths(q: Trajectories) -> Values:
    """Joint-space length of each trajectory [rad]."""
    return np.linalg.norm(np.diff(q, axis=1), axis=2).sum(axis=1)


def sampled(draw: Draw, lengths: Callable[[ndarray], ndarray] = path_lengths) -> Method:
    """A method that validates a batch of sampled trajectories, and measures the valid one for which `lengths`
    is smallest."""

    def call(run: Run) -> Iterator[Fields]:
        problem = run.problem
        checker = CollisionChecker(problem.robot, problem.scene)
        with Clock() as clock:
            q = draw(run, checker)
        verdict = validated(problem, q)
        measures = {}
        if verdict.passed.any():
            best = int(np.where(verdict.passed, lengths(verdict.waypoints), np.inf).argmin())
            path = Path(problem.robot.joint_names, verdict.waypoints[best])
            measures = measured(problem.robot, path, None, verdict.reports[best])
        yield {
            "status": SOLVED if measures else UNSOLVED,
            "passed": float(verdict.passed.mean()),
            "collided": float(verdict.hit.mean()),
            **clock.fields,
            **measures,
        }

    return call


def sampling_digest(settings: DiffusionSettings | ControlSettings, folder: FilePath | None) -> str:
    """A hash of everything that samples depend on: the settings, and the weights in the folder of a network,
    if there is a network. It is part of the names of methods."""
    weights = None if folder is None else json.loads((folder / "model.json").read_text())["weights_sha256"]
    about = json.dumps(asdict(settings) | {"weights": weights}, sort_keys=True)
    return hashlib.sha256(about.encode()).hexdigest()[:12]


def from_network(
    sampler: Diffusion,
    encoded: Callable[[Run], Problem] | None = None,
    clearances: "ClearanceFn | None" = None,
) -> Draw:
    """Draws samples of the network, without refinement, search or shortcuts.

    Args:
        sampler: The planner with the network.
        encoded: Returns a problem for a run; the scene of this problem is encoded in place of the scene of
            the run.
        clearances: Computes the clearances that are inputs of the denoiser, in place of the usual function.
    """

    def draw(run: Run, checker: CollisionChecker) -> ndarray:
        problem = run.problem
        rng = run.rng()
        model = sampler.network(problem.robot)
        scene_checker = checker if encoded is None else CollisionChecker(problem.robot, encoded(run).scene)
        embedding = encode(model, scene_checker, sampler.settings.points, rng)
        return sampler.draw(model, checker, embedding, problem.start, goal_of(problem)[None], rng, clearances)

    return draw


def from_control(settings: ControlSettings) -> Draw:
    """Draws the candidates of a control."""
    control = Control(settings)

    def draw(run: Run, checker: CollisionChecker) -> ndarray:
        return control.candidates(run.problem.start, goal_of(run.problem)[None], checker, run.rng())

    return draw
