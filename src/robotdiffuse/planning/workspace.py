"""Workspace: a robot, its named obstacles and its held objects, which a program keeps between calls; and
steps such as approach, grasp, lift, carry and place, planned in one call."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import field, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.errors import (
    InputError,
    check_name,
    check_type,
    counted,
    located,
    numbers,
    rigid_transform,
    shown,
)
from robotdiffuse.core.transforms import inverse, rpy_from_rotation
from robotdiffuse.core.transforms import pose as pose_matrix
from robotdiffuse.core.types import AnyConfiguration, Configuration, PlanResult, Trajectory, frozen_dataclass
from robotdiffuse.planning import plan
from robotdiffuse.planning.context import PlanRequest, clock, time_left
from robotdiffuse.planning.pipeline.waypoints import join, one_after_another
from robotdiffuse.problems.constraints import CartesianLine, Constraint
from robotdiffuse.problems.problem import (
    AnyGoal,
    Goal,
    JointGoal,
    PoseGoal,
    Problem,
    StateValidity,
    checked_configuration,
    goals_of,
)
from robotdiffuse.robots.robot import Robot, check_robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Shape

Contacts = Mapping[str, Sequence[str] | str]

TIP = "tip"
WORLD = "world"
LINE_TIME_LIMIT = 0.3
"""Time limit for planning a straight line after a `MoveTo` step [s]. It is short, because if the line fails,
the `MoveTo` step is planned again to another end."""
SAME_END = 0.1
"""Two end configurations of a step are different if a joint differs by more than this [rad] or [m], apart
from whole turns of continuous joints."""


def _kept(value: Any) -> Any:
    """A copy of the value: its arrays, lists and dicts do not change if those of the caller do."""
    if isinstance(value, list):
        return [_kept(entry) for entry in value]
    if isinstance(value, dict):
        return {name: _kept(entry) for name, entry in value.items()}
    array = numbers(value) if isinstance(value, ndarray) or hasattr(value, "detach") else None
    return value if array is None else array


class _OwnValues:
    """Base of steps: their fields do not change if the caller changes the values that it gave."""

    def __post_init__(self) -> None:
        self.__dict__.update(_kept(vars(self)))


@frozen_dataclass
class MoveTo(_OwnValues):
    """A step of `Workspace.plan_steps`: move around the obstacles to a goal."""

    goal: Any
    """A pose T_world_link [4, 4]; several poses [n, 4, 4], any of which may be reached; or any other goal
    that `Workspace.plan` takes."""
    link: str | None = None
    """The link or held object that moves to the pose; None: the tip of the workspace."""
    constraints: Sequence[Constraint] = ()
    """Path constraints of this step, in the frame of the base."""
    contacts: Contacts = field(default_factory=dict)
    """Contacts that are allowed during this step: for each obstacle, the links that may touch it, or
    "all"."""
    name: str = "move to"
    """Name of the step, for messages."""


@frozen_dataclass
class MoveRelative(_OwnValues):
    """A step of `Workspace.plan_steps`: move the tip along a straight line and keep its orientation."""

    xyz: ArrayLike
    """Displacement [3], in the axes of `frame` [m]."""
    frame: str = TIP
    """Axes of `xyz`: those of the tip at the start of the step ("tip"), or of the world ("world")."""
    tolerance: float = 0.001
    """Largest distance of the tip from the line [m]."""
    contacts: Contacts = field(default_factory=dict)
    """Permitted contacts, as in `MoveTo`."""
    name: str = "move relative"
    """Name of the step, for messages."""

    def __post_init__(self) -> None:
        xyz = numbers(self.xyz)
        if xyz is None or xyz.shape != (3,) or not np.isfinite(xyz).all():
            raise InputError(f"{self.name}: xyz is {shown(self.xyz)}; it must be 3 finite numbers [m]")
        if not isinstance(self.frame, str) or self.frame not in (TIP, WORLD):
            raise InputError(f"{self.name}: frame is {shown(self.frame)}; it must be {TIP!r} or {WORLD!r}")
        object.__setattr__(self, "xyz", xyz)
        super().__post_init__()


@frozen_dataclass
class Attach(_OwnValues):
    """A step of `Workspace.plan_steps`: the robot takes an obstacle."""

    obstacle: str
    """Name of the obstacle."""
    link: str | None = None
    """The link that holds it; None: the tip of the workspace."""
    touch_links: Sequence[str] = ()
    """Further links that it may touch while it is held."""
    name: str = "attach"
    """Name of the step, for messages."""


@frozen_dataclass
class Detach:
    """A step of `Workspace.plan_steps`: the robot releases a held object, which then is an obstacle."""

    held: str
    """Name of the object."""
    name: str = "detach"
    """Name of the step, for messages."""


Step = MoveTo | MoveRelative | Attach | Detach


@frozen_dataclass
class StepsResult:
    """The answer of `Workspace.plan_steps`."""

    steps: tuple[Step, ...]
    """The steps of the call."""
    results: tuple[PlanResult | None, ...]
    """The verified motion of each step, None for `Attach` and `Detach`. If a step failed, its result is the
    last one."""
    workspace: Any
    """The `Workspace` after these steps, with the obstacles and held objects as they are then; if a step
    failed, as it was before that step."""
    reason: str
    """A sentence: "solved in ... steps", or which step failed and why."""
    planning_time: float
    """Wall time of the call, without loading code [s]."""

    def __repr__(self) -> str:
        outcome = "solved" if self.solved else "failed"
        return f"StepsResult({outcome} in {self.planning_time:.3g} s: {self.reason})"

    @property
    def solved(self) -> bool:
        """Whether no step failed."""
        return self.failed is None

    @property
    def failed(self) -> str | None:
        """Name of the step that failed; None if none did."""
        last = self.results[-1] if self.results else None
        return None if last is None or last.solved else self.steps[len(self.results) - 1].name

    @property
    def trajectory(self) -> Trajectory | Any:
        """The motions of all steps one after the other, at rest in between; None if a step failed, or if no
        step moves the arm. Each motion was verified with the contacts and held objects of its step."""
        motions = [result.trajectory for result in self.results if result is not None]
        return one_after_another(motions) if motions and self.solved else None

    @property
    def begins(self) -> Float[ndarray, "steps"]:
        """Time at which each step begins in `trajectory` [s]; the gripper acts when `Attach` and `Detach`
        begin."""
        durations = [
            result.duration if result is not None and result.solved else 0.0 for result in self.results
        ]
        return np.cumsum([0.0, *durations])[:-1]

    def goal_index(self, name: str) -> int:
        """Look up the goal at which the motion of a step ends.

        Args:
            name: Name of a `MoveTo` step.

        Returns:
            The index of the goal, from 0; see `PlanResult.goal_index`.

        Raises:
            InputError: If no step of this name was planned.
        """
        for step, result in zip(self.steps, self.results, strict=False):
            if step.name == name and result is not None and result.goal_index is not None:
                return result.goal_index
        names = ", ".join(step.name for step in self.steps if isinstance(step, MoveTo))
        raise InputError(f"no motion was planned for a step {shown(name)}; MoveTo steps: {names or 'none'}")


def _goal_ends(problem: Problem) -> list[tuple[int, Configuration]]:
    """Configurations at the goals of a problem, each with its goal index (see `PlanResult.goal_index`); none
    for poses with tolerances and for poses of several links."""
    goals = goals_of(problem.goal)
    ends = list[tuple[int, Configuration]]()
    for i, goal in enumerate(goals):
        if isinstance(goal, PoseGoal) and not goal.tolerant:
            ends += [(i, row) for row in problem.robot.ik(goal.T_base_frame, goal.frame, near=problem.start)]
        elif isinstance(goal, JointGoal):
            single_goal = len(goals) == 1
            ends += [(j if single_goal else i, row) for j, row in enumerate(goal.positions)]
    return ends


class Workspace:
    """A robot among named obstacles, for programs that plan again and again.

    Poses given as matrices are in the frame of the world. Each call plans for the current obstacles; arrays
    computed for a robot with its held objects are reused. A workspace must be used by one thread only.

    Examples:
        >>> space = rd.Workspace(rd.load_robot("panda"))
        >>> space.add(rd.Sphere([0.5, 0.0, 0.7], 0.2, name="ball"))
        >>> space.move("ball", rd.pose([0.5, 0.4, 0.7]))
        >>> space.is_free("ready").reason
        ''
        >>> space.plan_line(space.pose("ready") @ rd.pose([0, 0, 0.1]), "ready").status.value
        'solved'
    """

    def __init__(self, robot: Robot, tip: str | None = None, T_world_base: ArrayLike | None = None) -> None:
        """Begin without obstacles.

        Args:
            robot: The robot.
            tip: The link that is moved to poses; None: the tip of the robot.
            T_world_base: Pose of the robot's base [4, 4]; None: the base is at the origin of the world.

        Raises:
            InputError: For an unknown link, a pose that is not rigid, and anything but a robot.
        """
        check_robot(robot)
        self.robot = robot
        """The robot with its held objects."""
        self.tip = robot.tip if tip is None else tip
        robot.link_frame(self.tip)
        self.scene = Scene()
        """The obstacles, in the frame of the base."""
        self.T_world_base = np.eye(4) if T_world_base is None else T_world_base  # type: ignore[assignment]

    @property
    def T_world_base(self) -> ndarray:
        """Pose of the base in the world. If a new pose is assigned, obstacles stay in place in the world."""
        return self._T_world_base

    @T_world_base.setter
    def T_world_base(self, T_world_base: ArrayLike) -> None:
        base = rigid_transform("T_world_base", T_world_base)
        base.setflags(write=False)
        T_base_world = inverse(base)
        if self.scene.shapes:
            self.scene = self.scene.moved(T_base_world @ self._T_world_base)
        self._T_world_base = base
        self._T_base_world = T_base_world

    @property
    def obstacles(self) -> tuple[str, ...]:
        """Names of the obstacles."""
        return tuple(shape.name for shape in self.scene.shapes)

    def add(self, *shapes: Shape) -> None:
        """Add obstacles. A shape with the name of an existing obstacle replaces it.

        Args:
            shapes: Shapes, meshes or point clouds with different names, in the frame of the world.

        Raises:
            InputError: For two shapes with equal names, a shape with the name of a held object, and anything
                but shapes.
        """
        for i, shape in enumerate(shapes):
            check_type(f"shapes[{i}]", shape, Shape, "a shape, each an argument of its own")
        new = Scene(shapes).moved(self._T_base_world).shapes
        names = [shape.name for shape in new]
        for body in self.robot.attached:
            if body.name in names:
                raise InputError(f"a shape is named {body.name}, like an object the robot holds; rename it")
        if names != [shape.name for shape in shapes]:
            raise InputError(
                f"shapes are named {', '.join(shape.name for shape in shapes)}; names must differ"
            )
        remaining = [shape for shape in self.scene.shapes if shape.name not in names]
        self.scene = self.scene.with_shapes([*remaining, *new])

    def move(self, name: str, T_world_shape: ArrayLike) -> None:
        """Move an obstacle.

        Args:
            name: Name of the obstacle.
            T_world_shape: New pose of the obstacle's own frame [4, 4].

        Raises:
            InputError: For an unknown name, a pose that is not rigid, and a point cloud, which has no pose.
        """
        shape = self._obstacle(name)
        T = self._T_base_world @ rigid_transform("T_world_shape", T_world_shape)
        moved = shape.moved(T @ inverse(shape.T_base_shape))
        self.scene = self.scene.with_shapes(
            [moved if obstacle is shape else obstacle for obstacle in self.scene.shapes]
        )

    def remove(self, *names: str) -> None:
        """Remove obstacles.

        Args:
            names: Names of the obstacles; without names, all are removed.

        Raises:
            InputError: For an unknown name.
        """
        removed = {self._obstacle(name).name for name in names} or set(self.obstacles)
        self.scene = self.scene.with_shapes(
            [shape for shape in self.scene.shapes if shape.name not in removed]
        )

    def allow(self, obstacle: str, links: Sequence[str] | str) -> None:
        """Set which links may touch an obstacle, such as the fingers that grasp it.

        Args:
            obstacle: Name of the obstacle.
            links: Names of links and held objects; "all"; or an empty list to allow no contact.

        Raises:
            InputError: For an unknown obstacle, and for links that are not a list of names or "all".
        """
        contacts = dict(self.scene.allowed_contacts) | {self._obstacle(obstacle).name: links}
        self.scene = Scene(self.scene.shapes, contacts)

    def attach(
        self, name: str, q: AnyConfiguration, link: str | None = None, touch_links: Sequence[str] = ()
    ) -> None:
        """Attach an obstacle to the robot: it becomes a held object, which moves with a link.

        Args:
            name: Name of the obstacle.
            q: Configuration at which it is grasped [dof], values by joint, or the name of a pose.
            link: The link that holds it; None: the tip of the workspace.
            touch_links: Further links that it may touch while it is held.

        Raises:
            InputError: For an unknown name, q of the wrong length or out of limits, and in the cases in which
                `Robot.attach` raises it.
        """
        self._obstacle(name)
        self.scene, self.robot = self.scene.attach(
            name, self.robot, self._configuration(q), self.tip if link is None else link, touch_links
        )

    def detach(self, name: str, q: AnyConfiguration) -> None:
        """Detach a held object from the robot: it becomes an obstacle at its current place.

        Args:
            name: Name of the object.
            q: Configuration at which it is released [dof], values by joint, or the name of a pose.

        Raises:
            InputError: For an unknown name, q of the wrong length or out of limits, an object that holds
                another one, and an object that is no shape.
        """
        scene, robot = self.scene.detach(name, self.robot, self._configuration(q))
        shared = {shape.name for shape in scene.shapes} & {body.name for body in robot.attached}
        if shared:
            raise InputError(f"a shape of {name} is named {min(shared)}, like an object the robot holds")
        self.scene, self.robot = scene, robot
        self.tip = self.robot.tip if self.tip == name else self.tip

    def pose(self, q: AnyConfiguration, link: str | None = None) -> ndarray:
        """Forward kinematics: the pose of a link.

        Args:
            q: A configuration [dof], values by joint, or the name of a pose.
            link: Name of the link; None: the tip of the workspace.

        Returns:
            T_world_link [4, 4].

        Raises:
            InputError: For an unknown link or name, and q of the wrong length or out of limits.
        """
        return self.T_world_base @ self.robot.fk(self._configuration(q), self.tip if link is None else link)

    def ik(self, pose: ArrayLike, near: ArrayLike | None = None, count: int = 10) -> ndarray:
        """Inverse kinematics: configurations that bring the tip to a pose. Collisions are not checked.

        Args:
            pose: T_world_tip [4, 4].
            near: A configuration [dof]; results are sorted by their distance from it.
            count: Largest number of configurations.

        Returns:
            Distinct configurations [k, dof]; no rows if none was found.

        Raises:
            InputError: For a pose that is not rigid, `near` of the wrong length, a count below 1, and a tip
                that no planned joint moves.
        """
        T = self._T_base_world @ rigid_transform("pose", pose)
        return self.robot.ik(T, self.tip, near=near, count=count)

    def is_free(self, q: AnyConfiguration) -> StateValidity:
        """Check the joint limits and collisions at a configuration; see `Problem.is_free`.

        Args:
            q: A configuration [dof], values by joint, or the name of a pose.

        Returns:
            A value that is true if the arm is free; otherwise its `reason` says why not.

        Raises:
            InputError: For q of the wrong length, an unknown name, and values that lack a planned joint.
        """
        return self._problem_at_rest().is_free(q)

    def clearance(self, q: ArrayLike) -> float | ndarray:
        """Lower bound of the distance to obstacles and between links; see `Problem.clearance_at`.

        Args:
            q: A configuration [dof], or several [n, dof].

        Returns:
            The bound [m], one for each row.

        Raises:
            InputError: For q of the wrong shape, and numbers that are not finite or beyond ±1e4.
        """
        return self._problem_at_rest().clearance_at(q)

    def plan(
        self,
        goal: Any,
        start: AnyConfiguration,
        constraints: Sequence[Constraint] = (),
        time_limit: float = 1.0,
        **request: Any,
    ) -> PlanResult:
        """Plan a motion among the obstacles as they are now.

        Args:
            goal: A pose of the tip [4, 4] in the frame of the world, or several [n, 4, 4], any of which may
                be reached; or a goal that `rd.Problem` takes, in the frame of the base.
            start: Start configuration [dof], values by joint, or the name of a pose.
            constraints: Path constraints, in the frame of the base.
            time_limit: Wall time of the call, including the conversion of many goals [s].
            request: Further arguments of `rd.plan`: seed, until, ...

        Returns:
            A result with a verified motion, or with a status and a reason why there is none.

        Raises:
            InputError: For what `rd.Problem` or `rd.plan` does not accept.
        """
        began = clock()
        PlanRequest(time_limit)  # raises InputError for a wrong limit, before it is used
        problem = self._problem(start, self._goal(goal), constraints)
        return plan(problem, time_left(time_limit, began), **request)

    def plan_steps(
        self, steps: Sequence[Step], start: AnyConfiguration, time_limit: float = 10.0, **request: Any
    ) -> StepsResult:
        """Plan steps such as approach, grasp, lift, carry and place. The workspace is not changed.

        If a step fails, the last `MoveTo` step before it that has an untried goal or goal configuration is
        planned again, to this goal or configuration.

        Args:
            steps: `rd.MoveTo`, `rd.MoveRelative`, `rd.Attach` and `rd.Detach`, in their order.
            start: Start configuration [dof], values by joint, or the name of a pose.
            time_limit: Wall time of the call [s].
            request: Further arguments of `rd.plan`: seed, until, ...

        Returns:
            A result with a verified motion for each step, or with the step that failed and the reason.

        Raises:
            InputError: For a step with wrong input (the message names the step), a wrong start, what
                `rd.plan` does not accept, and anything but a list of steps.

        Examples:
            >>> space = rd.Workspace(rd.load_robot("panda"))
            >>> space.add(rd.Box([0.5, 0.0, -0.06], [0.8, 1.2, 0.1], name="table"))
            >>> steps = [rd.MoveRelative([0, 0, -0.1], "world"), rd.MoveTo("extended", name="stretch")]
            >>> space.plan_steps(steps, "ready").solved
            True
        """
        # The search is depth-first: if a step fails, the last `MoveTo` step before it that has another end
        # configuration is planned again to this configuration.
        began = clock()
        space = self
        check_type("steps", steps, (list, tuple), "a list of steps")
        for i, step in enumerate(steps):
            check_type(f"steps[{i}]", step, Step.__args__, "rd.MoveTo, MoveRelative, Attach or Detach")
            check_type(f"steps[{i}].name", step.name, str, "a text")
            if isinstance(step, MoveTo | MoveRelative):
                check_type(f"steps[{i}].contacts", step.contacts, Mapping, "a mapping of obstacles to links")
        if "constraints" in request:
            raise InputError("constraints are those of one step; give them to rd.MoveTo")
        PlanRequest(time_limit)  # raises InputError for a wrong limit, before the limit is divided
        furthest = StepsResult((), (), space, "", 0.0)
        tried_ends = 0

        def motions(k: int, space: Any, q: Configuration) -> Iterator[PlanResult]:
            """Motions of step k from q, each to another goal or goal configuration. If the first one fails,
            the failed result is the only one; if a later one fails, there are no more."""
            step = steps[k]
            assert isinstance(step, MoveTo | MoveRelative)
            space = copy(space)
            space.scene = Scene(space.scene.shapes, [*space.scene.allowed_contacts, *step.contacts.items()])
            seconds_left = time_left(time_limit, began)
            seconds_left /= sum(isinstance(later, MoveTo | MoveRelative) for later in steps[k:])
            if isinstance(step, MoveRelative):
                T = space.pose(q)
                end = pose_matrix(step.xyz) @ T if step.frame == WORLD else T @ pose_matrix(step.xyz)
                if any(isinstance(earlier, MoveTo) for earlier in steps[:k]):
                    seconds_left = min(seconds_left, LINE_TIME_LIMIT)
                yield space.plan_line(end, q, step.tolerance, time_limit=seconds_left, **request)
                return
            space.tip = space.tip if step.link is None else step.link
            space.robot.link_frame(space.tip)  # raises InputError for an unknown link
            options = {"constraints": step.constraints, "time_limit": seconds_left, **request}
            result = space.plan(step.goal, q, **options)
            yield result
            if result.solved:
                ends = _goal_ends(result.problem)
                indices = [result.goal_index]
            while result.solved:
                gaps = np.array([end for _, end in ends]).reshape(-1, space.robot.dof)
                gaps -= result.path.positions[-1]
                gaps -= space.robot.whole_turns(gaps)
                ends = [end for end, gap in zip(ends, gaps, strict=True) if np.abs(gap).max() > SAME_END]
                # ends at goals that no earlier motion reached come first
                untried = [(i, end) for i, end in ends if i not in indices] or ends
                if not untried:
                    return
                result = space.plan(JointGoal(np.array([end for _, end in untried])), q, **options)
                if result.solved:
                    index = untried[result.goal_index or 0][0]
                    indices.append(index)
                    yield replace(result, goal_index=index)

        def where(k: int) -> str:
            return f"step {k + 1} of {len(steps)}, {steps[k].name}"

        # The planned motions: number of the step, the workspace and the results before it, and its
        # alternatives. This is a list, since a recursion with one call per step has a limit.
        planned = list[tuple[int, Any, tuple[PlanResult | None, ...], Iterator[PlanResult]]]()
        results: tuple[PlanResult | None, ...] = ()
        q = checked_configuration(space.robot, "start", start, [])
        k = 0
        while k < len(steps):
            step = steps[k]
            if isinstance(step, Attach | Detach):
                space = copy(space)
                with located(where(k)):
                    if isinstance(step, Attach):
                        space.attach(step.obstacle, q, step.link, step.touch_links)
                    else:
                        space.detach(step.held, q)
                results = (*results, None)
                k += 1
                continue
            planned.append((k, space, results, motions(k, space, q)))
            over = False
            while True:
                k, space, results, alternatives = planned[-1]
                with located(where(k)):
                    result = None if over else next(alternatives, None)
                if result is not None and result.solved:
                    break
                if result is not None and len(results) >= len(furthest.results):
                    reason = f"{where(k)}: {result.reason}"
                    furthest = StepsResult(tuple(steps), (*results, result), space, reason, 0.0)
                planned.pop()
                if not planned:
                    ends_note = f"; {tried_ends} ends of earlier steps were tried" if tried_ends > 1 else ""
                    reason = furthest.reason + ends_note
                    return replace(furthest, reason=reason, planning_time=clock() - began)
                tried_ends += isinstance(steps[planned[-1][0]], MoveTo)
                over = clock() - began > time_limit
            results = (*results, result)
            q = result.path.positions[-1]
            k += 1
        return StepsResult(tuple(steps), results, space, f"solved in {counted(k, 'step')}", clock() - began)

    def plan_line(
        self,
        pose: Any,
        start: AnyConfiguration,
        tolerance: float = 0.001,
        angle: float | None = 0.05,
        speed: float | None = None,
        time_limit: float = 1.0,
        waypoints: Sequence[ArrayLike] = (),
        **request: Any,
    ) -> PlanResult:
        """Plan a motion of the tip along a straight line, with an evenly turning orientation.

        Args:
            pose: End of the line: T_world_tip [4, 4]; or an `rd.PoseGoal`, `rd.JointGoal`, `rd.PosesGoal` or
                `rd.AnyGoal`, in the frame of the base. For an `rd.PoseGoal` with tolerances, the line ends at
                a pose within them that is near to the pose at the start. For an `rd.AnyGoal`, lines to the
                goals are tried until one is found, nearest goal first.
            start: Start configuration [dof], values by joint, or the name of a pose.
            tolerance: Largest distance of the tip from the line [m].
            angle: Largest deviation from the evenly turning orientation [rad]; None: any orientation on the
                way.
            speed: Largest speed of the tip [m/s]; None: only the joint limits apply.
            time_limit: Wall time of the call [s]; the remaining time is divided equally among the lines that
                are not planned yet.
            waypoints: Poses T_world_tip [4, 4] on the way. A line leads to each, and the motion stops there.
            request: Further arguments of `rd.plan`: seed, until, ...

        Returns:
            A result. `fraction` says how much of the line can be followed; if it is below 1, `reason` says
            why. With waypoints, each line is verified, and the lines are joined as by `rd.join`. For an
            `rd.AnyGoal`, `goal_index` is the goal that is reached; if none is, the result is that of the goal
            with the largest `fraction`.

        Raises:
            InputError: For what `rd.Problem`, `rd.CartesianLine` or `rd.plan` does not accept, and for
                several poses [n, 4, 4].
        """
        from robotdiffuse.problems.compiled_constraints import line_end  # compiled code

        line = CartesianLine(self.tip, tolerance, angle, speed)
        PlanRequest(time_limit)  # raises InputError for a wrong limit, before the limit is divided
        began = clock()
        check_type("waypoints", waypoints, Iterable, "a list of poses")
        stops = [*waypoints]
        if stops:
            lines = list[PlanResult]()
            q = start
            ends = [*stops, pose]
            for k, end in enumerate(ends):
                seconds_left = time_left(time_limit, began) / (len(ends) - k)
                result = self.plan_line(end, q, tolerance, angle, speed, seconds_left, **request)
                if not result.solved:
                    reason = f"line {k + 1} of {len(ends)}: {result.reason}"
                    return replace(result, reason=reason, fraction=(k + (result.fraction or 0.0)) / len(ends))
                q = result.path.positions[-1]
                lines.append(result)
            joined = join(lines, time_limit=time_left(time_limit, began))
            joined = replace(joined, seed=lines[-1].seed)
            return replace(joined, fraction=1.0, goal_index=lines[-1].goal_index) if joined.solved else joined
        several = isinstance(pose, AnyGoal)
        matrices = numbers(pose)
        if matrices is not None and matrices.ndim == 3:
            raise InputError(
                f"pose is {len(pose)} poses; a line has one end: give all poses but the last as waypoints, "
                "or give an rd.AnyGoal to reach any one pose"
            )
        goals = goals_of(pose) if isinstance(pose, Goal) else [self._goal(rigid_transform("pose", pose))]
        q = self._configuration(start)
        goals = [self._exact(goal, q) if isinstance(goal, PoseGoal) else goal for goal in goals]
        problems = [self._problem(start, goal, [line]) for goal in goals]
        T_start = self.robot.fk(q, self.tip)
        distances = [np.linalg.norm((line_end(problem, line) - T_start)[:3, 3]) for problem in problems]
        best = None
        for attempt, i in enumerate(np.argsort(distances, kind="stable")):
            if best is not None and clock() - began >= time_limit:
                break
            seconds_left = time_left(time_limit, began) / (len(goals) - attempt)
            result = plan(problems[i], seconds_left, **request)
            if result.solved:
                return replace(result, goal_index=int(i)) if several else result
            if several:
                result = replace(result, reason=f"goal {i}: {result.reason}")
            if best is None or (result.fraction or 0.0) > (best.fraction or 0.0):
                best = result
        assert best is not None
        return best

    def _exact(self, goal: PoseGoal, q: ndarray) -> PoseGoal:
        """A goal without tolerances: the pose within the tolerances of `goal` that is near to the pose of its
        link at q. Each coordinate of the link's pose is clipped to its tolerance."""
        T = inverse(goal.T_base_frame) @ self.robot.fk(q, goal.frame)
        tolerances = goal.xyz_tolerance, goal.rpy_tolerance
        xyz_tolerance, rpy_tolerance = (0.0 if size is None else size for size in tolerances)
        xyz = np.clip(T[:3, 3], -xyz_tolerance, xyz_tolerance)
        rpy = np.clip(rpy_from_rotation(T[:3, :3]), -rpy_tolerance, rpy_tolerance)
        return PoseGoal(goal.frame, goal.T_base_frame @ pose_matrix(xyz, rpy=rpy))

    def _goal(self, goal: Any) -> Any:
        matrices = numbers(goal)
        if matrices is not None and matrices.ndim == 3:
            return AnyGoal(tuple(self._goal(T) for T in matrices))
        if matrices is None and isinstance(goal, (list, tuple)):
            return [self._goal(item) for item in goal]
        if matrices is None or matrices.shape != (4, 4):
            return goal
        # four configurations of four joints have this shape too; a transposed pose is refused below
        ends = matrices[3], matrices[:, 3]
        if self.robot.dof == 4 and not any(np.array_equal(end, [0, 0, 0, 1]) for end in ends):
            return goal
        return PoseGoal(self.tip, self._T_base_world @ rigid_transform("goal", goal))

    def _configuration(self, q: AnyConfiguration) -> ndarray:
        return checked_configuration(self.robot, "q", q, [])

    def _problem(self, start: AnyConfiguration, goal: Any, constraints: Sequence[Constraint] = ()) -> Problem:
        base = self.T_world_base if (self.T_world_base != np.eye(4)).any() else None
        return Problem(self.robot, self.scene, start, goal, constraints=constraints, T_world_base=base)

    def _problem_at_rest(self) -> Problem:
        """A problem that is used for its scene only; its start and goal are placeholders."""
        return self._problem(self.robot.middle, self.robot.middle)

    def _obstacle(self, name: str) -> Shape:
        obstacles = {shape.name: shape for shape in self.scene.shapes}
        check_name("obstacle", name, obstacles)
        return obstacles[name]
