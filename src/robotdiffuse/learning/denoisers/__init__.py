"""Networks that predict the clean trajectory from a noisy one.

Parameters in millions and time of a forward pass, see `PAPER_SIZE` for the second column.
"""

from robotdiffuse.learning.denoisers.base import Denoiser
from robotdiffuse.learning.denoisers.decoder_only import DecoderOnly, DecoderOnlySettings
from robotdiffuse.learning.denoisers.encoder_decoder import EncoderDecoder, EncoderDecoderSettings
from robotdiffuse.learning.denoisers.transformer import Transformer, TransformerSettings
from robotdiffuse.learning.denoisers.unet import UNet, UNetSettings

DenoiserSettings = TransformerSettings | EncoderDecoderSettings | DecoderOnlySettings | UNetSettings

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
