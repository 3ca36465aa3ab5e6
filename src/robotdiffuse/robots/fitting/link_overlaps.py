"""Where links meet: points that a link's neighbours hide, at any angle of the joint between them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.core.transforms import inverse
from robotdiffuse.robots.fitting.sphere_fitting_kernel import within
from robotdiffuse.robots.fitting.sphere_size_grid import Planes, stacked_planes
from robotdiffuse.robots.joints import MOVING_KINDS
from robotdiffuse.robots.robot import Robot

ANGLES = 9
"""Values of the joint between two links at which hiding is tested."""
NEARLY = 0.004
"""Points so near to a neighbour count as inside [m]: a gap between two links is as thin as that."""

BESIDE = 10 * NEARLY
"""What is further from a neighbour's box is not nearly inside, sharp as its edges may be [m]."""


@dataclass(frozen=True, eq=False)
class Neighbour:
    """A link next to another one."""

    link: str
    T_link_neighbour: Float[ndarray, "n 4 4"]
    """At values of the joint between them over its range; one if they are fixed to each other."""


def neighbours(robot: Robot, link: str) -> tuple[Neighbour, ...]:
    """Links with geometry that a joint connects to this one; fixed links without geometry are passed."""
    found = []
    for joint in robot.joints:
        above, T_above_parent = joint.parent, np.eye(4)
        while above not in robot.meshes and above != robot.base:
            through = next(j for j in robot.joints if j.child == above)
            if through.kind in MOVING_KINDS:
                break
            above, T_above_parent = through.parent, through.T_parent_joint @ T_above_parent
        if link not in (above, joint.child) or not {above, joint.child} <= set(robot.meshes):
            continue
        turn = joint.kind == "continuous"
        ends = (-np.pi, np.pi) if turn else (joint.lower, joint.upper)
        values = np.linspace(*ends, ANGLES) if joint.kind in MOVING_KINDS else [0.0]
        T = np.stack([T_above_parent @ joint.T_parent_joint @ joint.motion(float(q)) for q in values])
        other = joint.child if link == above else above
        found.append(Neighbour(other, T if link == above else np.stack([inverse(t) for t in T])))
    return tuple(found)


def hidden_by_neighbours(robot: Robot, link: str) -> Callable[[Float[ndarray, "n 3"]], Bool[ndarray, "n"]]:
    """Which points, in the link's frame, are inside one neighbour at all values of the joint between them."""
    beside: list[tuple[Neighbour, tuple[ndarray, ndarray], Planes]] = []
    for other in neighbours(robot, link):
        corners = np.concatenate([mesh.vertices for mesh in robot.meshes[other.link]])
        box = corners.min(0) - BESIDE, corners.max(0) + BESIDE
        beside.append((other, box, stacked_planes(robot.meshes[other.link])))

    def hidden(points: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        found = np.zeros(len(points), dtype=bool)
        for other, (low, high), planes in beside:
            left = np.flatnonzero(~found)
            for T in other.T_link_neighbour:
                local = (points[left] - T[:3, 3]) @ T[:3, :3]
                near = ((local >= low) & (local <= high)).all(axis=1)
                left, local = left[near], local[near]
                left = left[within(local, *planes, -NEARLY)]
            found[left] = True
        return found

    return hidden
