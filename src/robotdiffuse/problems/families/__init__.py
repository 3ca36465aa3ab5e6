"""Families of random problems by name: ROP (the paper's), its dense variant, and furniture."""

from typing import TYPE_CHECKING

from robotdiffuse.core.registry import Entry, Registry

if TYPE_CHECKING:
    from robotdiffuse.problems.families.family import Family

HERE = "robotdiffuse.problems.families"
FAMILIES = Registry(
    "family",
    {
        "rop": Entry(f"{HERE}.rop:ROP", "the paper's: two spheres or cubes around the arm, and a floor"),
        "rop_dense": Entry(f"{HERE}.rop:ROP_DENSE", "3 to 12 spheres or cubes of varied size"),
        "shelf": Entry(f"{HERE}.furniture:SHELF", "from one compartment of a bookcase to another"),
        "crate": Entry(f"{HERE}.furniture:CRATE", "in and out of open-topped boxes on the ground"),
        "table": Entry(f"{HERE}.furniture:TABLE", "between the objects on a table, and beneath it"),
        "clutter": Entry(f"{HERE}.furniture:CLUTTER", "between many small objects on a table"),
        "kitchen": Entry(f"{HERE}.furniture:KITCHEN", "in ovens and cupboards and on a counter"),
        "cabinet": Entry(
            f"{HERE}.furniture:CABINET", "in cabinets of any proportions, with doors and drawers"
        ),
    },
    group="robotdiffuse.families",
)
"""Append new families at the end: the seeds of held-out problems depend on the position in this table."""


def load_family(name: str) -> "Family":
    """The family of this name. Raises InputError, which lists the known names, for an unknown one."""
    return FAMILIES.load(name)
