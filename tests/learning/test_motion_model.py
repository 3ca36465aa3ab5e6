"""The diffusion model and its parts: encoder, noise, samplers."""

import math
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.refusals import refuses
from helpers.small_model import cloud, nothing_near, small_model
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.transforms import transform
from robotdiffuse.learning.denoisers import TransformerSettings
from robotdiffuse.learning.denoisers.networks import MAX_UNFUSED_TOKENS, attend
from robotdiffuse.learning.diffusion import SAMPLERS, NoiseSchedule, ScheduleSettings, noise_factor
from robotdiffuse.learning.encoders.networks import chamfer, nearest
from robotdiffuse.learning.motion_model import MAX_CLEARANCE, GuideFn, MotionModelSettings, SamplingSettings, link_clearances
from robotdiffuse.learning.motion_network import MotionNetwork, block_means
from robotdiffuse.learning.training.config import STAGES, PlannerTraining
from robotdiffuse.learning.weight_files import RobotIdentity
from robotdiffuse.robots.kinematic_tree import JointNormalizer

START = np.array([-1.0, 0.5, 2.0])
GOAL = np.array([1.5, -0.5, 0.1])


def sample_with(model: MotionNetwork, settings: SamplingSettings, guide: GuideFn | None = None) -> np.ndarray:
    return model.sample(START, GOAL, np.zeros(8, np.float32), nothing_near, np.random.default_rng(0), settings, guide)


def test_nearest_and_chamfer_against_all_pairs():
    a = cloud(7, 1)
    b = cloud(11, 2)
    allowed = torch.arange(11)[None] < 9
    distance = (a[0, :, None] - b[0, None]).norm(dim=-1)
    forth, back = nearest(a, b, allowed)
    assert torch.equal(forth[0], distance[:, :9].argmin(1)) and torch.equal(back[0, :9], distance[:, :9].argmin(0))
    rms = [distance[:, :9].min(i).values.square().mean().sqrt() for i in (0, 1)]
    torch.testing.assert_close(chamfer(a, b, allowed), sum(rms), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("smooth", [False, True])
def test_noise_is_zero_at_the_ends_and_has_the_data_s_covariance(smooth):
    s = np.linspace(0, np.pi, 16)[:, None]
    factor = noise_factor(np.random.default_rng(0).standard_normal((500, 1, 2)) * np.sin(s), smooth)
    covariance = factor @ factor.T
    assert not covariance[[0, -1]].any() and np.trace(covariance) / 14 == pytest.approx(1.0, abs=1e-3)
    shape = (np.sin(s) @ np.sin(s).T)[1:-1, 1:-1]
    wanted = shape / (np.trace(shape) / 14) if smooth else np.eye(14)
    np.testing.assert_allclose(covariance[1:-1, 1:-1], wanted, atol=2e-3)


def test_samples_hold_start_and_goal():
    model = small_model().requires_grad_(False).eval()
    model.residual_scale.fill_(0.3)
    settings = SamplingSettings(samples=5, sampling_steps=6, eta=0.5)
    for guide in (None, lambda q, level: q + 0.1):
        q = sample_with(model, settings, guide)
        assert q.shape == (5, 16, 3) and (q[:, 0] == START).all() and (q[:, -1] == GOAL).all()
        assert (q >= box_arm().lower).all() and (q <= box_arm().upper).all()
        assert np.abs(q[0] - q[1]).max() > 1e-3
        np.testing.assert_array_equal(sample_with(model, settings, guide), q)


def test_clearances_are_inputs_of_the_denoiser():
    model = small_model()
    reference = model.reference(np.zeros((2, 3)), np.ones((2, 3)))
    clearances = np.array([-5, 0.15, 9])
    features = model.features(np.zeros((2, 16, 3), np.float32), reference, lambda q: np.tile(clearances, (*q.shape[:-1], 1)))
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


@pytest.mark.parametrize(("steps", "share", "guided"), [(5, 0.5, 3), (1, 0.5, 1), (6, 0.0, 0), (50, 0.02, 1)])
def test_the_last_share_of_the_steps_is_guided(steps: int, share: float, guided: int) -> None:
    model = small_model()
    guide = Mock(side_effect=lambda q, level: q)
    sample_with(model, SamplingSettings(samples=1, sampling_steps=steps, guided_share=share), guide)
    expected = model.schedule.sampling_levels(steps)[:-1] / model.schedule.steps
    np.testing.assert_allclose([call.args[1] for call in guide.call_args_list], expected[steps - guided :])


def test_a_sampler_by_name_is_that_of_a_checkpoint() -> None:
    for name in SAMPLERS:
        model = small_model()
        by_setting = sample_with(model, SamplingSettings(samples=2, sampling_steps=4, sampler=name))
        model.settings = replace(model.settings, sampler=name)
        np.testing.assert_array_equal(by_setting, sample_with(model, SamplingSettings(samples=2, sampling_steps=4)))


def test_what_makes_no_sense_is_refused() -> None:
    refuses("joint 1", JointNormalizer, np.array([0.0, 1.0]), np.array([1.0, 1.0]))
    # matrices of 10**25 rows were asked for; found by fuzzing
    for kind, values in ((MotionModelSettings, {}), (PlannerTraining, {"data": "d", "encoder": "e"})):
        refuses(r"waypoints is 1000+; it must be between 3 and 4096", kind.from_json, values | {"waypoints": 10**25}, "x")
    refuses(r"unknown sampling\.sampler 'heun'; known: ddim, ddpm", SamplingSettings, sampler="heun")
    refuses(r"guided_share is 1.5", SamplingSettings, guided_share=1.5)
    late = SamplingSettings(sampling_steps=201)
    refuses("sampling steps is 201; it must be between 1 and 200", sample_with, small_model(), late)


PANDA = rd.load_robot("panda")
ROD = rd.Box([0, 0, 0.3], [0.05, 0.05, 0.4], name="rod")
HELD = {
    "panda_hand": PANDA.attach(ROD, "panda_hand"),
    "panda_rightfinger": PANDA.with_tool("panda_link8", transform(np.zeros(3))).attach(ROD, "tool"),
    "panda_link4": PANDA.attach(ROD, "panda_link4"),
}
"""By the link that counts as carrying it: without geometry of its own, the last that moves as it does."""


@pytest.mark.parametrize("carrier", HELD)
@pytest.mark.parametrize("clearance_gradients", [False, True])
def test_a_held_object_counts_as_a_part_of_what_carries_it(carrier: str, clearance_gradients: bool) -> None:
    held = HELD[carrier]
    settings = MotionModelSettings(clearance_gradients=clearance_gradients)
    scene = rd.Scene([rd.Sphere([0.5, 0.0, 0.1], 0.1)])
    q = np.random.default_rng(0).uniform(PANDA.lower, PANDA.upper, (4, 5, 7)).astype(np.float32)
    checkers = CollisionChecker(PANDA, scene), CollisionChecker(held, scene)
    bare, carrying = (link_clearances(checker, settings)(q) for checker in checkers)
    assert bare.shape == carrying.shape, "the network was trained for the bare arm"
    links = checkers[0].links
    own = checkers[1]
    rod = own.link_clearances(q.reshape(-1, 7), MAX_CLEARANCE)[:, own.links.index("rod")]
    at = links.index(carrier)
    expected = bare[..., : len(links)].copy()
    expected[..., at] = np.minimum(expected[..., at], rod.reshape(4, 5))
    np.testing.assert_allclose(carrying[..., : len(links)], expected, atol=1e-6)
    assert (expected[..., at] < bare[..., at]).any(), "the rod is nearer somewhere"
    assert not RobotIdentity.of(PANDA).difference(held)


SMALL = TransformerSettings(32, 2, 2, 64, patch=1)


def test_gradients_of_attention_in_bf16_are_those_in_fp32():
    tokens = MAX_UNFUSED_TOKENS + 30
    inputs = torch.randn(3, 2, 4, tokens, 32, generator=torch.Generator().manual_seed(0))
    target = torch.randn(2, tokens, 128, generator=torch.Generator().manual_seed(1))
    gradients = []
    for dtype in (torch.float32, torch.bfloat16):
        parts = inputs.to(dtype, copy=True).requires_grad_()
        q, k, v = parts.unbind(0)
        gradients.append(torch.autograd.grad((attend(q, k, v).float() - target).square().mean(), parts)[0].float())
    assert (gradients[1] - gradients[0]).norm() < 1e-2 * gradients[0].norm()


@pytest.mark.parametrize("block", [1, 4, 9])
def test_means_of_blocks_keep_the_ends_and_straight_lines(block):
    means, interpolation, _ = block_means(38, block)
    line = torch.linspace(-1.0, 2.0, 38)[:, None]
    blocks = means @ line
    assert blocks[0] == line[0] and blocks[-1] == line[-1]
    torch.testing.assert_close(interpolation @ blocks, line)


def test_means_of_white_noise_are_white_and_the_signal_to_noise_ratio_is_shifted():
    block = 9
    means = block_means(254, block)[0]
    covariance = (means @ means.T)[1:-1, 1:-1]
    torch.testing.assert_close(covariance, torch.eye(len(covariance)) / block)
    plain = NoiseSchedule(ScheduleSettings(floor=1e-12))
    shifted = NoiseSchedule(ScheduleSettings(floor=1e-12, log_snr_shift=math.log(25)))
    np.testing.assert_allclose(2 * (plain.half_log_snr[1:-1] - shifted.half_log_snr[1:-1]), math.log(25), rtol=1e-6)


def test_a_denoiser_on_blocks_learns_all_waypoints():
    settings = MotionModelSettings(waypoints=38, target="absolute", clearance_features=False, denoiser_settings=SMALL)
    model = MotionNetwork(RobotIdentity.of(rd.load_robot("panda")), settings)
    torch.nn.init.normal_(model.denoiser.out.weight, std=0.1)
    inputs = torch.randn(3, 38, model.feature_count), torch.ones(3), torch.zeros(3, model.condition_count)
    fine = model.denoise(*inputs)
    for _, block in STAGES:
        model.coarsen(block)
        output = model.denoise(*inputs)
        assert output.shape == fine.shape and torch.equal(output, fine) == (block == 1)


def test_progressive_training_needs_white_noise_and_blocks_that_fit():
    run: dict[str, Any] = {"data": "", "encoder": "pointnet", "waypoints": 38, "smooth_noise": False}
    run |= {"progressive": True, "target": "absolute", "denoiser_settings": SMALL}
    assert PlannerTraining(**run).progressive
    refuses("blocks of 9 must divide the 35 waypoints", PlannerTraining, **run | {"waypoints": 37})
    refuses("smooth_noise False", PlannerTraining, **run | {"smooth_noise": True})
    refuses("patch 1", PlannerTraining, **run | {"denoiser_settings": None})
