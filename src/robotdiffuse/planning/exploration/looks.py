"""Where to look: configurations that the arm can reach and from which its camera sees what a motion would
sweep; and the next best view, the pose of a camera beside the arm that sees most of it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.bounds import Value, rigid_transform
from robotdiffuse.core.errors import InputError, check_type
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.types import Configuration, Configurations, Path, Pose, interpolated
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.observed_volume import observe
from robotdiffuse.perception.occupancy_map import COVER_RADIUS, OccupancyMap
from robotdiffuse.perception.ray_caster import looking_at
from robotdiffuse.perception.unknown_space import CARVING_MARGIN
from robotdiffuse.perception.visibility import seen_weights
from robotdiffuse.perception.voxel_grid import FINE, MAP, Probabilities, Voxels, refined
from robotdiffuse.planning.exploration.seen_free import near_ends
from robotdiffuse.planning.exploration.steps import ArmCamera
from robotdiffuse.planning.pipeline.unknown_space import policy_for, unknown_space_of
from robotdiffuse.planning.search.rrt_kernel import extend, make_trees
from robotdiffuse.problems.problem import PREDICTED, Problem, check_problem
from robotdiffuse.robots.kinematics import placed_spheres
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.trajectories.simplification import simplify

RESOLUTION = 0.02
"""No point of the arm moves further than this between two checks of a motion [m]."""
CAPACITY = 2000
"""Most configurations of a tree."""
PARTS = (0.25, 0.5, 1.0)
"""Parts of a way that may be gone."""


class ReachableTree:
    """A tree of straight motions without collision from a configuration on.

    Searches between two configurations fail where only a narrow gap leads out of the first one. The tree
    knows what is beyond such gaps before anything there is chosen as a goal.
    """

    def __init__(self, robot: Robot, scene: Scene, start: Configuration) -> None:
        self._space = search_space(CollisionChecker(robot, scene), RESOLUTION)
        self._start = start
        self._trees = make_trees(start.astype(np.float32), np.zeros((0, robot.dof), np.float32), CAPACITY)

    def __len__(self) -> int:
        return int(self._trees.sizes[0])

    @property
    def configurations(self) -> Configurations:
        """The start, and what is reached from it."""
        return self._trees.nodes[0, : len(self)].astype(np.float64)

    def grow(self, targets: Configurations, longest: Float[ndarray, "n"]) -> None:
        """Extend the tree from its nearest configuration towards each target, where that motion is free.

        longest: the longest extension towards each [rad, joint-space L2].
        """
        targets = np.clip(targets, self._space.lower, self._space.upper)
        extend(self._space, self._trees, targets.astype(np.float32), longest.astype(np.float32))

    def way(self, number: int) -> Configurations:
        """Waypoints from the start to one of the configurations."""
        nodes = self._trees.nodes[0]
        parents = self._trees.parents[0]
        path = [number]
        while parents[path[-1]] >= 0:
            path.append(parents[path[-1]])
        way = simplify(self._space, nodes[path[::-1]], 1).astype(np.float64)
        way[0] = self._start
        return way


def moved(robot: Robot, to: Configurations, others: Sequence[Configuration]) -> Float[ndarray, "n"]:
    """How far the arm is in each configuration from where it is in the nearest of others: the mean of its
    covering spheres [m]."""
    reached, away = (np.stack([placed_spheres(robot, q)[:, :3] for q in some]) for some in (to, others))
    return np.min([np.linalg.norm(reached - one, axis=2).mean(axis=1) for one in away], axis=0)


def first_parts(waypoints: Configurations) -> Iterator[Configurations]:
    """The first parts of a way, the shortest first, and all of it."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1))])
    for part in PARTS:
        end = part * at[-1]
        last = interpolated(end, at, waypoints)
        yield np.concatenate([waypoints[at < end], last[None]])


# Reachable configurations that a look is chosen from, at first; random ones that they are sought by in a
# round; and the most rounds.
CONFIGURATIONS = 900
TARGETS = 1200
ROUNDS = 5
SPREADS = (0.3, 0.8, 2.0)
"""Standard deviations of the distances of random ones from the arm's, in equal parts [rad]."""
LONGEST_STEP = 1.0
"""The longest step towards one [rad, joint-space L2]; most are much shorter, for gaps."""
REFINEMENTS = (0.25, 0.1)
"""Standard deviations of the configurations around the best ones, in rounds after the first [rad]."""
# Number of the best ones, and of configurations around each of them.
REFINED = 12
NEIGHBORS = 15
MAX_VOXELS = 1500
"""Maximum number of swept voxels by which views are scored."""
FULL_COST_LENGTH = 8.0
"""A look this far away counts half [rad, joint-space L2]."""
UNSEEN_WEIGHT = 0.05
"""Weight of a swept voxel that is surely free, by the prediction; one that is surely occupied has 1 more."""
MIN_SEEN = 0.02
"""Looks that see a smaller part of the weight are of no use."""
CONFINED = 0.1
"""An arm that gets no farther than this is hemmed in by what its own shadow hides from cameras beside it. It
moves as far as it can first, so that the shadow moves too [m]."""
SIMILAR_LOOK = 0.2
"""A look that is nearer than this to one that did not show what is wanted counts less [rad]."""


def swept_unseen(known: OccupancyMap, path: Path) -> Voxels:
    """The voxels that the map does not know and whose covering balls a path touches, without those near its
    ends, which count as free."""
    swept = (
        MAP.swept(known.robot, path, COVER_RADIUS) & known.unknown & ~near_ends(known, [path.positions[0]])
    )
    return swept & ~MAP.filled(known.robot, path.positions[-1:], CARVING_MARGIN)


def best_looks(
    known: OccupancyMap,
    tree: ReachableTree,
    camera: ArmCamera,
    wanted: Voxels,
    probability: Probabilities | None,
    rng: np.random.Generator,
    taken: Sequence[Configuration] = (),
    hemmed_in: bool = False,
    beside: DepthView | None = None,
) -> Iterator[Configurations]:
    """Ways to configurations from which the camera sees wanted voxels, the best first: weighted by the
    prediction if there is one, against the way to get there.

    tree: of configurations that the arm can reach, which grows here. A voxel counts by the chance that
    nothing hides it: neither the arm, nor what is occupied or predicted.
    taken: configurations of earlier images that did not show the wanted voxels; looks from nearby count
    less, once for each of them.
    beside: the latest image of a camera that does not move, which sees what the arm no longer hides.
    hemmed_in: whether there is no way back. At last, and first for an arm that is CONFINED, there is a way to
    where the arm is farthest from where images were taken.
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
        at = at[chosen]
        weights = weights[chosen]
    start, (width, height) = tree.configurations[0], camera.size

    def seen_by(
        intrinsics: tuple[float, float, float, float],
        size: tuple[int, ...],
        reach: float,
        q: Configurations,
        poses: Float[ndarray, "n 4 4"],
    ) -> Float[ndarray, "n"]:
        """The part of the weight that a camera sees at each pose, with the arm in each configuration."""
        sums = seen_weights(
            compile_robot(robot),
            q.astype(np.float32),
            poses.astype(np.float32),
            np.array(intrinsics, np.float32),
            size,
            np.float32(reach),
            at,
            weights,
            filled,
            *MAP.frame,
        )
        return sums / weights.sum()

    seen_at_start = 0.0
    if beside is not None:
        pose = beside.T_base_camera[None]
        [seen_at_start] = seen_by(beside.intrinsics, beside.depth.shape, np.inf, start[None], pose)

    def scored(q: Configurations) -> Float[ndarray, "n"]:
        """The scores of configurations; 0 for those that see too little."""
        seen = seen_by(camera.intrinsics, (height, width), camera.range, q, camera.poses(robot, q))
        if beside is not None:
            poses = np.tile(beside.T_base_camera, (len(q), 1, 1))
            others = seen_by(beside.intrinsics, beside.depth.shape, np.inf, q, poses)
            seen = seen + np.maximum(others - seen_at_start, 0.0)
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
        best = tree.configurations[np.argsort(-score, kind="stable")[:REFINED]].repeat(NEIGHBORS, axis=0)
        tree.grow(best + spread * rng.standard_normal(best.shape), np.full(len(best), np.inf))
        score = np.concatenate([score, scored(tree.configurations[len(score) :])])
    distances = moved(robot, tree.configurations, [start, *taken])
    farthest = int(distances.argmax())
    if hemmed_in and distances[farthest] < CONFINED:
        yield tree.way(farthest)
    for number in np.argsort(-score, kind="stable"):
        if score[number] == 0:
            break
        yield tree.way(int(number))
    if hemmed_in:
        yield tree.way(farthest)


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

    T_base_camera: Pose
    seen: float
    """Expected part of the summed probability that a camera there sees, from 0 to 1."""


def poses_around() -> list[Pose]:
    """Camera poses around the base, looking at the arm."""
    angles = 2 * np.pi * np.arange(POSES_PER_RING) / POSES_PER_RING
    ring = RING_RADIUS * np.column_stack([np.cos(angles), np.sin(angles)])
    places = [(x, y, height) for height in RING_HEIGHTS for x, y in ring]
    return [looking_at(np.array(place), np.array(TARGET)) for place in places]


def next_view(problem: Problem, result: PlanResult, poses: Sequence[Pose] | None = None) -> NextView:
    """The camera pose that shows most of what a motion may collide with.

    It is the pose from which a camera like that of the first view sees most of the probability that the
    motion sweeps. A voxel counts by the chance that nothing hides it: neither what was seen, nor what is
    predicted, nor the arm at the start. With a policy other than "predicted", all swept unknown voxels count
    the same.

    Args:
        problem: A problem with views.
        result: The result that holds the motion.
        poses: Camera poses T_base_camera [4, 4] to choose from; None: `poses_around`.

    Raises:
        InputError: Without views, without a motion and without poses.
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
        *FINE.frame,
    )
    best = int(seen.argmax())
    return NextView(candidates[best], float(seen[best] / weights.sum()))
