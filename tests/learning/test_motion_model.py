"""The diffusion model and its parts: encoder, noise, samplers."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.box_arm import box_arm
from helpers.small_model import cloud, small_model
from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.diffusion import SAMPLERS, noise_factor
from robotdiffuse.learning.encoders.networks import (
    chamfer,
    nearest,
)
from robotdiffuse.learning.motion_model import GuideFn, MotionModelSettings, SamplingSettings
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.training.config import PlannerTraining
from robotdiffuse.robots.kinematic_tree import JointNormalizer

START = np.array([-1.0, 0.5, 2.0])
GOAL = np.array([1.5, -0.5, 0.1])


def sample_with(model: MotionNetwork, settings: SamplingSettings, guide: GuideFn | None = None) -> np.ndarray:
    def far(q: np.ndarray) -> np.ndarray:
        return np.full((*q.shape[:2], 3), 0.4, np.float32)

    code = np.zeros(8, np.float32)
    return model.sample(START, GOAL, code, far, np.random.default_rng(0), settings, guide)


def test_nearest_and_chamfer_against_all_pairs():
    a = cloud(7, 1)
    b = cloud(11, 2)
    allowed = torch.arange(11)[None] < 9
    distance = (a[0, :, None] - b[0, None]).norm(dim=-1)
    forth, back = nearest(a, b, allowed)
    assert torch.equal(forth[0], distance[:, :9].argmin(1))
    assert torch.equal(back[0, :9], distance[:, :9].argmin(0))
    rms = [distance[:, :9].min(i).values.square().mean().sqrt() for i in (0, 1)]
    torch.testing.assert_close(chamfer(a, b, allowed), sum(rms), atol=1e-4, rtol=1e-4)


def test_normalizer():
    normalizer = JointNormalizer(np.array([-1.0, 0.0]), np.array([3.0, 0.5]))
    q = np.array([[-1.0, 0.0], [3.0, 0.5], [1.0, 0.25]])
    np.testing.assert_allclose(normalizer.to_unit(q), [[-1, -1], [1, 1], [0, 0]], atol=1e-7)
    np.testing.assert_allclose(normalizer.from_unit(normalizer.to_unit(q)), q, atol=1e-7)
    with pytest.raises(InputError, match="joint 1"):
        JointNormalizer(np.array([0.0, 1.0]), np.array([1.0, 1.0]))


@pytest.mark.parametrize("smooth", [False, True])
def test_noise_is_zero_at_the_ends_and_has_the_data_s_covariance(smooth):
    s = np.linspace(0, np.pi, 16)[:, None]
    residuals = np.random.default_rng(0).standard_normal((500, 1, 2)) * np.sin(s)
    factor = noise_factor(residuals, smooth)
    covariance = factor @ factor.T
    assert not covariance[[0, -1]].any()
    assert np.trace(covariance) / 14 == pytest.approx(1.0, abs=1e-3)
    shape = (np.sin(s) @ np.sin(s).T)[1:-1, 1:-1]
    wanted = shape / (np.trace(shape) / 14) if smooth else np.eye(14)
    np.testing.assert_allclose(covariance[1:-1, 1:-1], wanted, atol=2e-3)


def test_samples_hold_start_and_goal():
    model = small_model().requires_grad_(False).eval()
    model.residual_scale.fill_(0.3)
    settings = SamplingSettings(samples=5, sampling_steps=6, eta=0.5)
    for guide in (None, lambda q, level: q + 0.1):
        q = sample_with(model, settings, guide)
        assert q.shape == (5, 16, 3)
        assert (q[:, 0] == START).all() and (q[:, -1] == GOAL).all()
        assert (q >= box_arm().lower).all() and (q <= box_arm().upper).all()
        assert np.abs(q[0] - q[1]).max() > 1e-3
        np.testing.assert_array_equal(sample_with(model, settings, guide), q)


def test_clearances_are_inputs_of_the_denoiser():
    model = small_model()
    reference = model.reference(np.zeros((2, 3)), np.ones((2, 3)))
    x = np.zeros((2, 16, 3), np.float32)
    features = model.features(
        x, reference, lambda q: np.stack([q[..., 0] * 0 + d for d in (-5, 0.15, 9)], -1)
    )
    assert features.shape == (2, 16, 9)
    np.testing.assert_allclose(features[0, 0, 6:], [-1, 0, 1], atol=1e-6)


def test_residual_and_joints_are_inverse():
    model = small_model()
    q = np.random.default_rng(0).uniform(-2, 2, (4, 16, 3)).astype(np.float32)
    model.fit_statistics(q, smooth_noise=True)
    reference = model.reference(q[:, 0], q[:, -1])
    x = model.normalize(q, reference)
    np.testing.assert_allclose(model.joints(x, reference), q, atol=1e-5)
    assert np.sqrt((x[:, 1:-1] ** 2).mean((0, 1))) == pytest.approx([1, 1, 1], abs=1e-4)


@pytest.mark.parametrize(
    ("steps", "share", "guided"), [(5, 0.5, 3), (1, 0.5, 1), (6, 0.0, 0), (6, 1.0, 6), (50, 0.02, 1)]
)
def test_the_last_share_of_the_steps_is_guided(steps: int, share: float, guided: int) -> None:
    model = small_model()
    levels = []

    def guide(q: np.ndarray, level: float) -> np.ndarray:
        levels.append(level)
        return q

    sample_with(model, SamplingSettings(samples=1, sampling_steps=steps, guided_share=share), guide)
    expected = model.schedule.sampling_levels(steps)[:-1] / model.schedule.steps
    np.testing.assert_allclose(levels, expected[steps - guided :])


def test_a_sampler_by_name_is_that_of_a_checkpoint() -> None:
    for name in SAMPLERS:
        model = small_model()
        by_setting = sample_with(model, SamplingSettings(samples=2, sampling_steps=4, sampler=name))
        model.settings = replace(model.settings, sampler=name)
        by_default = sample_with(model, SamplingSettings(samples=2, sampling_steps=4))
        np.testing.assert_array_equal(by_setting, by_default)


def test_sampling_settings_are_checked() -> None:
    with pytest.raises(InputError, match=r"unknown sampling\.sampler 'heun'; known: ddim, ddpm"):
        SamplingSettings(sampler="heun")
    with pytest.raises(InputError, match=r"guided_share is 1.5"):
        SamplingSettings(guided_share=1.5)
    with pytest.raises(InputError, match="sampling steps is 201; it must be between 1 and 200"):
        sample_with(small_model(), SamplingSettings(sampling_steps=201))


def test_numbers_of_waypoints_are_bounded():
    """Matrices of 10**25 rows were asked for; found by fuzzing."""
    with pytest.raises(InputError, match=r"waypoints is 1000+; it must be between 3 and 4096"):
        MotionModelSettings.from_json({"waypoints": 10**25}, "model")
    with pytest.raises(InputError, match=r"waypoints is 1000+; it must be between 3 and 4096"):
        PlannerTraining.from_json({"data": "d", "encoder": "e", "waypoints": 10**25}, "training")
