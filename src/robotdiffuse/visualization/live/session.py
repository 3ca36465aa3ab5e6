"""State of the interactive page: the current problem, the shown motion, and whether the motion is valid. The
session does not depend on browsers.

Changes return at once; invalid changes raise InputError and leave the session unchanged. Four threads do the
work, each on its most recent request. One plans, one validates the shown motion in the current scene, and two
solve inverse kinematics for dragged goal and start poses.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.resources import as_file, files
from typing import Annotated, Any, Generic, NamedTuple, TypeVar

import numpy as np

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.collision_cost import CLEARANCE_CAP
from robotdiffuse.core.errors import InputError, check_name, described, unknown_name
from robotdiffuse.core.files import decoded, parse_json, parse_yaml
from robotdiffuse.core.settings import Bound, OneOf, Settings
from robotdiffuse.core.transforms import inverse, transform
from robotdiffuse.core.types import Configuration, PlanResult, Pose, Vector, frozen_dataclass
from robotdiffuse.drawables import own_frame
from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS, load_planner
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems.families import load_family
from robotdiffuse.problems.files import WRITERS, load_problem, problem_from_record, problem_record
from robotdiffuse.problems.problem import AnyGoal, Goal, JointGoal, PoseGoal, PosesGoal, Problem, poses_of
from robotdiffuse.robots import known_robots, load_robot
from robotdiffuse.robots.inverse_kinematics import InverseKinematicsSettings, inverse_kinematics
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Shape, Sphere, Triangulated
from robotdiffuse.validation.report import Report
from robotdiffuse.validation.validator import verify

NEW_OBSTACLES: dict[str, Callable[[Vector, float], Shape]] = {
    "sphere": lambda center, size: Sphere(center, size),
    "box": lambda center, size: Box(center, (2 * size, 2 * size, 2 * size)),
    "cylinder": lambda center, size: Cylinder(center, 0.75 * size, 3 * size),
    "capsule": lambda center, size: Capsule(center, 0.75 * size, 2.5 * size),
}
"""Functions that make new obstacles, by kind, from the center and a size: the radius of a sphere of similar
size [m]."""
# bounds of the dimensions of obstacles [m]
MIN_DIMENSION = 0.01
MAX_DIMENSION = 2.0
AXES = ("x", "y", "z")
ORIENTED = (Box, Cylinder, Capsule, Triangulated)
"""Shapes that can be rotated by dragging. Rotating a sphere has no effect, and point clouds store no pose."""
# position of new obstacles, and radius of a new sphere, as fractions of the arm's reach
NEW_POSITION = np.array([0.5, 0.0, 0.5])
NEW_RADIUS = 0.094
TREE_PLANNERS = ("robotdiffuse", "aorrtc", "rrt_connect")
"""Planners whose search trees can be shown."""
QUICK_IK = InverseKinematicsSettings(max_rounds=2, patience=1)
"""Settings of inverse kinematics while dragging: few attempts, because many poses are out of reach."""


DEMO_FILE = "shelf.yaml"
FAMILY = "shelf"
MAX_UPLOAD_SIZE = 5_000_000
"""Largest size of an uploaded problem file [bytes]."""
MAX_SAMPLES = 1000
"""Number of random configurations among which a free start and goal are looked for."""
# kinds of badges: valid motion, invalid motion, no motion, not validated yet
VALID = "valid"
INVALID = "invalid"
NO_MOTION = "none"
PENDING = "pending"
COLLISIONS = ("scene_collision", "self_collision")


@dataclass(frozen=True)
class PageOptions(Settings):
    """Planning options of the page."""

    planner: Annotated[str, OneOf(PLANNERS)] = DEFAULT_PLANNER
    """Name of the planner, in PLANNERS."""
    time_limit: Annotated[float, Bound(above=0.0, most=60.0)] = 1.0
    """Time limit of each call [s]."""
    follow: bool = True
    """Whether the page plans again after each change."""
    trees: bool = False
    """Whether the search trees of the last plan are shown."""


@dataclass(frozen=True)
class Validation:
    """The validator's report on the shown motion."""

    version: int
    """Version of the state for which the motion was validated."""
    report: Report
    seconds: float
    """Time that validation took [s]."""


@frozen_dataclass
class State:
    """Everything that the page shows at one moment."""

    problem: Problem
    options: PageOptions = PageOptions()
    version: int = 0
    """Number of changes so far of the problem and of the options other than `trees`."""
    planning: bool = False
    """Whether a plan for this version is being computed."""
    answer: PlanResult | None = None
    """The planner's result for this version; None until it is known."""
    failure: str = ""
    """Why the planner could not run, in one line; empty if it could."""
    motion: PlanResult | None = None
    """The result whose motion is shown. A new one for an outdated version is shown only if it is free."""
    validation: Validation | None = None
    """Validation of the shown motion. Until the validation for this version is complete, it is one of an
    earlier version."""
    seconds: tuple[tuple[str, float], ...] = ()
    """Name and time [s] of each stage of the last plan."""
    goal_frame: str = ""
    """The link that visitors drag to move the goal."""
    goal_pose: Pose = field(default_factory=lambda: np.eye(4))
    """T_base_frame of this link at the goal; of the first goal if there are several."""
    goal_configuration: Configuration | None = None
    """A configuration that reaches the goal; None if no such configuration was found."""

    @property
    def obstacles(self) -> dict[str, Shape]:
        """The known obstacles by name."""
        return {shape.name: shape for shape in self.problem.known_scene.shapes}


class Session:
    """The state of the page and its threads. `on_change` is called after each change of the state, from any
    thread."""

    def __init__(self, problem: Problem, options: PageOptions = PageOptions()) -> None:
        self.on_change: Callable[[], None] = lambda: None
        self._lock = threading.RLock()
        self.state = _opened(problem, options)
        """The current state."""
        self._planners = dict[str, Planner]()
        self._planning_task = LatestTask(self._plan, "plan")
        self._validation_task = LatestTask(self._validate, "validate")
        self._goal_task = LatestTask(self._find_goal_configuration, "aim")
        self._start_task = LatestTask(self._move_start, "start")

    def start(self) -> None:
        """Find a configuration at the goal, and plan for the first time if `follow` is on."""
        self._goal_task.submit(self.state.goal_pose)
        self._changed()

    def close(self) -> None:
        """Start no more work. Running calls are not interrupted."""
        for thread in (self._planning_task, self._validation_task, self._goal_task, self._start_task):
            thread.close()

    def _set(self, **changes: Any) -> None:
        self.state = replace(self.state, **changes)

    # Changes by the user

    def open(self, problem: Problem) -> None:
        """Replace the problem; it may have another robot."""
        with self._lock:
            old = self.state
            new = _opened(problem, self.state.options)
            same_robot = old.problem.robot is new.problem.robot
            self.state = replace(new, version=old.version, motion=old.motion if same_robot else None)
            self._goal_task.submit(new.goal_pose)
            self._changed()

    def set_options(self, **changes: Any) -> None:
        """Change fields of `PageOptions`. Raises InputError for bad values."""
        with self._lock:
            before = self.state.options
            options = replace(self.state.options, **changes)
            self._set(options=options)
            if replace(before, trees=options.trees) != options:
                self._changed()
            elif before != options:
                self.on_change()

    def plan_now(self) -> None:
        """Plan now, also if automatic planning (`PageOptions.follow`) is off."""
        with self._lock:
            self._set(planning=True)
            self._planning_task.submit(self.state.version)
        self.on_change()

    def move_goal(self, T_base_frame: Pose) -> None:
        """Set the goal to a pose of the link `State.goal_frame`."""
        with self._lock:
            state = self.state
            goal = _posed(state.problem.goal, state.goal_frame, T_base_frame)
            self._set(problem=replace(state.problem, goal=goal), goal_pose=T_base_frame)
            self._goal_task.submit(T_base_frame)
            self._changed()

    def set_start(self, q: Configuration) -> None:
        """Set the start configuration."""
        with self._lock:
            self._set(problem=replace(self.state.problem, start=q))
            self._changed()

    def move_start(self, T_base_tip: Pose) -> None:
        """Set the start to the nearest configuration with the tip at a pose, if such a configuration is
        found."""
        self._start_task.submit(T_base_tip)

    def add_obstacle(self, kind: str) -> str:
        """Add an obstacle half the arm's reach in front of the base and as far above it; return its name."""
        with self._lock:
            check_name("kind of obstacle", kind, NEW_OBSTACLES)
            length = self.state.problem.robot.reach
            obstacle = NEW_OBSTACLES[kind](length * NEW_POSITION, round(NEW_RADIUS * length, 2))
            self._set_scene([*self.state.obstacles.values(), obstacle])
            return [*self.state.obstacles][-1]

    def change_obstacle(self, name: str, change: Callable[[Shape], Shape | None]) -> None:
        """Replace an obstacle by the result of `change`; if that is None, delete it. Raises InputError for an
        unknown name."""
        with self._lock:
            obstacles = self.state.obstacles
            check_name("obstacle", name, obstacles)
            changed = {**obstacles, name: change(obstacles[name])}
            self._set_scene([shape for shape in changed.values() if shape is not None])

    def _set_scene(self, shapes: list[Shape]) -> None:
        problem = self.state.problem
        self._set(problem=replace(problem, scene=problem.scene.with_shapes(shapes)))
        self._changed()

    def _changed(self) -> None:
        """Validate the shown motion again, and plan again if `follow` is on."""
        with self._lock:
            state = self.state
            version = state.version + 1
            follow = state.options.follow
            self._set(version=version, planning=follow, answer=None, failure="")
            if state.motion is not None:
                self._validation_task.submit(version)
            if follow:
                self._planning_task.submit(version)
        self.on_change()

    # Work of the threads

    def _publish(self, fits: Callable[[State], bool], **changes: Any) -> None:
        """Change the state to computed results, unless they no longer fit the current state."""
        with self._lock:
            if not fits(self.state):
                return
            self._set(**changes)
        self.on_change()

    def _validate(self, _version: int) -> None:
        state = self.state
        if state.motion is None:
            return
        validation = _validated(state.problem, state.motion, state.version)

        def fits(now: State) -> bool:
            newer = now.validation is not None and now.validation.version > validation.version
            return now.motion is state.motion and not newer

        self._publish(fits, validation=validation)

    def _find_goal_configuration(self, T_base_frame: Pose) -> None:
        """Find a configuration that reaches the goal, close to the previous one."""
        state = self.state
        previous = state.goal_configuration
        robot = state.problem.robot
        near = state.problem.start if previous is None else previous
        q = _configuration_at(robot, state.goal_frame, T_base_frame, near)
        self._publish(lambda now: now.problem.robot is robot, goal_configuration=q)

    def _move_start(self, T_base_tip: Pose) -> None:
        problem = self.state.problem
        q = _configuration_at(problem.robot, problem.robot.tip, T_base_tip, problem.start)
        with self._lock:  # `open` may change the robot meanwhile
            if q is not None and self.state.problem.robot is problem.robot:
                self.set_start(q)

    def _plan(self, version: int) -> None:
        state = self.state
        if state.version != version:
            return
        result, failure, seconds = self._solve(state)
        validation = None
        now = self.state
        same_robot = now.problem.robot is state.problem.robot
        if same_robot and result is not None and result.trajectory is not None:
            validation = _validated(now.problem, result, now.version)
            seconds = (*seconds, ("validating again", validation.seconds))
        with self._lock:
            current = self.state.version == version
            if current:
                self._set(planning=False, answer=result, failure=failure, seconds=seconds)
            # a motion for an outdated version is still shown if it is free in the current scene
            same_robot = self.state.problem.robot is state.problem.robot
            violation = None if validation is None else validation.report.violation
            # an outdated motion may miss the goal, which moves while it is dragged
            free = violation is None or violation.kind == "goal"
            if same_robot and validation is not None and (current or free):
                self._set(motion=result, validation=validation)
                if validation.version != self.state.version:
                    self._validation_task.submit(self.state.version)
        self.on_change()

    def _solve(self, state: State) -> tuple[PlanResult | None, str, tuple[tuple[str, float], ...]]:
        """Plans for a state. Returns the planner's result (None if it failed), the reason why it failed (else
        ""), and the times of its stages."""
        options = state.options
        problem = state.problem
        try:
            planner = self._planners.get(options.planner)
            if planner is None:
                settings = {"keep_trees": True} if options.planner in TREE_PLANNERS else None
                planner = load_planner(options.planner, settings)
                planner.warm_up(problem)
                self._planners[options.planner] = planner
            began = time.perf_counter()
            result = planner.plan(problem, options.time_limit)
            total_time = time.perf_counter() - began
        except InputError as error:
            return None, str(error), ()
        except Exception as error:  # the page survives any error of a planner
            return None, f"{options.planner} failed: {described(error)}", ()
        seconds = [("first path", result.progress[0][0])] if result.progress else []
        seconds += [("planning", result.planning_time)]
        if result.solved:
            seconds += [("timing", max(0.0, total_time - result.planning_time))]
        return result, "", tuple(seconds)


def _configuration_at(
    robot: Robot, link: str, T_base_link: Pose, near: Configuration
) -> Configuration | None:
    solutions = inverse_kinematics(
        robot, link, T_base_link, 1, rng=np.random.default_rng(0), settings=QUICK_IK, near=near, rest=near
    )
    return solutions[0] if len(solutions) else None


def _opened(problem: Problem, options: PageOptions) -> State:
    """The state for a new problem. Its goal is represented by the pose of one link and, for a joint goal, by
    a configuration."""
    goal = problem.goal
    robot = problem.robot
    if isinstance(goal, AnyGoal):
        goal = goal.goals[0]
    if poses := poses_of(goal):
        return State(problem, options, goal_pose=poses[0].T_base_frame, goal_frame=poses[0].frame)
    assert isinstance(goal, JointGoal)
    q = goal.positions[0]
    T = robot.fk(q)
    return State(problem, options, goal_pose=T, goal_frame=robot.tip, goal_configuration=q)


def _posed(goal: Goal, frame: str, T_base_frame: Pose) -> PoseGoal | PosesGoal:
    """The goal with another pose of one link. Tolerances and the poses of other links are unchanged. A joint
    goal, or several alternative goals, become one pose goal."""
    if isinstance(goal, PoseGoal):
        return replace(goal, T_base_frame=T_base_frame)
    if isinstance(goal, PosesGoal):
        return PosesGoal(
            [replace(pose, T_base_frame=T_base_frame) if pose.frame == frame else pose for pose in goal.poses]
        )
    return PoseGoal(frame, T_base_frame)


def _validated(problem: Problem, motion: PlanResult, version: int) -> Validation:
    began = time.perf_counter()
    report = verify(problem, motion.trajectory)
    return Validation(version, report, time.perf_counter() - began)


def moved_to(shape: Shape, T_base_handle: Pose) -> Shape:
    """The shape, moved so that its handle has a pose. Shapes without an orientation are not rotated."""
    if not isinstance(shape, ORIENTED):
        T_base_handle = transform(T_base_handle[:3, 3])
    return shape.moved(T_base_handle @ inverse(own_frame(shape)))


def dimensions(shape: Shape) -> dict[str, float]:
    """The adjustable dimensions of a shape by name [m]; empty for meshes and point clouds."""
    if isinstance(shape, Box):
        return {f"size {axis}": float(value) for axis, value in zip(AXES, shape.size, strict=True)}
    if isinstance(shape, Sphere):
        return {"radius": shape.radius}
    if isinstance(shape, Cylinder | Capsule):
        return {"radius": shape.radius, "height": shape.height}
    return {}


def resized(shape: Shape, dimension: str, value: float) -> Shape:
    """The shape with one of its `dimensions` changed. Raises InputError for another name, and for values that
    no shape may have."""
    sizes = dimensions(shape)
    check_name(f"dimension of {shape.name}:", dimension, sizes)
    if isinstance(shape, Box):
        size = np.array([value if name == dimension else old for name, old in sizes.items()])
        return replace(shape, size=size)
    return replace(shape, **{dimension: value})  # type: ignore[type-var]


class Validity(NamedTuple):
    """Kind and text of the badge."""

    kind: str
    """VALID, INVALID, NO_MOTION or PENDING."""
    headline: str
    lines: tuple[str, ...] = ()


def validity(state: State) -> Validity:
    """The badge of a state: the clearances of the shown motion; or link, obstacle, depth and time of its
    violation; or the reason why there is no motion."""
    why_not = state.failure
    if not why_not and state.answer is not None and not state.answer.solved:
        why_not = f"{state.answer.status.value}: {state.answer.reason}"
    more = (f"no new plan: {why_not}",) if why_not else ()
    validation = state.validation
    if state.motion is None:
        if why_not:
            return Validity(NO_MOTION, "no plan", (why_not,))
        if state.planning:
            return Validity(
                PENDING, "planning", ("on a new machine, code is compiled first, for about a minute",)
            )
        return Validity(PENDING, "not planned yet")
    if validation is None:
        return Validity(PENDING, "validating")
    report = validation.report
    trajectory = state.motion.trajectory
    violation = report.violation
    if violation is None:
        obstacles = state.problem.scene.shapes or state.problem.moving
        to_obstacles = f"to obstacles {_distance(report.scene_clearance)}" if obstacles else "no obstacles"
        between = f"between links {_distance(report.self_clearance)}"
        lines = (f"{to_obstacles}, {between}, over {trajectory.duration:.2f} s", *more)
        clearance = _distance(report.min_clearance).removeprefix("more than ")
        return Validity(VALID, f"free, clearance at least {clearance}", lines)
    title = "collides" if violation.kind in COLLISIONS else "not valid"
    when = f"at {violation.time:.2f} s of {trajectory.duration:.2f} s"
    return Validity(INVALID, f"{title}: {violation.message}", (when, *more))


def _distance(meters: float | None) -> str:
    meters = meters or 0.0
    if meters > CLEARANCE_CAP - 1e-4:
        return f"more than {CLEARANCE_CAP:g} m"
    return f"{100 * meters:.1f} cm" if meters >= 0.01 else f"{1000 * meters:.1f} mm"


def first_problem(file: str | None, robot: str | None) -> Problem:
    """The first problem of the page: read from a file, made for a robot, or the demo if neither is given.

    Raises InputError if both are given, and for an invalid file or robot.
    """
    if file is not None and robot is not None:
        raise InputError(f"{file} names its robot; give a problem or --robot {robot}, not both")
    if file is not None:
        return load_problem(file)
    if robot is not None:
        return problem_for(load_robot(robot))
    with as_file(files("robotdiffuse") / "examples" / DEMO_FILE) as demo:
        return load_problem(demo)


def problem_for(robot: Robot) -> Problem:
    """A problem of the family shelf for the robot. If the family cannot be drawn for it, the problem is
    between two free configurations in an empty scene. Raises InputError if fewer than two are found."""
    rng = np.random.default_rng(0)
    try:
        return load_family(FAMILY).draw(robot, rng).problem(robot)
    except InputError:
        pass
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in (robot.lower, robot.upper))
    q = rng.uniform(lower, upper, (MAX_SAMPLES, robot.dof))
    q = q[CollisionChecker(robot, Scene()).free(q)]
    if len(q) > 1:
        return Problem(robot, Scene(), q[0], JointGoal(q[1]))
    raise InputError(f"of {MAX_SAMPLES} random configurations of {robot.name} fewer than 2 are free")


def uploaded_problem(content: bytes, name: str, robot: Robot) -> Problem:
    """The problem in an uploaded file.

    The problem may name known robots and the robot of the page, but no files on the server. Raises InputError
    with a message that begins with the name of the uploaded file.
    """
    if len(content) > MAX_UPLOAD_SIZE:
        raise InputError(f"{name} has {len(content)} bytes; at most {MAX_UPLOAD_SIZE} are read")
    text = decoded(content, name)
    data = parse_json(text, name) if name.lower().endswith(".json") else parse_yaml(text, name)
    robots = dict[Any, Robot]()
    try:
        if isinstance(data, dict) and "robot" in data:
            named_robot = data["robot"]
            names = known_robots()
            if named_robot not in (*names, robot.source):
                raise unknown_name("robot", named_robot, names)
            robots[named_robot] = load_robot(str(named_robot))
        return problem_from_record(data, robots)
    except InputError as error:
        raise InputError(f"{name}: {str(error).removeprefix('problem: ')}") from None


def problem_text(problem: Problem) -> bytes:
    """The problem as a YAML file."""
    return WRITERS[".yaml"](problem_record(problem)).encode()


FRAME_RATE = 30.0
"""Number of calls per second of a Player's function `show` while it plays."""
END_PAUSE = 0.7
"""Pause at the end of a motion before it is played again [s]."""
Work = TypeVar("Work")


class LatestTask(Generic[Work]):
    """A thread that calls `do` with the most recent request.

    A pending request is dropped when a newer one arrives. Errors of `do` are logged.
    """

    def __init__(self, do: Callable[[Work], None], name: str) -> None:
        self._do = do
        self._pending = list[Work]()
        self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, work: Work) -> None:
        """Replace the pending request; returns at once."""
        with self._changed:
            self._pending[:] = [work]
            self._changed.notify()

    def close(self) -> None:
        """Start no more requests; the running one continues to its end."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._pending or self._closed)
                if self._closed:
                    return
                work = self._pending.pop()
            try:
                self._do(work)
            except Exception:
                logging.getLogger(__name__).exception("%s failed", self._thread.name)


class Changes:
    """Remembers the values that were last shown, by name, to find changes."""

    def __init__(self) -> None:
        self._shown = dict[str, tuple[object, ...]]()

    def new(self, what: str, *values: object) -> bool:
        """Whether values differ from the last values with the name `what`; remembers them. Floats, texts
        and tuples are compared by value, other objects by identity."""
        last_values = self._shown.get(what)
        self._shown[what] = values
        return last_values is None or not all(map(_same, last_values, values))


def _same(known: object, value: object) -> bool:
    plain = isinstance(value, str | bytes | bool | float | tuple)
    return known is value or (plain and known == value)


class Player:
    """Plays a motion in a loop: a thread calls `show` with the time in the motion [s]."""

    def __init__(self, show: Callable[[float], None]) -> None:
        self._show = show
        self._lock = threading.RLock()
        self._ended = threading.Event()
        self.playing = False
        """Whether the motion is playing."""
        self.duration = 0.0
        self.time = 0.0
        threading.Thread(target=self._run, name="player", daemon=True).start()

    def load(self, duration: float) -> None:
        """Switch to a motion of this duration [s]; the time is set to the same fraction of the motion as
        before."""
        with self._lock:
            share = self.time / self.duration if self.duration else 0.0
            self.duration = duration
            self.seek(min(share, 1.0) * duration)

    def seek(self, at: float) -> None:
        """Go to a time of the motion [s]; times beyond its ends are clipped."""
        with self._lock:
            self.time = min(max(at, 0.0), self.duration)
            self._show(self.time)

    def close(self) -> None:
        """End the thread."""
        self._ended.set()

    def _run(self) -> None:
        last = time.perf_counter()
        while not self._ended.wait(1 / FRAME_RATE):
            now = time.perf_counter()
            with self._lock:
                if self.playing:
                    at = self.time + now - last
                    self.time = at if at <= self.duration + END_PAUSE else 0.0
                    self._show(min(self.time, self.duration))
            last = now
