"""What all planners share: a planner writes `solve`, and `plan` surrounds it."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar, Generic, TypeVar

from robotdiffuse.collision.motion import finer
from robotdiffuse.planners.call import Call
from robotdiffuse.planners.ends import Ends, usable_ends
from robotdiffuse.problems.problem import Problem
from robotdiffuse.results import PlanResult
from robotdiffuse.robots.robot import Robot
from robotdiffuse.settings import Settings

Own = TypeVar("Own", bound=Settings)


class Planner(ABC, Generic[Own]):
    """A planner: its name, the class of its settings, and `solve`."""

    name: ClassVar[str]
    settings_class: type[Own]

    def __init__(self, settings: Own | None = None) -> None:
        self.settings = self.settings_class() if settings is None else settings

    def plan(self, problem: Problem, time_limit: float = 1.0, seed: int = 0) -> PlanResult:
        """Plan a motion within `time_limit` [s] of wall time, less what verifying and timing it take.

        The same seed gives the same path, as long as time does not run out. A result with status SOLVED holds
        a path and a trajectory that passed `verify`; any other status comes with a reason.

        Raises InputError for a time limit or seed that is none, and where `prepare` does.
        """
        self.prepare(problem.robot)
        call = Call(self.name, problem, time_limit, seed)
        ends = usable_ends(call)
        return ends if isinstance(ends, PlanResult) else self.solve(call, ends)

    def prepare(self, robot: Robot) -> None:
        """What is done before the clock starts: a learned planner loads its weights for the robot, and raises
        InputError where there are none."""

    @abstractmethod
    def solve(self, call: Call, ends: Ends) -> PlanResult:
        """Search from the ends until `call.finish` accepts a path, or there is none: `call.unsolved`."""


def ever_finer(call: Call, settings: Own) -> Iterator[tuple[Own, int]]:
    """The settings and number of each attempt, until time runs out. From one to the next the resolution is
    halved: for planners whose path the judge refused."""
    attempt = 0
    while attempt == 0 or call.remaining > 0:
        yield settings, attempt
        settings = replace(settings, resolution=finer(settings.resolution))  # type: ignore
        attempt += 1
