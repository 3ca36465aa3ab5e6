"""Networks that predict the clean trajectory from a noisy one. A new one is one file and one line.

Millions of parameters of the defaults (48 waypoints) and of `paper_size` (254 waypoints) for a Panda, and
the time of a forward pass of the defaults on a batch of 16, one thread, in units of the transformer's (5.8
ms in bf16, 10.7 ms in fp32; torch 2.13, CPU with AVX-512 BF16). Other work was running, so times are
accurate to about 20 %.

| denoiser        | default | paper's size | bf16 | fp32 |
|-----------------|---------|--------------|------|------|
| transformer     |   1.7   |     18.0     | 1.0  | 1.0  |
| encoder_decoder |   1.7   |     18.2     | 0.95 | 0.8  |
| decoder_only    |   1.7   |     18.0     | 1.0  | 1.0  |
| cross_attention |   2.3   |     17.1     | 1.5  | 1.5  |
| unet            |   1.7   |     16.4     | 1.1  | 1.3  |
"""

from robotdiffuse.core.registry import Entry, Registry

_PACKAGE = "robotdiffuse.learning.denoisers."
_SETTINGS = _PACKAGE + "settings:"
DENOISERS = Registry(
    "denoiser",
    {
        "transformer": Entry(
            _PACKAGE + "transformer:Transformer",
            "encoder-only transformer, the paper's",
            _SETTINGS + "TransformerSettings",
        ),
        "encoder_decoder": Entry(
            _PACKAGE + "encoder_decoder:EncoderDecoder",
            "encoder-decoder transformer",
            _SETTINGS + "EncoderDecoderSettings",
        ),
        "decoder_only": Entry(
            _PACKAGE + "decoder_only:DecoderOnly",
            "decoder-only transformer",
            _SETTINGS + "DecoderOnlySettings",
        ),
        "cross_attention": Entry(
            _PACKAGE + "cross_attention:CrossAttention",
            "transformer whose waypoints attend to points of the scene, of the encoder points",
            _SETTINGS + "CrossAttentionSettings",
        ),
        "unet": Entry(_PACKAGE + "unet:UNet", "temporal U-Net", _SETTINGS + "UNetSettings"),
    },
)
"""By the name in settings and checkpoints."""
