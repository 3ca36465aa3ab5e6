"""Viewpoints: configurations that the arm can reach and from which its camera sees the unseen space that a
motion would sweep; and the next best view, the pose beside the arm from which a camera sees most of that
space.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.errors import InputError, check_type, rigid_transform
from robotdiffuse.core.types import Configuration, Configurations, Path, PlanResult, Pose, Value, interpolated
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.observed_volume import observe
from robotdiffuse.perception.occupancy_map import COVER_RADIUS, OccupancyMap
from robotdiffuse.perception.ray_caster import looking_at
from robotdiffuse.perception.unknown_space import CARVING_MARGIN
from robotdiffuse.perception.visibility import seen_share
from robotdiffuse.perception.voxel_grid import FINE, MAP, Probabilities, Voxels, refined
from robotdiffuse.planning.exploration.seen_free import near_ends
from robotdiffuse.planning.exploration.steps import ArmCamera
from robotdiffuse.planning.pipeline.unknown_space import policy_for, unknown_space_of
from robotdiffuse.planning.search.rrt_kernel import branch, extend, make_trees
from robotdiffuse.problems.problem import PREDICTED, Problem, check_problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.trajectories.simplification import simplify

RESOLUTION = 0.02
"""No point of the arm moves further than this between two checks of a motion [m]."""
CAPACITY = 2000
"""Maximum number of configurations in a tree."""
PARTS = (0.25, 0.5, 1.0)
"""Fractions of a path's length at which `first_parts` cuts it."""


class ReachableTree:
    """A tree of collision-free straight motions that begins at a configuration.

    A search between two configurations often fails if only a narrow gap leads away from the first one. The
    tree finds what is reachable behind such gaps before one of its configurations is chosen as a goal.
    """

    def __init__(self, robot: Robot, scene: Scene, start: Configuration) -> None:
        self._space = search_space(CollisionChecker(robot, scene), RESOLUTION)
        self._start = start
        self._trees = make_trees(start.astype(np.float32), np.zeros((0, robot.dof), np.float32), CAPACITY)

    def __len__(self) -> int:
        return int(self._trees.sizes[0])

    @property
    def configurations(self) -> Configurations:
        """The configurations of the tree, the start first."""
        return self._trees.nodes[0, : len(self)].astype(np.float64)

    def grow(self, targets: Configurations, longest: Float[ndarray, "n"]) -> None:
        """Extend the tree from its nearest configuration towards each target, if that motion is free.

        longest: the longest extension towards each target [rad, joint-space L2].
        """
        targets = np.clip(targets, self._space.lower, self._space.upper)
        extend(self._space, self._trees, targets.astype(np.float32), longest.astype(np.float32))

    def way(self, number: int) -> Configurations:
        """Waypoints from the start to the configuration with this index."""
        waypoints = simplify(self._space, branch(self._trees, 0, number), 1).astype(np.float64)
        waypoints[0] = self._start
        return waypoints


def moved(robot: Robot, to: Configurations, others: Sequence[Configuration]) -> Float[ndarray, "n"]:
    """For each configuration of `to`, how far the arm moves to it from the nearest configuration of `others`:
    the mean over the arm's covering spheres [m]."""
    reached, away = (np.stack([robot.placed_spheres(q)[:, :3] for q in rows]) for rows in (to, others))
    return np.min([np.linalg.norm(reached - other, axis=2).mean(axis=1) for other in away], axis=0)


def first_parts(waypoints: Configurations) -> Iterator[Configurations]:
    """Beginnings of a path, the shortest first and the whole path last."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1))])
    for part in PARTS:
        end = part * at[-1]
        last = interpolated(end, at, waypoints)
        yield np.concatenate([waypoints[at < end], last[None]])


# In each round, the tree grows towards TARGETS random targets, until it has CONFIGURATIONS configurations or
# after ROUNDS rounds.
CONFIGURATIONS = 900
TARGETS = 1200
ROUNDS = 5
SPREADS = (0.3, 0.8, 2.0)
"""Standard deviations of the targets about the start, each for a third of the targets [rad]."""
LONGEST_STEP = 1.0
"""Longest extension towards a target [rad, joint-space L2]; most are much shorter, to pass gaps."""
REFINEMENTS = (0.25, 0.1)
"""In each of two further rounds, the standard deviation of the targets about the configurations with the best
scores [rad]."""
# Number of configurations with the best scores, and of targets about each of them.
REFINED = 12
NEIGHBORS = 15
MAX_VOXELS = 1500
"""Maximum number of swept voxels by which viewpoints are scored."""
HALVING_DISTANCE = 8.0
"""The score of a viewpoint at this distance from the start is halved [rad, joint-space L2]."""
UNSEEN_WEIGHT = 0.05
"""Weight of a swept voxel, to which its predicted probability of being occupied is added."""
MIN_SEEN = 0.02
"""Viewpoints that see a smaller part of the total weight are not used."""
CONFINED = 0.1
"""An arm that can move (see `moved`) no farther than this [m] is confined by unseen space, which the arm
itself hides from the fixed cameras. The arm first moves as far as it can, so that these cameras see the space
that it left."""
SIMILAR_LOOK = 0.2
"""A viewpoint counts less if no joint is farther than this [rad] from an earlier viewpoint that did not show
the wanted voxels."""


def swept_unseen(known: OccupancyMap, path: Path) -> Voxels:
    """The unknown voxels whose covering balls a path touches, except near its start and end: voxels there
    count as free."""
    swept = (
        MAP.swept(known.robot, path, COVER_RADIUS) & known.unknown & ~near_ends(known, [path.positions[0]])
    )
    return swept & ~MAP.filled(known.robot, path.positions[-1:], CARVING_MARGIN)


def best_viewpoints(
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
    """Yields paths to viewpoints from which the camera sees wanted voxels, the best first.

    The score of a viewpoint is the weight of the wanted voxels that it sees, reduced for viewpoints far from
    the start. A voxel counts with the probability that nothing hides it: neither the arm, nor occupied or
    predicted voxels.

    tree: configurations that the arm can reach; it grows here.
    probability: the predicted probability that each voxel is occupied, which adds to its weight; None without
    a prediction.
    taken: configurations of earlier images that did not show the wanted voxels. Each of them lowers the score
    of viewpoints nearby.
    hemmed_in: whether the arm cannot go back far enough along its latest motion. If so, the last path leads
    to the configuration in which the arm is farthest from the start and from all of `taken`. If even this
    configuration is nearer than CONFINED, the path to it also comes first.
    beside: the latest image of a fixed camera. With the arm at a viewpoint, this camera may see wanted voxels
    that the arm hides now.
    """
    robot = known.robot
    at = np.ascontiguousarray(np.argwhere(wanted))
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
    space = at, weights, filled, MAP
    start, (width, height) = tree.configurations[0], camera.size
    seen_at_start = 0.0
    if beside is not None:
        image = beside.intrinsics, beside.depth.shape, np.inf
        [seen_at_start] = seen_share(robot, start[None], beside.T_base_camera[None], *image, *space)

    def scored(q: Configurations) -> Float[ndarray, "n"]:
        """The scores of configurations; 0 for configurations that see less than MIN_SEEN."""
        on_arm = camera.intrinsics, (height, width), camera.range
        seen = seen_share(robot, q, camera.poses(robot, q), *on_arm, *space)
        if beside is not None:
            poses = np.tile(beside.T_base_camera, (len(q), 1, 1))
            image = beside.intrinsics, beside.depth.shape, np.inf
            from_beside = seen_share(robot, q, poses, *image, *space)
            seen = seen + np.maximum(from_beside - seen_at_start, 0.0)
        score = seen / (1 + np.linalg.norm(q - start, axis=1) / HALVING_DISTANCE)
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
    # the configuration in which the arm is farthest from the start and from where it was in `taken`
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
    """A camera pose, and how much it sees of the unknown space that a motion sweeps."""

    T_base_camera: Pose
    """Pose of the camera [4, 4]."""
    seen: float
    """Fraction of the unknown space on the motion that a camera with this pose is expected to see, weighted
    by the probability that the space is occupied."""


def poses_around() -> list[Pose]:
    """Camera poses around the base, looking at the arm."""
    angles = 2 * np.pi * np.arange(POSES_PER_RING) / POSES_PER_RING
    ring = RING_RADIUS * np.column_stack([np.cos(angles), np.sin(angles)])
    places = [(x, y, height) for height in RING_HEIGHTS for x, y in ring]
    return [looking_at(np.array(place), np.array(TARGET)) for place in places]


def next_view(problem: Problem, result: PlanResult, poses: Sequence[Pose] | None = None) -> NextView:
    """Choose the camera pose that shows the most of what a motion may collide with.

    Of the given poses, it is the one from which a camera with the intrinsics of the first view sees the
    largest share of the unknown voxels that the motion sweeps. Each voxel counts with the predicted
    probability that it is occupied, times the probability that nothing hides it: neither seen or predicted
    obstacles nor the arm at the start. With a policy other than "predicted", the first factor is the same for
    all voxels.

    Args:
        problem: A problem with views.
        result: The result that holds the motion.
        poses: Camera poses T_base_camera [4, 4] to choose from; None: 48 poses around the base.

    Returns:
        The pose, and how much of the space a camera there is expected to see.

    Raises:
        InputError: The problem has no views, the result has no motion, or `poses` is empty.

    Examples:
        >>> T_base_camera = rd.pose([0.3, -1, 0.5], rpy=[-np.pi / 2, 0, 0])  # it looks along y
        >>> view = rd.DepthView(np.full((48, 64), 1.6), [50, 50, 31.5, 23.5], T_base_camera)
        >>> robot = rd.load_robot("panda")
        >>> problem = rd.Problem(robot, rd.Scene(), "ready", "extended", views=[view], unknown="padded")
        >>> rd.next_view(problem, rd.plan(problem, until="first")).seen > 0.9
        True
    """
    check_problem(problem)
    check_type("result", result, PlanResult, "a PlanResult, as rd.plan returns it")
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
    at = np.ascontiguousarray(np.argwhere(likely > MIN_PROBABILITY))
    weights = likely[tuple(at.T)]
    if not len(at):
        return NextView(candidates[0], 1.0)
    filled = refined(volume.occupied).astype(np.float32)
    if predicted is not None:
        np.maximum(filled, predicted, out=filled)
    image = problem.views[0]
    q = np.tile(problem.start, (len(candidates), 1))
    size = image.depth.shape
    seen = seen_share(
        problem.robot, q, np.stack(candidates), image.intrinsics, size, np.inf, at, weights, filled, FINE
    )
    best = int(seen.argmax())
    return NextView(candidates[best], float(seen[best]))
