"""Overlaps of neighbouring links: points of a link that are inside a neighbour at any angle of the joint
between."""

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

JOINT_SAMPLES = 9
"""Values of the joint between two links at which points are tested."""
GAP = 0.004
"""Points this close to a neighbour count as inside [m]: gaps between links are about this thin."""
BOX_PADDING = 10 * GAP
"""Points further than this from a neighbour's bounding box are skipped, even near sharp edges [m]."""


@dataclass(frozen=True, eq=False)
class Neighbour:
    """A link that a joint connects to another one."""

    link: str
    T_link_neighbour: Float[ndarray, "n 4 4"]
    """At joint values over the range of the joint between them; one pose if it is fixed."""


def neighbours(robot: Robot, link: str) -> tuple[Neighbour, ...]:
    """Links with geometry that a joint connects to this one; skips fixed links without geometry in
    between."""
    found = []
    for joint in robot.joints:
        above = joint.parent
        T_above_parent = np.eye(4)
        while above not in robot.meshes and above != robot.base:
            through = next(j for j in robot.joints if j.child == above)
            if through.kind in MOVING_KINDS:
                break
            above = through.parent
            T_above_parent = through.T_parent_joint @ T_above_parent
        if link not in (above, joint.child) or not {above, joint.child} <= set(robot.meshes):
            continue
        endless = joint.kind == "continuous"
        ends = (-np.pi, np.pi) if endless else (joint.lower, joint.upper)
        values = np.linspace(*ends, JOINT_SAMPLES) if joint.kind in MOVING_KINDS else [0.0]
        T = np.stack([T_above_parent @ joint.T_parent_joint @ joint.motion(float(q)) for q in values])
        other = joint.child if link == above else above
        found.append(Neighbour(other, T if link == above else np.stack([inverse(t) for t in T])))
    return tuple(found)


def hidden_by_neighbours(robot: Robot, link: str) -> Callable[[Float[ndarray, "n 3"]], Bool[ndarray, "n"]]:
    """A function that tells which points, in the link's frame [m], are inside one neighbour at all joint
    values."""
    neighbour_planes: list[tuple[Neighbour, tuple[ndarray, ndarray], Planes]] = []
    for other in neighbours(robot, link):
        corners = np.concatenate([mesh.vertices for mesh in robot.meshes[other.link]])
        box = corners.min(0) - BOX_PADDING, corners.max(0) + BOX_PADDING
        neighbour_planes.append((other, box, stacked_planes(robot.meshes[other.link])))

    def hidden(points: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        found = np.zeros(len(points), dtype=bool)
        for other, (low, high), planes in neighbour_planes:
            left = np.flatnonzero(~found)
            for T in other.T_link_neighbour:
                local = (points[left] - T[:3, 3]) @ T[:3, :3]
                near = ((local >= low) & (local <= high)).all(axis=1)
                left = left[near]
                local = local[near]
                left = left[within(local, *planes, -GAP)]
            found[left] = True
        return found

    return hidden
