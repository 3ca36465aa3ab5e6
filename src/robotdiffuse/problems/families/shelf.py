"""A bookcase that faces the arm."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.random import Generator

from robotdiffuse.core.settings import Bound, Count, NotNegative, Positive, Share
from robotdiffuse.problems.families.family import PositiveRange
from robotdiffuse.problems.families.furniture import (
    AHEAD,
    GAP,
    Built,
    Furniture,
    Standing,
    Thing,
    count,
)
from robotdiffuse.scenes.shapes import Box, Sphere

AtLeastTwo = Annotated[int, Bound(least=2.0)]


@dataclass(frozen=True)
class Shelf(Furniture):
    """A bookcase that faces the arm: boards between uprights, open in front. Regions are its compartments and
    the space on its top board; the hand points into it. Of the loose things, at most one stands at a side of
    a compartment; one that would leave too little room there is left out. Lengths in [m]."""

    reach: Positive = 0.85
    """A hand that points ahead reaches farther than one that points down."""
    distance: PositiveRange = (0.45, 0.7)
    """From the base to the middle of the front."""
    boards: tuple[AtLeastTwo, AtLeastTwo] = (2, 4)
    lowest: tuple[NotNegative, NotNegative] = (0.0, 0.33)
    """Height of the lower side of the lowest board."""
    row_height: PositiveRange = (0.26, 0.42)
    """Free height between two boards, drawn for each row."""
    columns: tuple[Count, Count] = (1, 3)
    column_width: PositiveRange = (0.3, 0.5)
    """Free width between two uprights, drawn for each column."""
    depth: PositiveRange = (0.2, 0.35)
    thickness: PositiveRange = (0.01, 0.03)
    """Of all boards of a shelf."""
    back_share: Share = 0.6
    """Share of the shelves that have a back."""

    @property
    def most_obstacles(self) -> int:
        return self.boards[1] + self.columns[1] + 2 + self.objects[1]

    def build(self, rng: Generator) -> Built:
        frame = Standing(self, self.distance, rng)
        depth, t = rng.uniform(*self.depth), rng.uniform(*self.thickness)
        rows = rng.uniform(*self.row_height, count(self.boards, rng) - 1)
        tops = rng.uniform(*self.lowest) + t + np.concatenate([[0.0], np.cumsum(rows + t)])
        columns = rng.uniform(*self.column_width, count(self.columns, rng))
        sides = np.concatenate([[0.0], np.cumsum(columns + t)])
        sides -= (sides[-1] + t) / 2
        left, right, height = sides[0], sides[-1] + t, tops[-1]
        shapes: list[Box | Sphere] = [
            frame.box((0.0, left + t, z - t), (depth, right - t, z), "board") for z in tops
        ]
        shapes += [frame.box((0.0, y, 0.0), (depth, y + t, height), "upright") for y in sides]
        if rng.random() < self.back_share:
            shapes.append(frame.box((depth, left, 0.0), (depth + t, right, height), "back"))
        ceilings = [*(tops[1:] - t), height + self.row_height[1]]
        rooms = [
            [y + t, y + t + w, z, ceiling]
            for z, ceiling in zip(tops, ceilings, strict=True)
            for y, w in zip(sides[:-1], columns, strict=True)
        ]
        things = min(count(self.objects, rng), len(rooms))
        for i in rng.permutation(len(rooms))[:things]:
            low, high, z, ceiling = rooms[i]
            thing = Thing(self, rng, ceiling - z - GAP)
            if 3 * thing.half > high - low:
                continue
            x = rng.uniform(min(thing.half, depth / 2), max(depth - thing.half, depth / 2))
            y = low + thing.half if rng.random() < 0.5 else high - thing.half
            shapes.append(thing.placed(frame, x, y, z))
            rooms[i][:2] = (y + thing.half, high) if y < (low + high) / 2 else (low, y - thing.half)
        regions = [
            frame.region((0.0, low, z), (depth, high, ceiling), AHEAD) for low, high, z, ceiling in rooms
        ]
        return shapes, regions


SHELF = Shelf()
