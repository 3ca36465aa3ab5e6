"""Settings of denoisers: networks that predict the clean trajectory, or the noise, from a noisy trajectory.

Nothing here loads PyTorch, so that planning can read the settings. The networks are in `denoisers.networks`.

The second and third columns of the table are the millions of parameters for a Panda, with the default
settings (48 waypoints) and with `PAPER_SIZES` (254 waypoints). The last two columns are the time of a forward
pass with the default settings, relative to the transformer, which takes 5.8 ms in bf16 and 10.7 ms in fp32
(batch of 16, one thread, torch 2.13, CPU with AVX-512 BF16). Other processes were running, so times are
accurate to about 20 %.

| denoiser        | default | paper's size | bf16 | fp32 |
|-----------------|---------|--------------|------|------|
| transformer     |   1.7   |     18.0     | 1.0  | 1.0  |
| encoder_decoder |   1.7   |     18.2     | 0.95 | 0.8  |
| decoder_only    |   1.7   |     18.0     | 1.0  | 1.0  |
| cross_attention |   2.3   |     17.1     | 1.5  | 1.5  |
| unet            |   1.7   |     16.4     | 1.1  | 1.3  |
"""

from dataclasses import dataclass
from typing import ClassVar

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.registry import Entry, Registry
from robotdiffuse.core.settings import Count, Settings, Sizes


@dataclass(frozen=True)
class DenoiserSettings(Settings):
    """Settings of a denoiser."""


@dataclass(frozen=True)
class AttentionSettings(DenoiserSettings):
    """Settings of all transformers. z_tk is the token that carries the condition and the noise level.

    The paper states neither the number of heads nor the size of the hidden layer: `PAPER_SIZES` has those
    of the network that the paper follows, the motion diffusion model of Tevet et al. 2023.
    """

    causal: ClassVar[bool] = False
    """Whether waypoints attend only to z_tk, the waypoints before them and those of their own patch."""
    points: ClassVar[bool] = False
    """Whether waypoints also attend to points of the scene (encoder `points`). The points replace z, the
    vector in which other encoders describe the scene."""
    width: Count = 160
    """Size of a token; even (paper: 512)."""
    layers: Count = 6
    """Number of blocks (paper: 8)."""
    heads: Count = 5
    """Number of attention heads; a divisor of `width`."""
    hidden: Count = 480
    """Size of the hidden layer of each feed-forward network."""
    patch: Count = 4
    """Number of waypoints in a token; a divisor of the number of waypoints (paper: 1)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        kind = self.settings_name
        if self.width % self.heads:
            raise InputError(f"{kind}.heads is {self.heads}; it must divide width, which is {self.width}")
        if self.width % 2:  # sines and cosines
            raise InputError(f"{kind}.width is {self.width}; it must be even")

    def tokens(self, waypoints: int) -> int:
        """The number of patches. Raises InputError unless the waypoints can be divided into patches."""
        if waypoints % self.patch:
            raise InputError(
                f"{self.settings_name}.patch is {self.patch}; it must divide the {waypoints} waypoints"
            )
        return waypoints // self.patch


@dataclass(frozen=True)
class TransformerSettings(AttentionSettings, name="transformer"):
    add_z_tk: bool = True
    """Whether z_tk is also added to all other tokens, so that the first layer need not distribute it. If
    not, z_tk is only a token, as in the paper."""


@dataclass(frozen=True)
class EncoderDecoderSettings(AttentionSettings, name="encoder_decoder"):
    width: Count = 144
    """Size of a token; even."""
    layers: Count = 4
    """Number of blocks of the decoder."""
    heads: Count = 4
    """Number of attention heads; a divisor of `width`."""
    hidden: Count = 432
    """Size of the hidden layer of each feed-forward network."""
    encoder_layers: Count = 2
    """Number of blocks of the encoder."""


@dataclass(frozen=True)
class DecoderOnlySettings(AttentionSettings, name="decoder_only"):
    """Waypoints attend to z_tk, to all waypoints of their own patch, and to those of earlier patches."""

    causal = True


@dataclass(frozen=True)
class CrossAttentionSettings(AttentionSettings, name="cross_attention"):
    points = True
    patch: Count = 8
    """Number of waypoints in a token; a divisor of the number of waypoints."""


@dataclass(frozen=True)
class UNetSettings(DenoiserSettings, name="unet"):
    width: Count = 48
    """Number of channels at the full resolution; even."""
    multiples: Sizes = (1, 2, 4)
    """Number of channels at each resolution, in units of `width`; each resolution has half as many waypoints
    as the one before."""
    kernel: Count = 5
    """Number of waypoints that a convolution covers; odd."""
    condition_width: Count = 128
    """Size of the vector that carries the condition and the noise level; even."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kernel % 2 == 0:
            raise InputError(f"unet.kernel is {self.kernel}; it must be odd")
        for name, width in (("width", self.width), ("condition_width", self.condition_width)):
            if width % 2:
                raise InputError(f"unet.{name} is {width}; it must be even")


_NETWORKS = "robotdiffuse.learning.denoisers.networks"
DENOISERS = Registry(
    "denoiser",
    {
        "transformer": Entry(
            f"{_NETWORKS}:TrajectoryTransformer",
            "encoder-only transformer, the paper's",
            f"{__name__}:TransformerSettings",
        ),
        "encoder_decoder": Entry(
            f"{_NETWORKS}:TrajectoryTransformer",
            "encoder-decoder transformer",
            f"{__name__}:EncoderDecoderSettings",
        ),
        "decoder_only": Entry(
            f"{_NETWORKS}:TrajectoryTransformer",
            "decoder-only transformer",
            f"{__name__}:DecoderOnlySettings",
        ),
        "cross_attention": Entry(
            f"{_NETWORKS}:TrajectoryTransformer",
            "transformer whose waypoints attend to points of the scene; needs the encoder named points",
            f"{__name__}:CrossAttentionSettings",
        ),
        "unet": Entry(f"{_NETWORKS}:UNet", "temporal U-Net", f"{__name__}:UNetSettings"),
    },
)
"""Denoisers by their name in settings and checkpoints."""
PAPER_SIZES: dict[str, DenoiserSettings] = {
    "transformer": TransformerSettings(512, 8, 4, 1024, patch=1, add_z_tk=False),
    "encoder_decoder": EncoderDecoderSettings(512, 4, 4, 1024, patch=1),
    "decoder_only": DecoderOnlySettings(512, 8, 4, 1024, patch=1),
    "cross_attention": CrossAttentionSettings(512, 5, 4, 1024, patch=1),
    "unet": UNetSettings(width=144, condition_width=512),
}
"""Settings of about the size of the paper's network, 8 layers of width 512 and a token per waypoint."""
