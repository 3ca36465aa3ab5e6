"""How a trajectory is written as rows of numbers for the network: its frames, or control points of a spline.

Both are linear, so each is three constant matrices. The first and the last row are the first and the last
frame, so that ends are held exactly by holding these rows (the paper's noise interpolation).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.interpolate import BSpline

from robotdiffuse.errors import InputError, unknown_name

DEGREE = 3


@dataclass(frozen=True, eq=False)
class Parametrization:
    """Rows of a trajectory: `fit @ frames`; its frames again: `evaluate @ rows`."""

    fit: Float[ndarray, "rows frames"]
    """Least squares with both ends exact."""
    evaluate: Float[ndarray, "frames rows"]
    sites: Float[ndarray, "rows rows"]
    """`sites @ rows`: the trajectory at one place for each row, where the network is told of clearances."""

    themselves: bool = False
    """Rows are the frames: nothing is multiplied."""

    @property
    def rows(self) -> int:
        return len(self.fit)

    def to_rows(self, frames: Float[ndarray, "*batch frames dof"]) -> Float[ndarray, "*batch rows dof"]:
        return frames if self.themselves else self.fit @ frames

    def to_frames(self, rows: Float[ndarray, "*batch rows dof"]) -> Float[ndarray, "*batch frames dof"]:
        return rows if self.themselves else self.evaluate @ rows

    def at_sites(self, rows: Float[ndarray, "*batch rows dof"]) -> Float[ndarray, "*batch rows dof"]:
        return rows if self.themselves else self.sites @ rows


def frames_themselves(frames: int, rows: int) -> Parametrization:
    """A row for each frame. `rows` must be `frames`."""
    if rows != frames:
        raise InputError(f"rows is {rows}; for the parametrization frames it must be {frames}, the frames")
    identity = np.eye(frames, dtype=np.float32)
    return Parametrization(identity, identity, identity, themselves=True)


def b_spline(frames: int, rows: int) -> Parametrization:
    """Control points of a clamped uniform cubic B-spline (C. de Boor, "A Practical Guide to Splines", 1978).

    Its derivatives are continuous up to the second. Sites are the Greville abscissae.
    """
    if not DEGREE + 1 <= rows <= frames:
        raise InputError(
            f"rows is {rows}; a cubic spline through {frames} frames needs {DEGREE + 1} to {frames}"
        )
    inner = np.linspace(0.0, 1.0, rows - DEGREE + 1)[1:-1]
    knots = np.concatenate([np.zeros(DEGREE + 1), inner, np.ones(DEGREE + 1)])
    evaluate = _basis(knots, np.linspace(0.0, 1.0, frames))
    greville = np.array([knots[i + 1 : i + 1 + DEGREE].mean() for i in range(rows)])
    # the ends first; the inner control points fit what they leave
    fit = np.zeros((rows, frames))
    fit[0, 0] = fit[-1, -1] = 1.0
    left = np.eye(frames) - evaluate[:, [0, -1]] @ fit[[0, -1]]
    fit[1:-1] = np.linalg.pinv(evaluate[:, 1:-1]) @ left
    sites = _basis(knots, greville)
    return Parametrization(fit.astype(np.float32), evaluate.astype(np.float32), sites.astype(np.float32))


def _basis(knots: Float[ndarray, "m"], at: Float[ndarray, "n"]) -> Float[ndarray, "n rows"]:
    basis = BSpline.design_matrix(at, knots, DEGREE).toarray()
    basis[np.abs(basis) < 1e-12] = 0.0
    return basis


PARAMETRIZATIONS: dict[str, Callable[[int, int], Parametrization]] = {
    "frames": frames_themselves,
    "b_spline": b_spline,
}
"""By the name in checkpoints: made from the numbers of frames and of rows."""


def parametrization(name: str, frames: int, rows: int) -> Parametrization:
    """Raises InputError for an unknown name, listing the known, and for rows that do not fit."""
    if name not in PARAMETRIZATIONS:
        raise unknown_name("parametrization", name, PARAMETRIZATIONS)
    return PARAMETRIZATIONS[name](frames, rows)
