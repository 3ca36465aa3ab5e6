"""The completing auto-encoder: an observed volume to the probability that each voxel of 2 cm holds obstacles.

A U-Net of residual blocks. Voxels of 4 cm come in blocks of 2 x 2 x 2, so that nothing is computed at their
full number: the finest features stand for 8 cm, and each predicts the 4 x 4 x 4 voxels of 2 cm there. There
is no normalisation, nor anything else that needs single precision: one such layer would slow training in bf16
several times. Features are the last axis in memory, which bf16 wants.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from numpy import ndarray
from torch import Tensor, nn

from robotdiffuse.core.settings import Count, Settings
from robotdiffuse.learning.completion.samples import BITS, FREE, STEP
from robotdiffuse.perception.observed_volume import LOW, SHAPE, VOXEL

CHANNELS = 7
"""Occupied, free, depth behind a surface, the arm's shadow, out of view, height, distance from the base's
axis."""
BEHIND = 0.5
"""Depths behind surfaces are given in units of this [m]."""
SHOULDER = (0.0, 0.0, 0.33)
REACH = 1.0
"""Voxels count that are within this of a Panda's shoulder [m]: none of its points gets further."""


@dataclass(frozen=True)
class CompletionSettings(Settings, name="completion"):
    """Sizes of the network."""

    channels: tuple[Count, Count, Count] = (32, 64, 128)
    """Features of a cell of 8, 16 and 32 cm."""
    blocks: tuple[Count, Count, Count] = (1, 1, 2)
    """Residual blocks at each size, once on the way down and once up; at the last once alone."""


def voxel_centers() -> Float[ndarray, "56 56 32 3"]:
    """Of the voxels of an observed volume [m]."""
    axes = [(np.arange(n) + 0.5) * VOXEL + low for n, low in zip(SHAPE, LOW, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def reachable() -> Bool[ndarray, "56 56 32"]:
    """Which voxels the arm may get to."""
    return np.linalg.norm(voxel_centers() - SHOULDER, axis=-1) <= REACH


def _places() -> Float[Tensor, "28 28 16 16"]:
    """The inputs that do not depend on what is seen: height, and distance from the base's axis [m]."""
    centers = torch.from_numpy(voxel_centers().astype(np.float32))
    places = torch.stack([centers[..., 2], centers[..., :2].norm(dim=-1)])
    return folded(places).permute(1, 2, 3, 0, 4).reshape(28, 28, 16, 16)


def folded(x: Shaped[Tensor, "n i j k"]) -> Shaped[Tensor, "n i//2 j//2 k//2 8"]:
    """Voxels by the block of 2 x 2 x 2 that they are in: one of 8 cm, and the number in it, 4 x + 2 y + z."""
    n, i, j, k = x.shape
    blocks = x.reshape(n, i // 2, 2, j // 2, 2, k // 2, 2).permute(0, 1, 3, 5, 2, 4, 6)
    return blocks.reshape(n, i // 2, j // 2, k // 2, 8)


def unfolded(x: Shaped[Tensor, "n i j k c"]) -> Shaped[Tensor, "n 2*i 2*j 2*k c//8"]:
    """The inverse: a pixel shuffle in three dimensions, of features that come block by block."""
    n, i, j, k, c = x.shape
    blocks = x.reshape(n, i, j, k, 2, 2, 2, c // 8).permute(0, 1, 4, 2, 5, 3, 6, 7)
    return blocks.reshape(n, 2 * i, 2 * j, 2 * k, c // 8)


def _shuffled(x: Float[Tensor, "n c i j k"]) -> Float[Tensor, "n c//8 2*i 2*j 2*k"]:
    """`unfolded` where features are the second axis; in memory they are the last."""
    return unfolded(x.permute(0, 2, 3, 4, 1)).permute(0, 4, 1, 2, 3)


class Block(nn.Module):
    """A residual block; it begins as nearly nothing."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv3d(channels, channels, 3, padding=1)
        self.second = nn.Conv3d(channels, channels, 3, padding=1)
        with torch.no_grad():
            self.second.weight.mul_(0.2)

    def forward(self, x: Float[Tensor, "b c x y z"]) -> Float[Tensor, "b c x y z"]:
        return self.second(self.first(x).relu_()).add_(x)  # in place: 3 % less time


class CompletionNetwork(nn.Module):
    """Observed volumes to logits; `probabilities` scales them by a temperature, once that is known."""

    places: Tensor
    temperature: Tensor
    beyond: Tensor

    def __init__(self, settings: CompletionSettings) -> None:
        super().__init__()
        self.settings = settings
        (a, b, c), (m, n, o) = settings.channels, settings.blocks
        self.first, self.skip = nn.Conv3d(8 * CHANNELS, a, 1), nn.Conv3d(8 * CHANNELS, a, 1)
        self.down = nn.ModuleList([nn.Conv3d(a, b, 2, 2), nn.Conv3d(b, c, 2, 2)])
        self.up = nn.ModuleList([nn.Conv3d(c, 8 * b, 1), nn.Conv3d(b, 8 * a, 1)])
        self.before = nn.ModuleList([_blocks(a, m), _blocks(b, n)])
        self.after = nn.ModuleList([_blocks(b, n), _blocks(a, m)])
        self.middle = _blocks(c, o)
        self.last = nn.Conv3d(a, 64, 1)
        self.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]
        self.register_buffer("places", _places(), persistent=False)
        self.register_buffer("temperature", torch.ones(()))
        self.register_buffer("beyond", torch.from_numpy(~reachable()), persistent=False)

    def features(
        self, seen: UInt8[Tensor, "n 56 56 32"], behind: UInt8[Tensor, "n 56 56 32"]
    ) -> Float[Tensor, "n 56 28 28 16"]:
        """What the network is told, of volumes as `samples.pack` packs them."""
        kind = torch.bfloat16 if torch.is_autocast_enabled(seen.device.type) else torch.float32
        seen, behind = folded(seen), folded(behind)
        out = seen.new_empty((*seen.shape[:4], 8 * CHANNELS), dtype=kind)
        parts = out.split(8, dim=-1)
        for part, bit in zip(parts[: len(BITS)], BITS, strict=True):
            part.copy_((seen & bit) != 0)
        parts[len(BITS)].copy_(behind).mul_(STEP / BEHIND)
        out[..., -self.places.shape[-1] :] = self.places
        return out.permute(0, 4, 1, 2, 3)

    def code(self, features: Float[Tensor, "n 56 28 28 16"]) -> tuple[Tensor, Tensor, Tensor]:
        """The bottleneck, and what goes around it to the decoder."""
        fine = self.before[0](self.first(features))
        middle = self.before[1](self.down[0](torch.relu(fine)))
        return self.middle(self.down[1](torch.relu(middle))), middle, fine

    def forward(
        self, seen: UInt8[Tensor, "n 56 56 32"], behind: UInt8[Tensor, "n 56 56 32"]
    ) -> Float[Tensor, "n 28 28 16 64"]:
        """Logits that voxels of 2 cm hold obstacles, by the voxels of 8 and of 4 cm that they are in."""
        features = self.features(seen, behind)
        code, middle, fine = self.code(features)
        middle = self.after[0](middle + _shuffled(self.up[0](torch.relu(code))))
        fine = self.after[1](fine + _shuffled(self.up[1](torch.relu(middle))) + self.skip(features))
        return self.last(torch.relu(fine)).permute(0, 2, 3, 4, 1)

    def probabilities(
        self, seen: UInt8[Tensor, "n 56 56 32"], behind: UInt8[Tensor, "n 56 56 32"]
    ) -> Float[Tensor, "n 112 112 64"]:
        """Of each voxel of 2 cm; 0 in voxels seen free, and beyond the reach that it was trained for."""
        logits = unfolded(unfolded(self(seen, behind).float()))[..., 0] / self.temperature
        free = (seen & FREE).bool() | self.beyond
        for axis in (1, 2, 3):
            free = free.repeat_interleave(2, axis)
        return torch.sigmoid(logits).masked_fill_(free, 0.0)


def _blocks(channels: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(Block(channels) for _ in range(count)))
