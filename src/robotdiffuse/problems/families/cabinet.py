"""A cabinet of any proportions: open cells, doors at any angle, drawers pulled out, legs or none."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from robotdiffuse.core.settings import Count, Natural, NotNegative, Positive, Share
from robotdiffuse.problems.families.family import PositiveRange, Range
from robotdiffuse.problems.families.furniture import (
    AHEAD,
    DOWN,
    MIN_GAP,
    Build,
    Furniture,
    FurnitureFrame,
    LooseObject,
    count,
)
from robotdiffuse.scenes.shapes import Box, Sphere

MIN_OPENING = 0.16
"""Minimum height and width of an opening that the hand is to enter [m]."""
DRAWER_SHAPES = 5


@dataclass(frozen=True)
class Cabinet(Furniture):
    """A grid of cells between thin or thick boards, from a desk to a tall bookcase. Lengths in [m].

    A cell is open, has a door that is shut or stands at any angle, or a drawer that is pulled out. The
    cabinet stands on the ground or on legs, or hangs. Regions are open cells, the insides of drawers, where
    the hand points down, the top, and the space between the legs.
    """

    turn: Range = (-0.7, 0.7)
    reach: Positive = 0.85
    object_width: PositiveRange = (0.03, 0.14)
    object_height: PositiveRange = (0.03, 0.35)
    objects: tuple[Natural, Natural] = (0, 6)
    distance: PositiveRange = (0.35, 0.8)
    """From the base to the middle of the front."""
    lowest: tuple[NotNegative, NotNegative] = (0.0, 0.7)
    """Height of the underside of the lowest board of a cabinet that does not stand on the ground."""
    ground_share: Share = 0.4
    """Fraction of the cabinets whose lowest board is on the ground."""
    legs_share: Share = 0.6
    """Fraction of the other cabinets that have legs; the rest hang."""
    rows: tuple[Count, Count] = (1, 4)
    row_height: PositiveRange = (0.12, 0.55)
    columns: tuple[Count, Count] = (1, 3)
    column_width: PositiveRange = (0.2, 0.7)
    depth: PositiveRange = (0.15, 0.6)
    thickness: PositiveRange = (0.004, 0.05)
    """Thickness of all boards; its logarithm is uniform."""
    back_share: Share = 0.6
    """Fraction of the cabinets with a back."""
    top_share: Share = 0.85
    """Fraction of the cabinets with a board on top."""
    door_share: Share = 0.2
    """Fraction of the cells with a door."""
    door_angle: PositiveRange = (0.3, 2.8)
    """Angle at which an open door stands [rad]."""
    shut_share: Share = 0.3
    """Fraction of the doors that are shut."""
    drawer_share: Share = 0.15
    """Fraction of the cells with a drawer."""
    pulled: PositiveRange = (0.3, 0.95)
    """How far a drawer is pulled out, as a fraction of the depth."""

    @property
    def max_obstacles(self) -> int:
        rows, columns = self.rows[1], self.columns[1]
        legs, back = 4, 1
        return rows + 1 + columns + 1 + DRAWER_SHAPES * rows * columns + legs + back + self.objects[1]

    def build(self, rng: Generator) -> Build:
        frame = FurnitureFrame(self, self.distance, rng)
        depth, t = rng.uniform(*self.depth), float(np.exp(rng.uniform(*np.log(self.thickness))))
        on_ground = rng.random() < self.ground_share
        low = 0.0 if on_ground else rng.uniform(*self.lowest)
        tops = low + t + _edges(rng.uniform(*self.row_height, count(self.rows, rng)), t)
        sides = _edges(rng.uniform(*self.column_width, count(self.columns, rng)), t)
        sides -= (sides[-1] + t) / 2
        left, right, height = float(sides[0]), float(sides[-1]) + t, float(tops[-1])
        boards = tops if rng.random() < self.top_share else tops[:-1]
        shapes: list[Box | Sphere] = [
            frame.box((0.0, left + t, z - t), (depth, right - t, z), "board") for z in boards.tolist()
        ]
        shapes += [frame.box((0.0, y, low), (depth, y + t, height), "upright") for y in sides.tolist()]
        if rng.random() < self.back_share:
            shapes.append(frame.box((depth, left, low), (depth + t, right, height), "back"))
        regions = []
        if not on_ground and rng.random() < self.legs_share:
            w = 2 * t
            for x in (0.0, depth - w):
                for y in (left, right - w):
                    shapes.append(frame.box((x, y, 0.0), (x + w, y + w, low), "leg"))
        if low > MIN_OPENING:
            regions.append(frame.region((0.0, left + 2 * t, 0.0), (depth / 2, right - 2 * t, low), AHEAD))
        if len(boards) == len(tops):
            regions.append(frame.region((0.0, left, height), (depth, right, height + 0.3), AHEAD))
        free = []
        for z, ceiling in zip(tops[:-1].tolist(), (tops[1:] - t).tolist(), strict=True):
            for y, end in zip((sides[:-1] + t).tolist(), sides[1:].tolist(), strict=True):
                kind = rng.random()
                if kind < self.door_share:
                    shut = rng.random() < self.shut_share
                    angle = 0.0 if shut else rng.uniform(*self.door_angle)
                    shapes.append(_door(frame, (y, end, z, ceiling), t, angle, rng.random() < 0.5))
                    if shut:
                        continue
                elif kind < self.door_share + self.drawer_share:
                    front = -depth * rng.uniform(*self.pulled)
                    top = z + (ceiling - z) * rng.uniform(0.4, 1.0)
                    shapes += _drawer(frame, (front, y, z), (front + depth, end, top), t)
                    inside = (front + t, y + t, z + t), (min(0.0, front + depth), end - t, top)
                    regions.append(frame.region(*inside, DOWN))
                    continue
                free.append([y, end, z, ceiling])
        things = min(count(self.objects, rng), len(free))
        for i in rng.permutation(len(free))[:things]:
            y, end, z, ceiling = free[i]
            loose = LooseObject(self, rng, ceiling - z - MIN_GAP)
            if 3 * loose.half > end - y:
                continue
            x = rng.uniform(min(loose.half, depth / 2), max(depth - loose.half, depth / 2))
            at = rng.uniform(y + loose.half, end - loose.half)
            shapes.append(loose.placed(frame, x, at, z))
            free[i][:2] = (at + loose.half, end) if at < (y + end) / 2 else (y, at - loose.half)
        regions += [
            frame.region((0.0, y, z), (depth, end, ceiling), AHEAD)
            for y, end, z, ceiling in free
            if min(end - y, ceiling - z) > MIN_OPENING
        ]
        return shapes, regions


def _edges(sizes: np.ndarray, t: float) -> np.ndarray:
    """Positions of the boards between gaps of these sizes, beginning with 0."""
    return np.concatenate([[0.0], np.cumsum(sizes + t)])


def _door(
    frame: FurnitureFrame, cell: tuple[float, float, float, float], t: float, angle: float, on_left: bool
) -> Box:
    """A door of a cell (right, left, bottom, top), open by an angle about its left or right edge [rad]."""
    y, end, z, ceiling = cell
    hinge, side = (end, -1.0) if on_left else (y, 1.0)
    half = (end - y) / 2
    middle = np.array([-half * np.sin(angle), hinge + side * half * np.cos(angle)])
    low = (middle[0] - t / 2, middle[1] - half, z)
    high = (middle[0] + t / 2, middle[1] + half, ceiling)
    return frame.box(low, high, "door", side * angle)


def _drawer(
    frame: FurnitureFrame, low: tuple[float, float, float], high: tuple[float, float, float], t: float
) -> list[Box]:
    """The bottom, front, back and sides of a drawer."""
    (x, y, z), (far, end, top) = low, high
    corners = (
        (low, (far, end, z + t)),
        ((x, y, z + t), (x + t, end, top)),
        ((far - t, y, z + t), (far, end, top)),
        ((x + t, y, z + t), (far - t, y + t, top)),
        ((x + t, end - t, z + t), (far - t, end, top)),
    )
    return [frame.box(a, b, "drawer") for a, b in corners]


CABINET = Cabinet()
