"""Polylines with rounded corners: twice continuously differentiable, at a known distance to the polyline."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.types import Configuration, Configurations, JointRows, Values
from robotdiffuse.trajectories.timing_kernel import BLEND_DEVIATION, evaluate, rounded_line


class BlendedPolyline:
    """Straight lines between waypoints, each corner rounded over a half width to either side of it.

    The parameter s is the arc length of the polyline, and b(u) a C2 replacement of max(u, 0) on [-1, 1],
    whose second derivative is 3/4 (1 - u²). With directions e before and f behind corner i at s_i and
    u = (s - s_i) / d_i in [-1, 1], the path is w_i + d_i (e u + (f - e) b(u)). It leaves the polyline by at
    most 3/16 d_i |f - e|, at u = 0.
    """

    def __init__(self, waypoints: Configurations, half_widths: Values) -> None:
        """`waypoints`: at least two, no two neighbors equal. `half_widths`: one for each inner waypoint; no
        two rounded corners overlap, and none reaches beyond an end."""
        self.waypoints = waypoints
        steps = waypoints[1:] - waypoints[:-1]
        lengths = np.linalg.norm(steps, axis=1)
        self.knots: Values = np.concatenate([[0.0], np.cumsum(lengths)])
        self.directions: Float[ndarray, "segments dof"] = steps / lengths[:, None]
        self.half_widths = half_widths

    @property
    def length(self) -> float:
        """Arc length of the polyline: the end of the parameter s."""
        return float(self.knots[-1])

    @property
    def arrays(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """The arguments of the compiled functions: waypoints, knots, directions and half widths."""
        return self.waypoints, self.knots, self.directions, self.half_widths

    def __call__(self, s: Values, order: int) -> JointRows:
        """The path (order 0) or its first or second derivative with respect to s."""
        return evaluate(self.arrays, s, order)


def half_widths(waypoints: Configurations, deviations: Values) -> Values:
    """Half widths of the widest blends that leave the polyline by at most the deviations and do not
    overlap."""
    return rounded_line(np.asarray(waypoints, float), np.asarray(deviations, float))[3]


def corner_middle(path: Configurations, row: int, deviation: float) -> Configuration:
    """The middle of the rounded corner at an inner row, for a deviation [rad, joint-space L2]."""
    e = path[row] - path[row - 1]
    f = path[row + 1] - path[row]
    lengths = np.linalg.norm(e), np.linalg.norm(f)
    if min(lengths) == 0:
        return path[row]
    turn = f / lengths[1] - e / lengths[0]
    width = half_widths(path[row - 1 : row + 2], np.array([deviation]))[0]
    return path[row] + BLEND_DEVIATION * width * turn
