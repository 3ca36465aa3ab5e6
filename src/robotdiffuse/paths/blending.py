"""A polyline with rounded corners: twice continuously differentiable, at a known distance to the polyline."""

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

DEVIATION = 3.0 / 16.0
"""Distance between corner and blend, over half width times the change of direction: b(0) of `_blend`."""


def _blend(u: Float[ndarray, "n"], order: int) -> Float[ndarray, "n"]:
    """A C2 replacement of max(u, 0) on [-1, 1], whose second derivative is 3/4 (1 - u²)."""
    if order == 0:
        return 3 / 16 + u / 2 + 3 / 8 * u**2 - u**4 / 16
    if order == 1:
        return 1 / 2 + 3 / 4 * u - u**3 / 4
    return 3 / 4 * (1 - u**2)


class BlendedPolyline:
    """Straight lines between waypoints, each corner rounded over a half width to either side of it.

    The parameter s is the arc length of the polyline. With directions e before and f behind corner i at s_i
    and u = (s - s_i) / d_i in [-1, 1], the path is w_i + d_i (e u + (f - e) b(u)). It leaves the polyline by
    at most 3/16 d_i |f - e|, at u = 0.
    """

    def __init__(self, waypoints: Float[ndarray, "n dof"], half_widths: Float[ndarray, "corners"]) -> None:
        """Takes at least two waypoints, no two neighbours equal, and a half width for each inner one.

        Half widths must not exceed half of the shorter neighbouring segment.
        """
        self.waypoints = waypoints
        steps = np.diff(waypoints, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        self.knots: Float[ndarray, "n"] = np.concatenate([[0.0], np.cumsum(lengths)])
        self.directions: Float[ndarray, "segments dof"] = steps / lengths[:, None]
        self.half_widths = half_widths

    @property
    def length(self) -> float:
        """Arc length of the polyline: the end of the parameter s."""
        return float(self.knots[-1])

    def __call__(self, s: Float[ndarray, "m"], order: int) -> Float[ndarray, "m dof"]:
        """The path (order 0) or its first or second derivative with respect to s."""
        segment = np.clip(np.searchsorted(self.knots, s, side="right") - 1, 0, len(self.directions) - 1)
        if order == 0:
            q = self.waypoints[segment] + (s - self.knots[segment])[:, None] * self.directions[segment]
        elif order == 1:
            q = self.directions[segment].copy()
        else:
            q = np.zeros((len(s), self.waypoints.shape[1]))
        if len(self.half_widths):
            corner, inside = self._corner(s, segment)
            self._round(q, s, corner[inside], inside, order)
        return q

    def _corner(
        self, s: Float[ndarray, "m"], segment: Int[ndarray, "m"]
    ) -> tuple[Int[ndarray, "m"], Bool[ndarray, "m"]]:
        """The nearest corner of each s, and whether s lies inside its blend."""
        middle = 0.5 * (self.knots[segment] + self.knots[segment + 1])
        corner = np.clip(np.where(s < middle, segment - 1, segment), 0, len(self.half_widths) - 1)
        return corner, np.abs(s - self.knots[corner + 1]) < self.half_widths[corner]

    def _round(
        self,
        q: Float[ndarray, "m dof"],
        s: Float[ndarray, "m"],
        corner: Int[ndarray, "k"],
        inside: Bool[ndarray, "m"],
        order: int,
    ) -> None:
        d = self.half_widths[corner]
        u = (s[inside] - self.knots[corner + 1]) / d
        e, f = self.directions[corner], self.directions[corner + 1]
        b = _blend(u, order)[:, None]
        if order == 0:
            q[inside] = self.waypoints[corner + 1] + d[:, None] * (u[:, None] * e + (f - e) * b)
        elif order == 1:
            q[inside] = e + (f - e) * b
        else:
            q[inside] = (f - e) * b / d[:, None]


def half_widths(
    waypoints: Float[ndarray, "n dof"], deviations: Float[ndarray, "corners"]
) -> Float[ndarray, "corners"]:
    """The widest blends that leave the polyline by no more than the deviations and do not overlap."""
    steps = np.diff(waypoints, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    turn = np.linalg.norm(np.diff(steps / lengths[:, None], axis=0), axis=1)
    room = 0.5 * np.minimum(lengths[:-1], lengths[1:])
    return np.minimum(room, deviations / np.maximum(DEVIATION * turn, 1e-12))
