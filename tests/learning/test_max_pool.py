"""The maximum over points: PyTorch's, with a gradient for the first of equal ones."""

import pytest
import torch

from robotdiffuse.learning.max_pool import max_pool


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_it_is_the_maximum_and_has_its_gradient(dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    x = torch.randn(5, 11, 7).to(dtype)
    x[0] = -x[0].abs()
    x[1, 3] = x[1, 8] = 9.0
    x.requires_grad_()
    weight = torch.randn(5, 7).to(dtype)
    best = max_pool(x)
    assert torch.equal(best, x.amax(1))
    (own,) = torch.autograd.grad((best * weight).sum(), x)
    (wanted,) = torch.autograd.grad((x.max(1).values * weight).sum(), x)
    assert torch.equal(own[[0, 2, 3, 4]], wanted[[0, 2, 3, 4]])
    assert torch.equal(own[1, 3], weight[1]) and not own[1, 8].any()


def test_slices_of_other_arrays_are_taken_as_they_are() -> None:
    x = torch.arange(24.0).reshape(2, 3, 4).transpose(1, 2).requires_grad_()
    assert torch.equal(max_pool(x), x.amax(1))
