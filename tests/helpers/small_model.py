"""A small model of motions for the arm of boxes, untrained: for tests of what is built around one."""

import torch

from helpers.box_arm import box_arm
from robotdiffuse.learning.denoisers import DENOISERS, TransformerSettings
from robotdiffuse.learning.encoders import PointAutoencoderSettings
from robotdiffuse.learning.motion_model import MotionModel, MotionModelConfig

SMALL_ENCODER = PointAutoencoderSettings(code=8, points=(16, 24), hidden=16, decoded=12)


def small_model(seed: int = 0) -> MotionModel:
    """A model for the arm of boxes, with random weights in the last layer too."""
    torch.manual_seed(seed)
    robot = box_arm()
    kind, _ = DENOISERS["transformer"]
    config = MotionModelConfig(
        robot=robot.name,
        joint_names=robot.joint_names,
        lower=tuple(robot.lower.tolist()),
        upper=tuple(robot.upper.tolist()),
        frame_offsets=tuple(tuple(map(tuple, T)) for T in robot.frame_offsets.tolist()),
        links=("l1", "l2", "l3"),
        frames=16,
        encoder_settings=SMALL_ENCODER,
        denoiser_settings=TransformerSettings(width=16, layers=2, heads=2, hidden=32, patch=4),
    )
    model = MotionModel(config)
    assert isinstance(model.denoiser, kind)
    torch.nn.init.normal_(model.denoiser.out.weight, std=0.2)
    return model
