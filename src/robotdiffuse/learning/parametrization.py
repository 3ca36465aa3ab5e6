"""How a trajectory is written as rows of numbers for the network: its waypoints, or control points of a
spline.

Both are linear, so each is three constant matrices. The first and the last row are the first and the last
waypoint, so that ends are held exactly by holding these rows (the paper's noise interpolation).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.interpolate import BSpline

from robotdiffuse.core.errors import InputError, unknown_name

DEGREE = 3


@dataclass(frozen=True, eq=False)
class Parametrization:
    """Rows of a trajectory: `fit @ waypoints`; its waypoints again: `evaluate @ rows`."""

    fit: Float[ndarray, "rows waypoints"]
    """Least squares with both ends exact."""
    evaluate: Float[ndarray, "waypoints rows"]
    sites: Float[ndarray, "rows rows"]
    """`sites @ rows`: the trajectory at one place for each row, where the network is told of clearances."""

    themselves: bool = False
    """Rows are the waypoints: nothing is multiplied."""

    @property
    def rows(self) -> int:
        return len(self.fit)

    def to_rows(self, waypoints: Float[ndarray, "*batch waypoints dof"]) -> Float[ndarray, "*batch rows dof"]:
        return waypoints if self.themselves else self.fit @ waypoints

    def to_waypoints(self, rows: Float[ndarray, "*batch rows dof"]) -> Float[ndarray, "*batch waypoints dof"]:
        return rows if self.themselves else self.evaluate @ rows

    def at_sites(self, rows: Float[ndarray, "*batch rows dof"]) -> Float[ndarray, "*batch rows dof"]:
        return rows if self.themselves else self.sites @ rows


def waypoints_themselves(waypoints: int, rows: int) -> Parametrization:
    """A row for each waypoint. `rows` must be `waypoints`."""
    if rows != waypoints:
        raise InputError(
            f"rows is {rows}; for the parametrization waypoints it must be {waypoints}, the waypoints"
        )
    identity = np.eye(waypoints, dtype=np.float32)
    return Parametrization(identity, identity, identity, themselves=True)


def b_spline(waypoints: int, rows: int) -> Parametrization:
    """Control points of a clamped uniform cubic B-spline (C. de Boor, "A Practical Guide to Splines", 1978).

    Its derivatives are continuous up to the second. Sites are the Greville abscissae.
    """
    if not DEGREE + 1 <= rows <= waypoints:
        raise InputError(
            f"rows is {rows}; a cubic spline through {waypoints} waypoints needs {DEGREE + 1} to {waypoints}"
        )
    inner = np.linspace(0.0, 1.0, rows - DEGREE + 1)[1:-1]
    knots = np.concatenate([np.zeros(DEGREE + 1), inner, np.ones(DEGREE + 1)])
    evaluate = _basis(knots, np.linspace(0.0, 1.0, waypoints))
    greville = np.array([knots[i + 1 : i + 1 + DEGREE].mean() for i in range(rows)])
    # the ends first; the inner control points fit what they leave
    fit = np.zeros((rows, waypoints))
    fit[0, 0] = fit[-1, -1] = 1.0
    left = np.eye(waypoints) - evaluate[:, [0, -1]] @ fit[[0, -1]]
    fit[1:-1] = np.linalg.pinv(evaluate[:, 1:-1]) @ left
    sites = _basis(knots, greville)
    return Parametrization(fit.astype(np.float32), evaluate.astype(np.float32), sites.astype(np.float32))


def _basis(knots: Float[ndarray, "m"], at: Float[ndarray, "n"]) -> Float[ndarray, "n rows"]:
    basis = BSpline.design_matrix(at, knots, DEGREE).toarray()
    basis[np.abs(basis) < 1e-12] = 0.0
    return basis


PARAMETRIZATIONS: dict[str, Callable[[int, int], Parametrization]] = {
    "waypoints": waypoints_themselves,
    "b_spline": b_spline,
}
"""By the name in checkpoints: made from the numbers of waypoints and of rows."""


def parametrization(name: str, waypoints: int, rows: int) -> Parametrization:
    """Raises InputError for an unknown name, listing the known, and for rows that do not fit."""
    if name not in PARAMETRIZATIONS:
        raise unknown_name("parametrization", name, PARAMETRIZATIONS)
    return PARAMETRIZATIONS[name](waypoints, rows)
