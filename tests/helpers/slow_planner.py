"""A planner that answers when it is told to."""

import threading

from robotdiffuse.core.results import PlanResult
from robotdiffuse.planning.search.aorrtc import AORRTC
from robotdiffuse.problems.problem import Problem

PATIENCE = 300.0
"""[s]"""


class SlowPlanner(AORRTC):
    """AORRTC whose answers wait for `go`; it breaks at an obstacle named broken."""

    name = "slow"
    calls: list[Problem] = []  # noqa: RUF012
    """What it was asked for, and has found."""
    go = threading.Semaphore(0)

    def warm_up(self, problem: Problem, until: str = "first") -> list[PlanResult]:
        return []

    def plan(self, problem: Problem, *request: object, **more: object) -> PlanResult:
        if any(shape.name == "broken" for shape in problem.scene.shapes):
            raise RuntimeError("no such luck")
        result = super().plan(problem, 2.0)
        self.calls.append(problem)
        assert self.go.acquire(timeout=PATIENCE)
        return result
