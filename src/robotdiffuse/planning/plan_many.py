"""Many problems at once, over processes of this machine."""

import os
import queue
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import fields, replace
from numbers import Integral
from typing import Any, NamedTuple

from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.processes import SingleWorker, NotStartedError, check_not_importing
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Settings
from robotdiffuse.core.types import Status
from robotdiffuse.planning import DEFAULT_PLANNER, load_planner
from robotdiffuse.planning.context import PlanningContext, Request
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems.problem import Problem, check_problem
from robotdiffuse.robots.robot import Robot


def plan_many(
    problems: Iterable[Problem],
    planner: str = DEFAULT_PLANNER,
    settings: Settings | None = None,
    weights: str | None = None,
    workers: int | None = None,
    **request: Any,
) -> Iterator[PlanResult]:
    """The results of problems in their order, each as soon as those before it are there.

    planner, settings, weights: as of `load_planner`.
    workers: processes; None: as many as there are cores.
    request: arguments of `Planner.plan`, the same for all problems: time_limit, seed, until, ...

    A problem that raises an error, or whose process dies of it, has a result with status ERROR; the others go
    on. Processes import the main script: without the line `if __name__ == "__main__":` above what it does,
    all results have status ERROR. A process compiles or loads its code before its first problem, outside the
    time limit.

    Raises InputError for an unknown planner, settings or weights that it cannot have, arguments that are
    wrong, and a number of workers below 1.
    """
    check_not_importing()
    if isinstance(problems, str) or not isinstance(problems, Iterable):
        raise InputError(f"problems is {shown(problems)}; it must be a list of Problems")
    problems = list(problems)
    for i, problem in enumerate(problems):
        check_problem(problem, f"problems[{i}]")
    if workers is not None and not (isinstance(workers, Integral) and workers >= 1):
        raise InputError(f"workers is {shown(workers)}; it must be a whole number, at least 1")
    unknown = set(request) - ARGUMENTS
    if unknown:
        raise InputError(f"unknown argument {shown(min(unknown))}; known: {', '.join(sorted(ARGUMENTS))}")
    load_planner(planner, settings, weights)
    asked = dict(request)
    if problems:
        PlanningContext(
            planner, problems[0], asked.pop("time_limit", 1.0), asked.pop("seed", 0), Request(**asked)
        )
    count = min(workers or os.cpu_count() or 1, len(problems))
    return _planned(problems, (planner, settings, weights), count, request)


ARGUMENTS = {"time_limit", "seed", *(field.name for field in fields(Request))}
"""Of a request."""
Loaded = tuple[str, Settings | None, str | None]


def _planned(
    problems: list[Problem], loaded: Loaded, workers: int, request: dict[str, Any]
) -> Iterator[PlanResult]:
    # robots go to a process once, without what was compiled of them, and keep there what it compiles
    robots = list(dict.fromkeys(problem.robot for problem in problems))
    number = {robot: i for i, robot in enumerate(robots)}
    bare = [replace(robot) for robot in robots]
    pool = [SingleWorker(_prepare, (loaded, bare, request)) for _ in range(workers)]
    idle: queue.SimpleQueue[SingleWorker] = queue.SimpleQueue()
    for worker in pool:
        idle.put(worker)

    not_started: list[NotStartedError] = []

    def one(problem: Problem) -> PlanResult:
        if not_started:  # nor would the next process
            return _error(loaded[0], problem, str(not_started[0]), request)
        asked = tuple(getattr(problem, field.name) for field in fields(problem) if field.name != "robot")
        worker = idle.get()
        try:
            return replace(worker.call(_plan, number[problem.robot], asked), problem=problem)
        except NotStartedError as error:
            not_started.append(error)
            return _error(loaded[0], problem, str(error), request)
        except BrokenProcessPool:
            return _error(loaded[0], problem, "the process of the planner died of this problem", request)
        except Exception as error:
            return _error(loaded[0], problem, f"{type(error).__name__}: {error}", request)
        finally:
            idle.put(worker)

    threads = ThreadPoolExecutor(max(workers, 1))
    try:
        yield from threads.map(one, problems)
    finally:
        for worker in pool:
            worker.close()
        threads.shutdown(cancel_futures=True)


def _error(planner: str, problem: Problem, reason: str, request: dict[str, Any]) -> PlanResult:
    return PlanResult(Status.ERROR, reason, planner, problem.robot.name, 0.0, request.get("seed", 0))


class _State(NamedTuple):
    """What a process keeps between problems."""

    planner: Planner
    robots: list[Robot]
    request: dict[str, Any]
    warm: set[Robot]


_state: _State | None = None


def _prepare(loaded: Loaded, robots: list[Robot], request: dict[str, Any]) -> None:
    global _state
    _state = _State(load_planner(*loaded), robots, request, set())


def _plan(robot: int, asked: tuple) -> PlanResult:
    assert _state is not None
    problem = Problem(_state.robots[robot], *asked)
    if problem.robot not in _state.warm:
        _state.planner.warm_up(problem)
        _state.warm.add(problem.robot)
    _state.planner.load_wanted(problem.robot)
    return replace(_state.planner.plan(problem, **_state.request), problem=None)  # not sent back
