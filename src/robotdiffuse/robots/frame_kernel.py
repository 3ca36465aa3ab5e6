"""Compiled operations on vectors and frames, for other compiled code."""

import numpy as np

from robotdiffuse.core.kernels import allocation_free, inner_kernel

inlined = allocation_free(fastmath={"contract"}, forceinline=True)


@inlined
def dot(a, b):
    """The scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def minus(a, b):
    """The difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined
def plus(a, b):
    """The sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inlined
def times(s, a):
    """The product of a number and a vector."""
    return s * a[0], s * a[1], s * a[2]


@inlined
def cross(a, b):
    """The cross product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def write(v, out):
    """Writes a vector to out[3]."""
    out[0], out[1], out[2] = v


@inlined
def length(a):
    """The norm of a vector."""
    return np.sqrt(dot(a, a))


@inlined
def column(R, k):
    """Column k of a matrix."""
    return R[0, k], R[1, k], R[2, k]


@inlined
def rotated_back(R, v):
    """The product of R transposed and v."""
    return dot(column(R, 0), v), dot(column(R, 1), v), dot(column(R, 2), v)


@inlined
def placed(T, p):
    """T @ p: the point p of a frame, seen in the base frame; T = T_base_frame."""
    return dot(T[0], p) + T[0, 3], dot(T[1], p) + T[1, 3], dot(T[2], p) + T[2, 3]


@inlined
def ball_gap(T, ball, T_other, other):
    """Signed distance of two balls [x, y, z, radius], each given in its own frame [m]."""
    return length(minus(placed(T, ball), placed(T_other, other))) - ball[3] - other[3]


@inner_kernel()
def step(parent, offset, slides, q, child):
    """Writes the frame that a joint moves, at joint value q [rad or m], to `child`: T_base_child =
    T_base_parent @ T_parent_joint @ M(q), where M rotates about z, or translates along z if the joint
    `slides`.

    `parent` is T_base_parent and `offset` T_parent_joint. `parent` and `child` may be the same array.
    """
    c, s, slide = (1.0, 0.0, q) if slides else (np.cos(q), np.sin(q), 0.0)
    for r in range(3):
        x = dot(parent[r], column(offset, 0))
        y = dot(parent[r], column(offset, 1))
        z = dot(parent[r], column(offset, 2))
        t = dot(parent[r], column(offset, 3))
        child[r, 0] = x * c + y * s
        child[r, 1] = y * c - x * s
        child[r, 2] = z
        child[r, 3] = t + parent[r, 3] + z * slide
