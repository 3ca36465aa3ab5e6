"""ROP with more and smaller obstacles of varied size: about half of these problems are not trivial."""

from robotdiffuse.problems.families.rop import Rop

ROP_DENSE = Rop(obstacles=(3, 12), sphere_radius=(0.08, 0.2), cube_side=(0.1, 0.3))
