"""A table with many small objects close together; those in front hide most of those behind."""

from robotdiffuse.problems.families.table import Table

CLUTTER = Table(
    objects=(10, 20),
    object_width=(0.03, 0.1),
    object_height=(0.04, 0.28),
    wall_share=0.0,
    pillar_share=0.2,
)
