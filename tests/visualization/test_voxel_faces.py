"""Faces of sets of voxels: by hand."""

import numpy as np

from robotdiffuse.perception.occupancy_map import MAP
from robotdiffuse.visualization.exploration import faces_between, faces_surface


def test_a_cube_has_six_faces_around_it() -> None:
    inside = np.zeros((4, 5, 6), np.bool_)
    inside[1, 2, 3] = True
    numbers, first = faces_between(inside, ~inside)
    size, at = inside.size, (1 * 5 + 2) * 6 + 3
    assert numbers.tolist() == [at - 30, at, size + at - 6, size + at, 2 * size + at - 1, 2 * size + at]
    assert first.tolist() == [False, True] * 3
    surface = faces_surface(inside, ~inside, (255, 0, 0))
    center = (np.array([1.5, 2.5, 3.5])) * MAP.edge + MAP.low
    away = surface.vertices - center
    np.testing.assert_allclose(np.abs(away), MAP.edge / 2)
    np.testing.assert_allclose((away * surface.normals).sum(axis=1), MAP.edge / 2)
    assert len(surface.faces) == 12 and (surface.colors == [1, 0, 0]).all()


def test_faces_lie_between_the_two_sets_alone() -> None:
    unknown, free = np.zeros((2, 3, 3, 3), np.bool_)
    unknown[0], free[1, 0, 0] = True, True
    numbers, first = faces_between(unknown, free)
    assert numbers.tolist() == [0] and first.tolist() == [True]
