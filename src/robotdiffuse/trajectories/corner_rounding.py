"""Polylines with rounded corners: twice continuously differentiable, within a known distance of the
polyline."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.types import Configuration, Configurations, JointRows, Values
from robotdiffuse.trajectories.timing_kernel import BLEND_DEVIATION, evaluate, rounded_line


class BlendedPolyline:
    """Straight lines between waypoints, with each corner rounded (blended) within a half width before and
    after it.

    The parameter s is the arc length of the polyline. Corner i is the waypoint w_i at s_i, with the half
    width d_i and the unit directions e before and f behind it. The blend is w_i + d_i (e u + (f - e) b(u)),
    with u = (s - s_i) / d_i in [-1, 1]. Here b(u) is a C2 replacement of max(u, 0) with the second derivative
    3/4 (1 - u²). The blend leaves the polyline by at most 3/16 d_i |f - e|, at u = 0.
    """

    def __init__(self, waypoints: Configurations, half_widths: Values) -> None:
        """
        waypoints: at least two rows [n, dof]; neighbors must differ.
        half_widths: one for each inner waypoint [n - 2]. Rounded corners must not overlap or reach beyond the
            path's ends.
        """
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
        """The path (order 0) or its first or second derivative by s, at each s."""
        return evaluate(self.arrays, s, order)


def half_widths(waypoints: Configurations, deviations: Values) -> Values:
    """Half widths [n - 2] of the widest blends that do not overlap and leave the polyline by at most the
    deviations [n - 2] [rad, joint-space L2]."""
    return rounded_line(np.asarray(waypoints, float), np.asarray(deviations, float))[3]


def corner_middle(path: Configurations, row: int, deviation: float) -> Configuration:
    """The middle of the blend at an inner row of a path, rounded by at most `deviation` [rad, joint-space
    L2]."""
    e = path[row] - path[row - 1]
    f = path[row + 1] - path[row]
    lengths = np.linalg.norm(e), np.linalg.norm(f)
    if min(lengths) == 0:
        return path[row]
    turn = f / lengths[1] - e / lengths[0]
    width = half_widths(path[row - 1 : row + 2], np.array([deviation]))[0]
    return path[row] + BLEND_DEVIATION * width * turn
