"""What the page knows: the problem as it was last changed, the motion shown, and the validator's word on it.

A session knows nothing of browsers. Changes return at once; they raise InputError where they make no sense,
and leave the session as it was. Three threads do the rest, each of them the latest of what it is asked: one
plans, one validates the motion shown in the scene as it now is, one looks for configurations for poses.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, shortened, unknown_name
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, OneOf, Settings
from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS, load_planner, planner_settings
from robotdiffuse.planning.diffusion.candidates import Candidates, draw_candidates
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems.goals import AnyGoal, Goal, JointGoal, PoseGoal, PosesGoal, poses_of
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.inverse_kinematics import InverseKinematicsSettings, inverse_kinematics
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.scaling import reach
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Shape
from robotdiffuse.validation.validator import Report, verify_trajectory
from robotdiffuse.visualization.live.latest_task import Latest
from robotdiffuse.visualization.live.obstacles import handle_pose, held_at, new_obstacle, resized

AHEAD, SIZE = np.array([0.5, 0.0, 0.5]), 0.094
"""Where new obstacles stand, and the radius of a ball, as shares of the arm's reach."""
KEEP_TREES = {
    "robotdiffuse": "search.keep_trees=true",
    "aorrtc": "keep_trees=true",
    "rrt_connect": "keep_trees=true",
}
"""The planners whose search can be looked at, and what they are told for it."""
QUICK = InverseKinematicsSettings(max_rounds=2, patience=1)
"""For poses that hands move: many are out of reach."""


@dataclass(frozen=True)
class Choice(Settings):
    """How the page plans."""

    planner: Annotated[str, OneOf(PLANNERS)] = DEFAULT_PLANNER
    """Name in PLANNERS."""
    time_limit: Annotated[float, Bound(above=0.0, most=60.0)] = 1.0
    """Of each call [s]."""
    follow: bool = True
    """Plan anew after each change."""
    candidates: bool = False
    """Draw a batch of the diffusion model after each plan, to look at."""
    trees: bool = False
    """Show the trees of the search that found the last plan, or none."""


@dataclass(frozen=True)
class Verdict:
    """The validator's word on the motion shown."""

    version: int
    """Of the problem that it was validated for."""
    report: Report
    seconds: float
    """What validating took [s]."""


@dataclass(frozen=True, eq=False)
class State:
    """All that a view shows, at one moment."""

    problem: Problem
    choice: Choice = Choice()
    version: int = 0
    """Counts the changes of the problem and of how it is planned."""
    planning: bool = False
    """A plan for this version is on its way."""
    answer: PlanResult | None = None
    """To the version asked for last; None until there is one."""
    failure: str = ""
    """Why the planner could not be asked, in one line."""
    motion: PlanResult | None = None
    """The motion shown: of the last result that had one."""
    verdict: Verdict | None = None
    """On the motion shown; of an earlier version for the moment that validating takes."""
    seconds: tuple[tuple[str, float], ...] = ()
    """What the stages of the last plan took [s]."""
    candidates: Candidates | None = None
    goal_frame: str = ""
    """The link that stands for the goal, and ..."""
    goal_pose: Float[ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """... T_base_frame of it, which is dragged: of the first of several goals."""
    goal_configuration: Float[ndarray, "dof"] | None = None
    """One that stands at the goal; None where none was found."""


class Session:
    """See the head of this file. `tell` is called after each change, from any thread."""

    def __init__(self, problem: Problem, choice: Choice = Choice()) -> None:
        self.tell: Callable[[], None] = lambda: None
        self._lock = threading.RLock()
        self._state = _opened(problem, choice)
        self._planners: dict[str, Planner] = {}
        self._planning = Latest(self._plan, "plan")
        self._validating = Latest(self._validator, "validator")
        self._aiming = Latest(self._aim, "aim")
        self._starting = Latest(self._begin_at, "start")

    def begin(self) -> None:
        """Plan for the first time."""
        self._aiming.ask(self._state.goal_pose)
        self._changed()

    @property
    def state(self) -> State:
        return self._state

    def close(self) -> None:
        """No more planning; what was begun ends in its own time."""
        for thread in (self._planning, self._validating, self._aiming, self._starting):
            thread.close()

    # What hands change

    def open(self, problem: Problem) -> None:
        """Another problem, perhaps of another robot."""
        with self._lock:
            old, new = self._state, _opened(problem, self._state.choice)
            same = old.problem.robot is new.problem.robot
            self._state = replace(new, version=old.version, motion=old.motion if same else None)
            self._aiming.ask(new.goal_pose)
            self._changed()

    def choose(self, **changes: Any) -> None:
        """Change fields of `Choice`; InputError for what it refuses."""
        with self._lock:
            if "planner" in changes:
                PLANNERS.entry(changes["planner"])
            before, choice = self._state.choice, replace(self._state.choice, **changes)
            self._state = replace(self._state, choice=choice)
            if replace(before, trees=choice.trees) != choice:
                self._changed()
            elif before != choice:
                self.tell()

    def plan_now(self) -> None:
        """Plan, whether the session follows changes or not."""
        with self._lock:
            self._state = replace(self._state, planning=True)
            self._planning.ask(self._state.version)
        self.tell()

    def move_goal(self, T_base_frame: Float[ndarray, "4 4"]) -> None:
        """The pose of the link that the goal names, or of the tip, becomes the goal."""
        with self._lock:
            state = self._state
            goal = _posed(state.problem.goal, state.goal_frame, T_base_frame)
            problem = replace(state.problem, goal=goal)
            self._state = replace(state, problem=problem, goal_pose=T_base_frame)
            self._aiming.ask(T_base_frame)
            self._changed()

    def set_start(self, q: Float[ndarray, "dof"]) -> None:
        with self._lock:
            self._state = replace(self._state, problem=replace(self._state.problem, start=q))
            self._changed()

    def move_start(self, T_base_tip: Float[ndarray, "4 4"]) -> None:
        """The start becomes the configuration nearby whose tip is at the pose, if there is one."""
        self._starting.ask(T_base_tip)

    def add_obstacle(self, kind: str, center: Float[ndarray, "3"] | None = None) -> str:
        """Its name. Without a centre [m], before the arm, halfway to where it reaches."""
        with self._lock:
            length = reach(self._state.problem.robot)
            center = length * AHEAD if center is None else center
            obstacle = new_obstacle(kind, center, round(SIZE * length, 2))
            shapes = [*self._state.problem.known_scene.shapes, obstacle]
            self._set_scene(shapes)
            return self._state.problem.known_scene.shapes[-1].name

    def move_obstacle(self, name: str, T_base_handle: Float[ndarray, "4 4"]) -> None:
        """Put an obstacle's handle at a pose."""
        self._change_obstacle(name, lambda shape: held_at(shape, T_base_handle))

    def resize_obstacle(self, name: str, dimension: str, value: float) -> None:
        """Change one of its dimensions [m]."""
        self._change_obstacle(name, lambda shape: resized(shape, dimension, value))

    def delete_obstacle(self, name: str) -> None:
        with self._lock:
            self.obstacle(name)
            self._set_scene([shape for shape in self._state.problem.known_scene.shapes if shape.name != name])

    def obstacle(self, name: str) -> Shape:
        """InputError for an unknown name."""
        shapes = {shape.name: shape for shape in self._state.problem.known_scene.shapes}
        if name not in shapes:
            raise unknown_name("obstacle", name, shapes)
        return shapes[name]

    def obstacle_pose(self, name: str) -> Float[ndarray, "4 4"]:
        """T_base_handle"""
        return handle_pose(self.obstacle(name))

    def _change_obstacle(self, name: str, change: Callable[[Shape], Shape]) -> None:
        with self._lock:
            self.obstacle(name)
            shapes = self._state.problem.known_scene.shapes
            self._set_scene([change(shape) if shape.name == name else shape for shape in shapes])

    def _set_scene(self, shapes: list[Shape]) -> None:
        self._state = replace(self._state, problem=replace(self._state.problem, scene=Scene(shapes)))
        self._changed()

    def _changed(self) -> None:
        """The problem or the choice is another: the verdict is due anew, and a plan."""
        with self._lock:
            state = self._state
            version = state.version + 1
            follow = state.choice.follow
            self._state = replace(
                state, version=version, planning=follow, answer=None, failure="", candidates=None
            )
            if state.motion is not None:
                self._validating.ask(version)
            if follow:
                self._planning.ask(version)
        self.tell()

    # What the threads do

    def _validator(self, _version: int) -> None:
        state = self._state
        if state.motion is None:
            return
        verdict = _verdict(state.problem, state.motion, state.version)
        with self._lock:
            known = self._state.verdict
            newer = known is not None and known.version > verdict.version
            if self._state.motion is not state.motion or newer:
                return
            self._state = replace(self._state, verdict=verdict)
        self.tell()

    def _aim(self, T_base_frame: Float[ndarray, "4 4"]) -> None:
        """A configuration at the goal: the one known, moved along with the pose, if it can be."""
        state = self._state
        known = state.goal_configuration
        robot, near = state.problem.robot, state.problem.start if known is None else known
        q = _reached(robot, state.goal_frame, T_base_frame, near)
        with self._lock:
            if self._state.problem.robot is not robot:
                return
            self._state = replace(self._state, goal_configuration=q)
        self.tell()

    def _begin_at(self, T_base_tip: Float[ndarray, "4 4"]) -> None:
        problem = self._state.problem
        q = _reached(problem.robot, problem.robot.tip, T_base_tip, problem.start)
        if q is not None and self._state.problem.robot is problem.robot:
            self.set_start(q)

    def _plan(self, version: int) -> None:
        state = self._state
        if state.version != version:
            return
        result, failure, seconds = self._solved(state)
        verdict, now = None, self._state
        same = now.problem.robot is state.problem.robot
        if same and result is not None and result.trajectory is not None:
            verdict = _verdict(now.problem, result, now.version)
            seconds = (*seconds, ("validating once more", verdict.seconds))
        with self._lock:
            current = self._state.version == version
            if current:
                self._state = replace(
                    self._state, planning=False, answer=result, failure=failure, seconds=seconds
                )
            # one that was overtaken is shown if it is free in the scene as it is now
            same = self._state.problem.robot is state.problem.robot
            if same and verdict is not None and (current or _free(verdict)):
                self._state = replace(self._state, motion=result, verdict=verdict)
                if verdict.version != self._state.version:
                    self._validating.ask(self._state.version)
        self.tell()
        if current and state.choice.candidates:
            self._draw(version)

    def _solved(self, state: State) -> tuple[PlanResult | None, str, tuple[tuple[str, float], ...]]:
        """The planner's answer, or why it has none, and what its stages took."""
        choice, problem = state.choice, state.problem
        try:
            planner = self._planners.get(choice.planner)
            if planner is None:
                told = KEEP_TREES.get(choice.planner)
                settings = None if told is None else planner_settings(choice.planner, [told])
                planner = load_planner(choice.planner, settings)
                planner.warm_up(problem)
                self._planners[choice.planner] = planner
            planner.load_wanted(problem.robot)
            began = time.perf_counter()
            result = planner.plan(problem, choice.time_limit)
            whole = time.perf_counter() - began
        except InputError as error:
            return None, str(error), ()
        except Exception as error:  # whatever a planner raises, the page stays alive
            return None, f"{choice.planner} failed: {type(error).__name__}: {shortened(str(error))}", ()
        seconds = [("first path", result.progress[0][0])] if result.progress else []
        seconds += [("planning", result.planning_time)]
        if result.solved:
            seconds += [("timing", max(0.0, whole - result.planning_time))]
        return result, "", tuple(seconds)

    def _draw(self, version: int) -> None:
        try:
            candidates = draw_candidates(self._state.problem)
        except InputError:
            candidates = None
        with self._lock:
            if self._state.version != version:
                return
            self._state = replace(self._state, candidates=candidates)
        self.tell()


def _reached(
    robot: Robot, link: str, T_base_link: Float[ndarray, "4 4"], near: Float[ndarray, "dof"]
) -> Float[ndarray, "dof"] | None:
    rng = np.random.default_rng(0)
    found = inverse_kinematics(robot, link, T_base_link, 1, rng=rng, settings=QUICK, near=near, rest=near)
    return found[0] if len(found) else None


def _opened(problem: Problem, choice: Choice) -> State:
    frame, T, q = _target(problem)
    return State(problem, choice, goal_pose=T, goal_frame=frame, goal_configuration=q)


def _target(problem: Problem) -> tuple[str, Float[ndarray, "4 4"], Float[ndarray, "dof"] | None]:
    """The link that stands for the goal, its pose, and a configuration if the goal names one."""
    goal, robot = problem.goal, problem.robot
    if isinstance(goal, AnyGoal):
        goal = goal.goals[0]
    if poses := poses_of(goal):
        return poses[0].frame, poses[0].T_base_frame, None
    assert isinstance(goal, JointGoal)
    q = goal.positions[0]
    return robot.tip, link_pose(robot, q, robot.tip), q


def _posed(goal: Goal, frame: str, T_base_frame: Float[ndarray, "4 4"]) -> PoseGoal | PosesGoal:
    """The goal at another pose of a link; tolerances stay, and the poses of other links."""
    if isinstance(goal, PoseGoal):
        return replace(goal, T_base_frame=T_base_frame)
    if isinstance(goal, PosesGoal):
        moved = replace(next(one for one in goal.poses if one.frame == frame), T_base_frame=T_base_frame)
        return PosesGoal([moved if one.frame == frame else one for one in goal.poses])
    return PoseGoal(frame, T_base_frame)


def _verdict(problem: Problem, motion: PlanResult, version: int) -> Verdict:
    assert motion.trajectory is not None
    began = time.perf_counter()
    report = verify_trajectory(problem, motion.trajectory)
    return Verdict(version, report, time.perf_counter() - began)


def _free(verdict: Verdict) -> bool:
    """Whether nothing is wrong with a motion but that it ends elsewhere, as while the target is dragged."""
    violation = verdict.report.violation
    return violation is None or violation.kind == "goal"
