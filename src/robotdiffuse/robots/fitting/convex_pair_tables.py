"""Tables for pairs of links that pass closer to each other than covering spheres can resolve, as a flange in
a fork.

The relative pose of two links depends only on the joints between them. If these are one or two joints, a
table over their values tells where the convex parts of the links are apart. A cell counts as free if the
distance of the links at its centre exceeds the motion of any point of one link, seen from the other, within
the cell. Other cells are split, down to a fraction of a millimetre of motion.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.robots.fitting.sampled_links import Links
from robotdiffuse.robots.link_pair_tables import TURN, LinkPairTable
from robotdiffuse.robots.motion_bounds import motion_radii
from robotdiffuse.robots.robot import Robot

CELLS = 128
"""Cells of a table along each joint; a power of two."""
ROUNDING = 1e-5
"""Upper bound on the rounding error of a distance [m]."""


def joint_table(robot: Robot, links: Links, pair: tuple[str, str], finest: float) -> LinkPairTable:
    """Table over the one or two joints between two links: where their convex parts are apart.

    Cells in which the links move by less than `finest` [m] relative to each other are not split; they count
    as colliding unless proven free.
    """
    joints = robot.joints_between(*pair)
    far = max(pair, key=robot.link_frame)
    with_spheres = [link for link in robot.link_names if link in robot.spheres]
    lever = motion_radii(robot)[with_spheres.index(far), list(joints)]
    slides = np.array(robot.prismatic)[list(joints)]
    lower = robot.lower[list(joints)]
    upper = robot.upper[list(joints)]
    upper = np.where(slides, upper, np.minimum(upper, lower + TURN))
    columns = [[j.name for j in links.joints].index(robot.joint_names[joint]) for joint in joints]
    held = links.named({})
    edge = (upper - lower) / CELLS
    apart = np.ones((CELLS,) * len(joints), dtype=bool)
    size = np.full(len(joints), float(CELLS))
    parts = np.indices([len(robot.meshes[link]) for link in pair]).reshape(2, -1)
    low = np.zeros((parts.shape[1], len(joints)))  # one row per pair of parts and cell where they may touch
    while len(low):
        cells, cell = np.unique(low, axis=0, return_inverse=True)
        q = np.tile(held, (len(cells), 1))
        q[:, columns] = lower + edge * (cells + size / 2)
        travel = float(lever @ (edge * size) / 2) + ROUNDING
        poses = links.poses(q, frozenset(pair))
        distance = links.part_distances(poses, *pair, cell.ravel(), parts, travel)
        touch = distance <= travel
        given_up = touch & ((size <= 1).all() & (distance <= 0) | (distance < -travel) | (travel < finest))
        for first, last in zip(*_cells(np.unique(low[given_up], axis=0), size), strict=True):
            apart[tuple(slice(*ends) for ends in zip(first, last, strict=True))] = False
        axis = int((lever * edge * size).argmax())
        size = size.copy()
        size[axis] /= 2
        low = low[touch & ~given_up]
        parts = parts[:, touch & ~given_up]
        low = np.concatenate([low, low + size * (np.arange(len(size)) == axis)])
        parts = np.tile(parts, 2)
        if (size <= 1).all():  # one contact decides a cell, so drop its other pairs
            is_open = apart[tuple(_cells(low, size)[0].T)]
            low = low[is_open]
            parts = parts[:, is_open]
    names = tuple(robot.joint_names[joint] for joint in joints)
    return LinkPairTable(pair, names, tuple(lower.tolist()), tuple(upper.tolist()), apart)


def _cells(low: Float[ndarray, "n joints"], size: Float[ndarray, "joints"]) -> tuple[ndarray, ndarray]:
    """Index of the first cell along each joint that boxes overlap, and one past the last."""
    return np.floor(low).astype(int), np.ceil(low + size).astype(int)
