"""A planner that fails in a way chosen by its seed."""

import os
import signal
import sys
import time

import numpy as np

from robotdiffuse.core.results import PlanResult
from robotdiffuse.planning import Entry
from robotdiffuse.planning.context import PlanningContext, PlanRequest
from robotdiffuse.planning.search.rrt import RRTConnect
from robotdiffuse.problems.problem import Problem

SOLVES, RAISES, DIES, HANGS, TALKS, SEARCHES, EXITS, EATS, KEEPS = range(9)
kept: list[np.ndarray] = []


class Faulty(RRTConnect):
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


ENTRY = Entry("helpers.faulty_planner:Faulty", "for tests")
