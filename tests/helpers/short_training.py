"""A short training of a network, for the tests of its loss."""

from collections.abc import Callable

import torch
from torch import Tensor, nn


def trained(network: nn.Module, loss_at: Callable[[int], Tensor], steps: int, rate: float) -> list[float]:
    """The loss of each step of a training; `loss_at` gives the loss for the number of a step."""
    optimizer = torch.optim.AdamW(network.parameters(), rate)
    losses = []
    for step in range(steps):
        loss = loss_at(step)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    return losses
