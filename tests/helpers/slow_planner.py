"""A planner that returns only when the test says so."""

import threading

from robotdiffuse.core.results import PlanResult
from robotdiffuse.planning.search.rrt import AORRTC
from robotdiffuse.problems.problem import Problem

MAX_WAIT = 300.0
"""Longest wait for `go` [s]."""


class SlowPlanner(AORRTC):
    """AORRTC that waits for `go` before it returns, and raises an error if an obstacle is named broken."""

    name = "slow"
    calls: list[Problem] = []  # noqa: RUF012
    """The problems that it was called with and has planned for."""
    go = threading.Semaphore(0)

    def warm_up(self, problem: Problem, until: str = "converged") -> list[PlanResult]:
        return []

    def plan(self, problem: Problem, *request: object, **more: object) -> PlanResult:
        if any(shape.name == "broken" for shape in problem.scene.shapes):
            raise RuntimeError("no such luck")
        result = super().plan(problem, 60.0)
        self.calls.append(problem)
        assert self.go.acquire(timeout=MAX_WAIT)
        return result
