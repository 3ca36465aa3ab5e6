"""Planning in a scene that cameras saw a part of: what is taken for occupied beside what was seen.

One way for all planners: a chain of rungs, each the scene as seen with more obstacles, the most careful
first; the first that has a motion answers. So every motion keeps clear of what was seen, and of as much
beside it as lets it pass:

- padded: points seen, padded by 9 cm, by 6, by 4; then as seen.
- imagined: voxels that the completing network finds occupied with a probability above 0.05, 0.1, 0.2, 0.35,
  0.5; then as seen. Of several motions of a rung, one that sweeps little probability.
- occupied: every voxel that no view saw, and nothing after it.
- optimistic: as seen.

Start and goal are taken to be free, so space around them is carved out of these obstacles, not of what was
seen.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from robotdiffuse.collision.arrays import compile_robot, compile_scene_for
from robotdiffuse.planners.call import Call, Request
from robotdiffuse.planners.confidence import confidence
from robotdiffuse.planners.ends import usable_ends
from robotdiffuse.planners.rungs import CARVED, FINE, FINE_SHAPE, Rung, Voxels, rungs, voxels_in
from robotdiffuse.planners.swept_kernel import sweep
from robotdiffuse.problems.problem import IMAGINED, OCCUPIED, OPTIMISTIC, JointGoal, Problem
from robotdiffuse.results import PlanResult
from robotdiffuse.robots.kinematics import placed_spheres
from robotdiffuse.scenes.depth_view import UnseenPoints
from robotdiffuse.scenes.observed_volume import LOW, ObservedVolume, observe
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.types import FIRST, Path

if TYPE_CHECKING:
    from robotdiffuse.planners.base import Planner

CANDIDATES = 8
"""First motions of a rung that the one of least probability is chosen from ..."""
SAFE = 0.1
"""... unless one sweeps no more than this."""
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
        from robotdiffuse.learning.completion import imagine  # PyTorch, before the clock starts
    else:
        imagine = None
    call = Call(planner.name, problem, time_limit, seed, request)
    volume = observe(problem.views, problem.robot, problem.start)
    if imagine is not None:
        imagined = imagine(volume)
    chain = _Chain(planner, call, request, _Unseen(problem, volume, imagined))
    as_seen = replace(problem, views=())
    if problem.unseen != OPTIMISTIC:
        goals = _goals(call, as_seen)
        if isinstance(goals, PlanResult):
            return goals
        for rung in rungs(problem, volume, imagined):
            last = problem.unseen == OCCUPIED
            if not last and (1 - RESERVED) * call.time_limit - call.elapsed < LEAST * call.time_limit:
                break
            beside = _beside(problem, rung, goals)
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


def _beside(problem: Problem, rung: Rung, goals: Float[ndarray, "n dof"]) -> Problem:
    """The problem in the scene as seen with a rung's obstacles; of several goals, with those that need the
    least carving."""
    start, *ends = (placed_spheres(problem.robot, q).astype(np.float32) for q in (problem.start, *goals))
    needed = np.array([rung.touched(spheres) for spheres in ends])
    easiest = np.flatnonzero(needed == needed.min())
    obstacles = rung.obstacles(np.concatenate([start, *(ends[i] for i in easiest)]))
    scene = Scene([*problem.scene.shapes, obstacles])
    return replace(problem, scene=scene, goal=JointGoal(goals[easiest]), views=())


class _Chain:
    """The calls of a planner within a call."""

    def __init__(self, planner: "Planner", call: Call, request: Request, unseen: "_Unseen") -> None:
        self.planner, self.call, self.request, self.unseen = planner, call, request, unseen

    def best(self, problem: Problem, rung: str, until: float) -> PlanResult:
        """A motion that is there by `until` [s since the call], or the result that says why there is none.

        Where something is imagined, the shortest of those that are about as likely free as the likeliest:
        of first motions, and of one made with the time that is left.
        """
        if self.unseen.probability is None:
            result = self._attempt(problem, until, self.call.seed, self.request)
            return self.unseen.judged(result, rung) if result.solved else result
        found = list[_Motion]()
        while len(found) < CANDIDATES:
            quick = replace(self.request, until=FIRST)
            result = self._attempt(problem, until, self.call.seed + len(found), quick)
            if not result.solved and not found:
                return result
            if not result.solved:
                break
            found.append(_Motion(result, rung, self.unseen))
            if self.call.elapsed >= until or found[-1].risk <= SAFE:
                break
        if self.request.until != FIRST and self.call.elapsed < until:
            result = self._attempt(problem, until, self.call.seed, self.request)
            found += [_Motion(result, rung, self.unseen)] if result.solved else []
        likeliest = max(motion.likely for motion in found)
        likely = [motion for motion in found if motion.likely >= likeliest - AS_LIKELY]
        chosen = min(likely, key=lambda motion: motion.length)
        return replace(self.unseen.judged(chosen.result, rung), planning_time=self.call.elapsed)

    def _attempt(self, problem: Problem, until: float, seed: int, request: Request) -> PlanResult:
        call, began = self.call, self.call.elapsed
        limit = max(until - began, LEAST * call.time_limit)
        result = self.planner.attempt(problem, limit, seed, request)
        progress = tuple((began + at, length) for at, length in result.progress)
        return replace(result, planning_time=began + result.planning_time, progress=progress, seed=call.seed)


class _Motion:
    """A motion of a rung where something is imagined."""

    def __init__(self, result: PlanResult, rung: str, unseen: "_Unseen") -> None:
        assert result.path is not None
        self.result, self.length = result, result.path.length
        self.risk = unseen.risk(result.path)
        self.likely = confidence(rung, self.risk)


class _Unseen:
    """Space that no view saw, and what motions cross of it."""

    def __init__(
        self, problem: Problem, volume: ObservedVolume, imagined: Float32[ndarray, "nx ny nz"] | None
    ) -> None:
        self.problem, self.volume = problem, volume
        goals = problem.goal.positions if isinstance(problem.goal, JointGoal) else ()
        ends = [placed_spheres(problem.robot, q).astype(np.float32) for q in (problem.start, *goals)]
        unknown = volume.unknown.repeat(2, 0).repeat(2, 1).repeat(2, 2) & ~voxels_in(
            np.concatenate(ends), CARVED
        )
        self.unknown: Bool[ndarray, "nx ny nz"] = unknown
        self.probability = None if imagined is None else np.where(unknown, imagined, np.float32(0))
        """Of what is unknown, less what the arm fills at the ends."""

    def swept(self, path: Path) -> Bool[ndarray, "nx ny nz"]:
        """The unknown voxels that the arm passes through."""
        out = np.zeros(FINE_SHAPE, np.bool_)
        low, edge = np.array(LOW, np.float32), np.float32(FINE)
        sweep(compile_robot(self.problem.robot), path.positions.astype(np.float32), low, edge, out)
        return out & self.unknown

    def risk(self, path: Path) -> float:
        """Summed probability of the voxels that a motion sweeps; 0 where none is imagined."""
        return 0.0 if self.probability is None else float(self.probability[self.swept(path)].sum())

    def judged(self, result: PlanResult, rung: str) -> PlanResult:
        """The result with what is known of its motion in unseen space."""
        assert result.path is not None
        risk = None if self.probability is None else self.risk(result.path)
        return replace(
            result,
            rung=rung,
            confidence=confidence(rung, risk),
            swept_probability=risk,
            unseen_region=self.region(result.path),
        )

    def region(self, path: Path) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """The corners of a box around that connected part of the unseen space that the arm passes through
        which is likeliest to be occupied; the largest where nothing is imagined."""
        from scipy.ndimage import find_objects, label  # which takes long to import

        swept = self.swept(path)
        if not swept.any():
            return None
        parts = np.zeros(swept.shape, np.int32)
        label(swept, output=parts)
        weights = None if self.probability is None else self.probability[swept]
        part = int(np.bincount(parts[swept], weights).argmax())
        box = find_objects(parts)[part - 1]
        low, high = (np.array([getattr(side, end) for side in box]) for end in ("start", "stop"))
        return tuple((low * FINE + LOW).round(3).tolist()), tuple((high * FINE + LOW).round(3).tolist())
