"""Waypoints and splines: ends exact, straight lines straight, smooth trajectories nearly so."""

import numpy as np
import pytest

from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.parametrization import PARAMETRIZATIONS, parametrization

ROWS = {"waypoints": 48, "b_spline": 12}


@pytest.fixture(params=list(PARAMETRIZATIONS))
def rows_of(request):
    return parametrization(request.param, 48, ROWS[request.param])


def test_every_parametrization_is_tried() -> None:
    assert set(ROWS) == set(PARAMETRIZATIONS)


def test_ends_are_held_by_the_first_and_last_row(rows_of) -> None:
    x = np.random.default_rng(0).normal(size=(48, 7)).astype(np.float32)
    rows = rows_of.fit @ x
    assert np.array_equal(rows[[0, -1]], x[[0, -1]])
    np.testing.assert_allclose((rows_of.evaluate @ rows)[[0, -1]], x[[0, -1]], atol=1e-6)
    np.testing.assert_allclose((rows_of.sites @ rows)[[0, -1]], x[[0, -1]], atol=1e-6)
    other = rows.copy()
    other[1:-1] += 1.0
    assert np.array_equal((rows_of.evaluate @ other)[[0, -1]], (rows_of.evaluate @ rows)[[0, -1]])


def test_lines_and_cubics_are_exact(rows_of) -> None:
    s = np.linspace(0, 1, 48)[:, None]
    for x in (1 - 2 * s, s**3 - s + 0.5):
        x = x.astype(np.float32)
        np.testing.assert_allclose(rows_of.evaluate @ (rows_of.fit @ x), x, atol=2e-6)


def test_rows_again_from_frames(rows_of) -> None:
    rows = np.random.default_rng(1).normal(size=(rows_of.rows, 7)).astype(np.float32)
    np.testing.assert_allclose(rows_of.fit @ (rows_of.evaluate @ rows), rows, atol=1e-4)


def test_a_bend_needs_few_control_points() -> None:
    s = np.linspace(0, 1, 48)[:, None]
    x = np.abs(s - 0.4).astype(np.float32)
    errors = []
    for rows in (6, 12, 24):
        spline = parametrization("b_spline", 48, rows)
        errors.append(np.abs(spline.evaluate @ (spline.fit @ x) - x).max())
    assert errors[0] > errors[1] > errors[2] and errors[1] < 0.03


@pytest.mark.parametrize(("name", "rows"), [("waypoints", 12), ("b_spline", 3), ("b_spline", 49)])
def test_numbers_of_rows_that_do_not_fit(name: str, rows: int) -> None:
    with pytest.raises(InputError, match=f"rows is {rows}"):
        parametrization(name, 48, rows)


def test_unknown_names_list_the_known() -> None:
    with pytest.raises(InputError, match="b_spline"):
        parametrization("bezier", 48, 12)
