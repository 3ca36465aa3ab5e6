"""Motions of an Explorer by chance: among what was seen and predicted, with the confidence that they are
free."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from robotdiffuse.core.results import PlanResult
from robotdiffuse.perception.occupancy_map import OccupancyMap
from robotdiffuse.perception.unknown_space import UnknownSpace, explored_confidence
from robotdiffuse.perception.voxel_grid import LAYERS_BELOW, MAP
from robotdiffuse.planning.context import PlanRequest
from robotdiffuse.planning.pipeline.unknown_space import plan_with_unknown_space
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems.problem import PADDED, PREDICTED, JointGoal, Problem


def planned_by_chance(
    planner: Planner,
    known: OccupancyMap,
    problem: Problem,
    predicted: Float32[ndarray, "nx ny nz"] | None,
    request: PlanRequest,
    to_goal: bool = True,
) -> PlanResult:
    """A motion among what was seen and predicted, with its confidence; see `with_confidence`.

    predicted: the probability that each voxel of the map is occupied; None without the network.
    to_goal: whether the problem's goal is the Explorer's, not where a look ends.
    """
    asked = replace(problem, unknown=PADDED if predicted is None else PREDICTED)
    goals = problem.goal.positions if to_goal and isinstance(problem.goal, JointGoal) else ()
    unknown = _unknown(known, problem, np.stack([problem.start, *goals]), predicted)
    above = None if predicted is None else predicted[:, :, LAYERS_BELOW:]
    result = plan_with_unknown_space(planner, asked, request, above, unknown)
    return replace(with_confidence(known, problem, result, predicted, to_goal), problem=asked)


def with_confidence(
    known: OccupancyMap,
    problem: Problem,
    motion: PlanResult,
    predicted: Float32[ndarray, "nx ny nz"] | None,
    to_goal: bool = True,
) -> PlanResult:
    """The motion with the confidence that follows from the probability that it sweeps; None if the map holds
    no measurement. The arm is taken to be
    free where a motion begins, and at the goal, but not where a look ends."""
    if motion.path is None or predicted is None:
        return motion
    ends = motion.path.positions[[0, -1] if to_goal else [0]]
    swept = _unknown(known, problem, ends, predicted).crossed(motion.path).risk
    stated = None if swept is None or known.is_blind else explored_confidence(swept)
    return replace(motion, swept_probability=swept, confidence=stated)


def _unknown(
    known: OccupancyMap,
    problem: Problem,
    ends: Float[ndarray, "n dof"],
    predicted: Float32[ndarray, "nx ny nz"] | None,
) -> UnknownSpace:
    """What the map does not know, without the voxels that the arm fills at these configurations."""
    return UnknownSpace(problem.robot, ends, known.unknown, predicted, 0.0, MAP)
