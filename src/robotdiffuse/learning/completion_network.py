"""The occupancy completion network: from an observed volume to the probability that each voxel of 2 cm is
occupied.

A U-Net of residual blocks. The input's voxels of 4 cm are folded into cells of 2 x 2 x 2, to avoid computing
at the resolution of the voxels: the finest cells have 8 cm, and each predicts its 4 x 4 x 4 voxels of 2 cm.
There is no normalization, because a layer that needs single precision would make training in bf16 several
times slower. Features are the last axis in memory, which is the fast layout for bf16.
"""

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor, nn

from robotdiffuse.learning.completion import (
    BITS,
    DEPTH_STEP,
    FREE,
    CompletionSettings,
    reachable,
    voxel_centers,
)
from robotdiffuse.learning.network import SavedModule, exported
from robotdiffuse.perception.voxel_grid import SHAPE

Packed = UInt8[Tensor, "n 56 56 32"]
CHANNELS = 7
"""Number of input channels: occupied, free, shadow of the arm, out of view, depth behind a surface, height,
distance from the base's axis."""
DEPTH_SCALE = DEPTH_STEP / 0.5
"""Depths behind surfaces are stored as multiples of DEPTH_STEP. This factor scales half a meter to 1."""


def _position_inputs() -> Float[Tensor, "28 28 16 16"]:
    """The inputs that do not depend on the observation: height, and distance from the base's axis [m]."""
    centers = torch.from_numpy(np.ascontiguousarray(voxel_centers(), np.float32))
    places = torch.stack([centers[..., 2], centers[..., :2].norm(dim=-1)])
    return folded(places).permute(1, 2, 3, 0, 4).reshape(28, 28, 16, 16)


def folded(x: Shaped[Tensor, "n i j k"]) -> Shaped[Tensor, "n i//2 j//2 k//2 8"]:
    """Voxels grouped into cells, two along each axis. The last axis is the index in the cell, 4x + 2y + z."""
    n, i, j, k = x.shape
    cells = x.reshape(n, i // 2, 2, j // 2, 2, k // 2, 2).permute(0, 1, 3, 5, 2, 4, 6)
    return cells.reshape(n, i // 2, j // 2, k // 2, 8)


def unfolded(x: Shaped[Tensor, "n i j k c"]) -> Shaped[Tensor, "n 2*i 2*j 2*k c//8"]:
    """The inverse of `folded`: a pixel shuffle in three dimensions. The features are read as [8, c // 8]:
    the index in the cell, and the features of each voxel."""
    n, i, j, k, c = x.shape
    voxels = x.reshape(n, i, j, k, 2, 2, 2, c // 8).permute(0, 1, 4, 2, 5, 3, 6, 7)
    return voxels.reshape(n, 2 * i, 2 * j, 2 * k, c // 8)


def _shuffled(x: Float[Tensor, "n c i j k"]) -> Float[Tensor, "n c//8 2*i 2*j 2*k"]:
    """`unfolded` for features on the second axis (the last one in memory)."""
    return unfolded(x.permute(0, 2, 3, 4, 1)).permute(0, 4, 1, 2, 3)


class Block(nn.Module):
    """A residual block, initially close to the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv3d(channels, channels, 3, padding=1)
        self.second = nn.Conv3d(channels, channels, 3, padding=1)
        with torch.no_grad():
            self.second.weight.mul_(0.2)

    def forward(self, x: Float[Tensor, "b c x y z"]) -> Float[Tensor, "b c x y z"]:
        return self.second(self.first(x).relu_()).add_(x)  # in place: 3 % less time


class CompletionNetwork(SavedModule):
    """From observed volumes to logits; `probabilities` divides them by a temperature that training fits."""

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
        self.register_buffer("places", _position_inputs(), persistent=False)
        self.register_buffer("temperature", torch.ones(()))
        self.register_buffer("beyond", torch.from_numpy(~reachable()), persistent=False)

    def features(self, seen: Packed, behind: Packed) -> Float[Tensor, "n 56 28 28 16"]:
        """The input channels of volumes packed by `completion.pack`."""
        kind = torch.bfloat16 if torch.is_autocast_enabled(seen.device.type) else torch.float32
        seen = folded(seen)
        behind = folded(behind)
        out = seen.new_empty((*seen.shape[:4], 8 * CHANNELS), dtype=kind)
        parts = out.split(8, dim=-1)
        for part, bit in zip(parts[: len(BITS)], BITS, strict=True):
            part.copy_((seen & bit) != 0)
        parts[len(BITS)].copy_(behind).mul_(DEPTH_SCALE)
        out[..., -self.places.shape[-1] :] = self.places
        return out.permute(0, 4, 1, 2, 3)

    def forward(self, seen: Packed, behind: Packed) -> Float[Tensor, "n 28 28 16 64"]:
        """Logits of the voxels of 2 cm, grouped by cells of 8 cm and within them by voxels of 4 cm."""
        features = self.features(seen, behind)
        at_8cm = self.before[0](self.first(features))
        at_16cm = self.before[1](self.down[0](torch.relu(at_8cm)))
        at_32cm = self.middle(self.down[1](torch.relu(at_16cm)))
        at_16cm = self.after[0](at_16cm + _shuffled(self.up[0](torch.relu(at_32cm))))
        at_8cm = self.after[1](at_8cm + _shuffled(self.up[1](torch.relu(at_16cm))) + self.skip(features))
        return self.last(torch.relu(at_8cm)).permute(0, 2, 3, 4, 1)

    def probabilities(self, seen: Packed, behind: Packed) -> Float[Tensor, "n 112 112 64"]:
        """Probability of each voxel of 2 cm; 0 in voxels that were seen free, and beyond REACH."""
        logits = unfolded(unfolded(self(seen, behind).float()))[..., 0] / self.temperature
        free = (seen & FREE).bool() | self.beyond
        for axis in (1, 2, 3):
            free = free.repeat_interleave(2, axis)
        return torch.sigmoid(logits).masked_fill_(free, 0.0)

    def exports(self) -> dict[str, bytes]:
        """The bytes of the ONNX file of `probabilities`, for one volume."""
        # separate tensors: the exporter would merge two names of one tensor into one input
        inputs = {name: torch.zeros(SHAPE, dtype=torch.uint8) for name in ("seen", "behind")}
        return {".onnx": exported(self, self._probabilities_of_one, inputs, {})}

    def _probabilities_of_one(
        self, seen: UInt8[Tensor, "56 56 32"], behind: UInt8[Tensor, "56 56 32"]
    ) -> Float[Tensor, "112 112 64"]:
        return self.probabilities(seen[None], behind[None])[0]


def _blocks(channels: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(Block(channels) for _ in range(count)))
