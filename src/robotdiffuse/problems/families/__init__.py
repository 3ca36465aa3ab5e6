"""Families of random scenes by name: ROP, the paper's, its dense variant, and furniture."""

from robotdiffuse.problems.families.furniture import FLOOR, FURNITURE, FurnitureSettings
from robotdiffuse.problems.families.rop import ROP, ROP_DENSE, RopSettings, floor_box
from robotdiffuse.scenes.shapes import Box

FAMILIES: dict[str, RopSettings | FurnitureSettings] = {
    "rop": ROP,
    "rop_dense": ROP_DENSE,
    **FURNITURE,
}


def floor_of(family: RopSettings | FurnitureSettings) -> Box | None:
    """The first shape of every scene of the family; None if it has no floor."""
    return FLOOR if isinstance(family, FurnitureSettings) else floor_box(family)


def most_obstacles(family: RopSettings | FurnitureSettings) -> int:
    """Of a scene, the floor left out."""
    return family.slots if isinstance(family, FurnitureSettings) else family.obstacles[1]
