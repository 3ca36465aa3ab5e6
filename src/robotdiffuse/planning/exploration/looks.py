"""Where to look: configurations from which the arm's camera sees what a motion would sweep."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.core.types import Path
from robotdiffuse.perception.assumptions import CARVING_MARGIN, FINE_SHAPE, FINE_VOXEL_SIZE, voxels_in
from robotdiffuse.perception.observed_volume import LOW
from robotdiffuse.perception.occupancy_map import OccupancyMap
from robotdiffuse.perception.swept_voxels_kernel import sweep
from robotdiffuse.perception.visibility_kernel import seen_weights
from robotdiffuse.planning.exploration.cameras import ArmCamera
from robotdiffuse.robots.kinematics import placed_spheres
from robotdiffuse.scenes.scene import Scene

CONFIGURATIONS = 900
"""Random configurations that a look is chosen from."""
SPREADS = (0.3, 0.8, 2.0)
"""Standard deviations of their distances from the arm's configuration, in equal parts [rad]."""
MAX_VOXELS = 1500
"""Most swept voxels from which looks are scored."""
FULL_COST_LENGTH = 3.0
"""A look this far away counts half [rad, joint-space L2]."""
UNSEEN_WEIGHT = 0.05
"""Weight of a swept voxel that is surely free, by the prediction; one that is surely occupied has 1 more."""
MIN_SEEN = 0.02
"""Looks that see a smaller part of the weight are of no use."""


def swept_unseen(known: OccupancyMap, path: Path, start: Float[ndarray, "dof"]) -> Bool[ndarray, "nx ny nz"]:
    """The voxels that a path sweeps and that the map does not know to be free, without those at the start."""
    swept = np.zeros(FINE_SHAPE, np.bool_)
    positions = path.positions.astype(np.float32)
    sweep(
        compile_robot(known.robot), positions, np.array(LOW, np.float32), np.float32(FINE_VOXEL_SIZE), swept
    )
    here = voxels_in(placed_spheres(known.robot, start).astype(np.float32), CARVING_MARGIN)
    return swept & ~known.free & ~here


def best_looks(
    known: OccupancyMap,
    scene: Scene,
    camera: ArmCamera,
    wanted: Bool[ndarray, "nx ny nz"],
    probability: Float32[ndarray, "nx ny nz"] | None,
    start: Float[ndarray, "dof"],
    rng: np.random.Generator,
) -> Iterator[Float[ndarray, "dof"]]:
    """Configurations from which the camera sees wanted voxels, the best first: weighted by the prediction if
    there is one, against the way to get there.

    scene: the arm does not collide with it at the configurations. A voxel counts by the chance that nothing
    hides it: neither what is occupied nor what is predicted.
    """
    robot = known.robot
    at = np.argwhere(wanted)
    if not len(at):
        return
    weights = np.full(len(at), UNSEEN_WEIGHT, np.float32)
    filled = known.occupied.astype(np.float32)
    if probability is not None:
        weights += probability[tuple(at.T)]
        np.maximum(filled, np.where(known.free, np.float32(0), probability), out=filled)
    if len(at) > MAX_VOXELS:
        chosen = rng.choice(len(at), MAX_VOXELS, replace=False)
        at, weights = at[chosen], weights[chosen]
    spread = np.repeat(SPREADS, -(-CONFIGURATIONS // len(SPREADS)))[:, None]
    q = np.clip(start + spread * rng.standard_normal((len(spread), robot.dof)), robot.lower, robot.upper)
    q = q[CollisionChecker(robot, scene).free(q)]
    if not len(q):
        return
    width, height = camera.size
    seen = (
        seen_weights(
            camera.poses(robot, q).astype(np.float32),
            np.array(camera.intrinsics, np.float32),
            (height, width),
            at,
            weights,
            filled,
            np.array(LOW, np.float32),
            np.float32(FINE_VOXEL_SIZE),
        )
        / weights.sum()
    )
    score = seen / (1 + np.linalg.norm(q - start, axis=1) / FULL_COST_LENGTH)
    for best in np.argsort(-score, kind="stable"):
        if seen[best] < MIN_SEEN:
            continue
        yield q[best]
