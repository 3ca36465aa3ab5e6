"""Training of an auto-encoder."""

import pytest
import torch

from helpers.training_log import read_log
from robotdiffuse.learning.checkpoint import load_encoder
from robotdiffuse.learning.encoders import PointAutoencoderSettings
from robotdiffuse.learning.training.config import EncoderTraining
from robotdiffuse.learning.training.encoder import train_encoder

SMALL_ENCODER = PointAutoencoderSettings(code=8, points=(16, 24), hidden=16, decoded=12)


@pytest.mark.slow
def test_encoder_learns(tmp_path):
    settings = EncoderTraining(
        minutes=None, samples=1600, batch=16, points=64, warmup_steps=10, encoder=SMALL_ENCODER
    )
    report = train_encoder(settings, str(tmp_path))
    losses = [float(row["loss"]) for row in read_log(tmp_path)]
    assert losses[-1] < 0.85 * losses[0]
    assert report["distance"] < 0.8 * report["distance_of_constant"]
    codes = load_encoder(tmp_path)(torch.zeros(1, 1, 3))
    assert codes.shape == (1, 8)
