"""A bookcase that faces the arm."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.random import Generator

from robotdiffuse.core.settings import Bound, Count, NotNegative, Positive, Share
from robotdiffuse.problems.families.family import PositiveRange
from robotdiffuse.problems.families.furniture import (
    AHEAD,
    MIN_GAP,
    Build,
    Furniture,
    FurnitureFrame,
    LooseObject,
    count,
)
from robotdiffuse.scenes.shapes import Box, Sphere

AtLeastTwo = Annotated[int, Bound(least=2.0)]


@dataclass(frozen=True)
class Shelf(Furniture):
    """A bookcase that faces the arm: boards between uprights, open in front. Lengths in [m].

    Regions are its compartments and the space on its top board; the hand points into it. A compartment has at
    most one loose object, at one of its sides; objects that would leave too little space are left out.
    """

    reach: Positive = 0.85
    """Larger than for other furniture: a hand that points forward reaches farther than one that points
    down."""
    distance: PositiveRange = (0.45, 0.7)
    """From the base to the middle of the front."""
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

    def build(self, rng: Generator) -> Build:
        frame = FurnitureFrame(self, self.distance, rng)
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
        compartments = [
            [y + t, y + t + w, z, ceiling]
            for z, ceiling in zip(tops, ceilings, strict=True)
            for y, w in zip(sides[:-1], columns, strict=True)
        ]
        things = min(count(self.objects, rng), len(compartments))
        for i in rng.permutation(len(compartments))[:things]:
            low, high, z, ceiling = compartments[i]
            loose = LooseObject(self, rng, ceiling - z - MIN_GAP)
            if 3 * loose.half > high - low:
                continue
            x = rng.uniform(min(loose.half, depth / 2), max(depth - loose.half, depth / 2))
            y = low + loose.half if rng.random() < 0.5 else high - loose.half
            shapes.append(loose.placed(frame, x, y, z))
            compartments[i][:2] = (y + loose.half, high) if y < (low + high) / 2 else (low, y - loose.half)
        regions = [
            frame.region((0.0, low, z), (depth, high, ceiling), AHEAD)
            for low, high, z, ceiling in compartments
        ]
        return shapes, regions


SHELF = Shelf()
