"""Open crates on the ground or on blocks, with loose objects around them."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from robotdiffuse.core.settings import Count, Natural, Share
from robotdiffuse.problems.families.family import PositiveRange
from robotdiffuse.problems.families.furniture import (
    DOWN,
    PLACE_TRIES,
    Build,
    Furniture,
    FurnitureFrame,
    LooseObject,
    NoRoomError,
    Rectangle,
    Region,
    count,
    is_free,
)
from robotdiffuse.scenes.shapes import Box, Sphere


@dataclass(frozen=True)
class Crate(Furniture):
    """Open crates on the ground or on blocks, with loose objects around them. Lengths in [m].

    Regions are the insides of the crates and free spots on the ground; the hand points down.
    """

    object_height: PositiveRange = (0.1, 0.5)
    crates: tuple[Count, Count] = (1, 2)
    distance: PositiveRange = (0.4, 0.65)
    """From the base to the middle of a crate, a loose object or a spot."""
    length: PositiveRange = (0.25, 0.45)
    """Inner length and width of a crate."""
    height: PositiveRange = (0.12, 0.3)
    """Inner height of the walls."""
    thickness: PositiveRange = (0.01, 0.03)
    """Thickness of the walls and the bottom of a crate."""
    raised_share: Share = 0.4
    """Fraction of the crates that stand on a block."""
    block_height: PositiveRange = (0.05, 0.3)
    spots: tuple[Natural, Natural] = (1, 2)
    """Number of free spots on the ground."""
    spot_size: PositiveRange = (0.12, 0.2)

    @property
    def max_obstacles(self) -> int:
        return 6 * self.crates[1] + self.objects[1]

    def build(self, rng: Generator) -> Build:
        shapes: list[Box | Sphere] = []
        regions: list[Region] = []
        taken: list[Rectangle] = []
        for _ in range(count(self.crates, rng)):
            x, y = rng.uniform(*self.length, 2) / 2
            h, t = rng.uniform(*self.height), rng.uniform(*self.thickness)
            frame = _free_place(self, float(np.hypot(x + t, y + t)), taken, rng)
            low = 0.0
            if rng.random() < self.raised_share:
                low = rng.uniform(*self.block_height)
                shapes.append(frame.box((-x - t, -y - t, 0.0), (x + t, y + t, low), "block"))
            bottom, top = low + t, low + t + h
            shapes.append(frame.box((-x - t, -y - t, low), (x + t, y + t, bottom), "bottom"))
            for side in (-1, 1):
                a, b = sorted((side * x, side * (x + t)))
                shapes.append(frame.box((a, -y - t, bottom), (b, y + t, top), "wall"))
                a, b = sorted((side * y, side * (y + t)))
                shapes.append(frame.box((-x, a, bottom), (x, b, top), "wall"))
            regions.append(frame.region((-x, -y, bottom), (x, y, top), DOWN))
        for _ in range(count(self.spots, rng)):
            half = rng.uniform(*self.spot_size) / 2
            frame = _free_place(self, float(np.sqrt(2) * half), taken, rng)
            regions.append(frame.region((-half, -half, 0.0), (half, half, 2 * half), DOWN))
        for _ in range(count(self.objects, rng)):
            loose = LooseObject(self, rng)
            frame = _free_place(self, loose.half, taken, rng)
            shapes.append(loose.placed(frame, 0.0, 0.0, 0.0))
        return shapes, regions


def _free_place(crate: Crate, half: float, taken: list[Rectangle], rng: Generator) -> FurnitureFrame:
    """A free place on the ground for an object of this half width, which is then marked as taken.

    Raises NoRoomError.
    """
    for _ in range(PLACE_TRIES):
        frame = FurnitureFrame(crate, crate.distance, rng)
        square = (float(frame.xy[0]), float(frame.xy[1]), half, half)
        if is_free(square, taken):
            taken.append(square)
            return frame
    raise NoRoomError


CRATE = Crate()
