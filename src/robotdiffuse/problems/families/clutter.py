"""A table of many small things, close together: most of what stands in the second row is hidden."""

from robotdiffuse.problems.families.table import Table

CLUTTER = Table(
    objects=(10, 20),
    object_width=(0.03, 0.1),
    object_height=(0.04, 0.28),
    wall_share=0.0,
    pillar_share=0.2,
)
