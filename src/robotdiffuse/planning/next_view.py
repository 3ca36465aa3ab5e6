"""The next best view: the camera pose that sees most of the unknown space that a motion crosses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.core.bounds import Value, rigid_transform
from robotdiffuse.core.errors import InputError, check_type
from robotdiffuse.core.results import PlanResult
from robotdiffuse.perception.observed_volume import observe
from robotdiffuse.perception.ray_caster import looking_at
from robotdiffuse.perception.visibility import seen_weights
from robotdiffuse.perception.voxel_grid import FINE_VOXEL_SIZE, LOW, refined
from robotdiffuse.planning.pipeline.unknown_space import policy_for, unknown_space_of
from robotdiffuse.problems.problem import PREDICTED, Problem, check_problem

RING_RADIUS = 1.6
"""Distance of the default camera poses from the base's axis [m]."""
RING_HEIGHTS = (0.5, 0.95, 1.4)
"""Heights of the default camera poses [m]."""
POSES_PER_RING = 16
"""Number of default camera poses at each height."""
TARGET = (0.0, 0.0, 0.3)
"""The point that the default camera poses look at [m]."""
MIN_PROBABILITY = 1e-3
"""Voxels less likely occupied than this are ignored."""


@dataclass(frozen=True, eq=False)
class NextView(Value):
    """A camera pose, and how much of the crossed unknown space it sees."""

    T_base_camera: Float[ndarray, "4 4"]
    seen: float
    """Expected part of the summed probability that a camera there sees, from 0 to 1."""


def poses_around() -> list[Float[ndarray, "4 4"]]:
    """Camera poses around the base, looking at the arm."""
    angles = 2 * np.pi * np.arange(POSES_PER_RING) / POSES_PER_RING
    ring = RING_RADIUS * np.column_stack([np.cos(angles), np.sin(angles)])
    places = [(x, y, height) for height in RING_HEIGHTS for x, y in ring]
    return [looking_at(np.array(place), np.array(TARGET)) for place in places]


def next_view(
    problem: Problem, result: PlanResult, poses: Sequence[Float[ndarray, "4 4"]] | None = None
) -> NextView:
    """The pose from which a camera like that of the first view sees most of the probability that the motion
    of a result sweeps.

    poses: camera poses to choose from, T_base_camera each; None: `poses_around`.

    A voxel counts by the chance that nothing hides it: neither what was seen, nor what is predicted, nor the
    arm at the problem's start. With a policy other than "predicted", all swept unknown voxels count the same.

    Raises InputError without views, without a motion and without poses.
    """
    check_problem(problem)
    check_type("result", result, PlanResult, "a PlanResult, as of rd.plan")
    if not problem.views:
        raise InputError("next_view: the problem has no views; it is for scenes that cameras saw")
    if result.path is None:
        raise InputError(f"next_view: the result has no motion ({result.status.value})")
    candidates = (
        poses_around() if poses is None else [rigid_transform("next_view: T_base_camera", T) for T in poses]
    )
    if not candidates:
        raise InputError("next_view: poses is empty; at least one camera pose is needed")
    volume = observe(problem.views, problem.robot, problem.start)
    predicted = None
    if policy_for(problem)[0] == PREDICTED:
        from robotdiffuse.learning.completion import predict

        predicted = predict(volume)
    crossed = unknown_space_of(problem, volume, predicted).crossed(result.path)
    likely = crossed.voxels.astype(np.float32)
    if crossed.probability is not None:
        likely *= crossed.probability
    at = np.argwhere(likely > MIN_PROBABILITY)
    weights = likely[tuple(at.T)]
    if not len(at):
        return NextView(candidates[0], 1.0)
    filled = refined(volume.occupied).astype(np.float32)
    if predicted is not None:
        np.maximum(filled, predicted, out=filled)
    image = problem.views[0]
    start = problem.start.astype(np.float32)
    seen = seen_weights(
        compile_robot(problem.robot),
        np.tile(start, (len(candidates), 1)),
        np.stack(candidates).astype(np.float32),
        np.array(image.intrinsics, np.float32),
        image.depth.shape,
        np.float32(np.inf),
        at,
        weights,
        filled,
        np.array(LOW, np.float32),
        np.float32(FINE_VOXEL_SIZE),
    )
    best = int(seen.argmax())
    return NextView(candidates[best], float(seen[best] / weights.sum()))
