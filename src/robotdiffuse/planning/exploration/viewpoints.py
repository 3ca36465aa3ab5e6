"""Chooses views of the unseen space that a motion would sweep. Makes obstacles that keep an arm within space
that was seen free (`not_seen_free`). Tells whether the space that an arm fills at a goal was seen free
(`GoalSeen`).

Viewpoints are configurations that the arm can reach, for the camera on the arm. The next best view is a pose
for a camera beside the arm.

For the goal, voxels of 2 cm are too coarse: voxels that the arm touches there are rarely seen free as a
whole. So small balls cover the arm's surface at the goal. Each ball must be free for one of four reasons:

- an image sees through it: all returns of its pixels are from behind it;
- it lies in voxels that the map knows to be free;
- a covering sphere of the arm contained it when an image was taken;
- it is so near the arm at the start of the motion that it counts as free.

The space inside the surface needs no view: obstacles do not float, so one inside would cross the surface.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernel_arrays import reach_ball
from robotdiffuse.collision.motions import search_space, with_covering_spheres
from robotdiffuse.core.errors import InputError, check_type, rigid_transform
from robotdiffuse.core.transforms import placed
from robotdiffuse.core.types import (
    NO_SPHERES,
    Configuration,
    Configurations,
    Path,
    PlanResult,
    Points,
    Pose,
    Value,
    Values,
    arc_lengths,
    frozen_dataclass,
    interpolated,
)
from robotdiffuse.perception.depth_filter import MARGIN_SPREADS, filtered
from robotdiffuse.perception.depth_view import AssumedPoints, DepthView
from robotdiffuse.perception.observed_volume import observe, usable_image
from robotdiffuse.perception.occupancy_map import (
    CARVING_MARGIN,
    COVER_RADIUS,
    OccupancyMap,
    ViewMemory,
    without_known,
)
from robotdiffuse.perception.ray_caster import looking_at
from robotdiffuse.perception.seen_points import near_scene, sphere_distances
from robotdiffuse.perception.visibility import (
    BALL_RADIUS,
    see_through,
    seen_share,
    surface_balls,
    within_voxels,
)
from robotdiffuse.perception.voxel_grid import FINE, MAP, Probabilities, VoxelGrid, Voxels, refined, surface
from robotdiffuse.planning.exploration.steps import ArmCamera
from robotdiffuse.planning.pipeline.unknown_space import policy_for, unknown_space_of
from robotdiffuse.planning.search.rrt_kernel import branch, extend, make_trees
from robotdiffuse.problems.problem import PREDICTED, Problem, check_problem
from robotdiffuse.robots.robot import Robot, check_joints
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Shape
from robotdiffuse.trajectories.simplification import simplify

PARTS = 4
"""Near goals, voxels are split into this many parts along each edge."""
NOT_SEEN_FREE = "not seen free"
MIN_FREE_SHARE = 0.8
"""Before a search for a motion to the goal, at least this fraction of the space that the arm fills there but
not at the start must have been seen free: with less, searches fail (benchmarks/results/exploring.txt)."""
WALL = 2.0
"""Thickness of the walls around the map [m]."""


def not_seen_free(
    known: OccupancyMap, known_scene: Scene, start: Configuration, goals: Sequence[Configuration] = ()
) -> tuple[Shape, ...]:
    """Obstacles that cover all space that the map does not know to be free, except the known scene.

    Balls cover the voxels at the surface of this space, and walls surround the map. So a motion that the
    validator accepts among them enters only voxels that are known to be free. There are two exceptions.
    Voxels with centers near the arm at the start are not covered: the arm could not leave them otherwise.
    The space within CARVING_MARGIN of the arm at the goals is not covered either: voxels that reach into this
    space are split, and small balls cover only their parts outside. Seen points are separate obstacles.
    """
    unseen = ~(known.free | near_ends(known, (start,)))
    spheres = NO_SPHERES
    if goals:
        spheres = np.concatenate([known.robot.placed_spheres(q) for q in goals])
    near = MAP.within(spheres, CARVING_MARGIN + COVER_RADIUS)
    at = surface(unseen)
    points = MAP.centers(at[~near[tuple(at.T)]])
    obstacles = [cover(known, known_scene, points, MAP.edge, NOT_SEEN_FREE)]
    split = np.argwhere(near & unseen)
    if len(split):
        low = np.maximum(split.min(axis=0) - 1, 0)
        block = tuple(map(slice, low, split.max(axis=0) + 2))
        occupied = refined(unseen[block], PARTS)
        edge = MAP.edge / PARTS
        grid = VoxelGrid(tuple(MAP.low + low * MAP.edge), occupied.shape, edge)
        at = surface(occupied & ~grid.within(spheres, CARVING_MARGIN - COVER_RADIUS / PARTS))
        points = grid.centers(at[near[block][tuple(at.T // PARTS)]])
        obstacles.append(cover(known, known_scene, points, edge, NOT_SEEN_FREE))
    return *obstacles, *_walls()


def near_ends(known: OccupancyMap, ends: Sequence[Configuration]) -> Voxels:
    """The voxels whose centers are at most CARVING_MARGIN plus half an edge from the arm at these
    configurations."""
    return MAP.filled(known.robot, ends, CARVING_MARGIN + MAP.edge / 2)


def hardly_seen(known: OccupancyMap, start: Configuration, goal: Configuration) -> bool:
    """Whether so little of the space around a goal was seen free that a search within it would fail."""
    filled = near_ends(known, (goal,)) & ~near_ends(known, (start,))
    return bool(known.free[filled].sum() < MIN_FREE_SHARE * filled.sum())


def cover(known: OccupancyMap, known_scene: Scene, points: Points, edge: float, name: str) -> AssumedPoints:
    """Balls that cover voxels, except voxels in the known scene or out of the arm's reach.

    points: centers of the voxels [m]. edge: their edge [m]. name: of the obstacle.
    """
    radius = edge * 3**0.5 / 2
    center, reach = reach_ball(with_covering_spheres(known.robot))
    points = points[np.linalg.norm(points - center, axis=1) < reach + radius]
    return AssumedPoints(without_known(points, edge, known.robot, known_scene), radius, name=name)


def least_unknown(known: OccupancyMap, goals: Configurations) -> Configuration:
    """The configuration at which the arm fills the fewest unknown voxels."""
    return min(goals, key=lambda q: int((known.unknown & MAP.filled(known.robot, [q])).sum()))


def reaches_outside(robot: Robot, q: Configuration) -> bool:
    """Whether the arm reaches out of the map: the centers of some covering spheres of its moving links are
    outside."""
    moving = [link for link in robot.spheres if robot.link_frame(link)]
    centers = [placed(robot.fk(q, link), robot.spheres[link][:, :3]) for link in moving]
    return not all(MAP.contains(MAP.indices(points)).all() for points in centers)


def _walls() -> Iterator[Box]:
    """Yields boxes around the map."""
    low = np.array(MAP.low)
    high = low + np.array(MAP.shape) * MAP.edge
    for axis in range(3):
        for at, name in ((low[axis] - WALL / 2, "before"), (high[axis] + WALL / 2, "beyond")):
            center = (low + high) / 2
            size = high - low + 2 * WALL
            center[axis] = at
            size[axis] = WALL
            yield Box(center, size, name=f"{name} the map, {'xyz'[axis]}")


BORDER = np.float32(1.0)
"""In filtered images, pixels up to this far outside a ball's outline must also see past the ball [pixels],
since the filter moves edges by about one pixel."""
LITTLE_UNSEEN = 1e-3
"""If the unseen part of the surface is less than this fraction, messages say where this part is."""
KEY_DECIMALS = 5
"""Configurations that are equal to this number of decimals count as the same."""


class GoalSeen:
    """Keeps, for each goal configuration, the balls on the arm's surface that are not yet shown to be
    free."""

    def __init__(self, robot: Robot, known: OccupancyMap, views: ViewMemory, required: bool) -> None:
        """views: the kept views, which count for new goals as well. required: whether goals must be seen; if
        not, nothing is ever missing."""
        self._robot = robot
        self._known = known
        self._views = views
        self._required = required
        self._unseen = dict[tuple[float, ...], Points]()
        """Centers of the balls that no view has shown to be free, by configuration [m]."""
        self.taken = list[Configuration]()
        """Configurations of the views since the goal was set."""

    def forget(self) -> None:
        """Prepare for another goal."""
        self._unseen.clear()
        self.taken.clear()

    def observe(self, view: DepthView) -> None:
        """Take a new view into account."""
        assert view.configuration is not None  # the map takes no other views
        self.taken.append(view.configuration)
        if self._known.max_age is not None:
            self._unseen.clear()  # computed anew from the kept views, since views are forgotten
        elif self._required:
            self._unseen = {q: self._not_shown(balls, [view]) for q, balls in self._unseen.items()}

    def best(self, start: Configuration, goals: Configurations) -> Configuration:
        """The goal at which the smallest part of the arm's surface is unseen. Other configurations than these
        goals are forgotten."""
        best_goal = min(goals, key=lambda q: len(self.unseen(start, q)))
        goal_keys = set(map(_key, goals))
        self._unseen = {q: balls for q, balls in self._unseen.items() if q in goal_keys}
        return best_goal

    def unseen(self, start: Configuration, q: Configuration) -> Points:
        """The centers of the balls at configuration `q` that nothing has shown to be free [m]. start: the
        arm's present configuration."""
        key = _key(q)
        if key not in self._unseen:
            self._unseen[key] = self._not_shown(surface_balls(self._robot, q), self._views.views)
        balls = self._unseen[key]
        near = self._distances(balls, start) < CARVING_MARGIN - BALL_RADIUS
        return balls[~(near | within_voxels(balls, BALL_RADIUS, self._known.free, MAP))]

    def wanted(self, path: Path) -> Voxels:
        """The voxels with unseen parts of the arm's surface at the end of a path."""
        out = np.zeros(MAP.shape, np.bool_)
        if self._required:
            at = MAP.indices(self.unseen(path.positions[0], path.positions[-1]))
            out[tuple(at[MAP.contains(at)].T)] = True
        return out

    def missing(self, motion: PlanResult) -> str:
        """A message on how much of the arm's surface at the end of a motion was not seen and, if it is
        little, where; "" if nothing is missing."""
        if not self._required or motion.path is None:
            return ""
        start, q = motion.path.positions[[0, -1]]
        unseen = self.unseen(start, q)
        if not len(unseen):
            return ""
        share = len(unseen) / len(surface_balls(self._robot, q))
        x, y, z = unseen.mean(axis=0).tolist()
        where = f", around x {x:.2f}, y {y:.2f}, z {z:.2f} m" if share < LITTLE_UNSEEN else ""
        return f"{100 * share:.2g} % of the arm's surface at the goal was not seen{where}"

    def _not_shown(self, balls: Points, views: Iterable[DepthView]) -> Points:
        """The balls that no view shows to be free: no image sees through them, and the arm did not contain
        them when an image was taken."""
        for view in views:
            assert view.configuration is not None  # the map takes no other views
            depth, _ = usable_image(view, self._robot, view.configuration, 0.0)
            if view.range is not None:  # the sensor says nothing about farther space
                depth = np.minimum(depth, np.float32(view.range))
            noise = MARGIN_SPREADS * filtered(view).edge_spread
            # balls that the arm contained; `see_through` adds those that the image sees through
            seen = self._distances(balls, view.configuration) < -BALL_RADIUS
            see_through(
                depth,
                np.array(view.intrinsics, np.float32),
                view.T_base_camera.astype(np.float32),
                balls,
                np.float32(BALL_RADIUS),
                np.array([*view.pose_deviation, noise], np.float32),
                BORDER if noise else np.float32(0),
                seen,
            )
            balls = balls[~seen]
        return balls

    def _distances(self, balls: Points, q: Configuration) -> Float32[ndarray, "n"]:
        """Signed distances of the balls' centers to the arm's covering spheres at a configuration [m]."""
        return sphere_distances(balls, self._robot.placed_spheres(q).astype(np.float32))


def _key(q: Configuration) -> tuple[float, ...]:
    """A key that is the same for a goal and for the end of a motion to this goal."""
    return tuple(np.round(q, KEY_DECIMALS).tolist())


RESOLUTION = 0.02
"""No point of the arm moves further than this between two checks of a motion [m]."""
CAPACITY = 2000
"""Maximum number of configurations in a tree."""
WAY_PARTS = (0.25, 0.5, 1.0)
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

    def grow(self, targets: Configurations, longest: Values) -> None:
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


def moved(robot: Robot, to: Configurations, others: Sequence[Configuration]) -> Values:
    """For each configuration of `to`, how far the arm moves to it from the nearest configuration of `others`:
    the mean over the arm's covering spheres [m]."""
    reached, away = (np.stack([robot.placed_spheres(q)[:, :3] for q in rows]) for rows in (to, others))
    return np.min([np.linalg.norm(reached - spheres, axis=2).mean(axis=1) for spheres in away], axis=0)


def first_parts(waypoints: Configurations) -> Iterator[Configurations]:
    """Beginnings of a path, the shortest first and the whole path last."""
    at = arc_lengths(waypoints)
    for part in WAY_PARTS:
        end = part * at[-1]
        last = interpolated(end, at, waypoints)
        yield np.concatenate([waypoints[at < end], last[None]])


# In each of at most ROUNDS rounds, the tree grows towards TARGETS random targets. No round begins once the
# tree has CONFIGURATIONS configurations.
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
    cameras: Sequence[ArmCamera],
    wanted: Voxels,
    probability: Probabilities | None,
    rng: np.random.Generator,
    taken: Sequence[Configuration] = (),
    hemmed_in: bool = False,
    fixed_view: DepthView | None = None,
) -> Iterator[Configurations]:
    """Yields paths to viewpoints from which a camera sees wanted voxels, the best first.

    The score of a viewpoint is the weight of the wanted voxels that its best camera sees, reduced for
    viewpoints far from the start. A voxel counts with the probability that nothing hides it: neither the arm,
    nor occupied or predicted voxels.

    tree: configurations that the arm can reach; it grows here.
    probability: the predicted probability that each voxel is occupied, which adds to its weight; None without
    a prediction.
    taken: configurations of earlier images that did not show the wanted voxels. Each of them lowers the score
    of viewpoints nearby.
    hemmed_in: whether the arm cannot go back far along its latest motion. If so, the last path leads to the
    configuration in which the arm is farthest from the start and from all of `taken`. If even this
    configuration is nearer than CONFINED, the path to it also comes first.
    fixed_view: the latest image of a fixed camera. With the arm at a viewpoint, this camera may see wanted
    voxels that the arm hides now.
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
    start = tree.configurations[0]
    seen_at_start = 0.0
    if fixed_view is not None:
        K, size = fixed_view.intrinsics, fixed_view.depth.shape
        T = fixed_view.T_base_camera[None]
        reach = fixed_view.range or np.inf
        [seen_at_start] = seen_share(robot, start[None], T, K, size, reach, *space)

    def scored(q: Configurations) -> Values:
        """The scores of configurations; 0 for configurations that see less than MIN_SEEN."""
        each = [(c.poses(robot, q), c.intrinsics, c.size[::-1], c.range) for c in cameras]
        seen = np.max([seen_share(robot, q, *camera, *space) for camera in each], axis=0)
        if fixed_view is not None:
            poses = np.repeat(T, len(q), axis=0)
            seen_fixed = seen_share(robot, q, poses, K, size, reach, *space)
            seen = seen + np.maximum(seen_fixed - seen_at_start, 0.0)
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


@frozen_dataclass
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
    probability that it is occupied, times the probability that nothing hides it: neither the known
    scene, nor seen or predicted obstacles, nor the arm at the start. With a policy other than "predicted",
    the first factor is the same for all voxels.

    Args:
        problem: A problem with views.
        result: The result that holds the motion.
        poses: Camera poses T_base_camera [4, 4] to choose from; None: 48 poses around the base.

    Returns:
        The pose, and how much of the space a camera there is expected to see. If the motion crosses no
        unknown space, the first pose and 1.

    Raises:
        InputError: `problem` is no Problem or has no views, `result` is no PlanResult, has no motion or is of
            another robot, or `poses` is empty or holds a pose that is not rigid.

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
    check_joints("next_view: result.path", result.path.joint_names, problem.robot)
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
    known = near_scene(problem.robot, problem.known_scene, FINE.all_centers, FINE.edge / 2)
    filled[known.reshape(FINE.shape)] = 1.0
    image = problem.views[0]
    q = np.tile(problem.start, (len(candidates), 1))
    size = image.depth.shape
    reach = image.range or np.inf
    seen = seen_share(
        problem.robot, q, np.stack(candidates), image.intrinsics, size, reach, at, weights, filled, FINE
    )
    best = int(seen.argmax())
    return NextView(candidates[best], float(seen[best]))
