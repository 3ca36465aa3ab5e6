"""Families of random scenes beyond ROP: shelves, crates and tables around an arm that stands on the ground.

Everything is made of spheres and of boxes turned about the vertical, so the scenes pack as ROP's do. Each
comes with regions, where the fingers of the arm have something to do: in compartments, in crates and between
the things on a table; `sample_target` draws poses there.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.errors import InputError
from robotdiffuse.problems.families.rop import Range, obstacle_distance
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Sphere
from robotdiffuse.transforms import rotation_about, rotation_z_to, transform

FLOOR = Box((0.0, 0.0, -0.05), (3.0, 3.0, 0.1), name="floor")
"""The first shape of every scene, with its top at z = 0: wide enough for all that stands around the arm."""
SHOULDER = np.array([0.0, 0.0, 0.33])
"""Reaches are measured from here, a Panda's shoulder [m]."""
MARGIN = 0.03
"""Targets keep this distance from the sides of their region where it is wide enough [m]."""
FINGERS = 0.1
"""From the origin of a Panda's tip link, along its z axis, to about its fingertips [m]."""
DOWN = np.array([0.0, 0.0, -1.0])
AHEAD = np.array([1.0, 0.0, 0.0])
"""Of a piece of furniture: away from the arm."""
MAX_TRIES = 1000
"""Draws of a scene before the settings are called impossible."""
PLACE_TRIES = 30
"""Draws of a free place for one thing before it is left out, or the scene is drawn anew."""
BENEATH = 0.3
"""Tables at least this high have a region beneath [m]."""
GAP = 0.01
"""Least distance between the things that stand on a table or on the ground [m]."""


@dataclass(frozen=True, eq=False)
class Region:
    """A box free of furniture, turned about the vertical, where the fingers are to be at start or goal."""

    center: Float[ndarray, "3"]
    """In the base frame [m]."""
    size: Float[ndarray, "3"]
    """Full edge lengths [m]."""
    yaw: float
    """Of the box [rad]."""
    approach: Float[ndarray, "3"]
    """Unit vector, in the base frame, along which the hand points: into a compartment, down into a crate."""


@dataclass(frozen=True, eq=False)
class Furnished:
    """A scene and its regions, at least two."""

    scene: Scene
    """The floor first."""
    regions: tuple[Region, ...]


def sample_target(
    region: Region, rng: Generator, spread: float = 0.4, fingers: float = FINGERS
) -> Float[ndarray, "4 4"]:
    """A random pose T_base_tip of the robot's tip link, with its fingers in the region.

    The point `fingers` [m] ahead of the link's origin, along its z axis, is uniform in the region less a
    margin. The z axis is uniform among the directions within `spread` [rad] of the region's approach, and the
    turn about it is uniform.
    """
    half = np.maximum(region.size / 2 - MARGIN, 0)
    point = region.center + rotation_about(-DOWN, region.yaw) @ rng.uniform(-half, half)
    tilt = np.arccos(rng.uniform(np.cos(spread), 1.0))
    turn, roll = rng.uniform(-np.pi, np.pi, 2)
    about_z = [rotation_about(-DOWN, float(angle)) for angle in (turn, roll)]
    tilted = about_z[0] @ rotation_about(np.array([0.0, 1.0, 0.0]), float(tilt)) @ about_z[1]
    rotation = rotation_z_to(region.approach) @ tilted
    return transform(point - fingers * rotation[:, 2], rotation)


LEAST = {"objects": 0, "boards": 2, "columns": 1, "crates": 1, "spots": 0, "lowest": 0}
"""What these ranges may start from; the others, but for angles, must be positive."""


@dataclass(frozen=True)
class FurnitureSettings:
    """What all families share. Every range is drawn from uniformly; equal ends fix the value."""

    bearing: Range = (-np.pi, np.pi)
    """Direction of the furniture from the base, from the x axis [rad]."""
    turn: Range = (-0.3, 0.3)
    """Turn of the furniture about the vertical, from where it faces the base [rad]."""
    reach: float = 0.8
    """Regions whose centre is farther than this from the shoulder are left out [m]."""
    objects: tuple[int, int] = (0, 4)
    """Least and greatest number of loose things."""
    object_width: Range = (0.05, 0.12)
    """Edges of a loose box, or diameter of a ball, as seen from above [m]."""
    object_height: Range = (0.06, 0.3)
    """Of loose boxes [m]."""
    ball_share: float = 0.25
    """Share of the loose things that are balls."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name.endswith("_share"):
                if not 0 <= value <= 1:
                    raise InputError(f"{field.name} is {value}; it must be between 0 and 1")
            elif isinstance(value, tuple):
                if not value[0] <= value[1]:
                    raise InputError(
                        f"{field.name} is from {value[0]} to {value[1]}; the first must not be greater"
                    )
                least = LEAST.get(field.name)
                if least is not None and value[0] < least:
                    raise InputError(f"{field.name} is from {value[0]}; it must be at least {least}")
                if least is None and field.name not in ("bearing", "turn") and not value[0] > 0:
                    raise InputError(f"{field.name} is from {value[0]}; it must be positive")
            elif not value > 0:
                raise InputError(f"{field.name} is {value}; it must be positive")

    @property
    def slots(self) -> int:
        """The greatest number of shapes in a scene, without the floor."""
        raise NotImplementedError


@dataclass(frozen=True)
class ShelfSettings(FurnitureSettings):
    """A bookcase that faces the arm: boards between uprights, open in front. Regions are its compartments and
    the space on its top board; the hand points into it. Of the loose things, at most one stands at a side of
    a compartment; one that would leave too little room there is left out. Lengths in [m]."""

    reach: float = 0.85
    """A hand that points ahead reaches farther than one that points down."""
    distance: Range = (0.45, 0.7)
    """From the base to the middle of the front."""
    boards: tuple[int, int] = (2, 4)
    lowest: Range = (0.0, 0.33)
    """Height of the lower side of the lowest board."""
    row_height: Range = (0.26, 0.42)
    """Free height between two boards, drawn for each row."""
    columns: tuple[int, int] = (1, 3)
    column_width: Range = (0.3, 0.5)
    """Free width between two uprights, drawn for each column."""
    depth: Range = (0.2, 0.35)
    thickness: Range = (0.01, 0.03)
    """Of all boards of a shelf."""
    back_share: float = 0.6
    """Share of the shelves that have a back."""

    @property
    def slots(self) -> int:
        return self.boards[1] + self.columns[1] + 2 + self.objects[1]


@dataclass(frozen=True)
class CrateSettings(FurnitureSettings):
    """Open-topped boxes on the ground or on blocks, and things around them. Regions are the insides of the
    crates and free spots on the ground; the hand points down. Lengths in [m]."""

    object_height: Range = (0.1, 0.5)
    crates: tuple[int, int] = (1, 2)
    distance: Range = (0.4, 0.65)
    """From the base to the middle of a crate, of a thing or of a spot."""
    length: Range = (0.25, 0.45)
    """Inside, along and across."""
    height: Range = (0.12, 0.3)
    """Of the walls, inside."""
    thickness: Range = (0.01, 0.03)
    """Of walls and bottom of a crate."""
    raised_share: float = 0.4
    """Share of the crates that stand on a block."""
    block_height: Range = (0.05, 0.3)
    spots: tuple[int, int] = (1, 2)
    """Number of free spots on the ground."""
    spot_size: Range = (0.12, 0.2)

    @property
    def slots(self) -> int:
        return 6 * self.crates[1] + self.objects[1]


@dataclass(frozen=True)
class TableSettings(FurnitureSettings):
    """A table with things on it, sometimes divided by a wall or with a pillar. Regions are free spots between
    the things, where the hand points down, and the space beneath a table on legs. Lengths in [m]."""

    objects: tuple[int, int] = (3, 10)
    object_height: Range = (0.08, 0.35)
    distance: Range = (0.25, 0.4)
    """From the base to the middle of the near edge."""
    height: Range = (0.1, 0.5)
    """Of the upper side."""
    length: Range = (0.45, 0.7)
    """Away from the arm."""
    width: Range = (0.8, 1.4)
    thickness: Range = (0.02, 0.04)
    """Of the top, and of a dividing wall."""
    legs_share: float = 0.5
    """Share of the tables on four legs; the others are solid."""
    leg_width: Range = (0.04, 0.07)
    wall_share: float = 0.5
    """Share of the tables with a wall that runs away from the arm, in the middle part."""
    pillar_share: float = 0.3
    """Share of the tables with a pillar."""
    divider_height: Range = (0.25, 0.6)
    """Of walls and pillars."""
    pillar_width: Range = (0.06, 0.12)
    spots: tuple[int, int] = (2, 4)
    spot_size: Range = (0.12, 0.2)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.wall_share + self.pillar_share > 1:
            raise InputError(
                f"wall_share is {self.wall_share} and pillar_share {self.pillar_share}; "
                "together they must be at most 1"
            )

    @property
    def slots(self) -> int:
        return 6 + self.objects[1]


SHELF = ShelfSettings()
CRATE = CrateSettings()
TABLE = TableSettings()
FURNITURE: dict[str, FurnitureSettings] = {"shelf": SHELF, "crate": CRATE, "table": TABLE}


def sample_furniture(
    settings: FurnitureSettings, rng: Generator, keep_out: Float[ndarray, "m 4"] | None = None
) -> Furnished:
    """A random scene of the family that the settings belong to; the same state of `rng` gives the same one.

    `keep_out` are spheres, x y z radius, that nothing but the floor may enter: those of the robot's immovable
    base (see `base_spheres`). Raises InputError if the settings leave no scene with two regions in reach.
    """
    build = BUILDERS[type(settings)]
    for _ in range(MAX_TRIES):
        drawn = build(settings, rng)
        if drawn is None:
            continue
        shapes, regions = drawn
        regions = [r for r in regions if np.linalg.norm(r.center - SHOULDER) <= settings.reach]
        if len(regions) >= 2 and (keep_out is None or _clear(shapes, keep_out)):
            return Furnished(Scene([FLOOR, *shapes]), tuple(regions))
    raise InputError(
        f"no scene of {type(settings).__name__} with two regions in reach and nothing in the robot's base in "
        f"{MAX_TRIES} draws; change distance or reach"
    )


def _clear(shapes: list[Box | Sphere], keep_out: Float[ndarray, "m 4"]) -> bool:
    return all((obstacle_distance(shape, keep_out[:, :3]) > keep_out[:, 3]).all() for shape in shapes)


Corner = tuple[float, float, float]
Drawn = tuple[list[Box | Sphere], list[Region]] | None
"""None: there was no room for something."""


class _Frame:
    """Where a piece of furniture stands: x points away from the arm, y to the left, z up from the ground."""

    def __init__(self, settings: FurnitureSettings, distance: Range, rng: Generator) -> None:
        bearing, away = rng.uniform(*settings.bearing), rng.uniform(*distance)
        self.yaw = float(bearing + rng.uniform(*settings.turn))
        self.xy = away * np.array([np.cos(bearing), np.sin(bearing)])
        self.rotation = rotation_about(-DOWN, self.yaw)

    def point(self, xyz: Float[ndarray, "3"]) -> Float[ndarray, "3"]:
        return self.rotation @ xyz + [*self.xy, 0.0]

    def box(self, low: Corner, high: Corner, name: str, turn: float = 0.0) -> Box:
        """A box by two corners, then turned about its middle."""
        half = (self.yaw + turn) / 2
        middle, size = (np.array(low) + high) / 2, np.subtract(high, low)
        return Box(self.point(middle), size, (np.cos(half), 0.0, 0.0, np.sin(half)), name)

    def region(self, low: Corner, high: Corner, approach: Float[ndarray, "3"]) -> Region:
        middle, size = (np.array(low) + high) / 2, np.subtract(high, low)
        return Region(self.point(middle), size, self.yaw, self.rotation @ approach)


class _Thing:
    """A loose box or ball, at most `tallest` high."""

    def __init__(self, settings: FurnitureSettings, rng: Generator, tallest: float = np.inf) -> None:
        x, y = rng.uniform(*settings.object_width, 2)
        self.ball = rng.random() < settings.ball_share
        x = min(x, tallest) if self.ball else x
        self.size = (x, x, x) if self.ball else (x, y, min(rng.uniform(*settings.object_height), tallest))
        self.turn = float(rng.uniform(-np.pi, np.pi))
        self.half = x / 2 if self.ball else float(np.hypot(x, y)) / 2
        """Half the side of a square that holds it, however it is turned."""

    def placed(self, frame: _Frame, x: float, y: float, z: float) -> Box | Sphere:
        """It stands on the height z at x, y of the frame."""
        a, b, c = self.size
        if self.ball:
            return Sphere(frame.point(np.array([x, y, z + c / 2])), c / 2, "ball")
        return frame.box((x - a / 2, y - b / 2, z), (x + a / 2, y + b / 2, z + c), "thing", self.turn)


Square = tuple[float, float, float, float]
"""A rectangle on a surface: x, y of the middle, half edges."""


def _is_free(square: Square, taken: list[Square]) -> bool:
    x, y, a, b = square
    return all(abs(x - u) >= a + c + GAP or abs(y - v) >= b + d + GAP for u, v, c, d in taken)


def _count(numbers: tuple[int, int], rng: Generator) -> int:
    return int(rng.integers(numbers[0], numbers[1] + 1))


def _shelf(s: ShelfSettings, rng: Generator) -> Drawn:
    frame = _Frame(s, s.distance, rng)
    depth, t = rng.uniform(*s.depth), rng.uniform(*s.thickness)
    rows = rng.uniform(*s.row_height, _count(s.boards, rng) - 1)
    tops = rng.uniform(*s.lowest) + t + np.concatenate([[0.0], np.cumsum(rows + t)])
    columns = rng.uniform(*s.column_width, _count(s.columns, rng))
    sides = np.concatenate([[0.0], np.cumsum(columns + t)])
    sides -= (sides[-1] + t) / 2
    left, right, height = sides[0], sides[-1] + t, tops[-1]
    shapes: list[Box | Sphere] = [
        frame.box((0.0, left + t, z - t), (depth, right - t, z), "board") for z in tops
    ]
    shapes += [frame.box((0.0, y, 0.0), (depth, y + t, height), "upright") for y in sides]
    if rng.random() < s.back_share:
        shapes.append(frame.box((depth, left, 0.0), (depth + t, right, height), "back"))
    ceilings = [*(tops[1:] - t), height + s.row_height[1]]
    rooms = [
        [y + t, y + t + w, z, ceiling]
        for z, ceiling in zip(tops, ceilings, strict=True)
        for y, w in zip(sides[:-1], columns, strict=True)
    ]
    things = min(_count(s.objects, rng), len(rooms))
    for i in rng.permutation(len(rooms))[:things]:
        low, high, z, ceiling = rooms[i]
        thing = _Thing(s, rng, ceiling - z - GAP)
        if 3 * thing.half > high - low:
            continue
        x = rng.uniform(min(thing.half, depth / 2), max(depth - thing.half, depth / 2))
        y = low + thing.half if rng.random() < 0.5 else high - thing.half
        shapes.append(thing.placed(frame, x, y, z))
        rooms[i][:2] = (y + thing.half, high) if y < (low + high) / 2 else (low, y - thing.half)
    regions = [frame.region((0.0, low, z), (depth, high, ceiling), AHEAD) for low, high, z, ceiling in rooms]
    return shapes, regions


def _standing(settings: CrateSettings, half: float, taken: list[Square], rng: Generator) -> _Frame | None:
    """A free place on the ground for something of this half width; it is taken from now on."""
    for _ in range(PLACE_TRIES):
        frame = _Frame(settings, settings.distance, rng)
        square = (float(frame.xy[0]), float(frame.xy[1]), half, half)
        if _is_free(square, taken):
            taken.append(square)
            return frame
    return None


def _crates(s: CrateSettings, rng: Generator) -> Drawn:
    shapes: list[Box | Sphere] = []
    regions: list[Region] = []
    taken: list[Square] = []
    for _ in range(_count(s.crates, rng)):
        (x, y), h, t = rng.uniform(*s.length, 2) / 2, rng.uniform(*s.height), rng.uniform(*s.thickness)
        frame = _standing(s, float(np.hypot(x + t, y + t)), taken, rng)
        if frame is None:
            return None
        low = 0.0
        if rng.random() < s.raised_share:
            low = rng.uniform(*s.block_height)
            shapes.append(frame.box((-x - t, -y - t, 0.0), (x + t, y + t, low), "block"))
        bottom, top = low + t, low + t + h
        shapes.append(frame.box((-x - t, -y - t, low), (x + t, y + t, bottom), "bottom"))
        for side in (-1, 1):
            a, b = sorted((side * x, side * (x + t)))
            shapes.append(frame.box((a, -y - t, bottom), (b, y + t, top), "wall"))
            a, b = sorted((side * y, side * (y + t)))
            shapes.append(frame.box((-x, a, bottom), (x, b, top), "wall"))
        regions.append(frame.region((-x, -y, bottom), (x, y, top), DOWN))
    for _ in range(_count(s.spots, rng)):
        half = rng.uniform(*s.spot_size) / 2
        frame = _standing(s, float(np.sqrt(2) * half), taken, rng)
        if frame is None:
            return None
        regions.append(frame.region((-half, -half, 0.0), (half, half, 2 * half), DOWN))
    for _ in range(_count(s.objects, rng)):
        thing = _Thing(s, rng)
        frame = _standing(s, thing.half, taken, rng)
        if frame is None:
            return None
        shapes.append(thing.placed(frame, 0.0, 0.0, 0.0))
    return shapes, regions


def _table(s: TableSettings, rng: Generator) -> Drawn:
    frame = _Frame(s, s.distance, rng)
    length, side = rng.uniform(*s.length), rng.uniform(*s.width) / 2
    height, t = rng.uniform(*s.height), rng.uniform(*s.thickness)
    legs = rng.random() < s.legs_share
    under = height - t
    bottom = under if legs else 0.0
    shapes: list[Box | Sphere] = [frame.box((0.0, -side, bottom), (length, side, height), "table")]
    regions: list[Region] = []
    if legs:
        w = rng.uniform(*s.leg_width)
        for x, y in ((0.0, -side), (0.0, side - w), (length - w, -side), (length - w, side - w)):
            shapes.append(frame.box((x, y, 0.0), (x + w, y + w, under), "leg"))
        if under > BENEATH:
            inner = side - w
            regions.append(frame.region((0.0, -inner, 0.0), (length / 2, inner, under), AHEAD))
    taken: list[Square] = []

    def place(half: float) -> tuple[float, float] | None:
        for _ in range(PLACE_TRIES if half < min(length / 2, side) else 0):
            x, y = float(rng.uniform(half, length - half)), float(rng.uniform(half - side, side - half))
            if _is_free((x, y, half, half), taken):
                taken.append((x, y, half, half))
                return x, y
        return None

    kind, top = rng.random(), height + rng.uniform(*s.divider_height)
    if kind < s.wall_share:
        start, y = rng.uniform(0.0, length / 3), rng.uniform(-side / 3, side / 3)
        shapes.append(frame.box((start, y - t / 2, height), (length, y + t / 2, top), "wall"))
        taken.append(((start + length) / 2, y, (length - start) / 2, t / 2))
    elif kind < s.wall_share + s.pillar_share:
        w = rng.uniform(*s.pillar_width) / 2
        spot = place(w)
        if spot is None:
            return None
        x, y = spot
        shapes.append(frame.box((x - w, y - w, height), (x + w, y + w, top), "pillar"))
    for _ in range(_count(s.spots, rng)):
        half = rng.uniform(*s.spot_size) / 2
        spot = place(half)
        if spot is None:
            return None
        (x, y), z = spot, height + 2 * half
        regions.append(frame.region((x - half, y - half, height), (x + half, y + half, z), DOWN))
    for _ in range(_count(s.objects, rng)):
        thing = _Thing(s, rng)
        spot = place(thing.half)
        if spot is None:
            return None
        shapes.append(thing.placed(frame, *spot, height))
    return shapes, regions


BUILDERS: dict[type[FurnitureSettings], Callable[..., Drawn]] = {
    ShelfSettings: _shelf,
    CrateSettings: _crates,
    TableSettings: _table,
}
