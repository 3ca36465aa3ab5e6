"""The nearest voxels with points, against SciPy's distance transform."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from robotdiffuse.collision.kernels.nearest_voxels import nearest_voxels


@pytest.mark.parametrize(
    ("shape", "count"), [((9, 12, 7), 4), ((1, 1, 30), 2), ((30, 1, 1), 1), ((20, 17, 13), 900)]
)
def test_nearest_voxels_are_those_of_a_distance_transform(shape, count):
    rng = np.random.default_rng(0)
    run = np.full(shape, -1, np.int32)
    held = rng.choice(run.size, count, replace=False)
    run.ravel()[held] = np.arange(count)
    squares, holders = nearest_voxels(run)
    there = np.stack(np.unravel_index(held, shape), axis=-1)[holders]
    away = there - np.moveaxis(np.indices(shape), 0, -1)
    np.testing.assert_array_equal(squares, (away**2).sum(axis=-1))
    distances = np.asarray(distance_transform_edt(run < 0))
    np.testing.assert_allclose(np.sqrt(squares), distances, rtol=1e-6)
