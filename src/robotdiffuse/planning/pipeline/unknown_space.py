"""Planning in a scene that cameras saw a part of: what is taken for occupied beside what was seen.

One way for all planners: a chain of assumptions, each the scene as seen with more obstacles, the most careful
first; the first that has a motion answers. So every motion keeps clear of what was seen, and of as much
beside it as lets it pass:

- padded: points seen, padded by 9 cm, by 6, by 4; then as seen.
- predicted: voxels that the completing network finds occupied with a probability above 0.1, 0.2, 0.35, 0.5;
  then as seen. Of several motions of an assumption, one that sweeps little probability.
- occupied: every voxel that no view saw, and nothing after it.
- optimistic: as seen.

Start and goal are taken to be free, so space around them is carved out of these obstacles, not of what was
seen.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_scene_for
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.types import FIRST
from robotdiffuse.perception.assumptions import Assumption, Voxels, assumptions
from robotdiffuse.perception.confidence import confidence
from robotdiffuse.perception.depth_view import AssumedPoints
from robotdiffuse.perception.observed_volume import observe
from robotdiffuse.perception.unknown_space import UnknownSpace
from robotdiffuse.planning.context import PlanningContext, Request
from robotdiffuse.planning.start_goal import usable_start_goal
from robotdiffuse.problems.problem import OCCUPIED, OPTIMISTIC, PREDICTED, JointGoal, Problem
from robotdiffuse.robots.kinematics import placed_spheres
from robotdiffuse.scenes.scene import Scene

if TYPE_CHECKING:
    from robotdiffuse.planning.planner import Planner

CANDIDATES, FEW = 8, 4
"""First motions of an assumption that the one of least probability is chosen from, and how many of them at least,
unless one is safe ..."""
FAIR, SAFE = 2.0, 0.1
"""Summed probability: no more than FEW are looked for if one sweeps no more than FAIR, none once one sweeps
no more than SAFE."""
AS_LIKELY = 0.01
"""A shorter motion is taken whose confidence is less by no more than this."""
RESERVED = 0.3
"""Share of the time limit that is kept for the motion as seen, where it may be asked for."""
SHARE = 0.25
"""Of the rest that is left, for an assumption that others come after."""
LEAST = 0.1
"""Share of the time limit that every call of the planner has at least."""
SHOWN = 0.2
"""Probability above which pictures show a voxel."""
AS_SEEN = "as seen"
"""The assumption without any further obstacles."""


def plan_with_unknown_space(
    planner: "Planner",
    problem: Problem,
    time_limit: float,
    seed: int,
    request: Request,
    predicted: Float32[ndarray, "nx ny nz"] | None = None,
) -> PlanResult:
    """A motion as the problem's policy asks for it, within the time limit [s]; see the head of this file.

    `predicted`: the probability that each fine voxel of the observed volume is occupied, in place of what the
    completing network says. The result says which assumption it comes from, how likely the motion is free in truth
    and which unknown space it crosses.
    """
    if problem.unknown == PREDICTED and predicted is None:
        from robotdiffuse.learning.completion import bundled, predict  # PyTorch, before the clock starts

        bundled()
    else:
        predict = None
    context = PlanningContext(planner.name, problem, time_limit, seed, request)
    volume = observe(problem.views, problem.robot, problem.start)
    if predict is not None:
        predicted = predict(volume)
    chain = _Chain(planner, context, request, UnknownSpace(problem, volume, predicted))
    as_seen = replace(problem, views=())
    if problem.unknown != OPTIMISTIC:
        goals = _goals(context, as_seen)
        if isinstance(goals, PlanResult):
            return goals
        for assumption in assumptions(problem, volume, predicted):
            last = problem.unknown == OCCUPIED
            if (
                not last
                and (1 - RESERVED) * context.time_limit - context.elapsed < LEAST * context.time_limit
            ):
                break
            beside = with_assumption(problem, assumption, goals)
            compile_scene_for(problem.robot, beside.scene)  # no part of the assumption's share of the time
            left = (1 - RESERVED) * context.time_limit - context.elapsed
            until = (
                context.time_limit
                if last
                else context.elapsed + max(SHARE * left, LEAST * context.time_limit)
            )
            result = chain.best(beside, assumption.name, until)
            if last and not result.solved:
                why = "no motion keeps out of all space that no view saw"
                return replace(result, reason=f"{why}: {result.reason}")
            if last or result.solved:
                return result
    return chain.best(as_seen, AS_SEEN, context.time_limit)


def predicted_obstacles(problem: Problem) -> AssumedPoints:
    """What the completing network finds likely beside what the problem's views saw: for pictures."""
    from robotdiffuse.learning.completion import predict

    volume = observe(problem.views, problem.robot, problem.start)
    arm = placed_spheres(problem.robot, problem.start).astype(np.float32)
    return Voxels("likely", predict(volume) > SHOWN, problem).obstacles(arm)


def _goals(context: PlanningContext, as_seen: Problem) -> Float[ndarray, "n dof"] | PlanResult:
    """The goal configurations, those of a pose that are free of what was seen; or why there are none."""
    if isinstance(as_seen.goal, JointGoal):
        return as_seen.goal.positions
    start_goal = usable_start_goal(
        PlanningContext(context.planner, as_seen, context.time_limit, context.seed)
    )
    return start_goal if isinstance(start_goal, PlanResult) else np.stack(start_goal.goals)


def with_assumption(problem: Problem, assumption: Assumption, goals: Float[ndarray, "n dof"]) -> Problem:
    """The problem in the scene as seen with an assumption's obstacles; of several goals, with those that need the
    least carving."""
    start, *start_goal = (
        placed_spheres(problem.robot, q).astype(np.float32) for q in (problem.start, *goals)
    )
    needed = np.array([assumption.touched(spheres) for spheres in start_goal] if len(start_goal) > 1 else [0])
    easiest = np.flatnonzero(needed == needed.min())
    obstacles = assumption.obstacles(np.concatenate([start, *(start_goal[i] for i in easiest)]))
    scene = Scene([*problem.scene.shapes, obstacles])
    return replace(problem, scene=scene, goal=JointGoal(goals[easiest]), views=())


class _Chain:
    """The calls of a planner within a call."""

    def __init__(
        self, planner: "Planner", context: PlanningContext, request: Request, unknown: UnknownSpace
    ) -> None:
        self.planner, self.context, self.request, self.unknown = planner, context, request, unknown

    def best(self, problem: Problem, assumption: str, until: float) -> PlanResult:
        """A motion that is there by `until` [s since the call], or the result that says why there is none.

        Where something is predicted, the shortest of those that are about as likely free as the likeliest:
        of first motions, and of one made with the time that is left.
        """
        if self.unknown.probability is None:
            result = self._attempt(problem, until, self.context.seed, self.request)
            return _Motion(result, assumption, self.unknown).result if result.solved else result
        found = list[_Motion]()
        while len(found) < CANDIDATES:
            quick = replace(self.request, until=FIRST)
            result = self._attempt(problem, until, self.context.seed + len(found), quick)
            if not result.solved and not found:
                return result
            if not result.solved:
                break
            found.append(_Motion(result, assumption, self.unknown))
            least = min(motion.risk or 0.0 for motion in found)
            if self.context.elapsed >= until or least <= (FAIR if len(found) >= FEW else SAFE):
                break
        if self.request.until != FIRST and self.context.elapsed < until:
            result = self._attempt(problem, until, self.context.seed, self.request)
            found += [_Motion(result, assumption, self.unknown)] if result.solved else []
        likeliest = max(motion.likely for motion in found)
        likely = [motion for motion in found if motion.likely >= likeliest - AS_LIKELY]
        chosen = min(likely, key=lambda motion: motion.length)
        return replace(chosen.result, planning_time=self.context.elapsed)

    def _attempt(self, problem: Problem, until: float, seed: int, request: Request) -> PlanResult:
        context, began = self.context, self.context.elapsed
        limit = max(until - began, LEAST * context.time_limit)
        result = self.planner.attempt(problem, limit, seed, request)
        progress = tuple((began + at, length) for at, length in result.progress)
        return replace(
            result, planning_time=began + result.planning_time, progress=progress, seed=context.seed
        )


class _Motion:
    """A motion of an assumption, and what it crosses of unknown space."""

    def __init__(self, result: PlanResult, assumption: str, unknown: UnknownSpace) -> None:
        assert result.path is not None
        self._result, self._rung, self.length = result, assumption, result.path.length
        self._crossed = unknown.crossed(result.path)
        self.risk = self._crossed.risk
        self.likely = confidence(assumption, self.risk)

    @property
    def result(self) -> PlanResult:
        """With what is known of the motion in unknown space."""
        return replace(
            self._result,
            assumption=self._rung,
            confidence=self.likely,
            swept_probability=self.risk,
            unknown_region=self._crossed.region,
        )
