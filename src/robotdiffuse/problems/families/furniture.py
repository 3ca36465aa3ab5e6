"""What the families of furniture share: shelves, crates and tables around an arm that stands on the ground.

Everything is made of spheres and of boxes turned about the vertical, so the scenes pack as ROP's do. Each
comes with regions, where the fingers of the arm have something to do: in compartments, in crates and between
the things on a table; `sample_target` draws poses there.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Natural, Positive, Share
from robotdiffuse.core.transforms import rotation_about, rotation_z_to, transform
from robotdiffuse.problems.families.family import (
    CONFIGURATION,
    POSE_JOINTS,
    Drawn,
    PositiveRange,
    Range,
    Ranges,
    base_spheres,
    first_drawn,
    keeps_out,
    reaching_configurations,
)
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Sphere

FLOOR = Box((0.0, 0.0, -0.05), (3.0, 3.0, 0.1), name="floor")
"""With its top at z = 0: wide enough for all that stands around the arm."""
SHOULDER = np.array([0.0, 0.0, 0.33])
"""Reaches are measured from here, a Panda's shoulder [m]."""
MARGIN = 0.03
"""Targets keep this distance from the sides of their region where it is wide enough [m]."""
FINGERS = 0.1
"""From the origin of a Panda's tip link, along its z axis, to about its fingertips [m]."""
HAND = 0.3
"""The tip is at most this far from the middle of the region that its fingers are in [m]."""
DOWN = np.array([0.0, 0.0, -1.0])
AHEAD = np.array([1.0, 0.0, 0.0])
"""Of a piece of furniture: away from the arm."""
MAX_TRIES = 1000
"""Draws of a scene before the settings are called impossible."""
PLACE_TRIES = 30
"""Draws of a free place for one thing before the scene is drawn anew."""
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


@dataclass(frozen=True)
class Furniture(Ranges, ABC):
    """What all families share. Every range is drawn from uniformly; equal ends fix the value."""

    bearing: Range = (-np.pi, np.pi)
    """Direction of the furniture from the base, from the x axis [rad]."""
    turn: Range = (-0.3, 0.3)
    """Turn of the furniture about the vertical, from where it faces the base [rad]."""
    reach: Positive = 0.8
    """Regions whose centre is farther than this from the shoulder are left out [m]."""
    objects: tuple[Natural, Natural] = (0, 4)
    """Least and greatest number of loose things."""
    object_width: PositiveRange = (0.05, 0.12)
    """Edges of a loose box, or diameter of a ball, as seen from above [m]."""
    object_height: PositiveRange = (0.06, 0.3)
    """Of loose boxes [m]."""
    ball_share: Share = 0.25
    """Share of the loose things that are balls."""

    @property
    @abstractmethod
    def most_obstacles(self) -> int:
        """Of a scene, the floor left out."""

    @abstractmethod
    def build(self, rng: Generator) -> "Built":
        """Shapes and regions, in reach or not; raises NoRoomError."""

    @property
    def floor(self) -> Box:
        return FLOOR

    @property
    def region(self) -> Float[ndarray, "2 3"]:
        """The hand may be outside a region that its fingers are in."""
        far = self.reach + HAND
        return np.array([[-far, -far, 0.0], [far, far, SHOULDER[2] + far]])

    def furnish(self, rng: Generator, keep_out: Float[ndarray, "m 4"] | None = None) -> Furnished:
        """A random scene; the same state of `rng` gives the same one.

        `keep_out` are spheres, x y z radius, that nothing but the floor may enter: those of the robot's
        immovable base. Raises InputError if the settings leave no scene with two regions in reach.
        """
        for _ in range(MAX_TRIES):
            try:
                shapes, regions = self.build(rng)
            except NoRoomError:
                continue
            regions = [r for r in regions if np.linalg.norm(r.center - SHOULDER) <= self.reach]
            if len(regions) >= 2 and all(keeps_out(shape, keep_out) for shape in shapes):
                return Furnished(Scene([self.floor, *shapes]), tuple(regions))
        raise InputError(
            f"no scene of {type(self).__name__} with two regions in reach and nothing in the robot's base in "
            f"{MAX_TRIES} draws; change distance or reach"
        )

    def scene(self, rng: Generator, keep_out: Float[ndarray, "m 4"] | None = None) -> Scene:
        return self.furnish(rng, keep_out).scene

    def draw(self, robot: Robot, rng: Generator, goals: int = 1, target: str = CONFIGURATION) -> Drawn:
        """Start and goals are poses with the fingers in two of the regions, whatever the target; for an arm
        of fewer than six joints, their positions."""
        keep_out = base_spheres(robot)

        def attempt() -> Drawn | None:
            furnished = self.furnish(rng, keep_out)
            checker = CollisionChecker(robot, furnished.scene)
            first, second = (furnished.regions[i] for i in rng.choice(len(furnished.regions), 2, False))
            start = reaching_configurations(robot, sample_target(first, rng), 1, checker, rng)
            if not len(start):
                return None
            T_base_tip = sample_target(second, rng)
            reached = reaching_configurations(robot, T_base_tip, goals, checker, rng)
            if len(reached) and robot.dof < POSE_JOINTS:
                T_base_tip = link_pose(robot, reached[0].astype(np.float64), robot.tip)
            return Drawn(furnished.scene, start[0], reached, T_base_tip) if len(reached) else None

        return first_drawn(attempt, self, robot)


Corner = tuple[float, float, float]
Built = tuple[list[Box | Sphere], list[Region]]


class Standing:
    """Where a piece of furniture stands: x points away from the arm, y to the left, z up from the ground."""

    def __init__(self, settings: Furniture, distance: Range, rng: Generator) -> None:
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


class Thing:
    """A loose box or ball, at most `tallest` high."""

    def __init__(self, settings: Furniture, rng: Generator, tallest: float = np.inf) -> None:
        x, y = rng.uniform(*settings.object_width, 2)
        self.ball = rng.random() < settings.ball_share
        x = min(x, tallest) if self.ball else x
        self.size = (x, x, x) if self.ball else (x, y, min(rng.uniform(*settings.object_height), tallest))
        self.turn = float(rng.uniform(-np.pi, np.pi))
        self.half = x / 2 if self.ball else float(np.hypot(x, y)) / 2
        """Half the side of a square that holds it, however it is turned."""

    def placed(self, frame: Standing, x: float, y: float, z: float) -> Box | Sphere:
        """It stands on the height z at x, y of the frame."""
        a, b, c = self.size
        if self.ball:
            return Sphere(frame.point(np.array([x, y, z + c / 2])), c / 2, "ball")
        return frame.box((x - a / 2, y - b / 2, z), (x + a / 2, y + b / 2, z + c), "thing", self.turn)


Square = tuple[float, float, float, float]
"""A rectangle on a surface: x, y of the middle, half edges."""


class NoRoomError(Exception):
    """There is no free place for something: the scene is drawn anew."""


class Surface:
    """The upper side of a table or a counter, at a height [m], from 0 to `length` ahead and `side` to either
    hand: finds free places for things and for the fingers."""

    def __init__(self, frame: Standing, length: float, side: float, height: float) -> None:
        self.frame, self.length, self.side, self.height = frame, length, side, height
        self.taken: list[Square] = []

    def place(self, half_x: float, half_y: float, rng: Generator) -> tuple[float, float]:
        """The middle of a free rectangle, which is taken then; raises NoRoomError."""
        fits = half_x < self.length / 2 and half_y < self.side
        for _ in range(PLACE_TRIES if fits else 0):
            x = float(rng.uniform(half_x, self.length - half_x))
            y = float(rng.uniform(half_y - self.side, self.side - half_y))
            if is_free((x, y, half_x, half_y), self.taken):
                self.taken.append((x, y, half_x, half_y))
                return x, y
        raise NoRoomError

    def spots(self, numbers: tuple[int, int], size: Range, rng: Generator) -> list[Region]:
        """Regions that nothing stands on, as high as they are wide, where the hand points down."""
        found: list[Region] = []
        for _ in range(count(numbers, rng)):
            half = rng.uniform(*size) / 2
            (x, y), top = self.place(half, half, rng), self.height + 2 * half
            low, high = (x - half, y - half, self.height), (x + half, y + half, top)
            found.append(self.frame.region(low, high, DOWN))
        return found

    def things(self, settings: Furniture, rng: Generator) -> list[Box | Sphere]:
        """The settings' number of loose things."""
        found: list[Box | Sphere] = []
        for _ in range(count(settings.objects, rng)):
            thing = Thing(settings, rng)
            found.append(thing.placed(self.frame, *self.place(thing.half, thing.half, rng), self.height))
        return found


def is_free(square: Square, taken: list[Square]) -> bool:
    x, y, a, b = square
    return all(abs(x - u) >= a + c + GAP or abs(y - v) >= b + d + GAP for u, v, c, d in taken)


def count(numbers: tuple[int, int], rng: Generator) -> int:
    return int(rng.integers(numbers[0], numbers[1] + 1))
