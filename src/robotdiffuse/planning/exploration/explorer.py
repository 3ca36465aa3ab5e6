"""Explorer: takes an arm to goals through space that cameras see on the way.

**Strict.** The arm enters no voxel that was not seen free: the validator accepts each motion among obstacles
that cover all other space (`seen_free.py`). Exempt is the space within 2 cm of the arm where a motion begins
and ends; seen points count there too. So the promise is as good as the map: in a scene that does not change,
with a camera whose poses and errors are as stated, such a motion meets nothing.

**Chance.** The arm goes if the motion's stated `confidence` is high enough, and looks first if it is not.

Looks are chosen by what a tentative motion, planned among what was seen alone, would sweep unseen. A look's
own motion is subject to the same policy.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.bounds import vector
from robotdiffuse.core.errors import InputError, check_type
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Count, Natural, OneOf, Positive, Settings
from robotdiffuse.core.types import FIRST
from robotdiffuse.perception.assumptions import CARVING_MARGIN, voxels_in
from robotdiffuse.perception.confidence import confidence
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.observed_volume import observe
from robotdiffuse.perception.occupancy_map import Corners, MapSettings, OccupancyMap
from robotdiffuse.planning import load_planner
from robotdiffuse.planning.context import PlanningContext, PlanRequest
from robotdiffuse.planning.exploration.cameras import ArmCamera
from robotdiffuse.planning.exploration.looks import best_looks, swept_unseen
from robotdiffuse.planning.exploration.seen_free import not_seen_free
from robotdiffuse.planning.pipeline.unknown_space import plan_with_unknown_space
from robotdiffuse.planning.start_goal import usable_start_goal
from robotdiffuse.problems.goals import Goal
from robotdiffuse.problems.problem import PADDED, PREDICTED, JointGoal, Problem
from robotdiffuse.robots.kinematics import placed_spheres
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

GO, LOOK, DONE, STUCK = "go", "look", "done", "stuck"
"""What a step asks for."""
STRICT, CHANCE, STRICT_THEN_CHANCE = "strict", "chance", "strict_then_chance"
POLICIES = (STRICT, CHANCE, STRICT_THEN_CHANCE)
NOTHING = Scene(())
AT_GOAL = 1e-3
"""Largest distance of any joint to a goal that the arm is at [rad], [m] for prismatic joints."""


@dataclass(frozen=True)
class ExplorerSettings(Settings, name="explorer"):
    policy: Annotated[str, OneOf(POLICIES)] = STRICT
    """strict: only through space seen free; chance: where the stated confidence is high enough;
    strict_then_chance: the latter where the former leads nowhere."""
    confidence: Annotated[float, Bound(least=0.0, most=1.0)] = 0.98
    """Least stated confidence of motions by chance."""
    time_limit: Positive = 1.0
    """Time limit of each search [s]."""
    max_looks: Natural = 8
    """Most looks on the way to a goal."""
    look_attempts: Count = 4
    """Looks to which a motion is searched for in a step, the most useful first."""
    max_views: Count = 12
    """The latest views give seen points and the prediction; the map holds what all views told."""
    predict: bool = True
    """Whether the occupancy completion network weighs looks, and chances; it does where it covers the arm's
    reach."""
    map: MapSettings = field(default_factory=MapSettings)


@dataclass(frozen=True, eq=False)
class Step:
    """What the arm shall do next."""

    kind: Literal["go", "look", "done", "stuck"]
    """go: execute the motion, which ends at the goal; look: execute the motion, if there is one, then
    observe; done: the arm is at the goal; stuck: see `reason`."""
    reason: str
    policy: str = ""
    """The policy that the motion keeps, "strict" or "chance"."""
    motion: PlanResult | None = None
    """Solved. A strict motion is certified against all that was not seen free; `motion.problem` holds these
    obstacles."""
    confidence: float | None = None
    """Stated probability that a motion by chance is free."""
    seen: Scene | None = None
    """The known scene and the points that the latest views saw; None where nothing was planned."""


class Explorer:
    """Takes an arm to goals through space that cameras see on the way; see the head of this file."""

    def __init__(
        self,
        robot: Robot,
        cameras: Sequence[ArmCamera] = (),
        scene: Scene = NOTHING,
        free_zone: Corners | None = None,
        settings: ExplorerSettings = ExplorerSettings(),
        seed: int = 0,
    ) -> None:
        """
        cameras: on the arm, which looks are made with; views of other cameras can be observed all the same.
        scene: what is known without views, such as the floor.
        free_zone: low and high corner of a box declared free unless a view finds something there, such as
            the space around the arm's base [m].
        """
        check_type("settings", settings, ExplorerSettings, "ExplorerSettings")
        self.robot, self.cameras, self.scene, self.settings = robot, tuple(cameras), scene, settings
        self.map = OccupancyMap(robot, settings.map)
        if free_zone is not None:
            self.map.declare_free(free_zone)
        self._planner = load_planner("aorrtc")
        self._rng, self._seed = np.random.default_rng(seed), seed
        self._views: list[DepthView] = []
        self._goal: Goal | None = None
        self._looks = 0

    def set_goal(self, goal: ArrayLike | Goal) -> None:
        """The next goal: configurations, or poses as `rd.Problem` takes them. What was seen is kept."""
        middle = 0.5 * (self.robot.lower + self.robot.upper)
        self._goal = Problem(self.robot, NOTHING, middle, goal).goal
        self._looks = 0

    def observe(self, view: DepthView, stamp: float = 0.0) -> None:
        """Take a view into account; see `OccupancyMap.add`."""
        self.map.add(view, stamp)
        self._views = [*self._views, view][-self.settings.max_views :]

    def next(self, configuration: ArrayLike) -> Step:
        """What the arm, at rest at a configuration, shall do next.

        Raises InputError before `set_goal`, and for a configuration that is not one.
        """
        if self._goal is None:
            raise InputError("there is no goal; call set_goal first")
        q = vector("explorer", "configuration", configuration, self.robot.dof)
        if isinstance(self._goal, JointGoal) and self._at_goal(q, self._goal.positions):
            return Step(DONE, "the arm is at the goal")
        if not self._views:
            return Step(LOOK, "nothing was seen yet: observe a view from here")
        problem = Problem(self.robot, self.scene, q, self._goal, views=self._views)
        policies = (STRICT, CHANCE) if self.settings.policy == STRICT_THEN_CHANCE else (self.settings.policy,)
        step = Step(STUCK, "")
        for policy in policies:
            step = self._step(problem, policy)
            if step.kind != STUCK:
                break
        self._looks += step.kind == LOOK
        return replace(step, seen=problem.scene)

    def _at_goal(self, q: Float[ndarray, "dof"], goals: Float[ndarray, "n dof"]) -> bool:
        return bool((np.abs(goals - q).max(axis=1) < AT_GOAL).any())

    def _step(self, problem: Problem, policy: str) -> Step:
        """The step under one policy."""
        predicted = self._predicted(problem) if policy == CHANCE else None
        motion = self._motion(problem, policy, predicted)
        stated = motion.confidence if policy == CHANCE else None
        if motion.solved and (stated is None or stated >= self.settings.confidence):
            return Step(GO, _said(policy, stated), policy, motion, stated)
        if stated is not None:
            why = f"the motion's confidence is {stated:.2f}, below {self.settings.confidence:g}"
        else:
            why = motion.reason
        return self._look(problem, policy, predicted, motion, why)

    def _look(
        self,
        problem: Problem,
        policy: str,
        predicted: Float32[ndarray, "nx ny nz"] | None,
        motion: PlanResult,
        why: str,
    ) -> Step:
        """A look at what a tentative motion sweeps unseen, or why there is none."""
        if not self.cameras:
            return Step(STUCK, f"{why}; no camera is on the arm to look with", policy)
        if self._looks >= self.settings.max_looks:
            return Step(STUCK, f"{why}, after {self._looks} looks", policy)
        as_seen = replace(problem, views=())
        tentative = motion if motion.solved else self._planned(as_seen)
        if tentative.path is None:
            return Step(STUCK, f"no motion among what was seen: {tentative.reason}", policy)
        wanted = swept_unseen(self.map, tentative.path, problem.start)
        predicted = self._predicted(problem) if predicted is None else predicted
        here = voxels_in(placed_spheres(self.robot, problem.start).astype(np.float32), CARVING_MARGIN)
        closed = ~self.map.free & ~here
        for camera in self.cameras:
            looks = best_looks(self.map, as_seen.scene, camera, wanted, predicted, problem.start, self._rng)
            if policy == STRICT:
                looks = (q for q in looks if not (self._occupied_by(q) & closed).any())
            for there in islice(looks, self.settings.look_attempts):
                look = Problem(self.robot, self.scene, problem.start, there, views=self._views)
                way = self._motion(look, policy, predicted)
                stated = way.confidence if policy == CHANCE else None
                if way.solved and (stated is None or stated >= self.settings.confidence):
                    return Step(LOOK, f"{why}; look there first", policy, way, stated)
        return Step(STUCK, f"{why}; no look that would help can be reached", policy)

    def _motion(
        self, problem: Problem, policy: str, predicted: Float32[ndarray, "nx ny nz"] | None
    ) -> PlanResult:
        """A motion to the problem's goal that keeps to a policy."""
        if policy == CHANCE:
            asked = replace(problem, unknown=PADDED if predicted is None else PREDICTED)
            request = PlanRequest(self.settings.time_limit, self._seed, FIRST)
            result = plan_with_unknown_space(self._planner, asked, request, predicted)
            if result.swept_probability is not None:
                stated = confidence("predicted", result.swept_probability)
                result = replace(result, confidence=stated)
            return replace(result, problem=asked)
        goals = self._goals(problem)
        if isinstance(goals, PlanResult):
            return goals
        outside = [int((self.map.unknown & self._occupied_by(q)).sum()) for q in goals]
        goal = goals[int(np.argmin(outside))]
        obstacles = not_seen_free(self.map, self.scene, (problem.start, goal))
        scene = problem.scene.with_shapes([*problem.scene.shapes, *obstacles])
        result = self._planned(replace(problem, scene=scene, goal=JointGoal(goal[None]), views=()))
        if result.solved:
            return result
        return replace(result, reason=f"no motion within space seen free: {result.reason}")

    def _planned(self, problem: Problem) -> PlanResult:
        """A first motion in the problem's scene as it is."""
        return self._planner.plan(problem, self.settings.time_limit, self._seed, FIRST)

    def _goals(self, problem: Problem) -> Float[ndarray, "n dof"] | PlanResult:
        """The goal configurations, or the result that says why there is none."""
        if isinstance(problem.goal, JointGoal):
            return problem.goal.positions
        as_seen = replace(problem, views=())
        request = PlanRequest(self.settings.time_limit, self._seed, FIRST)
        usable = usable_start_goal(PlanningContext(self._planner.name, as_seen, request))
        return usable if isinstance(usable, PlanResult) else np.stack(usable.goals)

    def _occupied_by(self, q: Float[ndarray, "dof"]) -> Bool[ndarray, "nx ny nz"]:
        return voxels_in(placed_spheres(self.robot, q).astype(np.float32))

    def _predicted(self, problem: Problem) -> Float32[ndarray, "nx ny nz"] | None:
        """The probability that each voxel is occupied; None without the network."""
        from robotdiffuse.learning.completion import predict
        from robotdiffuse.learning.completion.coverage import covers

        if not (self.settings.predict and covers(self.robot)):
            return None
        return predict(observe(problem.views, self.robot, problem.start))


def _said(policy: str, stated: float | None) -> str:
    if policy == STRICT:
        return "a motion through space seen free alone"
    return "a motion" if stated is None else f"a motion that is free with a probability of {stated:.2f}"
