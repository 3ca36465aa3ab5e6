"""SIMD lanes in compiled code, against NumPy."""

import numpy as np
import pytest
from numba.core.errors import TypingError
from numpy import ndarray

from robotdiffuse.collision.kernels.simd import (
    W,
    absolute,
    by_sixteen,
    copysign,
    first_lane,
    floor,
    gather,
    lane,
    lane_numbers,
    lanes_array,
    lanes_with_bit,
    load,
    maximum,
    minimum,
    reduce_max,
    reduce_min,
    sqrt,
    store,
)
from robotdiffuse.core.kernels import allocation_free


@allocation_free(inner=False)
def _calculate(a, b, s, out):
    x = load(a, 0, 0)
    y = load(b, 1, 1)
    store(out, 0, 0, x + y * s)
    store(out, 1, 0, s - x)
    store(out, 2, 0, minimum(x, y))
    store(out, 3, 0, maximum(x, s))
    store(out, 4, 0, sqrt(absolute(x)))
    store(out, 5, 0, copysign(y, x))
    store(out, 6, 0, floor(x))
    store(out, 7, 0, lane_numbers())
    return x < y, reduce_min(x), reduce_max(x), lane(x, 3)


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


def bits(mask: int) -> ndarray:
    return mask >> np.arange(W) & 1 == 1


def test_arithmetic_is_numpys() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(0, 3, (1, W)).astype(np.float32)
    b = rng.normal(0, 3, (2, 3 * W)).astype(np.float32)
    out = np.zeros((8, W), np.float32)
    s = np.float32(0.7)
    mask, low, high, third = _calculate(a, b, s, out)
    x = a[0]
    y = b[1, W : 2 * W]
    right = [
        *(x + y * s, s - x, np.minimum(x, y), np.maximum(x, s), np.sqrt(abs(x))),
        *(np.copysign(y, x), np.floor(x), np.arange(W)),
    ]
    np.testing.assert_allclose(out, right, atol=1e-6)  # a product and a sum may be rounded once
    np.testing.assert_array_equal(bits(mask), x < y)
    assert (low, high, third) == (x.min(), x.max(), x[3])


def test_gathered_bits() -> None:
    rng = np.random.default_rng(1)
    table = np.arange(100, dtype=np.float32)
    index = rng.integers(0, 100, (1, W)).astype(np.float32)
    out = np.zeros((1, W), np.float32)
    total = _look_up(table, index, np.int32(4), out)
    np.testing.assert_array_equal(out, index)
    assert total == np.flatnonzero(index[0].astype(int) & 4).sum()


def test_lanes_of_float64_or_of_a_strided_array_are_refused() -> None:
    index = np.zeros((1, W), np.float32)
    out = np.zeros((1, W), np.float32)
    for table in (np.arange(100.0), np.arange(100, dtype=np.float32)[::2]):
        with pytest.raises(TypingError, match="gather"):
            _look_up(table, index, np.int32(4), out)


@pytest.mark.parametrize("n", [0, 1, 16, 17])
def test_rows_by_sixteen(n: int) -> None:
    rows = np.random.default_rng(n).normal(size=(n, 3)).astype(np.float32)
    packed = by_sixteen(rows, rows[-1:])
    assert packed.shape == (-(-n // W), 3 * W)
    unpacked = packed.reshape(-1, 3, W).swapaxes(1, 2).reshape(-1, 3)
    np.testing.assert_array_equal(unpacked[:n], rows)
    assert (unpacked[n:] == rows[-1:]).all()


def test_arrays_of_lanes_begin_at_cache_lines() -> None:
    arrays = [lanes_array(rows, 3) for rows in (1, 2, 7)]
    assert [array.shape for array in arrays] == [(1, 48), (2, 48), (7, 48)]
    assert all(array.ctypes.data % 64 == 0 and not array.any() for array in arrays)
