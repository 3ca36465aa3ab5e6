"""Nearest neighbours are those of brute force, for any points."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotdiffuse.planning.search.shared_tree.kd_tree import (
    BUCKET,
    insert,
    make_kd_tree,
    make_neighbours,
    query,
)


def tree_of(points: np.ndarray):
    tree = make_kd_tree(len(points))
    for i in range(len(points)):
        insert(tree, points, i)
    return tree


@given(st.integers(1, 400), st.integers(1, 7), st.integers(1, 40), st.integers(0, 2**31))
def test_the_same_as_brute_force(n: int, dof: int, k: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    # rounded: many equal coordinates, which a split must not separate
    points = rng.normal(size=(n, dof)).round(int(rng.integers(1, 6))).astype(np.float32)
    points = np.unique(points, axis=0)
    rng.shuffle(points)
    tree, out = tree_of(points), make_neighbours(40, dof)
    for q in rng.normal(size=(5, dof)).astype(np.float32):
        found = query(tree, points, q, k, out)
        squares = np.sort(((points - q) ** 2).sum(axis=1))[:k]
        assert found == len(squares) == min(k, len(points))
        np.testing.assert_allclose(out.distance[:found], squares, rtol=1e-5, atol=1e-10)
        assert len(set(out.index[:found].tolist())) == found


def test_copies_of_a_point_do_no_harm() -> None:
    points = np.ones((10 * BUCKET, 3), np.float32)
    points[-1] = 2.0
    tree, out = tree_of(points), make_neighbours(4, 3)
    assert query(tree, points, points[-1], 1, out) == 1
    assert out.distance[0] in (0.0, 3.0) and query(tree, points, points[0], 4, out) == 4


@pytest.mark.parametrize("order", ["random", "sorted"])
def test_cells_suffice_for_any_order(order: str) -> None:
    points = np.random.default_rng(0).uniform(size=(5000, 2)).astype(np.float32)
    if order == "sorted":
        points = points[np.lexsort(points.T)]
    tree, out = tree_of(points), make_neighbours(1, 2)
    assert tree.count[tree.axis < 0].sum() >= len(points)
    for i in range(0, len(points), 97):
        assert query(tree, points, points[i], 1, out) == 1 and out.index[0] == i
