"""Explorer: takes an arm to goals through space that cameras see on the way.

**Strict.** The arm enters no voxel that was not seen free: the validator accepts each motion among obstacles
that cover all other space (`seen_free.py`). Exempt is the space within 2 cm of the arm where a motion begins
and ends; seen points count there too. So the promise is as good as the map: in a scene that does not change,
with a camera whose poses and errors are as stated, such a motion meets nothing.

**Chance.** The arm goes if the motion's stated `confidence` is high enough, and looks first if it is not.

Looks are chosen by what a tentative motion, planned among what was seen alone, would sweep unseen. A look's
own motion is subject to the same policy; by chance, a strict one will do where none is confident enough.
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
from robotdiffuse.core.types import FIRST, Trajectory
from robotdiffuse.perception.assumptions import FINE_SHAPE, voxels_in
from robotdiffuse.perception.confidence import confidence
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.observed_volume import observe
from robotdiffuse.perception.occupancy_map import Corners, MapSettings, OccupancyMap
from robotdiffuse.planning import load_planner
from robotdiffuse.planning.context import PlanningContext, PlanRequest
from robotdiffuse.planning.exploration.cameras import ArmCamera
from robotdiffuse.planning.exploration.looks import best_looks, swept_unseen
from robotdiffuse.planning.exploration.seen_free import cover, near_ends, not_seen_free
from robotdiffuse.planning.exploration.stopping import Stop, stop_before
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
QUICK_FRACTION = 0.3
"""Part of the time limit for a search within space seen free that a look, or another search, may follow."""
TENTATIVE_MOTIONS = 6
"""Motions among what was seen, of which looks are made for the one that sweeps the least unseen."""
MAX_LOOKS_FOR = 2
"""Voxels that this many looks did not show are avoided by the motions that looks are made for."""
WAY_BACK_SHARES = (0.25, 0.5, 1.0)
"""Parts of the way in that the arm may go back."""
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
        self._looked_for = np.zeros(FINE_SHAPE, np.uint8)
        """How many looks were made for each voxel."""
        self._way_in: Float[ndarray, "n dof"] | None = None
        """Waypoints of the latest motion that was returned."""
        self._news: list[DepthView] = []
        """Views since the latest step."""
        self._free = self.map.free
        """Voxels that were free then."""

    def set_goal(self, goal: ArrayLike | Goal) -> None:
        """The next goal: configurations, or poses as `rd.Problem` takes them. What was seen is kept."""
        middle = 0.5 * (self.robot.lower + self.robot.upper)
        self._goal = Problem(self.robot, NOTHING, middle, goal).goal
        self._looks = 0
        self._looked_for[:] = 0

    def observe(self, view: DepthView, stamp: float = 0.0) -> None:
        """Take a view into account; see `OccupancyMap.add`."""
        self.map.add(view, stamp)
        self._views = [*self._views, view][-self.settings.max_views :]
        self._news.append(view)

    def next(self, configuration: ArrayLike) -> Step:
        """What the arm, at rest at a configuration, shall do next.

        Raises InputError before `set_goal`, and for a configuration that is not one.
        """
        if self._goal is None:
            raise InputError("there is no goal; call set_goal first")
        q = vector("explorer", "configuration", configuration, self.robot.dof)
        self._news, self._free = [], self.map.free
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
        if step.motion is not None and step.motion.path is not None:
            self._way_in = step.motion.path.positions
        return replace(step, seen=problem.scene)

    def stop(self, motion: Trajectory, time: float) -> Stop | None:
        """How a motion under way ends early, if what was observed since `next` returned it is in its way;
        None if it is not. time: when a new command takes effect, on the motion's clock [s]. After the stop,
        ask `next` again. See `stopping.stop_before`.
        """
        return stop_before(self.robot, self.scene, self._news, self._free, motion, time)

    def _at_goal(self, q: Float[ndarray, "dof"], goals: Float[ndarray, "n dof"]) -> bool:
        return bool((np.abs(goals - q).max(axis=1) < AT_GOAL).any())

    def _step(self, problem: Problem, policy: str) -> Step:
        """The step under one policy."""
        predicted = self._predicted(problem) if policy == CHANCE else None
        may_look = bool(self.cameras) and self._looks < self.settings.max_looks
        limit = self.settings.time_limit
        quick = may_look and policy == STRICT
        motion = self._motion(problem, policy, predicted, self._quick_limit if quick else limit)
        if self._good(motion, policy):
            return self._go(motion, policy)
        look = self._look(problem, policy, predicted, motion)
        if look.kind == STUCK and quick:
            motion = self._motion(problem, policy, predicted, limit)
            if motion.solved:
                return self._go(motion, policy)
        return look

    def _good(self, motion: PlanResult, policy: str) -> bool:
        """Whether a motion keeps to the policy."""
        if not motion.solved or policy == STRICT:
            return motion.solved
        return motion.confidence is not None and motion.confidence >= self.settings.confidence

    def _go(self, motion: PlanResult, policy: str) -> Step:
        stated = motion.confidence if policy == CHANCE else None
        return Step(GO, _said(stated), policy, motion, stated)

    def _look(
        self,
        problem: Problem,
        policy: str,
        predicted: Float32[ndarray, "nx ny nz"] | None,
        motion: PlanResult,
    ) -> Step:
        """A look at what a tentative motion sweeps unseen, or why there is none. `motion`: the one to the
        goal that does not keep to the policy."""
        why = motion.reason
        if motion.solved:
            why = f"the motion's confidence is {motion.confidence:.2f}, below {self.settings.confidence:g}"
        if not self.cameras:
            return Step(STUCK, f"{why}; no camera is on the arm to look with", policy)
        if self._looks >= self.settings.max_looks:
            return Step(STUCK, f"{why}, after {self._looks} looks", policy)
        as_seen = replace(problem, views=())
        wanted = swept_unseen(self.map, motion.path) if motion.path else self._least_unseen(as_seen)
        if isinstance(wanted, str):
            return Step(STUCK, f"no motion among what was seen: {wanted}", policy)
        predicted = self._predicted(problem) if predicted is None else predicted
        allowed = as_seen.scene
        if policy == STRICT:
            obstacles = not_seen_free(self.map, self.scene, (problem.start,))
            allowed = as_seen.scene.with_shapes([*as_seen.scene.shapes, *obstacles])
        for camera in self.cameras:
            looks = best_looks(self.map, allowed, camera, wanted, predicted, problem.start, self._rng)
            for there in islice(looks, self.settings.look_attempts):
                look = replace(problem, goal=JointGoal(there[None]))
                if policy == STRICT:
                    way = self._planned(replace(look, scene=allowed, views=()), self._quick_limit)
                else:
                    way = self._by_chance(look, predicted, self.settings.time_limit)
                if self._good(way, policy):
                    stated = way.confidence if policy == CHANCE else None
                    self._looked_for += wanted
                    return Step(LOOK, f"{why}; look there first", policy, way, stated)
        if policy == self.settings.policy == CHANCE:
            strict = self._look(problem, STRICT, predicted, motion)
            if strict.kind == LOOK:
                return strict
        back = self._way_back(problem) if policy == STRICT else None
        if back is not None:
            return Step(LOOK, f"{why}; back on the way in, to look from there", policy, back)
        return Step(STUCK, f"{why}; no look that would help can be reached", policy)

    def _way_back(self, problem: Problem) -> PlanResult | None:
        """A motion that leaves by the way in, as far as there is more room; None if there is none."""
        way = self._way_in
        if way is None or np.abs(way[-1] - problem.start).max() > AT_GOAL:
            return None
        for share in WAY_BACK_SHARES:
            waypoints = _first_part(way[::-1], share)
            obstacles = not_seen_free(self.map, self.scene, (problem.start, waypoints[-1]))
            scene = problem.scene.with_shapes([*problem.scene.shapes, *obstacles])
            leaving = replace(problem, scene=scene, goal=JointGoal(waypoints[-1:]), views=())
            context = PlanningContext(self._planner.name, leaving, PlanRequest(self.settings.time_limit))
            found = context.finish(waypoints, "the way in", "back on the way in")
            if found is not None:
                return replace(found, problem=leaving)
        return None

    def _least_unseen(self, as_seen: Problem) -> Bool[ndarray, "nx ny nz"] | str:
        """What a motion among what was seen sweeps unseen: the least of several motions, which avoid voxels
        that looks were made for in vain if they can; or why there is none."""
        goals = as_seen.goal.positions if isinstance(as_seen.goal, JointGoal) else ()
        ends = near_ends(self.map, (as_seen.start, *goals))
        in_vain = np.argwhere((self._looked_for >= MAX_LOOKS_FOR) & self.map.unknown & ~ends)
        avoided = cover(self.map, self.scene, in_vain, "looked for in vain")
        avoiding = replace(as_seen, scene=as_seen.scene.with_shapes([*as_seen.scene.shapes, avoided]))
        best = reason = None
        for i in range(TENTATIVE_MOTIONS):
            tentative = self._planned(avoiding, self._quick_limit, self._seed + i)
            if tentative.path is None and best is None:
                avoiding = as_seen
                tentative = self._planned(as_seen, self.settings.time_limit, self._seed + i)
            if tentative.path is None:
                reason = tentative.reason
                break
            wanted = swept_unseen(self.map, tentative.path)
            if best is None or wanted.sum() < best.sum():
                best = wanted
        return best if best is not None else str(reason)

    @property
    def _quick_limit(self) -> float:
        return QUICK_FRACTION * self.settings.time_limit

    def _motion(
        self,
        problem: Problem,
        policy: str,
        predicted: Float32[ndarray, "nx ny nz"] | None,
        limit: float,
    ) -> PlanResult:
        """A motion to the problem's goal by a policy, found within a time limit [s]."""
        if policy == CHANCE:
            return self._by_chance(problem, predicted, limit)
        goals = self._goals(problem)
        if isinstance(goals, PlanResult):
            return goals
        outside = [int((self.map.unknown & self._occupied_by(q)).sum()) for q in goals]
        goal = goals[int(np.argmin(outside))]
        obstacles = not_seen_free(self.map, self.scene, (problem.start, goal))
        scene = problem.scene.with_shapes([*problem.scene.shapes, *obstacles])
        result = self._planned(replace(problem, scene=scene, goal=JointGoal(goal[None]), views=()), limit)
        if result.solved:
            return result
        return replace(result, reason=f"no motion within space seen free: {result.reason}")

    def _by_chance(
        self, problem: Problem, predicted: Float32[ndarray, "nx ny nz"] | None, limit: float
    ) -> PlanResult:
        """A motion among what was seen and predicted, with its confidence."""
        asked = replace(problem, unknown=PADDED if predicted is None else PREDICTED)
        request = PlanRequest(limit, self._seed, FIRST)
        result = plan_with_unknown_space(self._planner, asked, request, predicted)
        if result.swept_probability is not None:
            stated = confidence("predicted", result.swept_probability)
            result = replace(result, confidence=stated)
        return replace(result, problem=asked)

    def _planned(self, problem: Problem, limit: float, seed: int | None = None) -> PlanResult:
        """A first motion in the problem's scene as it is, found within a time limit [s]."""
        return self._planner.plan(problem, limit, self._seed if seed is None else seed, FIRST)

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


def _first_part(waypoints: Float[ndarray, "n dof"], share: float) -> Float[ndarray, "m dof"]:
    """The part of a path before a share of its length."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1))])
    end = share * at[-1]
    last = np.array([np.interp(end, at, joint) for joint in waypoints.T])
    return np.concatenate([waypoints[at < end], last[None]])


def _said(stated: float | None) -> str:
    if stated is None:
        return "a motion through space seen free alone"
    return f"a motion that is free with a probability of {stated:.2f}"
