"""Where to look: configurations from which the arm's camera sees what a motion would sweep."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.core.types import Path
from robotdiffuse.perception.assumptions import FINE_SHAPE, FINE_VOXEL_SIZE
from robotdiffuse.perception.observed_volume import LOW
from robotdiffuse.perception.occupancy_map import OccupancyMap
from robotdiffuse.perception.swept_voxels_kernel import sweep
from robotdiffuse.perception.visibility_kernel import seen_weights
from robotdiffuse.planning.exploration.cameras import ArmCamera
from robotdiffuse.planning.exploration.seen_free import COVER_RADIUS, near_ends
from robotdiffuse.scenes.scene import Scene

CONFIGURATIONS = 900
"""Random configurations that a look is chosen from, at first."""
SPREADS = (0.3, 0.8, 2.0)
"""Standard deviations of their distances from the arm's configuration, in equal parts [rad]."""
REFINEMENTS = (0.25, 0.1)
"""Standard deviations of the configurations around the best ones, in rounds after the first [rad]."""
REFINED, NEIGHBOURS = 12, 15
"""Number of the best ones, and of configurations around each of them."""
MAX_VOXELS = 1500
"""Most swept voxels from which looks are scored."""
FULL_COST_LENGTH = 8.0
"""A look this far away counts half [rad, joint-space L2]."""
UNSEEN_WEIGHT = 0.05
"""Weight of a swept voxel that is surely free, by the prediction; one that is surely occupied has 1 more."""
MIN_SEEN = 0.02
"""Looks that see a smaller part of the weight are of no use."""


def swept_unseen(known: OccupancyMap, path: Path) -> Bool[ndarray, "nx ny nz"]:
    """The voxels that the map does not know and whose covering balls a path touches, without those near its
    ends, which count as free."""
    swept = np.zeros(FINE_SHAPE, np.bool_)
    positions, voxel = path.positions.astype(np.float32), np.float32(FINE_VOXEL_SIZE)
    low, margin = np.array(LOW, np.float32), np.float32(COVER_RADIUS)
    sweep(compile_robot(known.robot), positions, margin, low, voxel, swept)
    return swept & known.unknown & ~near_ends(known, (path.positions[0], path.positions[-1]))


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
    hides it: neither the arm, nor what is occupied or predicted.
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
    checker, (width, height) = CollisionChecker(robot, scene), camera.size

    def scored(q: Float[ndarray, "n dof"]) -> tuple[Float[ndarray, "m dof"], Float[ndarray, "m"]]:
        """The configurations without collision that see enough, and their scores."""
        q = np.clip(q, robot.lower, robot.upper)
        q = q[checker.free(q)]
        seen = (
            seen_weights(
                compile_robot(robot),
                q.astype(np.float32),
                camera.poses(robot, q).astype(np.float32),
                np.array(camera.intrinsics, np.float32),
                (height, width),
                np.float32(camera.range),
                at,
                weights,
                filled,
                np.array(LOW, np.float32),
                np.float32(FINE_VOXEL_SIZE),
            )
            / weights.sum()
        )
        score = seen / (1 + np.linalg.norm(q - start, axis=1) / FULL_COST_LENGTH)
        return q[seen >= MIN_SEEN], score[seen >= MIN_SEEN]

    spread = np.repeat(SPREADS, -(-CONFIGURATIONS // len(SPREADS)))[:, None]
    q, score = scored(start + spread * rng.standard_normal((len(spread), robot.dof)))
    for spread in REFINEMENTS:
        best = q[np.argsort(-score, kind="stable")[:REFINED]].repeat(NEIGHBOURS, axis=0)
        more, scores = scored(best + spread * rng.standard_normal(best.shape))
        q, score = np.concatenate([q, more]), np.concatenate([score, scores])
    yield from q[np.argsort(-score, kind="stable")]
