"""Max pooling over the points of a cloud, or of a group of points, with a fast gradient on CPUs.

The gradient of PyTorch's `amax` takes longer than the layers before it. Without a gradient `amax` is faster,
and planning need not load compiled code.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from robotdiffuse.core.kernels import kernel


def max_pool(x: Float[Tensor, "groups rows width"]) -> Float[Tensor, "groups width"]:
    """The maximum over the rows; among equal rows the first gets the gradient. At most 32,767 rows."""
    return _MaxPool.apply(x.contiguous()) if x.requires_grad and not x.is_cuda else x.amax(1)


class _MaxPool(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        best, which = x.new_empty(len(x), x.shape[2]), x.new_empty(len(x), x.shape[2], dtype=torch.int16)
        _forward(_bits(x), _bits(best), which.numpy())
        ctx.save_for_backward(which)
        ctx.rows = x.shape[1]
        return best

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (which,) = ctx.saved_tensors
        out = gradients[0].new_empty(len(which), ctx.rows, which.shape[1])
        _backward(_bits(gradients[0].contiguous()), which.numpy(), _bits(out))
        return out


def _bits(x: Tensor) -> ndarray:
    """The memory of a tensor, viewed as integers."""
    return x.detach().view(torch.int16 if x.dtype == torch.bfloat16 else torch.int32).numpy()


@kernel(nogil=True)
def _forward(values, best, which):
    """Writes the maximum over each group's rows of values [groups, rows, width] to best, its row to which.

    `values` are the bits of floating-point numbers as signed integers of the same size, int16 of bfloat16 or
    int32 of float32, and so is best [groups, width]; which [groups, width] is int16. Of equal rows the first
    counts.
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


@kernel(nogil=True)
def _backward(gradients, which, out):
    """Writes the gradient of `_forward` to out [groups, rows, width]: `gradients` [groups, width] at the
    maxima, 0 elsewhere, all as bits."""
    groups, rows, width = out.shape
    for i in range(groups):
        for r in range(rows):
            for c in range(width):
                out[i, r, c] = gradients[i, c] if which[i, c] == r else 0
