"""Tables of the joint values at which two links with only one or two joints between them may touch.

The relative pose of two links depends only on the joints between them. For links with one or two joints
between them, such as forearm and hand, bounding spheres overlap almost always. A table over these joints says
at which joint values the links may touch: one look-up replaces hundreds of distances. Tables are computed
from the spheres. If the robot has a table of the links' convex parts (`robots/fitting/self_collisions.py`),
cells that are proved free there are free here too.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int32
from numpy import ndarray

from robotdiffuse.collision.kernels.lane_clearance import pair_clearances
from robotdiffuse.collision.kernels.lane_collision import TABLE_HEADER, TABLE_SIDE
from robotdiffuse.robots.robot import LinkPairTable, Robot

CELLS_PER_JOINT = TABLE_SIDE - 2
"""Number of cells along each joint's range; one more cell at each end stands for values beyond the range."""
MAX_PAIRS = 24
"""Largest number of pairs per table: each pair is a bit of an integer, and float32 represents integers of up
to 24 bits exactly."""
ROUNDING_SLACK = 1e-5
"""Upper bound on the rounding error of a distance [m]."""


NO_TABLES = np.zeros((0, TABLE_HEADER + TABLE_SIDE**2), np.float32)


def build_pair_tables(
    arrays: Any,
    robot: Robot,
    radii: Float[ndarray, "groups dof"],
    known: Mapping[int, LinkPairTable],
) -> tuple[Int32[ndarray, "pairs 4"], Float32[ndarray, "tables width"]]:
    """The rows of `RobotArrays.pairs`, with table and bit filled in for pairs that depend on one or two
    joints, and the tables.

    A table is a row of numbers. It begins with three numbers for each of its two joints: the joint's index,
    its value at the first cell, and the number of cells per unit. Then come the cells. A cell is the sum of
    the bits of the pairs that may touch there.

    Args:
        arrays: The RobotArrays without tables.
        robot: The robot.
        radii: Upper bounds on how far a point of each group moves per unit of each joint [m].
        known: Tables of convex parts for some of the pairs, by index of the pair.

    Returns:
        The rows of `RobotArrays.pairs` and the tables.
    """
    lower = robot.lower
    upper = robot.upper
    parents = robot.parents
    pair_rows = arrays.pairs.copy()
    tables = [NO_TABLES]
    pairs_by_joint = dict[int, list[int]]()
    for p, (a, b) in enumerate(arrays.pairs[:, :2].tolist()):
        near, far = sorted((int(arrays.frame[a]), int(arrays.frame[b])))
        pairs = pairs_by_joint.setdefault(far - 1, [])
        parent = int(parents[far - 1])
        if near in (parent, parents[parent - 1] if parent else 0) and len(pairs) < MAX_PAIRS:
            pairs.append(p)
    # one table for all pairs with the same last joint; the table's other axis is the joint before
    for last, pairs in pairs_by_joint.items():
        before = int(parents[last]) - 1
        joints = np.array([before if before >= 0 else last, last])
        if not pairs or not (upper[joints] > lower[joints]).all():
            continue
        width = (upper[joints] - lower[joints]) / CELLS_PER_JOINT
        far_groups = [max(arrays.pairs[p, :2], key=lambda g: arrays.frame[g]) for p in pairs]
        # a pair is free in a whole cell if its clearance at the cell's center is at least `travel`
        travel = radii[far_groups][:, joints] @ width / 2 + ROUNDING_SLACK
        q = np.tile(((lower + upper) / 2).astype(np.float32), (CELLS_PER_JOINT**2, 1))
        i, j = np.divmod(np.arange(CELLS_PER_JOINT**2), CELLS_PER_JOINT)
        q[:, joints[0]] = lower[joints[0]] + width[0] * (i + 0.5)
        q[:, joints[1]] = lower[joints[1]] + width[1] * (j + 0.5)
        limit = np.float32(2 * travel.max())
        clearance = pair_clearances(arrays._replace(pairs=arrays.pairs[pairs]), q, limit)
        touch = (clearance < travel).reshape(CELLS_PER_JOINT, CELLS_PER_JOINT, -1)
        for column, p in enumerate(pairs):
            if p in known:
                axes = joints[-len(known[p].joints) :]
                low = lower[axes, None] + width[-len(axes) :, None] * np.arange(CELLS_PER_JOINT)
                ends = zip(low, low + width[-len(axes) :, None], strict=True)
                touch[..., column] &= ~known[p].throughout(*ends)
        bits = 1 << np.arange(len(pairs))
        table = np.full((TABLE_SIDE, TABLE_SIDE), bits.sum())
        table[1:-1, 1:-1] = touch @ bits
        pair_rows[pairs, 2:] = np.column_stack([np.full(len(pairs), len(tables) - 1), bits])
        header = np.column_stack([joints, lower[joints] - width, 1 / width]).ravel()
        tables.append(np.concatenate([header, table.ravel()])[None].astype(np.float32))
    return pair_rows, np.concatenate(tables)
