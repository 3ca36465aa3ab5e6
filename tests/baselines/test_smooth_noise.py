"""Smooth noise: fixed ends, joint limits, and the covariance of the noise in the Panda's weights."""

import numpy as np

from robotdiffuse import load_robot
from robotdiffuse.baselines.controls import MAX_HALF_RANGE, SPREAD, smooth_noise
from robotdiffuse.learning.exported_model import exported_model

PANDA = load_robot("panda")
MIDDLE = 0.5 * (PANDA.lower + PANDA.upper)
GOALS = np.stack([MIDDLE, MIDDLE + 0.1])


def test_ends_and_limits_are_kept() -> None:
    q = smooth_noise(PANDA.lower, GOALS, 5, 48, PANDA, np.random.default_rng(0))
    assert q.shape == (5, 48, 7) and q.dtype == np.float32
    assert np.array_equal(q[:, 0], np.repeat(PANDA.lower[None], 5, 0).astype(np.float32))
    assert np.array_equal(q[:, -1], GOALS[[0, 1, 0, 1, 0]].astype(np.float32))
    assert (q >= PANDA.lower.astype(np.float32)).all() and (q <= PANDA.upper.astype(np.float32)).all()


def test_its_covariance_is_about_that_of_the_pandas_weights() -> None:
    """Eigenvalues agree to a hundredth of their sum, and the standard deviation on average."""
    q = smooth_noise(MIDDLE, MIDDLE[None], 4000, 48, PANDA, np.random.default_rng(1)) - MIDDLE
    half = np.minimum(0.5 * (PANDA.upper - PANDA.lower), MAX_HALF_RANGE)
    rows = np.moveaxis(q / half, 1, 2).reshape(-1, 48)
    assert np.sqrt((rows**2).mean()) == np.float32(SPREAD).round(6) or abs(rows.std() - SPREAD) < 0.005
    model = exported_model("model", None, PANDA)
    factor = model.statistics.noise_factor.astype(np.float64)
    shares = [np.linalg.eigvalsh(c)[::-1] / np.trace(c) for c in (rows.T @ rows, factor @ factor.T)]
    assert np.abs(shares[0] - shares[1]).max() < 0.012
