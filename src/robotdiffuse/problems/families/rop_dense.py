"""ROP with more and smaller obstacles of varied size: in about half of these problems the straight line is
blocked."""

from robotdiffuse.problems.families.rop import Rop

ROP_DENSE = Rop(obstacles=(3, 12), sphere_radius=(0.08, 0.2), cube_side=(0.1, 0.3))
