"""SIMD lanes in compiled code, against NumPy."""

import numpy as np
import pytest
from numba.core.errors import TypingError

from robotdiffuse.collision.kernels.simd import W, first_lane, gather, lanes_with_bit, load, store
from robotdiffuse.core.kernels import allocation_free


@allocation_free(inner=False)
def _look_up(table, index, bit, out):
    found = gather(table, load(index, 0, 0))
    store(out, 0, 0, found)
    mask = lanes_with_bit(found, bit)
    total = 0
    while mask:
        total += first_lane(mask)
        mask &= mask - 1
    return total


def test_gathered_bits() -> None:
    index = np.random.default_rng(1).integers(0, 100, (1, W)).astype(np.float32)
    out = np.zeros((1, W), np.float32)
    total = _look_up(np.arange(100, dtype=np.float32), index, np.int32(4), out)
    np.testing.assert_array_equal(out, index)
    assert total == np.flatnonzero(index[0].astype(int) & 4).sum()


def test_lanes_of_float64_or_of_a_strided_array_are_refused() -> None:
    index = np.zeros((1, W), np.float32)
    out = np.zeros((1, W), np.float32)
    for table in (np.arange(100.0), np.arange(100, dtype=np.float32)[::2]):
        with pytest.raises(TypingError, match="gather"):
            _look_up(table, index, np.int32(4), out)
