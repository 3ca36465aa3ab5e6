"""The completion network in the form that is exported: its 3D convolutions as 2D ones over slices.

ONNX Runtime's 3D convolutions take 1.5 times as long as its 2D ones for the same products (76 and 52 ms). So
the first axis in space becomes the batch, and the kernels' extent along it more input channels: those of the
neighbouring slices.
"""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from robotdiffuse.learning.completion.network import DEPTH_SCALE, Block, CompletionNetwork, folded, unfolded
from robotdiffuse.learning.completion.samples import BITS, FREE
from robotdiffuse.learning.onnx_export import exported
from robotdiffuse.perception.observed_volume import SHAPE


class SliceConvolution(nn.Module):
    """A 3D convolution of size 1, of size 2 and stride 2, or of size 3 with padding 1."""

    def __init__(self, convolution: nn.Conv3d) -> None:
        super().__init__()
        outputs, inputs, self.size = convolution.weight.shape[:3]
        weight = convolution.weight.detach().transpose(1, 2)  # outputs, size, inputs, size, size
        stride, padding = (self.size, 0) if self.size < 3 else (1, 1)
        self.plane = nn.Conv2d(self.size * inputs, outputs, self.size, stride, padding)
        self.plane.weight = nn.Parameter(weight.reshape(self.plane.weight.shape).contiguous())
        assert convolution.bias is not None
        self.plane.bias = nn.Parameter(convolution.bias.detach().clone())

    def forward(self, x: Float[Tensor, "i c j k"]) -> Float[Tensor, "m d n o"]:
        if self.size == 2:
            x = x.reshape(x.shape[0] // 2, 2 * x.shape[1], *x.shape[2:])
        elif self.size == 3:
            outside = torch.zeros_like(x[:1])
            x = torch.cat([torch.cat([outside, x[:-1]]), x, torch.cat([x[1:], outside])], 1)
        return self.plane(x)


class SliceBlock(nn.Module):
    """`network.Block` of slices."""

    def __init__(self, block: Block) -> None:
        super().__init__()
        self.first, self.second = SliceConvolution(block.first), SliceConvolution(block.second)

    def forward(self, x: Float[Tensor, "i c j k"]) -> Float[Tensor, "i c j k"]:
        return x + self.second(torch.relu(self.first(x)))


class SliceNetwork(nn.Module):
    """`CompletionNetwork.probabilities` of one volume, computed by slices."""

    def __init__(self, network: CompletionNetwork) -> None:
        super().__init__()
        self.first, self.skip, self.last = map(SliceConvolution, (network.first, network.skip, network.last))
        self.down, self.up = (_list(SliceConvolution, parts) for parts in (network.down, network.up))
        self.before, self.after = (_lists(parts) for parts in (network.before, network.after))
        self.middle = _list(SliceBlock, network.middle)
        self.register_buffer("places", network.places.float())
        self.register_buffer("temperature", network.temperature)
        self.register_buffer("beyond", network.beyond)
        self.places: Tensor
        self.temperature: Tensor
        self.beyond: Tensor

    def forward(
        self, seen: UInt8[Tensor, "56 56 32"], behind: UInt8[Tensor, "56 56 32"]
    ) -> Float[Tensor, "112 112 64"]:
        bits, depth = folded(seen[None])[0], folded(behind[None])[0]
        planes = [((bits & bit) != 0).float() for bit in BITS]
        parts = [*planes, depth.float() * DEPTH_SCALE, self.places]
        features = torch.cat(parts, -1).permute(0, 3, 1, 2)
        fine = _through(self.before[0], self.first(features))
        middle = _through(self.before[1], self.down[0](torch.relu(fine)))
        bottleneck = _through(self.middle, self.down[1](torch.relu(middle)))
        middle = _through(self.after[0], middle + _shuffled(self.up[0](torch.relu(bottleneck))))
        fine = fine + _shuffled(self.up[1](torch.relu(middle))) + self.skip(features)
        logits = self.last(torch.relu(_through(self.after[1], fine))).permute(0, 2, 3, 1)
        logits = unfolded(unfolded(logits[None]))[0, ..., 0] / self.temperature
        free = ((seen & FREE) != 0) | self.beyond
        free = free[:, None, :, None, :, None].expand(-1, 2, -1, 2, -1, 2).reshape(logits.shape)
        return torch.where(free, 0.0, torch.sigmoid(logits))


def completion_exports(network: CompletionNetwork) -> dict[str, bytes]:
    """`CompletionNetwork.probabilities` of one volume; see `learning.network.Network.exports`."""
    # two tensors: the exporter takes one tensor for one input
    inputs = {name: torch.zeros(SHAPE, dtype=torch.uint8) for name in ("seen", "behind")}
    return {".onnx": exported(SliceNetwork(network), inputs, {})}


def _shuffled(x: Float[Tensor, "i c j k"]) -> Float[Tensor, "2*i c//8 2*j 2*k"]:
    """`network.unfolded` of slices."""
    return unfolded(x.permute(0, 2, 3, 1)[None])[0].permute(0, 3, 1, 2)


def _list(kind: type[nn.Module], parts: nn.Module) -> nn.ModuleList:
    return nn.ModuleList(kind(part) for part in parts.children())


def _lists(parts: nn.Module) -> nn.ModuleList:
    return nn.ModuleList(_list(SliceBlock, blocks) for blocks in parts.children())


def _through(blocks: nn.Module, x: Tensor) -> Tensor:
    for block in blocks.children():
        x = block(x)
    return x
