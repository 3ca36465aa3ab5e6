"""The maximum over the points of a cloud, or of a group of them, that training on a CPU waits for the least.

The gradient of PyTorch's takes longer than the layers before it; without a gradient PyTorch's is the faster
one, and planning need not load compiled code for it.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from numpy import ndarray
from torch import Tensor


def greatest(x: Float[Tensor, "groups rows width"]) -> Float[Tensor, "groups width"]:
    """The maximum over the rows; of equal ones the first has the gradient. At most 32,767 rows."""
    return _Greatest.apply(x.contiguous()) if x.requires_grad and not x.is_cuda else x.amax(1)


class _Greatest(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        best, which = x.new_empty(len(x), x.shape[2]), x.new_empty(len(x), x.shape[2], dtype=torch.int16)
        _take(_bits(x), _bits(best), which.numpy())
        ctx.save_for_backward(which)
        ctx.rows = x.shape[1]
        return best

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (which,) = ctx.saved_tensors
        out = gradients[0].new_empty(len(which), ctx.rows, which.shape[1])
        _put_back(_bits(gradients[0].contiguous()), which.numpy(), _bits(out))
        return out


def _bits(x: Tensor) -> ndarray:
    """The same memory as integers."""
    return x.detach().view(torch.int16 if x.dtype == torch.bfloat16 else torch.int32).numpy()


@njit(cache=True, nogil=True)
def _take(values, best, which):
    """The greatest of each group's rows: values [groups, rows, width] to best and which [groups, width].

    `values` are the bits of floating-point numbers as signed integers of the same size, int16 of bfloat16 or
    int32 of float32, and so is `best`; `which` is int16. Of equal ones the first counts.
    """
    groups, rows, width = values.shape
    sign = values.dtype.type(8 * values.itemsize - 1)
    magnitude = np.iinfo(values.dtype).max
    keys = np.empty(width, values.dtype)
    for i in range(groups):
        for c in range(width):
            v = values[i, 0, c]
            keys[c] = v ^ ((v >> sign) & magnitude)
            which[i, c] = 0
        for r in range(1, rows):
            for c in range(width):
                v = values[i, r, c]
                key = v ^ ((v >> sign) & magnitude)
                more = key > keys[c]
                keys[c] = key if more else keys[c]
                which[i, c] = r if more else which[i, c]
        for c in range(width):
            key = keys[c]
            best[i, c] = key ^ ((key >> sign) & magnitude)


@njit(cache=True, nogil=True)
def _put_back(gradients, which, out):
    """The gradient of `_take`: out [groups, rows, width] is `gradients` [groups, width] where the greatest
    were and 0 elsewhere, as bits too."""
    groups, rows, width = out.shape
    for i in range(groups):
        for r in range(rows):
            for c in range(width):
                out[i, r, c] = gradients[i, c] if which[i, c] == r else 0
