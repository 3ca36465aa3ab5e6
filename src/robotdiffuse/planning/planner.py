"""The base class of planners: a planner implements `solve`, and `plan` handles the rest of a call."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Generic, TypeVar

from robotdiffuse.collision.motions import finer_resolution
from robotdiffuse.core.deadline import OutOfTimeError
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.loading import compile_note, loading
from robotdiffuse.core.settings import NotNegative, Positive, Settings
from robotdiffuse.core.types import CONVERGED, PlanResult
from robotdiffuse.planning import CLEARANCE, PATH_CONSTRAINTS, planners_that_support
from robotdiffuse.planning.context import STOPS_NOTE, PlanningContext, PlanRequest
from robotdiffuse.planning.start_goal import StartGoal, usable_start_goal
from robotdiffuse.problems.constraints import CartesianLine
from robotdiffuse.problems.problem import Problem, check_problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Mesh, PointCloud, Shape, Sphere
from robotdiffuse.validation.tolerances import goal_index

PlannerSettings = TypeVar("PlannerSettings", bound=Settings)
# Time limits of the planning calls in `warm_up` [s]: for easy problems, and for the last one, which need not
# be solved.
EASY_TIME_LIMIT = 1.0
SHORT_TIME_LIMIT = 0.02
WARM_UP_RADIUS = 0.08
"""Radius of the balls of `warm_up` [m]."""


class Planner(ABC, Generic[PlannerSettings]):
    """A planner: its name, the class of its settings, and `solve`."""

    name: ClassVar[str]
    settings_class: type[PlannerSettings]
    supports: ClassVar[frozenset[str]] = frozenset()
    """Which of the features PATH_CONSTRAINTS and CLEARANCE the planner supports; `plan` refuses problems and
    requests that need a feature that is not among these. `plan` handles everything else that a problem or a
    request may contain, for every planner."""

    follows_lines: ClassVar[bool] = False
    """Whether `line_following.py` is tried before `solve` if a constraint of the problem is a
    `CartesianLine`."""

    def __init__(self, settings: PlannerSettings | None = None) -> None:
        """Keep the settings; `prepare` loads weights.

        Args:
            settings: An object of `settings_class`; None: its defaults.
        """
        self.settings = self.settings_class() if settings is None else settings

    def plan(self, problem: Problem, *values: Any, **request: Any) -> PlanResult:
        """Plan a motion.

        The same seed gives the same path, as long as time does not run out.

        Every planner accepts problems with:

        - waypoints: the motion stops at each waypoint, or passes it within its blend distance
          (`planning/pipeline/waypoints.py`);
        - moving obstacles: the motion waits, slows down or retreats on its path
          (`planning/pipeline/moving_obstacles.py`);
        - a start velocity: the arm is moving when the motion begins (`planning/pipeline/waypoints.py`);
        - camera views: `problem.unknown` says how unknown space is treated
          (`planning/pipeline/unknown_space.py`).

        Path constraints are supported by aorrtc, rrt_connect, robotdiffuse (`planning/search/constrained.py`)
        and diffusion.

        Args:
            problem: The problem.
            values: Fields of `PlanRequest` in their order; `rd.plan` documents them.
            request: Fields of `PlanRequest` by name.

        Returns:
            A result with a verified path and trajectory, or with a status and a reason why there is none.

        Raises:
            InputError: For arguments out of bounds, for a clearance or constraints that the planner does not
                support, and for missing weights (see `prepare`).
        """
        check_problem(problem)
        result = self._plan(problem, PlanRequest(*values, **request))
        notes = result.notes
        if result.path is not None:
            reached = goal_index(problem.robot, problem.goal, result.path.positions[-1])
            result = replace(result, goal_index=reached)
            # with waypoints or moving obstacles, stops and waits are wanted
            if result.trajectory is not None and not (problem.waypoints or problem.moving):
                stops = ", ".join(f"{at:.3g} s" for at in result.trajectory.stops)
                if stops:
                    notes += (f"{STOPS_NOTE}{stops}: corners there could not be rounded",)
        note = compile_note()
        return replace(result, problem=problem, notes=(*notes, note) if note else notes)

    def _plan(self, problem: Problem, request: PlanRequest) -> PlanResult:
        clearance = problem.clearance if request.clearance is None else request.clearance
        for feature, needed in ((PATH_CONSTRAINTS, bool(problem.constraints)), (CLEARANCE, bool(clearance))):
            if needed and feature not in self.supports:
                able = ", ".join(planners_that_support(feature))
                raise InputError(f"planner {self.name} does not support {feature}; these do: {able}")
        self.prepare(problem.robot)
        return pipeline_for(problem)(self, problem, request)

    def warm_up(self, problem: Problem, until: str = CONVERGED) -> list[PlanResult]:
        """Load or compile the code that planning calls need, so that the first call does not wait for it.

        Without `warm_up`, the first call loads this code itself, outside of its planning time.

        Args:
            problem: A problem like those of later calls.
            until: The `until` of later calls.

        Returns:
            The results of the planning calls that `warm_up` makes. The first is without obstacles. If it has
            a path, two more calls have a ball as obstacle, which the tip would meet on the straight line in
            joint space. The last, short one is with the first obstacle of each kind in the problem's scene
            (one triangle of a mesh, one point of a cloud), or with the whole scene if the problem has views.
        """
        from robotdiffuse.collision.exact_meshes import warm_up as load_coal

        def call(task: Problem, seconds: float) -> PlanResult:
            return self._plan(task, PlanRequest(seconds, until=until))

        robot = problem.robot
        start = problem.start
        goal = problem.goal
        load_coal(robot)
        results = [call(Problem(robot, Scene(), start, goal), EASY_TIME_LIMIT)]
        path = results[0].path
        # a ball on the straight line forces a path with corners, which needs more compiled code
        for share in () if path is None else (0.5, 0.35):
            q = start + share * (path.positions[-1] - start)  # type: ignore[union-attr]
            ball = Sphere(robot.fk(q)[:3, 3], WARM_UP_RADIUS)
            results.append(call(Problem(robot, Scene([ball]), start, goal), EASY_TIME_LIMIT))
        last = replace(problem, waypoints=(), blend=(), moving=(), start_velocity=None)
        if not problem.views:
            last = replace(last, scene=one_of_each(problem.scene))
        return [*results, call(last, SHORT_TIME_LIMIT)]

    def attempt(self, problem: Problem, request: PlanRequest) -> PlanResult:
        """Plan from the problem's start to its goal by one call of `solve`.

        Args:
            problem: The problem, without waypoints, moving obstacles, start velocity and views, which
                `planning/pipeline` handles.
            request: The arguments of the call.

        Returns:
            The result of `solve`, or of following a line if that succeeds; a failed result if start or goal
            cannot be used, or if time runs out.
        """
        context = PlanningContext(self.name, problem, request)
        followed = None
        lines = any(isinstance(constraint, CartesianLine) for constraint in problem.constraints)
        with context.deadline():
            try:
                if self.follows_lines and lines:
                    with loading():
                        from robotdiffuse.planning.line_following import follow_line  # compiled code

                    followed = follow_line(context)
                result = followed if followed is not None and followed.solved else self._searched(context)
            except OutOfTimeError as error:
                result = context.out_of_time(error)
        if lines and result.solved:
            return replace(result, fraction=1.0)
        if followed is None:
            return result
        return replace(result, fraction=followed.fraction, reason=f"{result.reason}; {followed.reason}")

    def _searched(self, context: PlanningContext) -> PlanResult:
        start_goal = usable_start_goal(context)
        if isinstance(start_goal, PlanResult):
            return start_goal
        context.begin_search()
        return self.solve(context, start_goal)

    def prepare(self, robot: Robot) -> None:
        """Prepare to plan, outside of planning time: learned planners load their weights.

        Args:
            robot: The robot of the next problem.

        Raises:
            InputError: If there are no weights for the robot.
        """

    @abstractmethod
    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """Search from the start to a goal until `context.finish` accepts a path.

        Args:
            context: Problem, request, clock and random numbers of the call.
            start_goal: Collision-free start and goal configurations.

        Returns:
            The result of `context.finish`; that of `context.unsolved` if no path was found.
        """


def pipeline_for(problem: Problem) -> Callable[[Planner, Problem, PlanRequest], PlanResult]:
    """The function of `planning/pipeline` that plans for a problem: the one that handles its moving
    obstacles, waypoints, start velocity or views, in this order of precedence; `Planner.attempt` if it has
    none. A module is imported only when it is needed."""
    if problem.moving:
        from robotdiffuse.planning.pipeline.moving_obstacles import plan_among_moving_obstacles

        return plan_among_moving_obstacles
    if problem.waypoints:
        from robotdiffuse.planning.pipeline.waypoints import plan_through_waypoints

        return plan_through_waypoints
    if problem.start_velocity is not None:
        from robotdiffuse.planning.pipeline.waypoints import plan_from_start_velocity

        return plan_from_start_velocity
    if problem.views:
        from robotdiffuse.planning.pipeline.unknown_space import plan_with_unknown_space

        return plan_with_unknown_space
    return Planner.attempt


@dataclass(frozen=True)
class CheckedSettings(Settings):
    """Collision checks of planners that check motions at a finite resolution; see `ever_finer`."""

    resolution: Positive = 0.05
    """No point of the arm moves further than this between neighboring checked configurations [m]; the
    validator certifies the motion in between. After a path that the validator refuses, the search starts
    again with half this distance."""
    clearance: NotNegative = 0.002
    """Distance to obstacles that paths keep where start and goal allow it [m]."""


def ever_finer(context: PlanningContext, settings: PlannerSettings) -> Iterator[PlannerSettings]:
    """Yields settings until time runs out, at least once. For searches that are repeated when the validator
    refuses their path: each attempt checks collisions at a finer resolution, down to FINEST_RESOLUTION."""
    yield settings
    while context.remaining > 0:
        settings = replace(settings, resolution=finer_resolution(settings.resolution))  # type: ignore
        yield settings


def one_of_each(scene: Scene) -> Scene:
    """A scene with the first shape of each kind; meshes are reduced to one triangle and point clouds to one
    point."""
    shapes = dict[str, Shape]()
    for shape in scene.shapes:
        if isinstance(shape, Mesh):
            shape = Mesh(shape.vertices[shape.faces[0]], [[0, 1, 2]], shape.xyz, shape.wxyz)
        elif isinstance(shape, PointCloud):
            shape = PointCloud(shape.points[:1], shape.point_radius)
        shapes.setdefault(shape.kind, shape)
    return Scene(list(shapes.values()))
