"""Planners for tests of what calls them: one fails as its seed says, one kills its process, one waits."""

import os
import signal
import sys
import threading
import time

import numpy as np

from robotdiffuse import InputError, PlanResult, Problem, Robot
from robotdiffuse.planning import Entry
from robotdiffuse.planning.context import PlanningContext, PlanRequest
from robotdiffuse.planning.search.rrt import AORRTC, RRTConnect, RRTConnectSettings as RRTConnectSettings
from robotdiffuse.planning.start_goal import StartGoal

SOLVES, RAISES, DIES, HANGS, TALKS, SEARCHES, EXITS, EATS, KEEPS = range(9)
kept: list[np.ndarray] = []


class Faulty(RRTConnect):
    """Fails in a way chosen by its seed."""

    name = "faulty"

    def plan(self, problem: Problem, time_limit: float = 1.0, seed: int = 0, **request: object) -> PlanResult:
        if seed == RAISES:
            raise ValueError("no such\nthing")
        if seed == EXITS:
            sys.exit("no license")
        if seed == DIES:
            print("about to die", flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
        if seed == EATS:
            np.ones(2**30)  # 8 GB
        if seed == KEEPS:
            kept.append(np.ones(2**26))  # 0.5 GB
        while seed == HANGS:
            time.sleep(1.0)
        context = PlanningContext(self.name, problem, PlanRequest(time_limit, seed))
        while seed == SEARCHES and context.remaining > -time_limit:
            time.sleep(0.01)
        if seed == TALKS:
            print("this is no answer", flush=True)
        return super().plan(problem, time_limit, seed)


ENTRY = Entry("helpers.planners:Faulty", "for tests")


class Deadly(RRTConnect):
    """Kills its process in scenes with a shape named deadly, and refuses the robot "unknown"."""

    def prepare(self, robot: Robot) -> None:
        if robot.name == "unknown":
            raise InputError("no such robot")

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        if any(shape.name == "deadly" for shape in context.problem.scene.shapes):
            os.kill(os.getpid(), signal.SIGKILL)
        return super().solve(context, start_goal)


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
        assert self.go.acquire(timeout=300.0)
        return result
