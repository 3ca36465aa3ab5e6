"""Tables of the configurations in which links close to each other along the arm can touch.

How two links stand to each other depends only on the joints between them. For pairs with one or two of those,
whose bounding spheres overlap almost always (forearm and hand), a table over the two joints says where they
may touch at all: one look-up in place of hundreds of distances. By spheres, or by the convex parts where the
robot brings such a table (`robots/fitting/convex_pair_tables.py`).
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int32
from numpy import ndarray

from robotdiffuse.collision.kernels.lane_clearance import pair_clearances
from robotdiffuse.collision.kernels.lane_collision import HEAD, SIDE
from robotdiffuse.robots.link_pair_tables import LinkPairTable

CELLS = SIDE - 2
"""Cells along each joint's range; around them is a ring that stands for values beyond it."""
MOST_PAIRS = 24
"""Pairs per table: bits of an integer that a float32 can hold."""
SLACK = 1e-5
"""More than what rounding does to a distance [m]."""


def no_tables() -> Float32[ndarray, "0 width"]:
    """Tables for no pair."""
    return np.zeros((0, HEAD + SIDE**2), np.float32)


def tabulate(
    arrays: Any,
    lower: Float[ndarray, "dof"],
    upper: Float[ndarray, "dof"],
    levers: Float[ndarray, "groups dof"],
    known: Mapping[int, LinkPairTable],
) -> tuple[Int32[ndarray, "pairs 4"], Float32[ndarray, "tables width"]]:
    """The robot's pairs with table and bit of those that depend on one or two joints, and the tables.

    A table holds the first joint, its low end and cells per unit, the same of the second joint, and the
    cells: sums of the bits of the pairs that may touch there. `arrays` are the RobotArrays without tables;
    `levers` how far a point of each group moves at most per unit of each joint [m]; `known` are tables of
    convex parts for some of the pairs, by number.
    """
    parents = np.arange(len(lower)) if arrays.parents is None else arrays.parents
    pairs_found, tables = arrays.pairs.copy(), [no_tables()]
    by_joint: dict[int, list[int]] = {}
    for p, (a, b) in enumerate(arrays.pairs[:, :2].tolist()):
        near, far = sorted((int(arrays.frame[a]), int(arrays.frame[b])))
        pairs = by_joint.setdefault(far - 1, [])
        before = int(parents[far - 1])
        if near in (before, parents[before - 1] if before else 0) and len(pairs) < MOST_PAIRS:
            pairs.append(p)
    for last, pairs in by_joint.items():
        before = int(parents[last]) - 1
        joints = np.array([before if before >= 0 else last, last])
        if not pairs or not (upper[joints] > lower[joints]).all():
            continue
        width = (upper[joints] - lower[joints]) / CELLS
        far_groups = [max(arrays.pairs[p, :2], key=lambda g: arrays.frame[g]) for p in pairs]
        travel = levers[far_groups][:, joints] @ width / 2 + SLACK
        q = np.tile(((lower + upper) / 2).astype(np.float32), (CELLS**2, 1))
        i, j = np.divmod(np.arange(CELLS**2), CELLS)
        q[:, joints[0]] = lower[joints[0]] + width[0] * (i + 0.5)
        q[:, joints[1]] = lower[joints[1]] + width[1] * (j + 0.5)
        limit = np.float32(2 * travel.max())
        clearance = pair_clearances(arrays._replace(pairs=arrays.pairs[pairs]), q, limit)
        touch = (clearance < travel).reshape(CELLS, CELLS, -1)
        for column, p in enumerate(pairs):
            if p in known:
                axes = joints[-len(known[p].joints) :]
                low = lower[axes, None] + width[-len(axes) :, None] * np.arange(CELLS)
                ends = zip(low, low + width[-len(axes) :, None], strict=True)
                touch[..., column] &= ~known[p].throughout(*ends)
        bits = 1 << np.arange(len(pairs))
        table = np.full((SIDE, SIDE), bits.sum())
        table[1:-1, 1:-1] = touch @ bits
        pairs_found[pairs, 2:] = np.column_stack([np.full(len(pairs), len(tables) - 1), bits])
        head = np.column_stack([joints, lower[joints] - width, 1 / width]).ravel()
        tables.append(np.concatenate([head, table.ravel()])[None].astype(np.float32))
    return pairs_found, np.concatenate(tables)
