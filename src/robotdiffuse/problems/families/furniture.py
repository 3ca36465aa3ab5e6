"""Families (generators of random problems) with furniture around an arm that stands on the ground: shelves,
crates, tables, kitchens and cabinets; `Furniture` is their base class.

All shapes are spheres, and boxes rotated about the vertical axis, so that data sets can store these scenes in
the same arrays as those of the family `rop`. Each scene has regions in which the arm works: in compartments,
in crates and between the objects on a table. `sample_target` samples poses with the fingers in a region.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.random import Generator

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import AtLeastTwo, Count, Natural, NotNegative, Positive, Share
from robotdiffuse.core.transforms import rotation_about, rotation_z_to, transform
from robotdiffuse.core.types import Pose, Values, Vector, frozen_dataclass
from robotdiffuse.problems.families.family import (
    CONFIGURATION,
    NaturalRange,
    PositiveRange,
    Range,
    Ranges,
    SampledProblem,
    Spheres,
    base_spheres,
    between_targets,
    is_clear_of,
    sample_until_found,
)
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Sphere

FLOOR = Box((0.0, 0.0, -0.05), (3.0, 3.0, 0.1), name="floor")
"""A floor with its top at z = 0, large enough for all furniture around the arm."""
SHOULDER = np.array([0.0, 0.0, 0.33])
"""Point from which reaches are measured: a Panda's shoulder, in the base frame [m]."""
REGION_MARGIN = 0.03
"""Distance of targets from the sides of their region, if the region is wide enough [m]."""
FINGER_LENGTH = 0.1
"""Approximate distance from the origin of a Panda's tip link, along its z axis, to its fingertips [m]."""
MAX_TILT = 0.4
"""Maximum angle between the hand and the approach of its region [rad]."""
DOWN = np.array([0.0, 0.0, -1.0])
AHEAD = np.array([1.0, 0.0, 0.0])
"""Direction away from the arm, in the frame of the furniture."""
MAX_TRIES = 1000
"""If this many samples of a scene all fail, the settings are rejected."""
PLACE_TRIES = 30
"""If this many samples of a place for an object are all occupied, the scene is sampled anew."""
MIN_GAP = 0.01
"""Minimum distance between the objects on a table, a counter or the ground, and between a loose object and
the board above it [m]."""
# Minimum free height beneath tables with a region there, and height of counters with a region inside [m].
MIN_TABLE_HEIGHT = 0.3
MIN_COUNTER_HEIGHT = 0.25
MIN_OPENING = 0.16
"""Minimum height and width of an opening of a cabinet that the hand is to enter [m]."""
TOP_HEIGHT = 0.3
"""Height of the region above a cabinet [m]."""
MIN_REGION = 0.1
"""Minimum edge of a region in a cabinet [m]."""
DRAWER_SHAPES = 5
"""Number of boxes that make up a drawer."""
Cell = tuple[float, float, float, float]
"""A compartment: y of its right and left side, z of its bottom and top, in the furniture's frame [m]."""


@frozen_dataclass
class Region:
    """A box without obstacles, rotated about the vertical axis, for the fingers at start or goal."""

    center: Vector
    """Center of the region in the base frame [m]."""
    size: Vector
    """Full edge lengths [m]."""
    yaw: float
    """Rotation of the box about the vertical axis [rad]."""
    approach: Vector
    """Unit vector of the hand's direction, in the base frame: away from the arm, or down."""


@frozen_dataclass
class FurnishedScene:
    """A scene and its regions, at least two."""

    scene: Scene
    """The scene; its first shape is the floor."""
    regions: tuple[Region, ...]


def sample_target(region: Region, rng: Generator) -> Pose:
    """A random pose T_base_tip of the robot's tip link, with its fingers in the region.

    The fingertips are uniform in the region less a margin. The z axis is uniform among the directions within
    MAX_TILT of the region's approach; the rotation about the z axis is uniform.
    """
    half = np.maximum(region.size / 2 - REGION_MARGIN, 0)
    point = region.center + rotation_about(-DOWN, region.yaw) @ rng.uniform(-half, half)
    tilt = np.arccos(rng.uniform(np.cos(MAX_TILT), 1.0))
    turn, roll = rng.uniform(-np.pi, np.pi, 2)
    about_z = [rotation_about(-DOWN, float(angle)) for angle in (turn, roll)]
    tilted = about_z[0] @ rotation_about(np.array([0.0, 1.0, 0.0]), float(tilt)) @ about_z[1]
    rotation = rotation_z_to(region.approach) @ tilted
    return transform(point - FINGER_LENGTH * rotation[:, 2], rotation)


@dataclass(frozen=True)
class Furniture(Ranges, ABC):
    """Settings of all furniture families. Ranges are sampled uniformly, except where they say otherwise;
    equal bounds fix the value."""

    bearing: Range = (-np.pi, np.pi)
    """Direction from the base to the furniture, measured from the x axis [rad]."""
    turn: Range = (-0.3, 0.3)
    """Rotation of the furniture about the vertical axis; 0 faces the base [rad]."""
    reach: Positive = 0.8
    """Maximum distance of the centers of regions from the shoulder; other regions are left out [m]."""
    objects: NaturalRange = (0, 4)
    """Minimum and maximum number of loose objects."""
    object_width: PositiveRange = (0.05, 0.12)
    """Horizontal edge lengths of a loose box, or diameter of a ball [m]."""
    object_height: PositiveRange = (0.06, 0.3)
    """Height of loose boxes [m]."""
    ball_share: Share = 0.25
    """Fraction of the loose objects that are balls."""

    @property
    @abstractmethod
    def max_obstacles(self) -> int:
        """Maximum number of obstacles of a scene, without the floor."""

    @abstractmethod
    def build(self, rng: Generator) -> "Sequence[FurnitureFrame]":
        """The pieces of furniture with all their regions, also regions out of reach. Raises NoRoomError if
        objects do not fit."""

    @property
    def floor(self) -> Box:
        return FLOOR

    def furnish(self, rng: Generator, keep_out: Spheres | None = None) -> FurnishedScene:
        """A random scene; the same state of `rng` gives the same scene.

        keep_out: spheres (x, y, z, radius), e.g. of the robot's fixed base, that only the floor may
        intersect. Raises InputError if no scene with two regions in reach was found.
        """
        for _ in range(MAX_TRIES):
            try:
                furniture = self.build(rng)
            except NoRoomError:
                continue
            shapes = [shape for item in furniture for shape in item.shapes]
            regions = [
                r
                for item in furniture
                for r in item.regions
                if np.linalg.norm(r.center - SHOULDER) <= self.reach
            ]
            if len(regions) >= 2 and all(is_clear_of(shape, keep_out) for shape in shapes):
                return FurnishedScene(Scene([self.floor, *shapes]), tuple(regions))
        raise InputError(
            f"each of {MAX_TRIES} scenes of {type(self).__name__} lacks room, two regions in reach, or a "
            "free place for the robot's base; change distance, reach or objects"
        )

    def scene(self, rng: Generator, keep_out: Spheres | None = None) -> Scene:
        return self.furnish(rng, keep_out).scene

    def draw(
        self, robot: Robot, rng: Generator, goals: int = 1, target: str = CONFIGURATION
    ) -> SampledProblem:
        """A random problem; see `Family.draw`.

        Whatever the kind of target, the fingers are in one region at the start and in another at the goals.
        Arms with fewer than six joints only reach the positions of the sampled poses.
        """
        keep_out = base_spheres(robot)

        def attempt() -> SampledProblem | None:
            furnished = self.furnish(rng, keep_out)
            checker = CollisionChecker(robot, furnished.scene)
            numbers = rng.choice(len(furnished.regions), 2, False)
            targets = (sample_target(furnished.regions[i], rng) for i in numbers)
            return between_targets(robot, furnished.scene, checker, targets, goals, rng)

        return sample_until_found(attempt, self, robot)


Corner = tuple[float, float, float]


class FurnitureFrame:
    """A piece of furniture in its frame: x points away from the arm, y to the left, z up from the ground."""

    def __init__(self, settings: Furniture, distance: Range, rng: Generator) -> None:
        self.shapes = list[Box | Sphere]()
        self.regions = list[Region]()
        bearing = rng.uniform(*settings.bearing)
        away = rng.uniform(*distance)
        self.yaw = float(bearing + rng.uniform(*settings.turn))
        self.xy = away * np.array([np.cos(bearing), np.sin(bearing)])
        self.rotation = rotation_about(-DOWN, self.yaw)

    def point(self, xyz: Vector) -> Vector:
        """A point of this frame, in the base frame [m]."""
        return self.rotation @ xyz + [*self.xy, 0.0]

    def box(self, low: Corner, high: Corner, name: str, turn: float = 0.0) -> None:
        """Adds a box. `low` and `high` are opposite corners in this frame, before the box is rotated by
        `turn` about the vertical axis through its middle [rad]."""
        if np.less_equal(high, low).any():  # boards that are thicker than the space for them
            raise NoRoomError
        half = (self.yaw + turn) / 2
        place = self._place(low, high)
        self.shapes.append(Box(*place, (np.cos(half), 0.0, 0.0, np.sin(half)), name))

    def region(self, low: Corner, high: Corner, approach: Vector) -> None:
        self.regions.append(Region(*self._place(low, high), self.yaw, self.rotation @ approach))

    def _place(self, low: Corner, high: Corner) -> tuple[Vector, Vector]:
        """The middle, in the base frame, and the size of a box between opposite corners."""
        return self.point((np.array(low) + high) / 2), np.subtract(high, low)

    def boxes(self, corners: Iterable[tuple[Corner, Corner]], name: str) -> None:
        """Adds several boxes of one name."""
        for low, high in corners:
            self.box(low, high, name)

    def case(self, depth: float, t: float, low: float, height: float, boards: Values, sides: Values) -> None:
        """Adds boards between uprights from `low` to `height`, all of thickness `t`, open in front.

        boards: z of the boards' tops. sides: y of the uprights' right sides.
        """
        right = sides[0] + t
        left = sides[-1]
        self.boxes((((0.0, right, z - t), (depth, left, z)) for z in boards), "board")
        self.boxes((((0.0, y, low), (depth, y + t, height)) for y in sides), "upright")


class LooseObject:
    """A random loose box or ball, at most `max_height` high [m]."""

    def __init__(self, settings: Furniture, rng: Generator, max_height: float = np.inf) -> None:
        x, y = rng.uniform(*settings.object_width, 2)
        self.ball = rng.random() < settings.ball_share
        x = min(x, max_height) if self.ball else x
        self.size = (x, x, x) if self.ball else (x, y, min(rng.uniform(*settings.object_height), max_height))
        self.turn = float(rng.uniform(-np.pi, np.pi))
        self.half = x / 2 if self.ball else float(np.hypot(x, y)) / 2
        """Half the side of a square that contains the object at any rotation."""

    def put(self, frame: FurnitureFrame, x: float, y: float, z: float) -> None:
        """Adds the shape at x, y of the frame, standing at height z."""
        a, b, c = self.size
        if self.ball:
            frame.shapes.append(Sphere(frame.point(np.array([x, y, z + c / 2])), c / 2, "ball"))
        else:
            frame.box((x - a / 2, y - b / 2, z), (x + a / 2, y + b / 2, z + c), "thing", self.turn)


Rectangle = tuple[float, float, float, float]
"""A rectangle on a surface: x and y of the middle, and half the edges along x and y [m]."""


def _check_exclusive(settings: Furniture, *names: str) -> None:
    """Raise InputError if two shares of which at most one applies sum to more than 1."""
    first, second = (getattr(settings, name) for name in names)
    if first + second > 1:
        raise InputError(f"{names[0]} is {first} and {names[1]} {second}; together they must be at most 1")


class NoRoomError(Exception):
    """An object has no free place, or a board no space: the scene is sampled anew."""


@dataclass(eq=False)
class Surface:
    """The top of a table or a counter, with the places on it that are taken.

    In the furniture's frame it extends over x from 0 to `length`, y from -`side` to `side` [m].
    """

    frame: FurnitureFrame
    length: float
    side: float
    height: float
    taken: list[Rectangle] = field(default_factory=list)

    def place(self, half_x: float, half_y: float, rng: Generator) -> tuple[float, float]:
        """The middle of a free rectangle, which is then marked as taken. Raises NoRoomError."""
        fits = half_x < self.length / 2 and half_y < self.side
        for _ in range(PLACE_TRIES if fits else 0):
            x = float(rng.uniform(half_x, self.length - half_x))
            y = float(rng.uniform(half_y - self.side, self.side - half_y))
            if is_free((x, y, half_x, half_y), self.taken):
                self.taken.append((x, y, half_x, half_y))
                return x, y
        raise NoRoomError

    def furnish(self, settings: "Table | Kitchen", rng: Generator) -> None:
        """Adds random free regions, in which the hand points down, and then random loose objects.

        The settings give the numbers and sizes of both. A region is as high as it is wide.
        """
        for _ in range(count(settings.spots, rng)):
            half = rng.uniform(*settings.spot_size) / 2
            x, y = self.place(half, half, rng)
            low = (x - half, y - half, self.height)
            high = (x + half, y + half, self.height + 2 * half)
            self.frame.region(low, high, DOWN)
        for _ in range(count(settings.objects, rng)):
            loose = LooseObject(settings, rng)
            loose.put(self.frame, *self.place(loose.half, loose.half, rng), self.height)


def is_free(rectangle: Rectangle, taken: list[Rectangle]) -> bool:
    """Whether a rectangle has at least a distance of MIN_GAP, along x or y, from each taken rectangle."""
    x, y, a, b = rectangle
    return all(abs(x - u) >= a + c + MIN_GAP or abs(y - v) >= b + d + MIN_GAP for u, v, c, d in taken)


def loose_in_cells(
    settings: Furniture,
    frame: FurnitureFrame,
    depth: float,
    cells: list[list[float]],
    rng: Generator,
    at_sides: bool = False,
) -> None:
    """Adds random loose objects, at most one per cell (see `Cell`). Objects that would take more than two
    thirds of a cell's width are left out, and so are objects in cells at most MIN_GAP high.

    Each cell with an object is narrowed to the wider free part beside the object. depth: of the cells [m].
    at_sides: whether objects stand at the left or right side of a cell, instead of anywhere.
    """
    object_count = min(count(settings.objects, rng), len(cells))
    for i in rng.permutation(len(cells))[:object_count]:
        low, high, z, ceiling = cells[i]
        loose = LooseObject(settings, rng, ceiling - z - MIN_GAP)
        half = loose.half
        if 3 * half > high - low or loose.size[2] <= 0:
            continue
        x = rng.uniform(min(half, depth / 2), max(depth - half, depth / 2))
        if at_sides:
            y = low + half if rng.random() < 0.5 else high - half
        else:
            y = rng.uniform(low + half, high - half)
        loose.put(frame, x, y, z)
        cells[i][:2] = (y + half, high) if y < (low + high) / 2 else (low, y - half)


def edges(sizes: Values, t: float) -> Values:
    """Positions of the lower sides of boards of thickness `t`, separated by gaps of these sizes, from 0."""
    return np.concatenate([[0.0], np.cumsum(sizes + t)])


def centered(widths: Values, t: float) -> Values:
    """Positions along y of the right sides of uprights, separated by gaps of these widths, with their middle
    at 0; see `edges`."""
    sides = edges(widths, t)
    return sides - (sides[-1] + t) / 2


def count(numbers: tuple[int, int], rng: Generator) -> int:
    """A random integer between the two numbers, inclusive."""
    return int(rng.integers(numbers[0], numbers[1] + 1))


@dataclass(frozen=True)
class Shelf(Furniture):
    """A bookcase that faces the arm: boards between uprights, open in front. Lengths in [m].

    Regions are its compartments and the space on its top board; the hand points forward into them. A
    compartment has at most one loose object, at one of its sides; objects that would leave too little space
    are left out.
    """

    reach: Positive = 0.85
    """Larger than the default: a hand that points forward reaches farther than one that points
    down."""
    distance: PositiveRange = (0.45, 0.7)
    """Distance from the base to the middle of the front."""
    boards: tuple[AtLeastTwo, AtLeastTwo] = (2, 4)
    """Number of boards."""
    lowest: tuple[NotNegative, NotNegative] = (0.0, 0.33)
    """Height of the underside of the lowest board."""
    row_height: PositiveRange = (0.26, 0.42)
    """Free height between two boards, sampled for each row."""
    columns: tuple[Count, Count] = (1, 3)
    column_width: PositiveRange = (0.3, 0.5)
    """Free width between two uprights, sampled for each column."""
    depth: PositiveRange = (0.2, 0.35)
    thickness: PositiveRange = (0.01, 0.03)
    """Thickness of all boards of a shelf."""
    back_share: Share = 0.6
    """Fraction of the shelves with a back."""

    @property
    def max_obstacles(self) -> int:
        return self.boards[1] + self.columns[1] + 2 + self.objects[1]

    def build(self, rng: Generator) -> Sequence[FurnitureFrame]:
        frame = FurnitureFrame(self, self.distance, rng)
        depth = rng.uniform(*self.depth)
        t = rng.uniform(*self.thickness)
        rows = rng.uniform(*self.row_height, count(self.boards, rng) - 1)
        tops = rng.uniform(*self.lowest) + t + edges(rows, t)
        columns = rng.uniform(*self.column_width, count(self.columns, rng))
        sides = centered(columns, t)
        height = tops[-1]
        frame.case(depth, t, 0.0, height, tops, sides)
        if rng.random() < self.back_share:
            frame.box((depth, sides[0], 0.0), (depth + t, sides[-1] + t, height), "back")
        ceilings = [*(tops[1:] - t), height + self.row_height[1]]
        compartments = [
            [y + t, y + t + w, z, ceiling]
            for z, ceiling in zip(tops, ceilings, strict=True)
            for y, w in zip(sides[:-1], columns, strict=True)
        ]
        loose_in_cells(self, frame, depth, compartments, rng, at_sides=True)
        for low, high, z, ceiling in compartments:
            frame.region((0.0, low, z), (depth, high, ceiling), AHEAD)
        return [frame]


SHELF = Shelf()


@dataclass(frozen=True)
class Crate(Furniture):
    """Open crates on the ground or on blocks, with loose objects around them. Lengths in [m].

    Regions are the insides of the crates and free spots on the ground; the hand points down.
    """

    object_height: PositiveRange = (0.1, 0.5)
    crates: tuple[Count, Count] = (1, 2)
    distance: PositiveRange = (0.4, 0.65)
    """Distance from the base to the middle of a crate, a loose object or a spot."""
    length: PositiveRange = (0.25, 0.45)
    """Inner length and width of a crate."""
    height: PositiveRange = (0.12, 0.3)
    """Inner height of the walls."""
    thickness: PositiveRange = (0.01, 0.03)
    """Thickness of the walls and the bottom of a crate."""
    raised_share: Share = 0.4
    """Fraction of the crates that stand on a block."""
    block_height: PositiveRange = (0.05, 0.3)
    spots: NaturalRange = (1, 2)
    """Number of free spots on the ground."""
    spot_size: PositiveRange = (0.12, 0.2)

    @property
    def max_obstacles(self) -> int:
        return 6 * self.crates[1] + self.objects[1]

    def build(self, rng: Generator) -> Sequence[FurnitureFrame]:
        frames = list[FurnitureFrame]()
        occupied = list[Rectangle]()

        def place(half: float) -> FurnitureFrame:
            """The frame of a new object of this half width, at a free place that is then marked as taken."""
            for _ in range(PLACE_TRIES):
                frame = FurnitureFrame(self, self.distance, rng)
                square = (float(frame.xy[0]), float(frame.xy[1]), half, half)
                if is_free(square, occupied):
                    occupied.append(square)
                    frames.append(frame)
                    return frame
            raise NoRoomError

        for _ in range(count(self.crates, rng)):
            x, y = rng.uniform(*self.length, 2) / 2
            h = rng.uniform(*self.height)
            t = rng.uniform(*self.thickness)
            frame = place(float(np.hypot(x + t, y + t)))
            low = 0.0
            if rng.random() < self.raised_share:
                low = rng.uniform(*self.block_height)
                frame.box((-x - t, -y - t, 0.0), (x + t, y + t, low), "block")
            bottom = low + t
            top = low + t + h
            frame.box((-x - t, -y - t, low), (x + t, y + t, bottom), "bottom")
            for side in (-1, 1):
                a, b = sorted((side * x, side * (x + t)))
                frame.box((a, -y - t, bottom), (b, y + t, top), "wall")
                a, b = sorted((side * y, side * (y + t)))
                frame.box((-x, a, bottom), (x, b, top), "wall")
            frame.region((-x, -y, bottom), (x, y, top), DOWN)
        for _ in range(count(self.spots, rng)):
            half = rng.uniform(*self.spot_size) / 2
            place(float(np.sqrt(2) * half)).region((-half, -half, 0.0), (half, half, 2 * half), DOWN)
        for _ in range(count(self.objects, rng)):
            loose = LooseObject(self, rng)
            loose.put(place(loose.half), 0.0, 0.0, 0.0)
        return frames


CRATE = Crate()


@dataclass(frozen=True)
class Table(Furniture):
    """A table with loose objects, sometimes divided by a wall or with a pillar. Lengths in [m].

    Regions are free spots between the objects, where the hand points down, and the space beneath a table on
    legs, where it points forward.
    """

    objects: NaturalRange = (3, 10)
    object_height: PositiveRange = (0.08, 0.35)
    distance: PositiveRange = (0.25, 0.4)
    """Distance from the base to the middle of the near edge of the table."""
    height: PositiveRange = (0.1, 0.5)
    """Height of the table's top."""
    length: PositiveRange = (0.45, 0.7)
    """Extent of the table in the direction away from the arm."""
    width: PositiveRange = (0.8, 1.4)
    thickness: PositiveRange = (0.02, 0.04)
    """Thickness of the top and of a dividing wall."""
    legs_share: Share = 0.5
    """Fraction of the tables with four legs; the others are solid."""
    leg_width: PositiveRange = (0.04, 0.07)
    wall_share: Share = 0.5
    """Fraction of the tables with a wall, near the middle, that runs away from the arm."""
    pillar_share: Share = 0.3
    """Fraction of the tables with a pillar."""
    divider_height: PositiveRange = (0.25, 0.6)
    """Height of walls and pillars."""
    pillar_width: PositiveRange = (0.06, 0.12)
    spots: NaturalRange = (2, 4)
    spot_size: PositiveRange = (0.12, 0.2)

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_exclusive(self, "wall_share", "pillar_share")

    @property
    def max_obstacles(self) -> int:
        return 6 + self.objects[1]

    def build(self, rng: Generator) -> Sequence[FurnitureFrame]:
        frame = FurnitureFrame(self, self.distance, rng)
        length = rng.uniform(*self.length)
        side = rng.uniform(*self.width) / 2
        height = rng.uniform(*self.height)
        t = rng.uniform(*self.thickness)
        legs = rng.random() < self.legs_share
        under = height - t
        bottom = under if legs else 0.0
        frame.box((0.0, -side, bottom), (length, side, height), "table")
        if legs:
            w = rng.uniform(*self.leg_width)
            for x, y in ((0.0, -side), (0.0, side - w), (length - w, -side), (length - w, side - w)):
                frame.box((x, y, 0.0), (x + w, y + w, under), "leg")
            if under > MIN_TABLE_HEIGHT:
                half_width = side - w
                frame.region((0.0, -half_width, 0.0), (length / 2, half_width, under), AHEAD)
        surface = Surface(frame, length, side, height)
        kind = rng.random()
        top = height + rng.uniform(*self.divider_height)
        if kind < self.wall_share:
            start = rng.uniform(0.0, length / 3)
            y = rng.uniform(-side / 3, side / 3)
            frame.box((start, y - t / 2, height), (length, y + t / 2, top), "wall")
            surface.taken.append(((start + length) / 2, y, (length - start) / 2, t / 2))
        elif kind < self.wall_share + self.pillar_share:
            w = rng.uniform(*self.pillar_width) / 2
            x, y = surface.place(w, w, rng)
            frame.box((x - w, y - w, height), (x + w, y + w, top), "pillar")
        surface.furnish(self, rng)
        return [frame]


TABLE = Table()


CLUTTER = Table(
    objects=(10, 20),
    object_width=(0.03, 0.1),
    object_height=(0.04, 0.28),
    wall_share=0.0,
    pillar_share=0.2,
)
"""Many small objects close together; objects in front hide most of the objects behind them."""


@dataclass(frozen=True)
class Kitchen(Furniture):
    """A counter against a wall, with ovens that are open in front, solid appliances and loose objects on it,
    and cupboards above it, some with an open door. Lengths in [m].

    Regions are the insides of ovens, of cupboards and of a counter that is open in front, where the hand
    points forward, and free spots on the counter, where it points down.
    """

    reach: Positive = 0.85
    """Larger than the default: a hand that points forward reaches farther than one that points
    down."""
    objects: NaturalRange = (1, 5)
    distance: PositiveRange = (0.3, 0.45)
    """Distance from the base to the middle of the near edge of the counter."""
    height: PositiveRange = (0.05, 0.4)
    """Height of the counter's top."""
    depth: PositiveRange = (0.4, 0.55)
    width: PositiveRange = (0.9, 1.5)
    thickness: PositiveRange = (0.01, 0.03)
    """Thickness of all boards and walls."""
    open_share: Share = 0.6
    """Fraction of the sufficiently high counters that are open in front."""
    ovens: NaturalRange = (0, 2)
    solids: NaturalRange = (0, 2)
    """Number of solid appliances."""
    appliance_width: PositiveRange = (0.3, 0.45)
    """Width of ovens. The width of a solid appliance is between half of this and all of it."""
    appliance_depth: PositiveRange = (0.22, 0.38)
    appliance_height: PositiveRange = (0.22, 0.36)
    cupboards: NaturalRange = (0, 3)
    """Number of cupboards, which hang side by side in the middle of the wall."""
    cupboard_width: PositiveRange = (0.28, 0.45)
    cupboard_depth: PositiveRange = (0.2, 0.33)
    cupboard_height: PositiveRange = (0.26, 0.4)
    above: PositiveRange = (0.38, 0.55)
    """Free height between the counter and the cupboards."""
    door_share: Share = 0.3
    """Fraction of the cupboards with a door, which is open."""
    spots: NaturalRange = (1, 2)
    spot_size: PositiveRange = (0.12, 0.2)

    @property
    def max_obstacles(self) -> int:
        wall = 1
        hollow = 5
        cupboards = 3 + 2 * self.cupboards[1]
        return wall + hollow * (1 + self.ovens[1]) + self.solids[1] + cupboards + self.objects[1]

    def build(self, rng: Generator) -> Sequence[FurnitureFrame]:
        frame = FurnitureFrame(self, self.distance, rng)
        depth = rng.uniform(*self.depth)
        side = rng.uniform(*self.width) / 2
        height = rng.uniform(*self.height)
        t = rng.uniform(*self.thickness)

        def hollow(low: Corner, high: Corner, name: str) -> None:
            """Adds a box that is open in front, and its inside as a region."""
            (x, y, z), (far, left, top) = low, high
            walls = (
                (low, (far, left, z + t)),
                ((x, y, top - t), high),
                ((x, y, z + t), (far, y + t, top - t)),
                ((x, left - t, z + t), (far, left, top - t)),
                ((far - t, y + t, z + t), (far, left - t, top - t)),
            )
            frame.boxes(walls, name)
            frame.region((x, y + t, z + t), (far - t, left - t, top - t), AHEAD)

        is_open = height > MIN_COUNTER_HEIGHT and rng.random() < self.open_share
        (hollow if is_open else frame.box)((0.0, -side, 0.0), (depth, side, height), "counter")
        low = height + rng.uniform(*self.above)
        widths = rng.uniform(*self.cupboard_width, count(self.cupboards, rng))
        front = depth - rng.uniform(*self.cupboard_depth)
        top = low + rng.uniform(*self.cupboard_height)
        if len(widths):
            sides = centered(widths, t)
            ends = (((front, sides[0], z), (depth, sides[-1] + t, z + t)) for z in (low, top - t))
            uprights = (((front, y, low + t), (depth, y + t, top - t)) for y in sides)
            frame.boxes((*ends, *uprights), "cupboard")
            for y, w in zip(sides[:-1], widths, strict=True):
                frame.region((front, y + t, low + t), (depth, y + t + w, top - t), AHEAD)
                if rng.random() < self.door_share:  # open at a right angle, hinged on the left or the right
                    hinge = y if rng.random() < 0.5 else y + w + t
                    frame.box((front - w, hinge, low), (front, hinge + t, top), "door")
        frame.box((depth, -side, 0.0), (depth + t, side, top), "wall")
        counter = Surface(frame, depth, side, height)
        ovens = count(self.ovens, rng)
        solids = count(self.solids, rng)
        for i in range(ovens + solids):
            a = rng.uniform(*self.appliance_depth) / 2
            b = rng.uniform(*self.appliance_width) / 2
            b *= 1.0 if i < ovens else rng.uniform(0.5, 1.0)
            (x, y), high = counter.place(a, b, rng), height + rng.uniform(*self.appliance_height)
            corners = (x - a, y - b, height), (x + a, y + b, high)
            if i < ovens:
                hollow(*corners, "oven")
            else:
                frame.box(*corners, "appliance")
        counter.furnish(self, rng)
        return [frame]


KITCHEN = Kitchen()


@dataclass(frozen=True)
class Cabinet(Furniture):
    """A grid of cells between thin or thick boards, from a desk to a tall bookcase. Lengths in [m].

    A cell is open, has a door (shut, or open at any angle), or has a drawer that is pulled out. The cabinet
    stands on the ground or on legs, or hangs. Regions are the cells without a drawer or a shut door, the
    insides of drawers, and the spaces above and below the cabinet. The hand points down into drawers, and
    forward elsewhere.
    """

    turn: Range = (-0.5, 0.5)
    reach: Positive = 0.85
    object_width: PositiveRange = (0.03, 0.14)
    object_height: PositiveRange = (0.03, 0.35)
    objects: NaturalRange = (0, 6)
    distance: PositiveRange = (0.35, 0.65)
    """Distance from the base to the middle of the front."""
    lowest: tuple[NotNegative, NotNegative] = (0.0, 0.7)
    """Height of the underside of the lowest board of a cabinet that does not stand on the ground."""
    ground_share: Share = 0.4
    """Fraction of the cabinets whose lowest board is on the ground."""
    legs_share: Share = 0.6
    """Fraction of the raised cabinets that stand on legs; the other raised cabinets hang."""
    rows: tuple[Count, Count] = (1, 4)
    row_height: PositiveRange = (0.18, 0.55)
    columns: tuple[Count, Count] = (1, 3)
    column_width: PositiveRange = (0.24, 0.7)
    depth: PositiveRange = (0.15, 0.5)
    thickness: PositiveRange = (0.004, 0.05)
    """Thickness of all boards; its logarithm is uniform."""
    back_share: Share = 0.6
    """Fraction of the cabinets with a back."""
    top_share: Share = 0.85
    """Fraction of the cabinets with a board on top."""
    door_share: Share = 0.2
    """Fraction of the cells with a door."""
    door_angle: PositiveRange = (0.3, 2.8)
    """Angle of a door that is not shut; 0 would be shut [rad]."""
    shut_share: Share = 0.3
    """Fraction of the doors that are shut."""
    drawer_share: Share = 0.15
    """Probability that a cell has a drawer. The doors of a cabinet with drawers open to at most 90°."""
    max_drawers: Natural = 2
    """Maximum number of drawers of a cabinet."""
    pulled: PositiveRange = (0.3, 0.95)
    """How far a drawer is pulled out, as a fraction of the depth."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_exclusive(self, "drawer_share", "door_share")

    @property
    def max_obstacles(self) -> int:
        boards = self.rows[1] + 1
        uprights = self.columns[1] + 1
        doors = self.rows[1] * self.columns[1]
        legs = 4
        back = 1
        return boards + uprights + legs + back + doors + DRAWER_SHAPES * self.max_drawers + self.objects[1]

    def build(self, rng: Generator) -> Sequence[FurnitureFrame]:
        frame = FurnitureFrame(self, self.distance, rng)
        depth = rng.uniform(*self.depth)
        t = float(np.exp(rng.uniform(*np.log(self.thickness))))
        on_ground = rng.random() < self.ground_share
        low = 0.0 if on_ground else rng.uniform(*self.lowest)
        tops = low + t + edges(rng.uniform(*self.row_height, count(self.rows, rng)), t)
        sides = centered(rng.uniform(*self.column_width, count(self.columns, rng)), t)
        right = sides[0]
        left = sides[-1] + t
        height = tops[-1]
        boards = tops if rng.random() < self.top_share else tops[:-1]
        frame.case(depth, t, low, height, boards, sides)
        if rng.random() < self.back_share:
            frame.box((depth, right, low), (depth + t, left, height), "back")
        regions = list[tuple[Corner, Corner, Vector]]()
        if not on_ground and rng.random() < self.legs_share:
            w = 2 * t
            for x in (0.0, depth - w):
                for y in (right, left - w):
                    frame.box((x, y, 0.0), (x + w, y + w, low), "leg")
        regions.append(((0.0, right + 2 * t, 0.0), (depth / 2, left - 2 * t, low), AHEAD))
        if len(boards) == len(tops):
            regions.append(((0.0, right, height), (depth, left, height + TOP_HEIGHT), AHEAD))
        cells = [
            (y + t, end, z, ceiling)
            for z, ceiling in zip(tops[:-1], tops[1:] - t, strict=True)
            for y, end in pairwise(sides)
        ]
        kinds = rng.random(len(cells))
        drawers = np.flatnonzero(kinds < self.drawer_share)[: self.max_drawers]
        max_angle = min(self.door_angle[1], np.pi / 2) if len(drawers) else self.door_angle[1]
        free = []
        for i, cell in enumerate(cells):
            if i in drawers:
                regions.append((*self._drawer(frame, cell, depth, t, rng), DOWN))
            elif kinds[i] > 1 - self.door_share:
                shut = rng.random() < self.shut_share
                angle = 0.0 if shut else rng.uniform(min(self.door_angle[0], max_angle), max_angle)
                _door(frame, cell, t, angle, rng.random() < 0.5)
                free += [] if shut else [[*cell]]
            else:
                free.append([*cell])
        loose_in_cells(self, frame, depth, free, rng)
        regions += [((t, y, z), (depth, end, ceiling), AHEAD) for y, end, z, ceiling in free]
        for region in regions:
            if _is_wide(*region):
                frame.region(*region)
        return [frame]

    def _drawer(
        self, frame: FurnitureFrame, cell: Cell, depth: float, t: float, rng: Generator
    ) -> tuple[Corner, Corner]:
        """Adds the bottom, front, back and sides of a drawer that is pulled out of a cell. Returns the part
        of its inside that is in front of the cabinet."""
        y, end, z, ceiling = cell
        x = -depth * rng.uniform(*self.pulled)
        top = z + (ceiling - z) * rng.uniform(0.4, 1.0)
        far = x + depth
        corners = (
            ((x, y, z), (far, end, z + t)),
            ((x, y, z + t), (x + t, end, top)),
            ((far - t, y, z + t), (far, end, top)),
            ((x + t, y, z + t), (far - t, y + t, top)),
            ((x + t, end - t, z + t), (far - t, end, top)),
        )
        frame.boxes(corners, "drawer")
        return (x + t, y + t, z + t), (min(0.0, far - t), end - t, top)


def _is_wide(low: Corner, high: Corner, approach: Vector) -> bool:
    """Whether a region is wide enough for the hand."""
    size = np.subtract(high, low)
    return bool(size.min() > MIN_REGION and (approach is DOWN or size[1:].min() > MIN_OPENING))


def _door(frame: FurnitureFrame, cell: Cell, t: float, angle: float, on_left: bool) -> None:
    """Adds a door of a cell, opened by an angle about the cell's left or right edge [rad]."""
    y, end, z, ceiling = cell
    hinge, side = (end, -1.0) if on_left else (y, 1.0)
    half = (end - y) / 2
    middle = np.array([-half * np.sin(angle), hinge + side * half * np.cos(angle)])
    low = (middle[0] - t / 2, middle[1] - half, z)
    high = (middle[0] + t / 2, middle[1] + half, ceiling)
    frame.box(low, high, "door", side * angle)


CABINET = Cabinet()
