"""Where to look: configurations from which the arm's camera sees what a motion would sweep."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.core.types import Path
from robotdiffuse.perception.occupancy_map import OccupancyMap
from robotdiffuse.perception.visibility import seen_weights
from robotdiffuse.perception.voxel_grid import MAP
from robotdiffuse.planning.exploration.cameras import ArmCamera
from robotdiffuse.planning.exploration.reachable import ReachableTree
from robotdiffuse.planning.exploration.seen_free import COVER_RADIUS, near_ends

CONFIGURATIONS, TARGETS, ROUNDS = 900, 1200, 5
"""Reachable configurations that a look is chosen from, at first; random ones that they are sought by in a
round; and the most rounds."""
SPREADS = (0.3, 0.8, 2.0)
"""Standard deviations of the distances of random ones from the arm's, in equal parts [rad]."""
LONGEST_STEP = 1.0
"""The longest step towards one [rad, joint-space L2]; most are much shorter, for gaps."""
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
SIMILAR_LOOK = 0.2
"""A look that is nearer than this to one that did not show what is wanted counts less [rad]."""


def swept_unseen(known: OccupancyMap, path: Path) -> Bool[ndarray, "nx ny nz"]:
    """The voxels that the map does not know and whose covering balls a path touches, without those near its
    ends, which count as free."""
    swept = MAP.swept(known.robot, path, COVER_RADIUS)
    return swept & known.unknown & ~near_ends(known, (path.positions[0], path.positions[-1]))


def best_looks(
    known: OccupancyMap,
    tree: ReachableTree,
    camera: ArmCamera,
    wanted: Bool[ndarray, "nx ny nz"],
    probability: Float32[ndarray, "nx ny nz"] | None,
    rng: np.random.Generator,
    taken: Sequence[Float[ndarray, "dof"]] = (),
) -> Iterator[Float[ndarray, "n dof"]]:
    """Ways to configurations from which the camera sees wanted voxels, the best first: weighted by the
    prediction if there is one, against the way to get there.

    tree: of configurations that the arm can reach, which grows here. A voxel counts by the chance that
    nothing hides it: neither the arm, nor what is occupied or predicted.
    taken: configurations of earlier images that did not show the wanted voxels; looks from nearby count
    less, once for each of them.
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
    start, (width, height) = tree.configurations[0], camera.size

    def scored(q: Float[ndarray, "n dof"]) -> Float[ndarray, "n"]:
        """The scores of configurations; 0 for those that see too little."""
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
                *MAP.frame,
            )
            / weights.sum()
        )
        score = seen / (1 + np.linalg.norm(q - start, axis=1) / FULL_COST_LENGTH)
        for earlier in taken:
            score *= np.minimum(np.abs(q - earlier).max(axis=1) / SIMILAR_LOOK, 1.0)
        return np.where(seen < MIN_SEEN, 0.0, score)

    spread = np.resize(SPREADS, TARGETS)[:, None]
    for _ in range(ROUNDS):
        if len(tree) < CONFIGURATIONS:
            targets = start + spread * rng.standard_normal((TARGETS, robot.dof))
            tree.grow(targets, LONGEST_STEP * rng.random(TARGETS) ** 2)
    score = scored(tree.configurations)
    for spread in REFINEMENTS:
        best = tree.configurations[np.argsort(-score, kind="stable")[:REFINED]].repeat(NEIGHBOURS, axis=0)
        tree.grow(best + spread * rng.standard_normal(best.shape), np.full(len(best), np.inf))
        score = np.concatenate([score, scored(tree.configurations[len(score) :])])
    for number in np.argsort(-score, kind="stable"):
        if score[number] == 0:
            return
        yield tree.way(int(number))
