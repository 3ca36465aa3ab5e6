"""Steps such as approach, grasp, lift, carry and place, planned in one call."""

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.bounds import numbers
from robotdiffuse.core.errors import InputError, check_type, located, shown
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.transforms import pose
from robotdiffuse.core.types import AnyConfiguration, Configuration, Trajectory
from robotdiffuse.planning.context import clock, time_left
from robotdiffuse.planning.pipeline.waypoints import one_after_another
from robotdiffuse.problems.constraints import Constraint
from robotdiffuse.problems.goals import AnyGoal, JointGoal, PoseGoal
from robotdiffuse.problems.problem import Problem
from robotdiffuse.scenes.scene import Scene

Contacts = Mapping[str, Sequence[str] | str]

TIP = "tip"
WORLD = "world"
LINE_TIME_LIMIT = 0.3
"""Time limit for planning a straight line after a `MoveTo` step [s]. It is short, because if the line fails,
the `MoveTo` step is planned again to another end."""
SAME_END = 0.1
"""Two end configurations of a step are different if a joint differs by more than this [rad] or [m]."""


@dataclass(frozen=True, eq=False)
class MoveTo:
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


@dataclass(frozen=True, eq=False)
class MoveRelative:
    """A step of `Workspace.plan_steps`: move the tip along a straight line and keep its orientation."""

    xyz: ArrayLike
    """Displacement [3], in the axes of `frame` [m]."""
    frame: str = TIP
    """Axes of `xyz`: those of the tip at the start of the step ("tip"), or of the world ("world")."""
    tolerance: float = 0.001
    """Largest distance of the tip from the line [m]."""
    contacts: Contacts = field(default_factory=dict)
    """As for `MoveTo`."""
    name: str = "move relative"
    """Name of the step, for messages."""

    def __post_init__(self) -> None:
        xyz = numbers(self.xyz)
        if xyz is None or xyz.shape != (3,) or not np.isfinite(xyz).all():
            raise InputError(f"{self.name}: xyz is {shown(self.xyz)}; it must be 3 finite numbers [m]")
        if self.frame not in (TIP, WORLD):
            raise InputError(f"{self.name}: frame is {shown(self.frame)}; it must be {TIP!r} or {WORLD!r}")


@dataclass(frozen=True, eq=False)
class Attach:
    """A step of `Workspace.plan_steps`: the robot takes an obstacle."""

    obstacle: str
    """Name of the obstacle."""
    link: str | None = None
    """The link that holds it; None: the tip of the workspace."""
    touch_links: Sequence[str] = ()
    """Further links that it may touch while it is held."""
    name: str = "attach"
    """Name of the step, for messages."""


@dataclass(frozen=True, eq=False)
class Detach:
    """A step of `Workspace.plan_steps`: the robot releases a held object, which then is an obstacle."""

    held: str
    """Name of the object."""
    name: str = "detach"
    """Name of the step, for messages."""


Step = MoveTo | MoveRelative | Attach | Detach


@dataclass(frozen=True, eq=False)
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
        raise InputError(f"no motion was planned for a step {shown(name)}")


def plan_steps(
    space: Any, steps: Sequence[Step], start: AnyConfiguration, time_limit: float, **request: Any
) -> StepsResult:
    """See `Workspace.plan_steps`. The search is depth-first: if a step fails, the last `MoveTo` step before
    it that has another end is planned again to that end."""
    began = clock()
    check_type("steps", steps, (list, tuple), "a list of steps")
    for i, step in enumerate(steps):
        check_type(f"steps[{i}]", step, Step.__args__, "rd.MoveTo, MoveRelative, Attach or Detach")
    furthest = StepsResult((), (), space, "", 0.0)
    tried_ends = 0

    def motions(k: int, space: Any, q: Configuration) -> Iterator[PlanResult]:
        """Motions of step k from q, each to another goal or goal configuration; the last may be a failure."""
        step = steps[k]
        assert isinstance(step, MoveTo | MoveRelative)
        space = copy(space)
        space.scene = Scene(space.scene.shapes, [*space.scene.allowed_contacts, *step.contacts.items()])
        seconds_left = time_left(time_limit, began)
        seconds_left /= sum(isinstance(later, MoveTo | MoveRelative) for later in steps[k:])
        if isinstance(step, MoveRelative):
            T = space.pose(q)
            end = pose(step.xyz) @ T if step.frame == WORLD else T @ pose(step.xyz)
            if any(isinstance(earlier, MoveTo) for earlier in steps[:k]):
                seconds_left = min(seconds_left, LINE_TIME_LIMIT)
            yield space.plan_line(end, q, step.tolerance, time_limit=seconds_left, **request)
            return
        space.tip = step.link or space.tip
        options = {"constraints": step.constraints, "time_limit": seconds_left, **request}
        result = space.plan(step.goal, q, **options)
        yield result
        if result.solved:
            ends = _goal_ends(result.problem)
            indices = [result.goal_index]
        while result.solved:
            ends = [(i, end) for i, end in ends if np.abs(end - result.path.positions[-1]).max() > SAME_END]
            # ends at goals that no earlier motion reached come first
            untried = [(i, end) for i, end in ends if i not in indices] or ends
            if not untried:
                return
            result = space.plan(JointGoal(np.array([end for _, end in untried])), q, **options)
            if result.solved:
                index = untried[result.goal_index or 0][0]
                indices.append(index)
                yield replace(result, goal_index=index)

    def planned(
        k: int, space: Any, q: Configuration, results: tuple[PlanResult | None, ...]
    ) -> StepsResult | None:
        """A result for all steps. The first k steps are planned already, with these `results`, and end at q.
        None if a later step fails; `furthest` then holds the failure that came after the most steps."""
        nonlocal furthest, tried_ends
        if k == len(steps):
            return StepsResult(tuple(steps), results, space, f"solved in {k} steps", clock() - began)
        step = steps[k]
        where = f"step {k + 1} of {len(steps)}, {step.name}"
        if isinstance(step, Attach | Detach):
            space = copy(space)
            with located(where):
                if isinstance(step, Attach):
                    space.attach(step.obstacle, q, step.link, step.touch_links)
                else:
                    space.detach(step.held, q)
            return planned(k + 1, space, q, (*results, None))
        alternatives = motions(k, space, q)
        while True:
            with located(where):
                result = next(alternatives, None)
            if result is None:
                return None
            if not result.solved:
                if len(results) >= len(furthest.results):
                    reason = f"{where}: {result.reason}"
                    furthest = StepsResult(tuple(steps), (*results, result), space, reason, 0.0)
                return None
            outcome = planned(k + 1, space, result.path.positions[-1], (*results, result))
            if outcome is not None or clock() - began > time_limit:
                return outcome
            tried_ends += 1

    with located("start"):
        q = Problem(space.robot, Scene(), start, start).start
    outcome = planned(0, space, q, ())
    if outcome is None:
        tried = f"; {tried_ends} ends of earlier steps were tried" if tried_ends > 1 else ""
        outcome = replace(furthest, reason=furthest.reason + tried, planning_time=clock() - began)
    return outcome


def _goal_ends(problem: Problem) -> list[tuple[int, Configuration]]:
    """Configurations at the goals of a problem, each with its goal index (see `PlanResult.goal_index`); none
    for poses with tolerances and for poses of several links."""
    goals = problem.goal.goals if isinstance(problem.goal, AnyGoal) else (problem.goal,)
    ends = list[tuple[int, Configuration]]()
    for i, goal in enumerate(goals):
        if isinstance(goal, PoseGoal) and not goal.tolerant:
            rows = problem.robot.ik(goal.T_base_frame, goal.frame, near=problem.start)
            ends += [(i, row) for row in rows]
        elif isinstance(goal, JointGoal):
            single_goal = len(goals) == 1
            ends += [(j if single_goal else i, row) for j, row in enumerate(goal.positions)]
    return ends
