"""Where to look next: the camera pose that sees most of what a motion may run into."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.bounds import Value, rigid_transform
from robotdiffuse.core.errors import InputError, check_type
from robotdiffuse.core.results import PlanResult
from robotdiffuse.perception.assumptions import FINE, fine, voxels_in
from robotdiffuse.perception.observed_volume import LOW, observe
from robotdiffuse.perception.ray_caster import looking_at
from robotdiffuse.perception.unknown_space import UnknownSpace
from robotdiffuse.perception.visibility_kernel import seen_weights
from robotdiffuse.problems.problem import PREDICTED, Problem, check_problem
from robotdiffuse.robots.kinematics import placed_spheres

RING = 1.6
"""Distance of the camera poses that are tried by themselves from the base's axis [m] ..."""
HEIGHTS = (0.5, 0.95, 1.4)
"""... their heights [m] ..."""
BEARINGS = 16
"""... how many of each height ..."""
TARGET = (0.0, 0.0, 0.3)
"""... and what they look at [m]."""
LEAST = 1e-3
"""Voxels that are less likely occupied do not count."""


@dataclass(frozen=True, eq=False)
class NextView(Value):
    """A camera pose, and what it is worth."""

    T_base_camera: Float[ndarray, "4 4"]
    seen: float
    """The share of what the motion may run into that a camera there sees, as far as is known."""


def poses_around() -> list[Float[ndarray, "4 4"]]:
    """Camera poses around the base, looking at the arm."""
    angles = 2 * np.pi * np.arange(BEARINGS) / BEARINGS
    places = [(RING * np.cos(a), RING * np.sin(a), height) for height in HEIGHTS for a in angles]
    return [looking_at(np.array(place), np.array(TARGET)) for place in places]


def next_view(
    problem: Problem, result: PlanResult, poses: Sequence[Float[ndarray, "4 4"]] | None = None
) -> NextView:
    """The pose from which a camera like that of the first view sees most of the probability that the motion
    of a result sweeps.

    `poses`: those that can be reached, T_base_camera each; None: `poses_around`. A voxel counts as seen as
    far as nothing is likely to be in the way: neither what was seen, nor what is predicted, nor the arm at
    the problem's start. With another policy than `predicted`, each unknown voxel that is swept counts the same.
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
    if problem.unknown == PREDICTED:
        from robotdiffuse.learning.completion import predict

        predicted = predict(volume)
    crossed = UnknownSpace(problem, volume, predicted).crossed(result.path)
    likely = crossed.voxels.astype(np.float32)
    if crossed.probability is not None:
        likely *= crossed.probability
    at = np.argwhere(likely > LEAST)
    weights = likely[tuple(at.T)]
    if not len(at):
        return NextView(candidates[0], 1.0)
    filled = fine(volume.occupied).astype(np.float32)
    if predicted is not None:
        np.maximum(filled, predicted, out=filled)
    filled[voxels_in(placed_spheres(problem.robot, problem.start).astype(np.float32))] = 1.0
    image = problem.views[0]
    seen = seen_weights(
        np.stack(candidates).astype(np.float32),
        np.array(image.intrinsics, np.float32),
        image.depth.shape,
        at,
        weights,
        filled,
        np.array(LOW, np.float32),
        np.float32(FINE),
    )
    best = int(seen.argmax())
    return NextView(candidates[best], float(seen[best] / weights.sum()))
