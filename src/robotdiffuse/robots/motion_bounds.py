"""Bounds on the motion of links: how far a link can be from the axis of a joint."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.transforms import placed
from robotdiffuse.robots.kinematic_tree import once_per_robot
from robotdiffuse.robots.robot import Robot

COLUMNS = 180
"""Number of directions around a joint's axis in the grid of `motion_radii`. Each joint between the axis and
the link adds about 0.1 % to the bound."""
LIMIT_SLACK = 1e-3
"""Joint limits are widened by this [rad] or [m], so that rounding errors of configurations at the limits do
not matter."""

STEP = 2 * np.pi / COLUMNS
"""Angle between neighboring directions of the grid [rad]."""
ROWS = COLUMNS // 2 + 1
"""Number of latitudes of the grid, from pole to pole."""
ARC_SAGITTA = 1 - np.cos(STEP / 2)
"""Height of a circular arc of angle STEP above its chord, for radius 1."""


@once_per_robot
def motion_radii(robot: Robot) -> Float[ndarray, "links dof"]:
    """Bounds on the motion of links per unit of joint motion; one row per link with spheres.

    Rows are in the order of `robot.link_names`, without links that have no spheres. Entry [l, j] is at least
    the distance [m] of any point of link l's spheres from the axis of planned joint j, in all configurations
    within the limits. It is 1 for a prismatic joint, and 0 if the joint does not move the link. So when the
    joints move by dq, no point of link l moves further than radii[l] @ abs(dq). The array is read-only.

    Method: the region that a link can reach, seen from frame j, is described by its support function h(u) =
    max p.u on a grid of directions u. This function is propagated from joint to joint towards the base.
    Rotation by an interval of angles is a sliding maximum along a circle of latitude. A rigid offset maps
    h(u) to h(R^T u) + t.u. Between the grid's directions, h is bounded by its sublinearity: h(u) <= sum w_i
    h(u_i) + |e| max |p| for weights w_i that sum to one and e = u - sum w_i u_i. So each step rounds upwards.
    The support function describes the region's convex hull; this does not enlarge the radii, since the
    distance from an axis is a convex function.
    """
    links = [link for link in robot.link_names if link in robot.spheres]
    bare_radii = motion_radii(robot.bare) if robot.bare is not None else np.zeros((0, robot.dof))
    links = links[len(bare_radii) :]  # without those of the bare robot, which come first
    frames = np.array([robot.link_frame(link) for link in links], int)
    radii = np.zeros((len(links), robot.dof))
    directions = _directions()
    directions_by_row = np.ascontiguousarray(directions.transpose(0, 2, 1))
    support = np.full((len(links), ROWS, COLUMNS), -np.inf)
    farthest = np.zeros(len(links))
    for j in reversed(range(robot.dof)):
        for i in np.flatnonzero(frames == j + 1):
            spheres = robot.spheres[links[i]]
            centers = placed(robot.T_frame_link(links[i]), spheres[:, :3])
            support[i] = (centers @ directions_by_row + spheres[:, 3, None]).max(axis=1)
            farthest[i] = (np.linalg.norm(centers, axis=1) + spheres[:, 3]).max()
        moved = np.flatnonzero(robot.moved_by[frames, j])
        if not len(moved):
            continue
        joint = robot.planned_joints[j]
        lower = joint.lower - LIMIT_SLACK
        upper = joint.upper + LIMIT_SLACK
        h = support[moved]
        r = farthest[moved]
        if robot.prismatic[j]:
            radii[moved, j] = 1.0
            h = h + np.maximum(directions[..., 2] * lower, directions[..., 2] * upper)
            r = r + max(abs(lower), abs(upper))
        else:
            radii[moved, j] = h[:, ROWS // 2].max(-1) + ARC_SAGITTA * r
            sagitta = ARC_SAGITTA * np.linalg.norm(directions[..., :2], axis=-1)
            h = _rotated(h, lower, upper) + sagitta * r[:, None, None]
        offset = robot.frame_offsets[j]
        corners, weights, residual = _interpolation(offset[:3, :3].tobytes())
        values = h.reshape(len(moved), -1)
        h = values[:, corners[0]] * weights[0]
        for corner, weight in zip(corners[1:], weights[1:], strict=True):
            h += values[:, corner] * weight
        h += residual * r[:, None]
        support[moved] = h.reshape(-1, ROWS, COLUMNS) + directions @ offset[:3, 3]
        farthest[moved] = r + np.linalg.norm(offset[:3, 3])
    radii = np.concatenate([bare_radii, radii])
    radii.setflags(write=False)
    return radii


def radii_of(robot: Robot, links: Sequence[str]) -> Float[ndarray, "links dof"]:
    """The rows of `motion_radii` for the given links, in a new array."""
    rows = [link for link in robot.link_names if link in robot.spheres]
    return motion_radii(robot)[[rows.index(link) for link in links]]


def _directions() -> Float[ndarray, "rows columns 3"]:
    """Unit vectors by latitude (rows, from pole to pole, including the equator) and longitude (columns)."""
    latitude = -np.pi / 2 + STEP * np.arange(ROWS)[:, None]
    longitude = STEP * np.arange(COLUMNS)[None, :]
    return np.stack(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.broadcast_to(np.sin(latitude), (ROWS, COLUMNS)),
        ],
        axis=-1,
    )


def _rotated(
    support: Float[ndarray, "n rows columns"], lower: float, upper: float
) -> Float[ndarray, "n rows columns"]:
    """For each longitude c, the largest grid value at longitudes from c - upper to c - lower, widened to
    whole steps."""
    first = -int(np.ceil(upper / STEP))
    width = -int(np.floor(lower / STEP)) - first + 1
    if width >= COLUMNS:
        return np.broadcast_to(support.max(-1, keepdims=True), support.shape)
    maxima = np.roll(support, -first, axis=-1)
    covered = 1
    while covered < width:  # maxima over 2 n neighbors from maxima over n
        shift = min(covered, width - covered)
        maxima = np.maximum(maxima, np.roll(maxima, -shift, axis=-1))
        covered += shift
    return maxima


@lru_cache(maxsize=64)
def _interpolation(
    rotation: bytes,
) -> tuple[Int[ndarray, "4 n"], Float[ndarray, "4 n"], Float[ndarray, "n"]]:
    """Interpolation by which a rigid offset with a rotation matrix, given as bytes, maps support functions.

    For each direction: the indices of the four grid directions around it after the rotation, their weights,
    which sum to one, and the length |e| of the residual. Many offsets share a rotation, and each new object
    on an arm needs the same interpolations again. An entry takes about 1 MB.
    """
    grid = _directions().reshape(-1, 3)
    u = grid @ np.frombuffer(rotation).reshape(3, 3)
    row = (np.arcsin(np.clip(u[:, 2], -1, 1)) + np.pi / 2) / STEP
    column = np.arctan2(u[:, 1], u[:, 0]) % (2 * np.pi) / STEP
    i = np.minimum(row.astype(int), ROWS - 2)
    k = column.astype(int)
    a = row - i
    b = column - k
    below = i * COLUMNS + np.stack([k % COLUMNS, (k + 1) % COLUMNS])
    corners = np.concatenate([below, below + COLUMNS])
    weights = np.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b])
    residual = np.linalg.norm(u - np.einsum("kn,knd->nd", weights, grid[corners]), axis=-1)
    return corners, weights, residual + 1e-12
