"""Planning for many problems at once, over processes of this machine or a Ray cluster."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
from robotdiffuse.planning.planner import Planner
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
    asked = PlanRequest(**request)
    if cluster is not None:
        check_name("cluster", cluster, CLUSTERS)
        if workers is not None:
            raise InputError(f"workers is {workers} and cluster is {cluster}; a cluster uses all its cores")
        outcomes = _planned_on_cluster(problems, (planner, settings, weights), cluster, asked)
    else:
        count = min(workers or os.cpu_count() or 1, len(problems))
        outcomes = _planned(problems, (planner, settings, weights), count, asked)

    def results() -> Results:
        with closing(outcomes):
            for completed, (i, outcome) in enumerate(outcomes, start=1):
                if progress is not None:
                    progress(completed, len(problems))
                if isinstance(outcome, str):
                    name = problems[i].robot.name
                    outcome = PlanResult(Status.ERROR, outcome, planner, name, 0.0, asked.seed)
                yield i, replace(outcome, problem=problems[i])

    return in_order(results())


Task = tuple[int, dict[str, Any]]
"""A problem as it is sent to a process: the index of its robot, and its other fields by name."""


def _tasks(problems: Sequence[Problem]) -> tuple[list[Robot], list[Task]]:
    """The robots of the problems, each once and without cached arrays, since a process computes and caches
    its own arrays; and the problems."""
    number = {robot: i for i, robot in enumerate(dict.fromkeys(problem.robot for problem in problems))}
    names = [field.name for field in fields(Problem) if field.name != "robot"]
    tasks = [
        (number[problem.robot], {name: getattr(problem, name) for name in names}) for problem in problems
    ]
    return [replace(robot) for robot in number], tasks


def _planned(
    problems: list[Problem], arguments: PlannerArguments, workers: int, request: PlanRequest
) -> Results:
    robots, tasks = _tasks(problems)
    with Workers(workers, _prepare, (arguments, robots, request)) as pool:
        calls: dict[Any, int] = {pool.submit(_plan, *task): i for i, task in enumerate(tasks)}
        for call in as_completed(calls):
            error = call.exception()
            if error is None:
                yield calls[call], call.result()
            elif isinstance(error, NotStartedError):
                yield calls[call], str(error)
            elif isinstance(error, EndedError):
                yield calls[call], "the process of the planner died while planning this problem"
            else:
                yield calls[call], f"{type(error).__name__}: {error}"


def _planned_on_cluster(
    problems: list[Problem], arguments: PlannerArguments, cluster: str, request: PlanRequest
) -> Results:
    batches = [problems[i : i + PROBLEMS_PER_TASK] for i in range(0, len(problems), PROBLEMS_PER_TASK)]
    calls = [(arguments, request, *_tasks(batch)) for batch in batches]
    with closing(CLUSTERS[cluster](_plan_on_node, calls)) as answers:
        for number, outcomes in answers:
            yield from enumerate(outcomes, start=number * PROBLEMS_PER_TASK)


def _plan_on_node(
    arguments: PlannerArguments, request: PlanRequest, robots: list[Robot], tasks: list[Task]
) -> list[PlanResult | str]:
    _prepare(arguments, robots, request)
    outcomes = list[PlanResult | str]()
    for task in tasks:
        try:
            outcomes.append(_plan(*task))
        except Exception as error:
            outcomes.append(f"{type(error).__name__}: {error}")
    return outcomes


# What a process keeps between problems: the planner, the robots, the request, and the indices of the robots
# for which the planner has compiled its code
_state: tuple[Planner[Any], list[Robot], PlanRequest, set[int]]


def _prepare(arguments: PlannerArguments, robots: list[Robot], request: PlanRequest) -> None:
    global _state
    _state = load_planner(*arguments), robots, request, set()


def _plan(robot: int, values: dict[str, Any]) -> PlanResult:
    """The result without its problem, which the caller has."""
    planner, robots, request, warm = _state
    problem = Problem(robots[robot], **values)
    if robot not in warm:
        planner.warm_up(problem)
        warm.add(robot)
    return replace(planner.plan(problem, **vars(request)), problem=None)
