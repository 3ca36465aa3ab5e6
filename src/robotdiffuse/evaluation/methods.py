"""What can be tried: planners, networks that sample, and searches that go on. Each gives its trials'
records, with the verdict of the validator, whose time is not counted unless it is part of a planner's call."""

import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from math import ceil
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.types import Path, Status
from robotdiffuse.evaluation.metrics import Measure
from robotdiffuse.evaluation.records import ENDED, RAISED, RESTARTABLE, SOLVED
from robotdiffuse.evaluation.runs import Clock, Fields, Method, Trial
from robotdiffuse.learning.guidance import CollisionGuidance
from robotdiffuse.planning.diffusion.diffusion import ModelSampler, encode
from robotdiffuse.planning.diffusion.hybrid import RobotDiffuseSettings, unlearned_starts
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems.held_out import goal_of
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.validation.validator import Report, VerifySettings, verifier

if TYPE_CHECKING:
    from robotdiffuse.learning.motion_model import ClearanceFn, MotionModel

NETWORK_ALONE = RobotDiffuseSettings(sampling_steps=6, guidance_steps=4, guidance_scale=1.0)
"""How networks are sampled where they are looked at alone: without guidance, the planner's steps are few."""
UNSOLVED = Status.NO_PATH.value
SHORTEST = 1 + 1e-6
"""A path is the shortest that there is if it is at most so many times as long as the straight line."""

measure_of = lru_cache(maxsize=8)(Measure)
"""That of a robot, made once."""


# Planners


def planned(planner: Planner, **request: Any) -> Method:
    """A planner in this process; `request` are further arguments of its `plan`."""

    def call(trial: Trial) -> Iterator[Fields]:
        yield from planner_calls(planner, trial.problem, trial.seed, trial.limit, False, request)

    return call


def planner_calls(
    planner: Planner,
    problem: Problem,
    seed: int,
    limit: float,
    restarts: bool,
    request: Mapping[str, Any] = MappingProxyType({}),
) -> Iterator[Fields]:
    """The record of a call, with further arguments; if there are to be restarts and it ended by itself, that
    of `restarted` too. An exception is a record."""
    measure, began = measure_of(problem.robot), time.perf_counter()
    try:
        with Clock() as clock:
            result = planner.plan(problem, time_limit=limit, seed=seed, **request)
        yield {"cpu": round(clock.cpu, 6), **fields_of(result, measure)}
        if restarts and result.status.value in RESTARTABLE and result.planning_time < ENDED * limit:
            again, result = restarted(planner, problem, seed, limit, result, request)
            yield {"restarts": again, **fields_of(result, measure)}
    except Exception as error:
        traceback.print_exc()
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        yield {"status": RAISED, "reason": reason, "time": time.perf_counter() - began}


def restarted(
    planner: Planner,
    problem: Problem,
    seed: int,
    limit: float,
    first: PlanResult,
    request: Mapping[str, Any] = MappingProxyType({}),
) -> tuple[int, PlanResult]:
    """How often a planner is called again, with fresh seeds, until its calls have used up the time limit
    together; and the shortest path of all of them, with the times at which paths were found.

    Not any more when there is no shorter path. As in single calls, only the answer needs a trajectory: the
    time that it takes to time the others is not counted.
    """
    best, spent, least, again = first, first.planning_time, first.planning_time, 0
    progress, straight = list(first.progress), _straight_length(problem)
    while limit - spent > least and (best.path_length or np.inf) > SHORTEST * straight:
        again += 1
        fresh = int(np.random.SeedSequence([seed, again]).generate_state(1)[0])
        result = planner.plan(problem, time_limit=limit - spent, seed=fresh, **request)
        for at, length in result.progress:
            if not progress or length < progress[-1][1]:
                progress.append((spent + at, length))
        spent, least = spent + result.planning_time, min(least, result.planning_time)
        if result.path_length is not None and result.path_length < (best.path_length or np.inf):
            best = result
    return again, replace(best, planning_time=spent, progress=tuple(progress))


def _straight_length(problem: Problem) -> float:
    """From the start to the nearest goal configuration [rad]; 0 where goals are poses."""
    if not isinstance(problem.goal, JointGoal):
        return 0.0
    return float(np.linalg.norm(problem.goal.positions - problem.start, axis=1).min())


def fields_of(result: PlanResult, measure: Measure) -> Fields:
    """What a record keeps of a result."""
    found: dict[str, Any] = {
        "status": result.status.value,
        "reason": result.reason,
        "time": round(result.planning_time, 6),
        "refused": result.refused,
        "stage": result.stage,
        "progress": [[round(at, 6), round(length, 6)] for at, length in result.progress],
    }
    if result.path is not None and result.trajectory is not None:
        found |= measure(result.path, result.trajectory, result)
        found["positions"] = np.round(result.path.positions, 9).tolist()
    return found


# Sampled trajectories


Draw = Callable[[Trial, CollisionChecker], ndarray]
"""A batch of trajectories [count, waypoints, dof] for a trial."""


class Validated(NamedTuple):
    """The validator's opinion of a batch."""

    passed: Bool[ndarray, "n"]
    hit: Bool[ndarray, "n"]
    """Which are in collision."""
    reports: list[Report]


def validated(problem: Problem, q: Float[ndarray, "n waypoints dof"]) -> Validated:
    """Of trajectories as they are, but for their ends, which are made exact."""
    validator, reports = verifier(problem, VerifySettings()), []
    for waypoints in q.astype(np.float64):
        waypoints[0], waypoints[-1] = problem.start, goal_of(problem)
        reports.append(validator.path(Path(problem.robot.joint_names, waypoints)))
    kinds = ["" if report.violation is None else report.violation.kind for report in reports]
    passed, hit = [not kind for kind in kinds], [kind.endswith("collision") for kind in kinds]
    return Validated(np.array(passed), np.array(hit), reports)


def path_lengths(q: Float[ndarray, "n waypoints dof"]) -> Float[ndarray, "n"]:
    """In joint space [rad]."""
    return np.linalg.norm(np.diff(q, axis=1), axis=2).sum(axis=1)


def sampled(draw: Draw, lengths: Callable[[ndarray], ndarray] = path_lengths) -> Method:
    """A batch of trajectories, all validated as they are; measured is the shortest of those that passed."""

    def call(trial: Trial) -> Iterator[Fields]:
        problem = trial.problem
        checker = CollisionChecker(problem.robot, problem.scene)
        with Clock() as clock:
            q = draw(trial, checker)
        verdict, found = validated(problem, q), {}
        if verdict.passed.any():
            best = int(np.where(verdict.passed, lengths(q), np.inf).argmin())
            path = Path(problem.robot.joint_names, q[best].astype(np.float64))
            found = measure_of(problem.robot)(path, None, verdict.reports[best])
        yield {
            "status": SOLVED if found else UNSOLVED,
            "passed": float(verdict.passed.mean()),
            "collided": float(verdict.hit.mean()),
            **clock.fields,
            **found,
        }

    return call


def from_network(
    sampler: ModelSampler,
    seen: Callable[[Trial], Problem] | None = None,
    hidden: bool = False,
) -> Draw:
    """Straight from the network: no refinement, no search, no shortcuts.

    seen: whose obstacles are encoded, in place of the problem's own. hidden: the denoiser is told that no
    link is anywhere near an obstacle. Guidance knows the obstacles in any case.
    """

    def draw(trial: Trial, checker: CollisionChecker) -> ndarray:
        problem, rng = trial.problem, trial.rng()
        model = sampler.model(problem.robot)
        assert model is not None
        other = checker if seen is None else CollisionChecker(problem.robot, seen(trial).scene)
        code = encode(model, other, sampler.settings.points, rng)
        ends = problem.start, goal_of(problem)[None]
        told = nothing_near(model) if hidden else None
        return sampler.draw(model, checker, code, *ends, rng, told)

    return draw


def nothing_near(model: "MotionModel") -> "ClearanceFn":
    """What a model is told of the obstacles where there are none."""
    links, width = len(model.robot.links), model.dof if model.settings.clearance_gradients else 0

    def clearances(q: ndarray) -> ndarray:
        told = np.zeros((*q.shape[:2], links + width), np.float32)
        told[..., :links] = model.settings.clearance_high
        return told

    return clearances


def without_network(settings: RobotDiffuseSettings, waypoints: int) -> Draw:
    """The control: the line and random bumps, and as many gradient steps as a network's samples take, all of
    them one after the other."""
    sampling_steps = settings.sampling_steps
    assert sampling_steps is not None  # as many as a network's would be
    steps = settings.guidance_steps * ceil(settings.guided_share * sampling_steps)

    def draw(trial: Trial, checker: CollisionChecker) -> ndarray:
        problem = trial.problem
        ends = problem.start, goal_of(problem)
        q = unlearned_starts(*ends, settings.samples, waypoints, problem.robot, trial.rng())
        return CollisionGuidance(checker, settings.guidance)(q, steps)[0] if steps else q

    return draw


# Searches that go on


Search = Callable[[Trial], Iterator[ndarray | None]]
"""Yields waypoints as it finds them; None where it only wants to be asked whether there is time left. What it
does before it returns the iterator is not counted."""


def searched(
    search: Search, marks: Sequence[float], whole: Callable[[Trial], Problem] = lambda trial: trial.problem
) -> Method:
    """A record for each mark, a CPU time [s]: of what a search has by then, the shortest path that passes the
    validator is its answer, and that is solved if it passes for the whole problem too.

    whole: what is true, where the trial's problem is what a planner sees of it. `passed` is 1 with an answer.
    """

    def call(trial: Trial) -> Iterator[Fields]:
        found: list[tuple[float, ndarray]] = []
        paths, began = search(trial), time.process_time()
        for path in paths:
            spent = time.process_time() - began
            if spent > marks[-1]:
                break
            if path is not None:
                found.append((spent, np.asarray(path, np.float64)))
        found.sort(key=lambda one: path_lengths(one[1][None])[0])
        names, verdicts = trial.problem.robot.joint_names, dict[int, Report]()

        def passes(i: int) -> bool:
            if i not in verdicts:
                verdicts[i] = verifier(trial.problem, VerifySettings()).path(Path(names, found[i][1]))
            return verdicts[i].valid

        for mark in marks:
            answer = next((i for i, (at, _) in enumerate(found) if at <= mark and passes(i)), None)
            fields: Fields = {"status": UNSOLVED, "time": mark, "time_limit": mark, "passed": 0.0}
            if answer is not None:
                at, path = found[answer][0], Path(names, found[answer][1])
                report = verifier(whole(trial), VerifySettings()).path(path)
                fields |= {"passed": 1.0, "time": at, "cpu": at}
                if report.valid:
                    fields |= {"status": SOLVED, **measure_of(trial.problem.robot)(path, None, report)}
            yield fields

    return call
