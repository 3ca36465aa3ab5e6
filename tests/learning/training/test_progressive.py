"""Training on means of blocks of waypoints, and attention in bf16."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.denoisers import TransformerSettings
from robotdiffuse.learning.denoisers.networks import MAX_UNFUSED_TOKENS, attend
from robotdiffuse.learning.diffusion import NoiseSchedule, ScheduleSettings
from robotdiffuse.learning.motion_model import MotionModelSettings
from robotdiffuse.learning.motion_network import MotionNetwork, block_means
from robotdiffuse.learning.training.config import STAGES, PlannerTraining, block_at
from robotdiffuse.learning.weight_files import RobotIdentity
from robotdiffuse.robots import load_robot

SMALL = TransformerSettings(32, 2, 2, 64, patch=1)
PROGRESSIVE: dict[str, Any] = {
    "data": "",
    "encoder": "pointnet",
    "waypoints": 38,
    "smooth_noise": False,
    "progressive": True,
}


def attention_gradient(dtype: torch.dtype) -> torch.Tensor:
    tokens = MAX_UNFUSED_TOKENS + 30
    inputs = torch.randn(3, 2, 4, tokens, 32, generator=torch.Generator().manual_seed(0))
    target = torch.randn(2, tokens, 128, generator=torch.Generator().manual_seed(1))
    parts = inputs.to(dtype, copy=True).requires_grad_()
    q, k, v = parts.unbind(0)
    (attend(q, k, v).float() - target).square().mean().backward()
    assert parts.grad is not None
    return parts.grad.float()


def test_gradients_of_attention_in_bf16_are_those_in_fp32():
    wanted = attention_gradient(torch.float32)
    error = attention_gradient(torch.bfloat16) - wanted
    assert error.norm() < 1e-2 * wanted.norm()


@pytest.mark.parametrize("block", [1, 4, 9])
def test_means_of_blocks_keep_the_ends_and_straight_lines(block):
    means, interpolation, _ = block_means(38, block)
    line = torch.linspace(-1.0, 2.0, 38)[:, None]
    blocks = means @ line
    assert blocks[0] == line[0] and blocks[-1] == line[-1]
    torch.testing.assert_close(interpolation @ blocks, line)


def test_means_of_white_noise_are_white():
    block = 9
    means = block_means(254, block)[0]
    covariance = (means @ means.T)[1:-1, 1:-1]
    torch.testing.assert_close(covariance, torch.eye(len(covariance)) / block)


def test_a_denoiser_on_blocks_learns_all_waypoints():
    """The output has every waypoint, the gradient reaches the network, and single waypoints come back."""
    settings = MotionModelSettings(
        waypoints=38, target="absolute", clearance_features=False, denoiser_settings=SMALL
    )
    model = MotionNetwork(RobotIdentity.of(load_robot("panda")), settings)
    torch.nn.init.normal_(model.denoiser.out.weight, std=0.1)
    inputs = torch.randn(3, 38, model.feature_count), torch.ones(3), torch.zeros(3, model.condition_count)
    fine = model.denoise(*inputs)
    for stage in STAGES:
        model.coarsen(stage.block)
        output = model.denoise(*inputs)
        assert output.shape == fine.shape
        assert torch.equal(output, fine) == (stage.block == 1)


def test_stages_end_on_single_waypoints():
    assert block_at(0.0) > block_at(0.8) > block_at(0.95) == block_at(1.0) == 1


def progressive_training(**changes: Any) -> PlannerTraining:
    settings: dict[str, Any] = PROGRESSIVE | {"target": "absolute", "denoiser_settings": SMALL} | changes
    return PlannerTraining(**settings)


def test_progressive_training_needs_white_noise_and_blocks_that_fit():
    assert progressive_training().progressive
    with pytest.raises(InputError, match="blocks of 9 must divide the 35 waypoints"):
        progressive_training(waypoints=37)
    with pytest.raises(InputError, match="smooth_noise False"):
        progressive_training(smooth_noise=True)
    with pytest.raises(InputError, match="patch 1"):
        progressive_training(denoiser_settings=None)


def test_shift_of_the_signal_to_noise_ratio():
    plain = NoiseSchedule(ScheduleSettings(floor=1e-12))
    shifted = NoiseSchedule(ScheduleSettings(floor=1e-12, log_snr_shift=math.log(25)))
    difference = 2 * (plain.half_log_snr[1:-1] - shifted.half_log_snr[1:-1])
    np.testing.assert_allclose(difference, math.log(25), rtol=1e-6)
