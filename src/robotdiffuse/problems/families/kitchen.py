"""A kitchenette: a counter with appliances, open in front or solid, and cupboards above it."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from robotdiffuse.core.settings import Natural, Positive, Share
from robotdiffuse.problems.families.family import PositiveRange
from robotdiffuse.problems.families.furniture import (
    AHEAD,
    Build,
    Corner,
    Furniture,
    FurnitureFrame,
    Region,
    Surface,
    count,
)
from robotdiffuse.scenes.shapes import Box, Sphere

MIN_OPEN_HEIGHT = 0.25
"""Minimum height of counters that may be open in front, with a region inside [m]."""


@dataclass(frozen=True)
class Kitchen(Furniture):
    """A counter against a wall, with ovens that are open in front, solid appliances and loose objects on it,
    and cupboards above it, some with an open door. Lengths in [m].

    Regions are the insides of ovens, of cupboards and of a counter that is open in front, where the hand
    points forward, and free spots on the counter, where it points down.
    """

    reach: Positive = 0.85
    """Larger than for other furniture: a hand that points forward reaches farther than one that points
    down."""
    objects: tuple[Natural, Natural] = (1, 5)
    distance: PositiveRange = (0.3, 0.45)
    """From the base to the middle of the near edge of the counter."""
    height: PositiveRange = (0.05, 0.4)
    """Height of the counter's top."""
    depth: PositiveRange = (0.4, 0.55)
    width: PositiveRange = (0.9, 1.5)
    thickness: PositiveRange = (0.01, 0.03)
    """Thickness of all boards and walls."""
    open_share: Share = 0.6
    """Fraction of the sufficiently high counters that are open in front."""
    ovens: tuple[Natural, Natural] = (0, 2)
    solids: tuple[Natural, Natural] = (0, 2)
    """Number of solid appliances."""
    appliance_width: PositiveRange = (0.3, 0.45)
    """Width of ovens; solid appliances have between half of it and all of it."""
    appliance_depth: PositiveRange = (0.22, 0.38)
    appliance_height: PositiveRange = (0.22, 0.36)
    cupboards: tuple[Natural, Natural] = (0, 3)
    """Number of cupboards, side by side in the middle of the wall."""
    cupboard_width: PositiveRange = (0.28, 0.45)
    cupboard_depth: PositiveRange = (0.2, 0.33)
    cupboard_height: PositiveRange = (0.26, 0.4)
    above: PositiveRange = (0.38, 0.55)
    """From the counter to the cupboards."""
    door_share: Share = 0.3
    """Fraction of the cupboards with a door, which is open."""
    spots: tuple[Natural, Natural] = (1, 2)
    spot_size: PositiveRange = (0.12, 0.2)

    @property
    def max_obstacles(self) -> int:
        wall, hollow, cupboards = 1, 5, 3 + 2 * self.cupboards[1]
        return wall + hollow * (1 + self.ovens[1]) + self.solids[1] + cupboards + self.objects[1]

    def build(self, rng: Generator) -> Build:
        frame = FurnitureFrame(self, self.distance, rng)
        depth, side = rng.uniform(*self.depth), rng.uniform(*self.width) / 2
        height, t = rng.uniform(*self.height), rng.uniform(*self.thickness)
        shapes: list[Box | Sphere] = []
        regions: list[Region] = []

        def hollow(low: Corner, high: Corner, name: str) -> None:
            """Adds a box that is open in front, and its inside as a region."""
            (x, y, z), (far, left, top) = low, high
            shapes.append(frame.box(low, (far, left, z + t), name))
            shapes.append(frame.box((x, y, top - t), high, name))
            shapes.append(frame.box((x, y, z + t), (far, y + t, top - t), name))
            shapes.append(frame.box((x, left - t, z + t), (far, left, top - t), name))
            shapes.append(frame.box((far - t, y + t, z + t), (far, left - t, top - t), name))
            regions.append(frame.region((x, y + t, z + t), (far - t, left - t, top - t), AHEAD))

        if height > MIN_OPEN_HEIGHT and rng.random() < self.open_share:
            hollow((0.0, -side, 0.0), (depth, side, height), "counter")
        else:
            shapes.append(frame.box((0.0, -side, 0.0), (depth, side, height), "counter"))
        hang = height + rng.uniform(*self.above)
        top = self._cupboards(frame, depth, hang, t, shapes, regions, rng)
        shapes.append(frame.box((depth, -side, 0.0), (depth + t, side, top), "wall"))
        counter = Surface(frame, depth, side, height)
        ovens, solids = count(self.ovens, rng), count(self.solids, rng)
        for i in range(ovens + solids):
            a, b = rng.uniform(*self.appliance_depth) / 2, rng.uniform(*self.appliance_width) / 2
            b *= 1.0 if i < ovens else rng.uniform(0.5, 1.0)
            (x, y), high = counter.place(a, b, rng), height + rng.uniform(*self.appliance_height)
            low_corner, high_corner = (x - a, y - b, height), (x + a, y + b, high)
            if i < ovens:
                hollow(low_corner, high_corner, "oven")
            else:
                shapes.append(frame.box(low_corner, high_corner, "appliance"))
        regions += counter.spots(self.spots, self.spot_size, rng)
        shapes += counter.loose_objects(self, rng)
        return shapes, regions

    def _cupboards(
        self,
        frame: FurnitureFrame,
        depth: float,
        low: float,
        t: float,
        shapes: list[Box | Sphere],
        regions: list[Region],
        rng: Generator,
    ) -> float:
        """Adds the cupboards and their insides; returns the height of their top."""
        widths = rng.uniform(*self.cupboard_width, count(self.cupboards, rng))
        front, top = depth - rng.uniform(*self.cupboard_depth), low + rng.uniform(*self.cupboard_height)
        if not len(widths):
            return top
        sides = np.concatenate([[0.0], np.cumsum(widths + t)])
        sides -= (sides[-1] + t) / 2
        left, right = float(sides[0]), float(sides[-1]) + t
        for z in (low, top - t):
            shapes.append(frame.box((front, left, z), (depth, right, z + t), "cupboard"))
        shapes += [
            frame.box((front, y, low + t), (depth, y + t, top - t), "cupboard") for y in sides.tolist()
        ]
        for y, w in zip(sides[:-1].tolist(), widths.tolist(), strict=True):
            regions.append(frame.region((front, y + t, low + t), (depth, y + t + w, top - t), AHEAD))
            if rng.random() < self.door_share:  # open at a right angle, hinged on the left or the right
                hinge = y if rng.random() < 0.5 else y + w + t
                shapes.append(frame.box((front - w, hinge, low), (front, hinge + t, top), "door"))
        return top


KITCHEN = Kitchen()
