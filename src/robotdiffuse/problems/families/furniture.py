"""Furniture: base of the families with shelves, crates and tables around an arm that stands on the ground.

All shapes are spheres, and boxes rotated about the vertical axis, so that the scenes can be packed like
ROP's. Each scene has regions in which the arm works: in compartments, in crates and between the objects on a
table. `sample_target` samples poses with the fingers in a region.
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
    MIN_POSE_DOF,
    PositiveRange,
    Range,
    Ranges,
    SampledProblem,
    base_spheres,
    is_clear_of,
    reaching_configurations,
    sample_until_found,
)
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Sphere

FLOOR = Box((0.0, 0.0, -0.05), (3.0, 3.0, 0.1), name="floor")
"""A floor with its top at z = 0, large enough for all furniture around the arm."""
SHOULDER = np.array([0.0, 0.0, 0.33])
"""Origin of reaches: a Panda's shoulder [m]."""
REGION_MARGIN = 0.03
"""Distance of targets from the sides of their region, if it is wide enough [m]."""
FINGER_LENGTH = 0.1
"""Approximate distance from the origin of a Panda's tip link, along its z axis, to its fingertips [m]."""
HAND_LENGTH = 0.3
"""Maximum distance of the tip from the middle of the region that contains its fingers [m]."""
DOWN = np.array([0.0, 0.0, -1.0])
AHEAD = np.array([1.0, 0.0, 0.0])
"""Direction away from the arm, in the frame of the furniture."""
MAX_TRIES = 1000
"""Samples of a scene before the settings are rejected."""
PLACE_TRIES = 30
"""Samples of a free place for one object before the scene is sampled anew."""
MIN_GAP = 0.01
"""Minimum distance between the objects on a table or on the ground [m]."""


@dataclass(frozen=True, eq=False)
class Region:
    """A box without obstacles, rotated about the vertical axis, for the fingers at start or goal."""

    center: Float[ndarray, "3"]
    """In the base frame [m]."""
    size: Float[ndarray, "3"]
    """Full edge lengths [m]."""
    yaw: float
    """Rotation of the box about the vertical axis [rad]."""
    approach: Float[ndarray, "3"]
    """Unit vector, in the base frame, in which the hand points: into a compartment, or down into a crate."""


@dataclass(frozen=True, eq=False)
class FurnishedScene:
    """A scene and its regions, at least two."""

    scene: Scene
    """The scene; its first shape is the floor."""
    regions: tuple[Region, ...]


def sample_target(
    region: Region, rng: Generator, spread: float = 0.4, finger_length: float = FINGER_LENGTH
) -> Float[ndarray, "4 4"]:
    """A random pose T_base_tip of the robot's tip link, with its fingers in the region.

    The point at `finger_length` [m] along the link's z axis is uniform in the region, less a margin. The z
    axis is uniform among the directions within `spread` [rad] of the region's approach, and the rotation
    about it is uniform.
    """
    half = np.maximum(region.size / 2 - REGION_MARGIN, 0)
    point = region.center + rotation_about(-DOWN, region.yaw) @ rng.uniform(-half, half)
    tilt = np.arccos(rng.uniform(np.cos(spread), 1.0))
    turn, roll = rng.uniform(-np.pi, np.pi, 2)
    about_z = [rotation_about(-DOWN, float(angle)) for angle in (turn, roll)]
    tilted = about_z[0] @ rotation_about(np.array([0.0, 1.0, 0.0]), float(tilt)) @ about_z[1]
    rotation = rotation_z_to(region.approach) @ tilted
    return transform(point - finger_length * rotation[:, 2], rotation)


@dataclass(frozen=True)
class Furniture(Ranges, ABC):
    """Settings of all furniture families. Every range is sampled uniformly; equal bounds fix the value."""

    bearing: Range = (-np.pi, np.pi)
    """Direction from the base to the furniture, measured from the x axis [rad]."""
    turn: Range = (-0.3, 0.3)
    """Rotation of the furniture about the vertical axis; 0 faces the base [rad]."""
    reach: Positive = 0.8
    """Maximum distance of the centres of regions from the shoulder; other regions are left out [m]."""
    objects: tuple[Natural, Natural] = (0, 4)
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
    def build(self, rng: Generator) -> "Build":
        """The shapes and all regions, whether in reach or not. Raises NoRoomError."""

    @property
    def floor(self) -> Box:
        return FLOOR

    @property
    def region(self) -> Float[ndarray, "2 3"]:
        """Box of tip positions: the hand may be outside the region that contains its fingers."""
        far = self.reach + HAND_LENGTH
        return np.array([[-far, -far, 0.0], [far, far, SHOULDER[2] + far]])

    def furnish(self, rng: Generator, keep_out: Float[ndarray, "m 4"] | None = None) -> FurnishedScene:
        """A random scene; the same state of `rng` gives the same scene.

        keep_out: spheres (x, y, z, radius), e.g. of the robot's fixed base, that only the floor may
        intersect. Raises InputError if no scene with two regions in reach was found.
        """
        for _ in range(MAX_TRIES):
            try:
                shapes, regions = self.build(rng)
            except NoRoomError:
                continue
            regions = [r for r in regions if np.linalg.norm(r.center - SHOULDER) <= self.reach]
            if len(regions) >= 2 and all(is_clear_of(shape, keep_out) for shape in shapes):
                return FurnishedScene(Scene([self.floor, *shapes]), tuple(regions))
        raise InputError(
            f"no scene of {type(self).__name__} with two regions in reach and nothing in the robot's base in "
            f"{MAX_TRIES} samples; change distance or reach"
        )

    def scene(self, rng: Generator, keep_out: Float[ndarray, "m 4"] | None = None) -> Scene:
        return self.furnish(rng, keep_out).scene

    def draw(
        self, robot: Robot, rng: Generator, goals: int = 1, target: str = CONFIGURATION
    ) -> SampledProblem:
        """A random problem; see `Family.draw`.

        For every target, start and goals have the fingers in two of the regions; arms with fewer than six
        joints only reach the positions of these poses.
        """
        keep_out = base_spheres(robot)

        def attempt() -> SampledProblem | None:
            furnished = self.furnish(rng, keep_out)
            checker = CollisionChecker(robot, furnished.scene)
            first, second = (furnished.regions[i] for i in rng.choice(len(furnished.regions), 2, False))
            start = reaching_configurations(robot, sample_target(first, rng), 1, checker, rng)
            if not len(start):
                return None
            T_base_tip = sample_target(second, rng)
            reached = reaching_configurations(robot, T_base_tip, goals, checker, rng)
            if len(reached) and robot.dof < MIN_POSE_DOF:
                T_base_tip = link_pose(robot, reached[0].astype(np.float64), robot.tip)
            return SampledProblem(furnished.scene, start[0], reached, T_base_tip) if len(reached) else None

        return sample_until_found(attempt, self, robot)


Corner = tuple[float, float, float]
Build = tuple[list[Box | Sphere], list[Region]]


class FurnitureFrame:
    """Frame of a piece of furniture: x points away from the arm, y to the left, z up from the ground."""

    def __init__(self, settings: Furniture, distance: Range, rng: Generator) -> None:
        bearing, away = rng.uniform(*settings.bearing), rng.uniform(*distance)
        self.yaw = float(bearing + rng.uniform(*settings.turn))
        self.xy = away * np.array([np.cos(bearing), np.sin(bearing)])
        self.rotation = rotation_about(-DOWN, self.yaw)

    def point(self, xyz: Float[ndarray, "3"]) -> Float[ndarray, "3"]:
        """A point of this frame, in the base frame [m]."""
        return self.rotation @ xyz + [*self.xy, 0.0]

    def box(self, low: Corner, high: Corner, name: str, turn: float = 0.0) -> Box:
        """A box with two opposite corners in this frame, then rotated about its middle by `turn` [rad]."""
        half = (self.yaw + turn) / 2
        middle, size = (np.array(low) + high) / 2, np.subtract(high, low)
        return Box(self.point(middle), size, (np.cos(half), 0.0, 0.0, np.sin(half)), name)

    def region(self, low: Corner, high: Corner, approach: Float[ndarray, "3"]) -> Region:
        middle, size = (np.array(low) + high) / 2, np.subtract(high, low)
        return Region(self.point(middle), size, self.yaw, self.rotation @ approach)


class LooseObject:
    """A random loose box or ball, at most `tallest` high [m]."""

    def __init__(self, settings: Furniture, rng: Generator, tallest: float = np.inf) -> None:
        x, y = rng.uniform(*settings.object_width, 2)
        self.ball = rng.random() < settings.ball_share
        x = min(x, tallest) if self.ball else x
        self.size = (x, x, x) if self.ball else (x, y, min(rng.uniform(*settings.object_height), tallest))
        self.turn = float(rng.uniform(-np.pi, np.pi))
        self.half = x / 2 if self.ball else float(np.hypot(x, y)) / 2
        """Half the side of a square that contains it at any rotation."""

    def placed(self, frame: FurnitureFrame, x: float, y: float, z: float) -> Box | Sphere:
        """The shape at x, y of the frame, standing at height z."""
        a, b, c = self.size
        if self.ball:
            return Sphere(frame.point(np.array([x, y, z + c / 2])), c / 2, "ball")
        return frame.box((x - a / 2, y - b / 2, z), (x + a / 2, y + b / 2, z + c), "thing", self.turn)


Rectangle = tuple[float, float, float, float]
"""A rectangle on a surface: x, y of the middle, half edges."""


class NoRoomError(Exception):
    """No free place for an object was found: the scene is sampled anew."""


class Surface:
    """The top of a table or a counter, where free places for objects and for the fingers are found.

    It extends from 0 to `length` along x and to `side` in both directions of y, at a height [m].
    """

    def __init__(self, frame: FurnitureFrame, length: float, side: float, height: float) -> None:
        self.frame, self.length, self.side, self.height = frame, length, side, height
        self.taken: list[Rectangle] = []

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

    def spots(self, numbers: tuple[int, int], size: Range, rng: Generator) -> list[Region]:
        """Random free regions, as high as they are wide, where the hand points down."""
        found: list[Region] = []
        for _ in range(count(numbers, rng)):
            half = rng.uniform(*size) / 2
            (x, y), top = self.place(half, half, rng), self.height + 2 * half
            low, high = (x - half, y - half, self.height), (x + half, y + half, top)
            found.append(self.frame.region(low, high, DOWN))
        return found

    def loose_objects(self, settings: Furniture, rng: Generator) -> list[Box | Sphere]:
        """The random loose objects of the settings."""
        found: list[Box | Sphere] = []
        for _ in range(count(settings.objects, rng)):
            loose = LooseObject(settings, rng)
            found.append(loose.placed(self.frame, *self.place(loose.half, loose.half, rng), self.height))
        return found


def is_free(square: Rectangle, taken: list[Rectangle]) -> bool:
    """Whether a rectangle keeps MIN_GAP from all those that are taken."""
    x, y, a, b = square
    return all(abs(x - u) >= a + c + MIN_GAP or abs(y - v) >= b + d + MIN_GAP for u, v, c, d in taken)


def count(numbers: tuple[int, int], rng: Generator) -> int:
    """A random number between two, inclusive."""
    return int(rng.integers(numbers[0], numbers[1] + 1))
