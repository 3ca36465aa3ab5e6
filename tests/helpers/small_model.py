"""A small, untrained diffusion model for the arm of boxes, for tests of code that uses a model."""

import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import torch

from helpers.box_arm import box_arm
from robotdiffuse.learning.checkpoint import save_network
from robotdiffuse.learning.denoisers import TransformerSettings
from robotdiffuse.learning.encoders import PointAutoencoderSettings
from robotdiffuse.learning.motion_model import MotionModelSettings
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.weight_files import RobotIdentity

SMALL_ENCODER = PointAutoencoderSettings(code=8, points=(16, 24), hidden=16, decoded=12)


def small_model(seed: int = 0) -> MotionNetwork:
    """A model for the arm of boxes, with random weights in the last layer too."""
    torch.manual_seed(seed)
    denoiser = TransformerSettings(width=16, layers=2, heads=2, hidden=32, patch=4)
    settings = MotionModelSettings(waypoints=16, encoder_settings=SMALL_ENCODER, denoiser_settings=denoiser)
    model = MotionNetwork(RobotIdentity.of(box_arm()), settings)
    torch.nn.init.normal_(model.denoiser.out.weight, std=0.2)
    return model


def nothing_near(q: np.ndarray) -> np.ndarray:
    """Clearances of the arm's three moving links."""
    return np.full((*q.shape[:-1], 3), 0.4, np.float32)


def cloud(n: int, seed: int = 0) -> torch.Tensor:
    points = np.random.default_rng(seed).uniform([-0.5, -0.5, 0.1], [0.5, 0.5, 0.8], (1, n, 3))
    return torch.from_numpy(points.astype(np.float32))


@cache
def _saved(exports: Callable[[MotionNetwork], object]) -> tempfile.TemporaryDirectory[str]:
    """A folder with the saved model, removed at the end; the export takes seconds, so it is made once for each `exports`."""
    folder = tempfile.TemporaryDirectory()
    save_network("model", small_model(), folder.name, {})
    return folder


def save_small_model(folder: Path) -> None:
    """Write the files of `small_model()`, as `save_network` does."""
    shutil.copytree(_saved(MotionNetwork.exports).name, folder, dirs_exist_ok=True)
