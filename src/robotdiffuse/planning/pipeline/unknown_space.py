"""Planning in a scene that cameras saw a part of: what is taken for occupied beside what was seen.

One way for all planners: a chain of rungs, each the scene as seen with more obstacles, the most careful
first; the first that has a motion answers. So every motion keeps clear of what was seen, and of as much
beside it as lets it pass:

- padded: points seen, padded by 9 cm, by 6, by 4; then as seen.
- imagined: voxels that the completing network finds occupied with a probability above 0.1, 0.2, 0.35, 0.5;
  then as seen. Of several motions of a rung, one that sweeps little probability.
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
from robotdiffuse.planning.context import Call, Request
from robotdiffuse.perception.confidence import confidence
from robotdiffuse.planning.start_goal import usable_ends
from robotdiffuse.perception.assumptions import Rung, Voxels, rungs
from robotdiffuse.perception.unknown_space import UnseenSpace
from robotdiffuse.problems.problem import IMAGINED, OCCUPIED, OPTIMISTIC, JointGoal, Problem
from robotdiffuse.core.results import PlanResult
from robotdiffuse.robots.kinematics import placed_spheres
from robotdiffuse.perception.depth_view import UnseenPoints
from robotdiffuse.perception.observed_volume import observe
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.core.types import FIRST

if TYPE_CHECKING:
    from robotdiffuse.planning.planner import Planner

CANDIDATES, FEW = 8, 4
"""First motions of a rung that the one of least probability is chosen from, and how many of them at least,
unless one is safe ..."""
FAIR, SAFE = 2.0, 0.1
"""Summed probability: no more than FEW are looked for if one sweeps no more than FAIR, none once one sweeps
no more than SAFE."""
AS_LIKELY = 0.01
"""A shorter motion is taken whose confidence is less by no more than this."""
RESERVED = 0.3
"""Share of the time limit that is kept for the motion as seen, where it may be asked for."""
SHARE = 0.25
"""Of the rest that is left, for a rung that others come after."""
LEAST = 0.1
"""Share of the time limit that every call of the planner has at least."""
SHOWN = 0.2
"""Probability above which pictures show a voxel."""
AS_SEEN = "as seen"
"""The rung without any further obstacles."""


def plan_beside_unseen(
    planner: "Planner",
    problem: Problem,
    time_limit: float,
    seed: int,
    request: Request,
    imagined: Float32[ndarray, "nx ny nz"] | None = None,
) -> PlanResult:
    """A motion as the problem's policy asks for it, within the time limit [s]; see the head of this file.

    `imagined`: the probability that each fine voxel of the observed volume is occupied, in place of what the
    completing network says. The result says which rung it comes from, how likely the motion is free in truth
    and which unseen space it crosses.
    """
    if problem.unseen == IMAGINED and imagined is None:
        from robotdiffuse.learning.completion import bundled, imagine  # PyTorch, before the clock starts

        bundled()
    else:
        imagine = None
    call = Call(planner.name, problem, time_limit, seed, request)
    volume = observe(problem.views, problem.robot, problem.start)
    if imagine is not None:
        imagined = imagine(volume)
    chain = _Chain(planner, call, request, UnseenSpace(problem, volume, imagined))
    as_seen = replace(problem, views=())
    if problem.unseen != OPTIMISTIC:
        goals = _goals(call, as_seen)
        if isinstance(goals, PlanResult):
            return goals
        for rung in rungs(problem, volume, imagined):
            last = problem.unseen == OCCUPIED
            if not last and (1 - RESERVED) * call.time_limit - call.elapsed < LEAST * call.time_limit:
                break
            beside = with_rung(problem, rung, goals)
            compile_scene_for(problem.robot, beside.scene)  # no part of the rung's share of the time
            left = (1 - RESERVED) * call.time_limit - call.elapsed
            until = call.time_limit if last else call.elapsed + max(SHARE * left, LEAST * call.time_limit)
            result = chain.best(beside, rung.name, until)
            if last and not result.solved:
                why = "no motion keeps out of all space that no view saw"
                return replace(result, reason=f"{why}: {result.reason}")
            if last or result.solved:
                return result
    return chain.best(as_seen, AS_SEEN, call.time_limit)


def imagined_obstacles(problem: Problem) -> UnseenPoints:
    """What the completing network finds likely beside what the problem's views saw: for pictures."""
    from robotdiffuse.learning.completion import imagine

    volume = observe(problem.views, problem.robot, problem.start)
    arm = placed_spheres(problem.robot, problem.start).astype(np.float32)
    return Voxels("likely", imagine(volume) > SHOWN, problem).obstacles(arm)


def _goals(call: Call, as_seen: Problem) -> Float[ndarray, "n dof"] | PlanResult:
    """The goal configurations, those of a pose that are free of what was seen; or why there are none."""
    if isinstance(as_seen.goal, JointGoal):
        return as_seen.goal.positions
    ends = usable_ends(Call(call.planner, as_seen, call.time_limit, call.seed))
    return ends if isinstance(ends, PlanResult) else np.stack(ends.goals)


def with_rung(problem: Problem, rung: Rung, goals: Float[ndarray, "n dof"]) -> Problem:
    """The problem in the scene as seen with a rung's obstacles; of several goals, with those that need the
    least carving."""
    start, *ends = (placed_spheres(problem.robot, q).astype(np.float32) for q in (problem.start, *goals))
    needed = np.array([rung.touched(spheres) for spheres in ends] if len(ends) > 1 else [0])
    easiest = np.flatnonzero(needed == needed.min())
    obstacles = rung.obstacles(np.concatenate([start, *(ends[i] for i in easiest)]))
    scene = Scene([*problem.scene.shapes, obstacles])
    return replace(problem, scene=scene, goal=JointGoal(goals[easiest]), views=())


class _Chain:
    """The calls of a planner within a call."""

    def __init__(self, planner: "Planner", call: Call, request: Request, unseen: UnseenSpace) -> None:
        self.planner, self.call, self.request, self.unseen = planner, call, request, unseen

    def best(self, problem: Problem, rung: str, until: float) -> PlanResult:
        """A motion that is there by `until` [s since the call], or the result that says why there is none.

        Where something is imagined, the shortest of those that are about as likely free as the likeliest:
        of first motions, and of one made with the time that is left.
        """
        if self.unseen.probability is None:
            result = self._attempt(problem, until, self.call.seed, self.request)
            return _Motion(result, rung, self.unseen).result if result.solved else result
        found = list[_Motion]()
        while len(found) < CANDIDATES:
            quick = replace(self.request, until=FIRST)
            result = self._attempt(problem, until, self.call.seed + len(found), quick)
            if not result.solved and not found:
                return result
            if not result.solved:
                break
            found.append(_Motion(result, rung, self.unseen))
            least = min(motion.risk or 0.0 for motion in found)
            if self.call.elapsed >= until or least <= (FAIR if len(found) >= FEW else SAFE):
                break
        if self.request.until != FIRST and self.call.elapsed < until:
            result = self._attempt(problem, until, self.call.seed, self.request)
            found += [_Motion(result, rung, self.unseen)] if result.solved else []
        likeliest = max(motion.likely for motion in found)
        likely = [motion for motion in found if motion.likely >= likeliest - AS_LIKELY]
        chosen = min(likely, key=lambda motion: motion.length)
        return replace(chosen.result, planning_time=self.call.elapsed)

    def _attempt(self, problem: Problem, until: float, seed: int, request: Request) -> PlanResult:
        call, began = self.call, self.call.elapsed
        limit = max(until - began, LEAST * call.time_limit)
        result = self.planner.attempt(problem, limit, seed, request)
        progress = tuple((began + at, length) for at, length in result.progress)
        return replace(result, planning_time=began + result.planning_time, progress=progress, seed=call.seed)


class _Motion:
    """A motion of a rung, and what it crosses of unseen space."""

    def __init__(self, result: PlanResult, rung: str, unseen: UnseenSpace) -> None:
        assert result.path is not None
        self._result, self._rung, self.length = result, rung, result.path.length
        self._crossed = unseen.crossed(result.path)
        self.risk = self._crossed.risk
        self.likely = confidence(rung, self.risk)

    @property
    def result(self) -> PlanResult:
        """With what is known of the motion in unseen space."""
        return replace(
            self._result,
            rung=self._rung,
            confidence=self.likely,
            swept_probability=self.risk,
            unseen_region=self._crossed.region,
        )
