"""A cabinet of any proportions: open cells, doors at any angle, drawers pulled out, legs or none."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.core.settings import Count, Natural, NotNegative, Positive, Share
from robotdiffuse.problems.families.family import PositiveRange, Range
from robotdiffuse.problems.families.furniture import (
    AHEAD,
    DOWN,
    MIN_GAP,
    Build,
    Corner,
    Furniture,
    FurnitureFrame,
    LooseObject,
    count,
)
from robotdiffuse.scenes.shapes import Box, Sphere

MIN_OPENING = 0.16
"""Minimum height and width of an opening that the hand is to enter [m]."""
TOP_HEIGHT = 0.3
"""Height of the region above a cabinet [m]."""
MIN_REGION = 0.1
"""Minimum edge of a region [m]."""
DRAWER_SHAPES = 5
Cell = tuple[float, float, float, float]
"""Right and left side, bottom and top [m]."""


@dataclass(frozen=True)
class Cabinet(Furniture):
    """A grid of cells between thin or thick boards, from a desk to a tall bookcase. Lengths in [m].

    A cell is open, has a door that is shut or stands at any angle, or a drawer that is pulled out. The
    cabinet stands on the ground or on legs, or hangs. Regions are open cells, the insides of drawers, where
    the hand points down, the top, and the space between the legs.
    """

    turn: Range = (-0.5, 0.5)
    reach: Positive = 0.85
    object_width: PositiveRange = (0.03, 0.14)
    object_height: PositiveRange = (0.03, 0.35)
    objects: tuple[Natural, Natural] = (0, 6)
    distance: PositiveRange = (0.35, 0.65)
    """From the base to the middle of the front."""
    lowest: tuple[NotNegative, NotNegative] = (0.0, 0.7)
    """Height of the underside of the lowest board of a cabinet that does not stand on the ground."""
    ground_share: Share = 0.4
    """Fraction of the cabinets whose lowest board is on the ground."""
    legs_share: Share = 0.6
    """Fraction of the other cabinets that have legs; the rest hang."""
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
    """Angle at which an open door stands [rad]."""
    shut_share: Share = 0.3
    """Fraction of the doors that are shut."""
    drawer_share: Share = 0.15
    """Fraction of the cells with a drawer, up to `max_drawers`. Beside drawers, doors open to a right angle
    at most."""
    max_drawers: Natural = 2
    pulled: PositiveRange = (0.3, 0.95)
    """How far a drawer is pulled out, as a fraction of the depth."""

    @property
    def max_obstacles(self) -> int:
        boards, uprights, doors = self.rows[1] + 1, self.columns[1] + 1, self.rows[1] * self.columns[1]
        legs, back = 4, 1
        return boards + uprights + legs + back + doors + DRAWER_SHAPES * self.max_drawers + self.objects[1]

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
        regions: list[tuple[Corner, Corner, Float[ndarray, "3"]]] = []
        if not on_ground and rng.random() < self.legs_share:
            w = 2 * t
            for x in (0.0, depth - w):
                for y in (left, right - w):
                    shapes.append(frame.box((x, y, 0.0), (x + w, y + w, low), "leg"))
        if low > MIN_OPENING:
            regions.append(((0.0, left + 2 * t, 0.0), (depth / 2, right - 2 * t, low), AHEAD))
        if len(boards) == len(tops):
            regions.append(((0.0, left, height), (depth, right, height + TOP_HEIGHT), AHEAD))
        cells = [
            (y + t, end, z, ceiling)
            for z, ceiling in zip(tops[:-1].tolist(), (tops[1:] - t).tolist(), strict=True)
            for y, end in zip(sides[:-1].tolist(), sides[1:].tolist(), strict=True)
        ]
        kinds = rng.random(len(cells))
        drawers = np.flatnonzero(kinds < self.drawer_share)[: self.max_drawers]
        widest = min(self.door_angle[1], np.pi / 2) if len(drawers) else self.door_angle[1]
        free = []
        for i, cell in enumerate(cells):
            if i in drawers:
                walls, inside = self._drawer(frame, cell, depth, t, rng)
                shapes += walls
                regions.append((*inside, DOWN))
            elif kinds[i] > 1 - self.door_share:
                shut = rng.random() < self.shut_share
                angle = 0.0 if shut else rng.uniform(self.door_angle[0], widest)
                shapes.append(_door(frame, cell, t, angle, rng.random() < 0.5))
                free += [] if shut else [[*cell]]
            else:
                free.append([*cell])
        shapes += self._loose_objects(frame, depth, free, rng)
        regions += [((t, y, z), (depth, end, ceiling), AHEAD) for y, end, z, ceiling in free]
        return shapes, [frame.region(*region) for region in regions if _is_wide(*region)]

    def _drawer(
        self, frame: FurnitureFrame, cell: Cell, depth: float, t: float, rng: Generator
    ) -> tuple[list[Box | Sphere], tuple[Corner, Corner]]:
        """The bottom, front, back and sides of a drawer that is pulled out of a cell, and the part of its
        inside that is in front of the cabinet."""
        y, end, z, ceiling = cell
        x, top = -depth * rng.uniform(*self.pulled), z + (ceiling - z) * rng.uniform(0.4, 1.0)
        far = x + depth
        corners = (
            ((x, y, z), (far, end, z + t)),
            ((x, y, z + t), (x + t, end, top)),
            ((far - t, y, z + t), (far, end, top)),
            ((x + t, y, z + t), (far - t, y + t, top)),
            ((x + t, end - t, z + t), (far - t, end, top)),
        )
        inside = (x + t, y + t, z + t), (min(0.0, far - t), end - t, top)
        return [frame.box(a, b, "drawer") for a, b in corners], inside

    def _loose_objects(
        self, frame: FurnitureFrame, depth: float, free: list[list[float]], rng: Generator
    ) -> list[Box | Sphere]:
        """Objects in free cells, whose free part becomes narrower."""
        shapes: list[Box | Sphere] = []
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
        return shapes


def _edges(sizes: Float[ndarray, "n"], t: float) -> Float[ndarray, "n+1"]:
    """Positions of the boards between gaps of these sizes, beginning with 0."""
    return np.concatenate([[0.0], np.cumsum(sizes + t)])


def _is_wide(low: Corner, high: Corner, approach: Float[ndarray, "3"]) -> bool:
    """Whether the hand gets into a region."""
    size = np.subtract(high, low)
    return bool(size.min() > MIN_REGION and (approach is DOWN or size[1:].min() > MIN_OPENING))


def _door(frame: FurnitureFrame, cell: Cell, t: float, angle: float, on_left: bool) -> Box:
    """A door of a cell, open by an angle about its left or right edge [rad]."""
    y, end, z, ceiling = cell
    hinge, side = (end, -1.0) if on_left else (y, 1.0)
    half = (end - y) / 2
    middle = np.array([-half * np.sin(angle), hinge + side * half * np.cos(angle)])
    low = (middle[0] - t / 2, middle[1] - half, z)
    high = (middle[0] + t / 2, middle[1] + half, ceiling)
    return frame.box(low, high, "door", side * angle)


CABINET = Cabinet()
