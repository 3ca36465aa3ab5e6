"""A table with loose objects, sometimes divided by a wall or with a pillar."""

from dataclasses import dataclass

from numpy.random import Generator

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Natural, Share
from robotdiffuse.problems.families.family import PositiveRange
from robotdiffuse.problems.families.furniture import (
    AHEAD,
    Build,
    Furniture,
    FurnitureFrame,
    Region,
    Surface,
)
from robotdiffuse.scenes.shapes import Box, Sphere

MIN_OPEN_HEIGHT = 0.3
"""Minimum height of tables with a region beneath them [m]."""


@dataclass(frozen=True)
class Table(Furniture):
    """A table with loose objects, sometimes divided by a wall or with a pillar. Lengths in [m].

    Regions are free spots between the objects, where the hand points down, and the space beneath a table on
    legs, where it points forward.
    """

    objects: tuple[Natural, Natural] = (3, 10)
    object_height: PositiveRange = (0.08, 0.35)
    distance: PositiveRange = (0.25, 0.4)
    """From the base to the middle of the near edge of the table."""
    height: PositiveRange = (0.1, 0.5)
    """Height of the table's top."""
    length: PositiveRange = (0.45, 0.7)
    """Extent away from the arm."""
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
    spots: tuple[Natural, Natural] = (2, 4)
    spot_size: PositiveRange = (0.12, 0.2)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.wall_share + self.pillar_share > 1:
            raise InputError(
                f"wall_share is {self.wall_share} and pillar_share {self.pillar_share}; "
                "together they must be at most 1"
            )

    @property
    def max_obstacles(self) -> int:
        return 6 + self.objects[1]

    def build(self, rng: Generator) -> Build:
        frame = FurnitureFrame(self, self.distance, rng)
        length, side = rng.uniform(*self.length), rng.uniform(*self.width) / 2
        height, t = rng.uniform(*self.height), rng.uniform(*self.thickness)
        legs = rng.random() < self.legs_share
        under = height - t
        bottom = under if legs else 0.0
        shapes: list[Box | Sphere] = [frame.box((0.0, -side, bottom), (length, side, height), "table")]
        regions: list[Region] = []
        if legs:
            w = rng.uniform(*self.leg_width)
            for x, y in ((0.0, -side), (0.0, side - w), (length - w, -side), (length - w, side - w)):
                shapes.append(frame.box((x, y, 0.0), (x + w, y + w, under), "leg"))
            if under > MIN_OPEN_HEIGHT:
                inner = side - w
                regions.append(frame.region((0.0, -inner, 0.0), (length / 2, inner, under), AHEAD))
        surface = Surface(frame, length, side, height)
        kind, top = rng.random(), height + rng.uniform(*self.divider_height)
        if kind < self.wall_share:
            start, y = rng.uniform(0.0, length / 3), rng.uniform(-side / 3, side / 3)
            shapes.append(frame.box((start, y - t / 2, height), (length, y + t / 2, top), "wall"))
            surface.taken.append(((start + length) / 2, y, (length - start) / 2, t / 2))
        elif kind < self.wall_share + self.pillar_share:
            w = rng.uniform(*self.pillar_width) / 2
            x, y = surface.place(w, w, rng)
            shapes.append(frame.box((x - w, y - w, height), (x + w, y + w, top), "pillar"))
        regions += surface.spots(self.spots, self.spot_size, rng)
        shapes += surface.loose_objects(self, rng)
        return shapes, regions


TABLE = Table()
