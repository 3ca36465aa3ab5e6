"""Planning for many problems at once, over processes of this machine or a Ray cluster."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import as_completed
from contextlib import closing
from dataclasses import fields, replace
from inspect import signature
from numbers import Integral
from typing import Any

import numpy as np

from robotdiffuse.core.errors import InputError, check_name, shown
from robotdiffuse.core.settings import Settings
from robotdiffuse.core.types import PlanResult, Status
from robotdiffuse.planning import DEFAULT_PLANNER, load_planner
from robotdiffuse.planning.context import PlanRequest
from robotdiffuse.problems.problem import Problem, check_problem
from robotdiffuse.processes.workers import (
    CLUSTERS,
    EndedError,
    NotStartedError,
    Results,
    Workers,
    check_not_importing,
    in_order,
)
from robotdiffuse.robots.robot import Robot

PlannerArguments = tuple[str, Settings | Mapping[str, object] | None, str | None]
"""Arguments of `load_planner`: name, settings, weights."""
PROBLEMS_PER_TASK = 20
"""Number of problems that a node of a cluster plans with one loaded planner."""


def plan_many(
    problems: Iterable[Problem],
    planner: str = DEFAULT_PLANNER,
    settings: Settings | Mapping[str, object] | None = None,
    weights: str | None = None,
    workers: int | None = None,
    cluster: str | None = None,
    progress: Callable[[int, int], object] | None = None,
    **request: Any,
) -> Iterator[PlanResult]:
    """Plan many problems in parallel.

    A problem that raises an error, or kills its process, gets a result with status ERROR; planning of the
    other problems continues. On a cluster, a problem that kills its process ends the call. Each process loads
    its compiled code before its first problem, outside the time limit. Processes import the main script, so
    its call of `plan_many` must be below `if __name__ == "__main__":`; otherwise all results have status
    ERROR.

    Args:
        problems: The problems.
        planner: Name of the planner, as in `load_planner`.
        settings: Settings of the planner, as in `load_planner`.
        weights: Folder of weights, as in `load_planner`.
        workers: Number of processes; None: one for each core.
        cluster: None: processes on this machine. "ray": the Ray cluster at the address RAY_ADDRESS, or a Ray
            instance that is started on this machine. Problems of a lost node are planned again on another
            node.
        progress: Called after each finished problem, in the order in which problems finish, with the number
            of finished problems and the number of all problems.
        request: Arguments of `rd.plan`, the same for all problems: time_limit, seed, until, ...

    Returns:
        An iterator over the results in the order of the problems. It yields a result as soon as this and all
        earlier results are finished.

    Raises:
        InputError: Before any planning, for an unknown planner, settings or weights that do not fit the
            planner, unknown arguments or arguments out of bounds, a number of workers below 1, and an unknown
            cluster.

    Examples:
        >>> robot = rd.load_robot("panda")
        >>> scenes = [rd.Scene([rd.Sphere([0.5, y, 0.7], 0.1)]) for y in (-0.3, 0.3)]
        >>> problems = [rd.Problem(robot, scene, "ready", "extended") for scene in scenes]
        >>> [result.solved for result in rd.plan_many(problems, workers=1, until="first")]
        [True, True]
    """
    check_not_importing()
    if isinstance(problems, str) or not np.iterable(problems):
        raise InputError(f"problems is {shown(problems)}; it must be a list of Problems")
    problems = list(problems)
    for i, problem in enumerate(problems):
        check_problem(problem, f"problems[{i}]")
    if workers is not None and not (isinstance(workers, Integral) and workers >= 1):
        raise InputError(f"workers is {shown(workers)}; it must be a whole number, at least 1")
    names = [*signature(plan_many).parameters][1:-1]  # without the problems and `request`
    names += [field.name for field in fields(PlanRequest)]
    for name in request:
        check_name("argument", name, names)
    load_planner(planner, settings, weights)
    if cluster is not None:
        check_name("cluster", cluster, CLUSTERS)
        if workers is not None:
            raise InputError(f"workers is {workers} and cluster is {cluster}; a cluster uses all its cores")
        results = _planned_on_cluster(problems, (planner, settings, weights), cluster, PlanRequest(**request))
    else:
        count = min(workers or os.cpu_count() or 1, len(problems))
        results = _planned(problems, (planner, settings, weights), count, PlanRequest(**request))
    return in_order(_reported(results, len(problems), progress))


def _reported(results: Results, total: int, progress: Callable[[int, int], object] | None) -> Results:
    with closing(results):
        for completed, result in enumerate(results, start=1):
            if progress is not None:
                progress(completed, total)
            yield result


def _planned(
    problems: list[Problem], arguments: PlannerArguments, workers: int, request: PlanRequest
) -> Results:
    # Each process gets each robot once, without cached arrays; the process computes and caches its own
    # arrays.
    robots = list(dict.fromkeys(problem.robot for problem in problems))
    number = {robot: i for i, robot in enumerate(robots)}
    bare = [replace(robot) for robot in robots]
    with Workers(workers, _prepare, (arguments, bare, request)) as pool:
        calls = {}
        for i, problem in enumerate(problems):
            values = {
                field.name: getattr(problem, field.name) for field in fields(problem) if field.name != "robot"
            }
            calls[pool.submit(_plan, number[problem.robot], values)] = i
        for call in as_completed(calls):
            problem = problems[calls[call]]
            error = call.exception()
            if error is None:
                yield calls[call], replace(call.result(), problem=problem)
                continue
            reason = f"{type(error).__name__}: {error}"
            if isinstance(error, EndedError):
                reason = "the process of the planner died while planning this problem"
            if isinstance(error, NotStartedError):
                reason = str(error)
            yield calls[call], replace(_error(arguments[0], problem, reason, request), problem=problem)


def _planned_on_cluster(
    problems: list[Problem], arguments: PlannerArguments, cluster: str, request: PlanRequest
) -> Results:
    bare = {robot: replace(robot) for robot in {problem.robot for problem in problems}}
    sent = [replace(problem, robot=bare[problem.robot]) for problem in problems]
    calls = [
        (arguments, request, sent[i : i + PROBLEMS_PER_TASK]) for i in range(0, len(sent), PROBLEMS_PER_TASK)
    ]
    with closing(CLUSTERS[cluster](_plan_on_node, calls)) as batches:
        for number, results in batches:
            for i, result in enumerate(results, start=number * PROBLEMS_PER_TASK):
                yield i, replace(result, problem=problems[i])


def _plan_on_node(
    arguments: PlannerArguments, request: PlanRequest, problems: list[Problem]
) -> list[PlanResult]:
    plan = _session(arguments, request)
    results = []
    for problem in problems:
        try:
            results.append(plan(problem))
        except Exception as error:
            results.append(_error(arguments[0], problem, f"{type(error).__name__}: {error}", request))
    return results


def _error(planner: str, problem: Problem, reason: str, request: PlanRequest) -> PlanResult:
    return PlanResult(Status.ERROR, reason, planner, problem.robot.name, 0.0, request.seed)


def _session(arguments: PlannerArguments, request: PlanRequest) -> Callable[[Problem], PlanResult]:
    """A function that plans with one loaded planner, which compiles its code before the first problem of each
    robot."""
    planner = load_planner(*arguments)
    warm = set[Robot]()

    def plan(problem: Problem) -> PlanResult:
        """The result without its problem, which the caller has."""
        if problem.robot not in warm:
            planner.warm_up(problem)
            warm.add(problem.robot)
        return replace(planner.plan(problem, **vars(request)), problem=None)

    return plan


# What a worker process keeps between problems
_state: tuple[Callable[[Problem], PlanResult], list[Robot]] | None = None


def _prepare(arguments: PlannerArguments, robots: list[Robot], request: PlanRequest) -> None:
    global _state
    _state = _session(arguments, request), robots


def _plan(robot: int, values: dict[str, Any]) -> PlanResult:
    assert _state is not None
    plan, robots = _state
    return plan(Problem(robots[robot], **values))
