"""What all planners share: a planner writes `solve`, and `plan` surrounds it."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar, Generic, TypeVar

from robotdiffuse.collision.motions import finer
from robotdiffuse.core.deadline import OutOfTimeError
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Settings
from robotdiffuse.core.types import FIRST, SHORT
from robotdiffuse.planning.context import PlanningContext, Request
from robotdiffuse.planning.start_goal import StartGoal, usable_start_goal
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Mesh, PointCloud, Shape, Sphere

Own = TypeVar("Own", bound=Settings)
WARM_UP, SLIGHT = 1.0, 0.02
"""Limits of the calls of `warm_up`: easy ones, and the beginning of a search [s]."""
CONSTRAINTS, CLEARANCE = "path constraints", "a clearance that is asked for"
"""What not every planner can keep."""
ABLE = {
    CONSTRAINTS: "robotdiffuse, aorrtc, rrt_connect, diffusion",
    CLEARANCE: "robotdiffuse, aorrtc, rrt_connect",
}
"""The planners that can, for messages."""
RADIUS = 0.08
"""Of the balls of `warm_up` [m]."""


class Planner(ABC, Generic[Own]):
    """A planner: its name, the class of its settings, and `solve`."""

    name: ClassVar[str]
    settings_class: type[Own]
    keeps: ClassVar[frozenset[str]] = frozenset()
    """Which of CONSTRAINTS and CLEARANCE it can keep; the others it refuses. All else that a problem and a
    call may ask for, `plan` sees to for every planner."""

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
            says, or 1 cm. The other planners have settings of their own, or keep what their motions have;
            they refuse one that is asked for.
        velocity_scaling, acceleration_scaling: shares of the robot's limits that the timed motion uses, from
            0.001 to 1.
        jerk: most jerk of any joint of the timed motion [rad/s³], at least 0.01. None: no limit, the fastest
            motion.

        Where the problem has waypoints, the motion stops at each or passes within its blend:
        `planning/pipeline/waypoints.py`. Where obstacles move, it waits, goes slower or draws back on its path:
        `planning/pipeline/moving_obstacles.py`. Where the problem has a start velocity, it begins moving:
        `planning/pipeline/start_velocity.py`. Where cameras saw the scene, `problem.unknown` says what the rest is taken
        for: `planning/pipeline/unknown_space.py`. Path constraints are for aorrtc, rrt_connect
        and robotdiffuse, `planners/constrained`, and for diffusion.

        Raises InputError for arguments that are none of these, for what the planner cannot keep, and where
        `prepare` does.
        """
        request = Request(until, clearance, velocity_scaling, acceleration_scaling, jerk)
        self._check_keeps(problem, request)
        self.prepare(problem.robot)
        return replace(self._plan(problem, time_limit, seed, request), problem=problem)

    def _plan(self, problem: Problem, time_limit: float, seed: int, request: Request) -> PlanResult:
        if problem.moving:
            from robotdiffuse.planning.pipeline.moving_obstacles import plan_among_moving

            return plan_among_moving(self, problem, time_limit, seed, request)
        if problem.waypoints:
            from robotdiffuse.planning.pipeline.waypoints import plan_by_waypoints

            return plan_by_waypoints(self, problem, time_limit, seed, request)
        if problem.start_velocity is not None:
            from robotdiffuse.planning.pipeline.start_velocity import plan_in_motion

            return plan_in_motion(self, problem, time_limit, seed, request)
        if problem.views:
            from robotdiffuse.planning.pipeline.unknown_space import plan_with_unknown_space

            return plan_with_unknown_space(self, problem, time_limit, seed, request)
        return self.attempt(problem, time_limit, seed, request)

    def _check_keeps(self, problem: Problem, request: Request) -> None:
        """InputError for what is asked for and the planner cannot keep."""
        clearance = problem.clearance if request.clearance is None else request.clearance
        for what, asked in ((CONSTRAINTS, bool(problem.constraints)), (CLEARANCE, bool(clearance))):
            if asked and what not in self.keeps:
                raise InputError(f"planner {self.name} cannot keep {what}; these can: {ABLE[what]}")

    def attempt(self, problem: Problem, time_limit: float, seed: int, request: Request) -> PlanResult:
        """`plan` in the problem's scene as it is."""
        context = PlanningContext(self.name, problem, time_limit, seed, request)
        with context.deadline():
            try:
                start_goal = usable_start_goal(context)
                return start_goal if isinstance(start_goal, PlanResult) else self.solve(context, start_goal)
            except OutOfTimeError as error:
                return context.out_of_time(error)

    def warm_up(self, problem: Problem, until: str = FIRST) -> list[PlanResult]:
        """Load the compiled code that calls on such a problem need, or compile it on a new machine, which
        takes about a minute; else the first call's time limit would have to do. `until` is what these calls
        will ask for: for those that go on after their first path, what only some of them need is loaded too,
        which takes a process seconds once: Coal, and the network of the hybrid.

        The results are of calls with nothing in the way, and with balls where the straight line is, and of
        a moment's with one small obstacle of each of the problem's kinds: its own scene is prepared within
        the time of its own call.
        """
        robot, start, goal = problem.robot, problem.start, problem.goal
        first = goal.positions[:1] if isinstance(goal, JointGoal) else []
        ways = [start + share * (end - start) for end in first for share in (0.5, 0.35)]
        balls = [Sphere(link_pose(robot, q, robot.tip)[:3, 3], RADIUS) for q in ways]
        kinds = replace(problem, waypoints=(), blend=(), moving=(), start_velocity=None)
        if not problem.views:
            kinds = replace(kinds, scene=one_of_each(problem.scene))
        easy = [Problem(robot, Scene(shapes), start, goal) for shapes in ([], *([ball] for ball in balls))]
        calls = [*((easier, WARM_UP) for easier in easy), (kinds, SLIGHT)]
        if until != FIRST:
            self._load_rarer(robot)
        return [self.plan(task, seconds, until=until) for task, seconds in calls]

    def prepare(self, robot: Robot) -> None:
        """What is done before the clock starts: a learned planner loads its weights for the robot, and raises
        InputError where there are none."""

    def load_wanted(self, robot: Robot) -> None:
        """What calls would have used and had no time to load, and Coal: for programs that make many calls, to
        make between them."""
        from robotdiffuse.collision.exact_meshes import make_ready  # which imports Coal

        make_ready(robot)

    def _load_rarer(self, robot: Robot) -> None:
        """What only some calls need."""
        self.load_wanted(robot)

    @abstractmethod
    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """Search from the ends until `call.finish` accepts a path, or there is none: `call.unsolved`."""


def ever_finer(context: PlanningContext, settings: Own) -> Iterator[tuple[Own, int]]:
    """The settings and number of each attempt, until time runs out. From one to the next the resolution is
    halved: for planners whose path the validator refused."""
    attempt = 0
    while attempt == 0 or context.remaining > 0:
        yield settings, attempt
        settings = replace(settings, resolution=finer(settings.resolution))  # type: ignore
        attempt += 1


def compiles_first(robot: Robot) -> str:
    """What to say while a first call keeps people waiting: code for trees of joints is compiled apart."""
    who = "a new machine" if robot.kernel_parents is None else "the first robot of several arms"
    return f"{who} compiles first, for about a minute"


def one_of_each(scene: Scene) -> Scene:
    """The first shape of each kind; of meshes and clouds a single triangle or point."""
    shapes: dict[str, Shape] = {}
    for shape in scene.shapes:
        if isinstance(shape, Mesh):
            shape = Mesh(shape.vertices[shape.faces[0]], [[0, 1, 2]], shape.xyz, shape.wxyz)
        elif isinstance(shape, PointCloud):
            shape = PointCloud(shape.points[:1], shape.point_radius)
        shapes.setdefault(shape.kind, shape)
    return Scene(list(shapes.values()))
