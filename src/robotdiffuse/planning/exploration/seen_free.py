"""Obstacles that keep an arm within space that was seen free (`not_seen_free`); and whether the space that an
arm fills at a goal was seen free (`GoalSeen`).

For the goal, voxels of 2 cm are too coarse: voxels that the arm touches there are rarely seen free as a
whole. So small balls cover the arm's surface at the goal, and each ball must be free for one of four reasons:
an image sees through it, which means that all returns of its pixels are from behind it; it lies in voxels
that the map knows to be free; a covering sphere of the arm contained it when an image was taken; or it is so
near the arm at the start of the motion that it counts as free. The space inside the surface needs no view,
since obstacles do not float.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import reach_ball
from robotdiffuse.collision.motions import with_covering_spheres
from robotdiffuse.core.types import Configuration, Configurations, Path, PlanResult, Points
from robotdiffuse.perception.depth_filter import MARGIN_SPREADS, filtered
from robotdiffuse.perception.depth_view import AssumedPoints, DepthView
from robotdiffuse.perception.observed_volume import usable_image
from robotdiffuse.perception.occupancy_map import COVER_RADIUS, OccupancyMap, ViewMemory
from robotdiffuse.perception.seen_points import sphere_distances
from robotdiffuse.perception.unknown_space import CARVING_MARGIN, without_known
from robotdiffuse.perception.visibility import BALL_RADIUS, see_through, surface_balls, within_voxels
from robotdiffuse.perception.voxel_grid import MAP, VoxelGrid, Voxels, refined, surface
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Shape

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
    spheres = np.zeros((0, 4))
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
    """The voxels whose centers are within CARVING_MARGIN and half an edge of the arm at these
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
    """Whether the arm reaches out of the map: the centers of some of its covering spheres are outside."""
    low, high = _corners_of_map()
    centers = robot.placed_spheres(q)[:, :3]
    return bool(((centers < low) | (centers > high)).any())


def _corners_of_map() -> tuple[Float[ndarray, "3"], Float[ndarray, "3"]]:
    """The low and the high corner of the map [m]."""
    low = np.array(MAP.low)
    return low, low + np.array(MAP.shape) * MAP.edge


def _walls() -> list[Box]:
    """Boxes around the map."""
    low, high = _corners_of_map()
    walls = []
    for axis in range(3):
        for at, name in ((low[axis] - WALL / 2, "before"), (high[axis] + WALL / 2, "beyond")):
            center = (low + high) / 2
            size = high - low + 2 * WALL
            center[axis] = at
            size[axis] = WALL
            walls.append(Box(tuple(center), tuple(size), name=f"{name} the map, {'xyz'[axis]}"))
    return walls


BORDER = np.float32(1.0)
"""In filtered images, pixels up to this far outside a ball's outline must also see past the ball [pixels],
since the filter moves edges by about one pixel."""
LITTLE_UNSEEN = 1e-3
"""If less than this part of the surface was not seen, messages say where it is."""
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
        self._unseen: dict[tuple[float, ...], Points] = {}
        """Centers of the balls that no view has shown to be free, by configuration [m]."""
        self.taken: list[Configuration] = []
        """Configurations of the views since the goal was set."""

    def forget(self) -> None:
        """Prepare for another goal."""
        self._unseen.clear()
        self.taken.clear()

    def observe(self, view: DepthView) -> None:
        """Take a new view into account."""
        assert view.configuration is not None  # the map takes no other views
        self.taken.append(view.configuration)
        if self._required:
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
