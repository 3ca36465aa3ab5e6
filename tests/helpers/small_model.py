"""A small model of motions for the arm of boxes, untrained: for tests of what is built around one."""

import torch

from helpers.box_arm import box_arm
from robotdiffuse.learning.denoisers.transformer import TransformerSettings
from robotdiffuse.learning.encoders.point_autoencoder import PointAutoencoderSettings
from robotdiffuse.learning.motion_model import MotionModel, MotionModelSettings
from robotdiffuse.learning.robot_identity import RobotIdentity

SMALL_ENCODER = PointAutoencoderSettings(code=8, points=(16, 24), hidden=16, decoded=12)


def small_model(seed: int = 0) -> MotionModel:
    """A model for the arm of boxes, with random weights in the last layer too."""
    torch.manual_seed(seed)
    settings = MotionModelSettings(
        waypoints=16,
        encoder_settings=SMALL_ENCODER,
        denoiser_settings=TransformerSettings(width=16, layers=2, heads=2, hidden=32, patch=4),
    )
    model = MotionModel(RobotIdentity.of(box_arm()), settings)
    torch.nn.init.normal_(model.denoiser.out.weight, std=0.2)
    return model
