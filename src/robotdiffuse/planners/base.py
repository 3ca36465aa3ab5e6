"""What all planners share: a planner writes `solve`, and `plan` surrounds it."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar, Generic, TypeVar

from robotdiffuse.collision.motion import finer
from robotdiffuse.planners.call import Call, Request
from robotdiffuse.planners.ends import Ends, usable_ends
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.results import PlanResult
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Sphere
from robotdiffuse.settings import Settings
from robotdiffuse.types import FIRST, SHORT

Own = TypeVar("Own", bound=Settings)
WARM_UP, SLIGHT = 1.0, 1e-3
"""Limits of the calls of `warm_up`: easy ones, and the beginning of a search [s]."""
RADIUS = 0.08
"""Of the balls of `warm_up` [m]."""


class Planner(ABC, Generic[Own]):
    """A planner: its name, the class of its settings, and `solve`."""

    name: ClassVar[str]
    settings_class: type[Own]

    def __init__(self, settings: Own | None = None) -> None:
        self.settings = self.settings_class() if settings is None else settings

    def plan(
        self,
        problem: Problem,
        time_limit: float = 1.0,
        seed: int = 0,
        until: str = SHORT,
        clearance: float | None = None,
        velocity_scaling: float = 1.0,
        acceleration_scaling: float = 1.0,
        jerk: float | None = None,
    ) -> PlanResult:
        """Plan a motion within `time_limit` [s] of wall time.

        The same seed gives the same path, as long as time does not run out. A result with status SOLVED holds
        a path and a trajectory that passed `verify`; any other status comes with a reason.

        until: "first" ends with the first verified motion, "short" when more time stops paying, "limit" when
            time runs out; planners that cannot improve a path always end with their first.
        clearance: distance to obstacles that aorrtc, rrt_connect and robotdiffuse keep wherever start, goal
            and passages allow it [m]; where they do not, less, and a note says so. None: what the problem
            says, or 1 cm. The other planners have settings for it, or keep what their motions have.
        velocity_scaling, acceleration_scaling: shares of the robot's limits that the timed motion uses.
        jerk: most jerk of any joint of the timed motion [rad/s³]. None: no limit, the fastest motion.

        Where the problem has waypoints, the motion stops at each: `planners/legs.py`. Where cameras saw the
        scene, `problem.unseen` says what the rest is taken for: `planners/unseen.py`.

        Raises InputError for arguments that are none of these, and where `prepare` does.
        """
        self.prepare(problem.robot)
        request = Request(until, clearance, velocity_scaling, acceleration_scaling, jerk)
        return replace(self._plan(problem, time_limit, seed, request), problem=problem)

    def _plan(self, problem: Problem, time_limit: float, seed: int, request: Request) -> PlanResult:
        if problem.waypoints:
            from robotdiffuse.planners.legs import plan_by_waypoints

            return plan_by_waypoints(self, problem, time_limit, seed, request)
        if problem.views:
            from robotdiffuse.planners.unseen import plan_beside_unseen

            return plan_beside_unseen(self, problem, time_limit, seed, request)
        return self.attempt(problem, time_limit, seed, request)

    def attempt(self, problem: Problem, time_limit: float, seed: int, request: Request) -> PlanResult:
        """`plan` in the problem's scene as it is."""
        call = Call(self.name, problem, time_limit, seed, request)
        ends = usable_ends(call)
        return ends if isinstance(ends, PlanResult) else self.solve(call, ends)

    def warm_up(self, problem: Problem, until: str = FIRST) -> list[PlanResult]:
        """Load the compiled code that calls on such a problem need, or compile it on a new machine, which
        takes about a minute; else the first call's time limit would have to do.

        The results are of calls with nothing in the way, and with balls where the straight line is; the
        problem itself is called on for a moment, for its kinds of obstacles.
        """
        robot, start, goal = problem.robot, problem.start, problem.goal
        first = goal.positions[:1] if isinstance(goal, JointGoal) else []
        ways = [start + share * (end - start) for end in first for share in (0.5, 0.35)]
        balls = [Sphere(link_pose(robot, q, robot.tip)[:3, 3], RADIUS) for q in ways]
        problem = replace(problem, waypoints=())
        easy = [Problem(robot, Scene(shapes), start, goal) for shapes in ([], *([ball] for ball in balls))]
        calls = [*((easier, WARM_UP) for easier in easy), (problem, SLIGHT)]
        return [self.plan(task, seconds, until=until) for task, seconds in calls]

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
