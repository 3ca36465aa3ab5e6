"""Networks that predict the clean trajectory from a noisy one.

Millions of parameters of the defaults (48 frames) and of `PAPER_SIZE` (254 frames) for a Panda, and the time
of a forward pass of the defaults on a batch of 16, one thread, in units of the transformer's (5.8 ms in bf16,
10.7 ms in fp32; torch 2.13, CPU with AVX-512 BF16). Other work was running, so times are good to about 20 %.

| denoiser        | default | paper's size | bf16 | fp32 |
|-----------------|---------|--------------|------|------|
| transformer     |   1.7   |     18.0     | 1.0  | 1.0  |
| encoder_decoder |   1.7   |     18.2     | 0.95 | 0.8  |
| decoder_only    |   1.7   |     18.0     | 1.0  | 1.0  |
| unet            |   1.7   |     16.4     | 1.1  | 1.3  |
"""

from robotdiffuse.learning.denoisers.base import Denoiser
from robotdiffuse.learning.denoisers.decoder_only import DecoderOnly, DecoderOnlySettings
from robotdiffuse.learning.denoisers.encoder_decoder import EncoderDecoder, EncoderDecoderSettings
from robotdiffuse.learning.denoisers.transformer import Transformer, TransformerSettings
from robotdiffuse.learning.denoisers.unet import UNet, UNetSettings

DenoiserSettings = TransformerSettings | EncoderDecoderSettings | DecoderOnlySettings | UNetSettings
"""Settings of any denoiser; a new one is named here and in DENOISERS."""

DENOISERS: dict[str, tuple[type[Denoiser], type[DenoiserSettings]]] = {
    "transformer": (Transformer, TransformerSettings),
    "encoder_decoder": (EncoderDecoder, EncoderDecoderSettings),
    "decoder_only": (DecoderOnly, DecoderOnlySettings),
    "unet": (UNet, UNetSettings),
}
"""Name in checkpoints: network and its settings."""

PAPER_SIZE: dict[str, DenoiserSettings] = {
    "transformer": TransformerSettings(512, 8, 4, 1024, patch=1, add_z_tk=False),
    "encoder_decoder": EncoderDecoderSettings(512, 2, 4, 4, 1024, patch=1),
    "decoder_only": DecoderOnlySettings(512, 8, 4, 1024, patch=1),
    "unet": UNetSettings(144, (1, 2, 4), 5, 512),
}
"""The paper's network, 8 layers of width 512 and a token per frame, and the others at about its size. The
paper does not say how many heads and how large a hidden layer: those are of the network that it follows, the
motion diffusion model of Tevet et al. 2023."""

__all__ = [
    "DENOISERS",
    "PAPER_SIZE",
    "DecoderOnly",
    "DecoderOnlySettings",
    "Denoiser",
    "DenoiserSettings",
    "EncoderDecoder",
    "EncoderDecoderSettings",
    "Transformer",
    "TransformerSettings",
    "UNet",
    "UNetSettings",
]
