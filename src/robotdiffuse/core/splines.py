"""Rows of uniform cubic B-splines, whose cubics keep the limits of the motion that they average."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

Rows = tuple[Float[ndarray, "n"], Float[ndarray, "n dof"], Float[ndarray, "n dof"], Float[ndarray, "n dof"]]
"""Times, positions, velocities and accelerations."""


def spline_rows(
    controls: Float[ndarray, "m dof"],
    step: float,
    window: int = 1,
    velocity: Float[ndarray, "dof"] | float = 0.0,
) -> Rows:
    """The uniform cubic B-spline whose control points are moving averages of the configurations of a motion
    that ends at rest, `step` [s] apart, over `window` of them. Before these the arm moved with `velocity`.

    Velocities and accelerations are weighted means of the motion's, and so within the same limits at every
    time; jerks are constant between rows. The spline leaves the motion's path by no more than about a sixth
    of the acceleration times `step` squared, and stays on straight lines.
    """
    before = np.arange(-window - 2, 0)[:, None] * step * np.broadcast_to(velocity, controls.shape[1])
    moved = np.concatenate(
        [
            before,
            controls - controls[0],
            np.repeat(controls[-1:] - controls[0], window + 1, axis=0),
        ]
    )
    total = np.cumsum(moved, axis=0)
    points = (total[window:] - total[:-window]) / window
    before, at, after = points[:-2], points[1:-1], points[2:]
    q = controls[0] + (before + 4 * at + after) / 6
    v, a = (after - before) / (2 * step), (after - 2 * at + before) / step**2
    q[-1] = controls[-1]
    v[0], v[-1], a[[0, -1]] = velocity, 0.0, 0.0
    return step * np.arange(len(q)), q, v, a
