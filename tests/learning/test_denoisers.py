"""Every denoiser of the table: its inputs, what it learns, its files; classifier-free guidance."""

import json
from dataclasses import replace
from itertools import cycle

import numpy as np
import pytest
import torch

from helpers.box_arm import box_arm
from helpers.refusals import refuses
from helpers.small_model import SMALL_ENCODER, nothing_near, small_model
from robotdiffuse.learning import denoisers
from robotdiffuse.learning.checkpoint import load_network, save_network
from robotdiffuse.learning.denoisers.networks import MAX_UNFUSED_TOKENS, Denoiser, attend
from robotdiffuse.learning.encoders import PointsSettings
from robotdiffuse.learning.exported_model import exported_model
from robotdiffuse.learning.motion_model import MotionModel, SamplingSettings
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.training.config import PlannerTraining
from robotdiffuse.learning.weight_files import RobotIdentity

DOF = 3
FEATURES = 9
CODE = 9
CONDITION = CODE + 2 * DOF
SMALL = {
    "transformer": denoisers.TransformerSettings(32, 2, 2, 48, 1),
    "encoder_decoder": denoisers.EncoderDecoderSettings(32, 2, 2, 48, 1, encoder_layers=1),
    "decoder_only": denoisers.DecoderOnlySettings(32, 2, 2, 48, 1),
    "cross_attention": denoisers.CrossAttentionSettings(32, 2, 2, 48, 1),
    "unet": denoisers.UNetSettings(16, (1, 2, 2), 3, 32),
}
UNEVEN = replace(SMALL["decoder_only"], patch=5)
SMALL_ENCODERS = {"points": PointsSettings(CODE, CODE // 3), "point_autoencoder": replace(SMALL_ENCODER, code=CODE)}


def denoiser(name: str, waypoints: int = 12, settings: object = None) -> Denoiser:
    torch.manual_seed(0)
    network = denoisers.DENOISERS.load(name)(settings or SMALL[name], waypoints, DOF, FEATURES, CONDITION)
    torch.nn.init.normal_(network.out.weight, std=0.2)
    return network


def inputs(waypoints: int = 12, batch: int = 2, seed: int = 1) -> tuple[torch.Tensor, ...]:
    random = torch.Generator().manual_seed(seed)
    return (
        torch.randn(batch, waypoints, FEATURES, generator=random),
        torch.rand(batch, generator=random),
        torch.randn(batch, CONDITION, generator=random),
    )


@pytest.mark.parametrize("name", denoisers.DENOISERS)
def test_untrained_network_predicts_the_mean_trajectory(name):
    out = denoisers.DENOISERS.load(name)(denoisers.DENOISERS.defaults(name), 48, DOF, FEATURES, CONDITION)(*inputs(48))
    assert out.shape == (2, 48, DOF) and out.dtype == torch.float32 and not out.any()


@pytest.mark.parametrize("name", denoisers.DENOISERS)
def test_every_parameter_level_and_number_of_the_condition_has_an_effect(name):
    network = denoiser(name)
    features, level, condition = inputs()
    network(features, level.requires_grad_(), condition.requires_grad_()).square().sum().backward()
    for parameter, values in network.named_parameters():
        assert values.grad is not None and values.grad.abs().max() > 1e-9, parameter
    for values in (level, condition):
        assert values.grad is not None and (values.grad.abs() > 1e-9).all()


@pytest.mark.parametrize("name", denoisers.DENOISERS)
def test_waypoints_attend_to_each_other(name):
    features, level, condition = inputs(batch=1)
    features.requires_grad_()
    out = denoiser(name)(features, level, condition).square().sum((0, 2))
    rows = [torch.autograd.grad(waypoint, features, retain_graph=True)[0][0] for waypoint in out]
    depends = (torch.stack(rows).abs().sum(-1) > 0).numpy()
    wanted = np.ones((12, 12), bool)
    np.testing.assert_array_equal(depends, np.tril(wanted) if name == "decoder_only" else wanted)


@pytest.mark.parametrize("name", denoisers.DENOISERS)
def test_samples_of_a_batch_do_not_mix(name):
    network, (features, level, condition) = denoiser(name), inputs(batch=3)
    alone = network(features[1:2], level[1:2], condition[1:2])
    torch.testing.assert_close(network(features, level, condition)[1:2], alone, atol=1e-5, rtol=1e-5)


def test_z_tk_as_a_token_only():
    network = denoiser("transformer", settings=replace(SMALL["transformer"], add_z_tk=False))
    added = denoiser("transformer")
    added.load_state_dict(network.state_dict())
    assert not torch.allclose(network(*inputs()), added(*inputs()))
    for parameter, values in network.named_parameters():
        if parameter.endswith("merge.weight"):  # only attention connects the token to the waypoints
            torch.nn.init.zeros_(values)
    features, level, condition = inputs()
    torch.testing.assert_close(network(features, level, condition), network(features, level, 2 * condition))


@pytest.mark.parametrize("causal", [False, True])
def test_fused_and_unfused_attention_agree(monkeypatch, causal):
    q, k, v = torch.randn(3, 2, 4, MAX_UNFUSED_TOKENS, 8, generator=torch.Generator().manual_seed(0))
    unfused = attend(q, k, v, causal)
    monkeypatch.setattr("robotdiffuse.learning.denoisers.networks.MAX_UNFUSED_TOKENS", 0)
    torch.testing.assert_close(attend(q, k, v, causal), unfused, atol=1e-6, rtol=1e-5)


def test_unet_pads_and_crops():
    """Motions are padded by their last waypoint to a length that can be halved often enough, unless they have one."""
    for waypoints, padding in ((12, 0), (13, 3), (254, 2), (1, 3)):
        network = denoiser("unet", waypoints)
        assert network.padding == padding
        features, level, condition = inputs(waypoints)
        longer = denoiser("unet", waypoints + padding)
        longer.load_state_dict(network.state_dict())
        added = torch.cat([features, features[:, -1:].expand(-1, padding, -1)], 1)
        torch.testing.assert_close(network(features, level, condition), longer(added, level, condition)[:, :waypoints])


def test_bad_settings():
    refuses("transformer.heads is 4", denoisers.TransformerSettings, width=30, heads=4)
    refuses("transformer.width is 15", denoisers.TransformerSettings, width=15, heads=5)
    refuses("unet.kernel is 4", denoisers.UNetSettings, kernel=4)
    refuses("unet.width is 7", denoisers.UNetSettings, width=7)
    refuses(r"decoder_only\.patch is 5; it must divide the 12 waypoints", denoiser, name="decoder_only", settings=UNEVEN)


def encoder_for(name: str) -> str:
    return "points" if name == "cross_attention" else "point_autoencoder"


def model_with(name: str, null_condition: bool = False) -> MotionNetwork:
    torch.manual_seed(0)
    kind = encoder_for(name)
    parts = {"encoder": kind, "encoder_settings": SMALL_ENCODERS[kind], "denoiser": name, "denoiser_settings": SMALL[name]}
    settings = replace(small_model().settings, waypoints=12, null_condition=null_condition, **parts)
    model = MotionNetwork(RobotIdentity.of(box_arm()), settings)
    torch.nn.init.normal_(model.denoiser.out.weight, std=0.2)
    if model.null_condition is not None:
        torch.nn.init.normal_(model.null_condition)
    return model


def sample(model: MotionModel, scale: float = 1.0) -> np.ndarray:
    ends = np.array([-1.0, 0.5, 2.0]), np.array([1.5, -0.5, 0.1])
    settings = SamplingSettings(samples=3, sampling_steps=3, guidance_scale=scale)
    return model.sample(*ends, np.ones(model.settings.code, np.float32), nothing_near, np.random.default_rng(0), settings)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "null_condition"), list(zip(denoisers.DENOISERS, cycle([True, False]))))
def test_files(tmp_path, name, null_condition):
    model = model_with(name, null_condition)
    for module in model.modules():
        if isinstance(module, torch.nn.Linear):
            module.weight.data = module.weight.data.half().float()  # as they are stored
    save_network("model", model, tmp_path, {})
    loaded = load_network("model", tmp_path, box_arm())
    assert loaded.settings == model.settings and type(loaded.denoiser) is denoisers.DENOISERS.load(name)
    scale = 2.0 if null_condition else 1.0
    np.testing.assert_array_equal(sample(loaded, scale), sample(model.requires_grad_(False).eval(), scale))
    np.testing.assert_allclose(sample(exported_model("model", tmp_path, box_arm()), scale), sample(loaded, scale), atol=1e-4)


@pytest.mark.parametrize("name", denoisers.DENOISERS)
def test_settings_of_a_run_as_json(name):
    parts = {"encoder": encoder_for(name), "denoiser": name, "denoiser_settings": SMALL[name]}
    settings = PlannerTraining(data="data", **parts)
    assert PlannerTraining.from_json(json.loads(json.dumps(settings.to_json())), "x") == settings
    kind = type(denoisers.DENOISERS.defaults(name))
    other = next(s for s in SMALL.values() if type(s) is not kind)
    refuses(f"denoiser is {name}, .* must be {kind.__name__}", replace, settings, denoiser_settings=other)


@pytest.mark.parametrize("name", denoisers.DENOISERS)
def test_dropped_conditions_have_no_effect(name):
    model = model_with(name, null_condition=True)
    dropped = torch.tensor([True, False, True])
    features, level, condition = inputs(batch=3)
    before = model.denoise(features, level, condition, dropped)
    after = model.denoise(features, level, condition + 1.0, dropped)
    assert [torch.equal(a, b) for a, b in zip(before, after, strict=True)] == dropped.tolist()
    (before * dropped[:, None, None]).square().sum().backward()
    assert model.null_condition is not None and model.null_condition.grad is not None and (model.null_condition.grad != 0).all()


def test_scale_of_classifier_free_guidance(monkeypatch):
    model = model_with("transformer", null_condition=True).requires_grad_(False).eval()
    features, level, condition = inputs(batch=3)
    c = model.denoise(features, level, condition)
    u = model.denoise(features, level, condition, torch.ones(3, dtype=torch.bool))
    for scale in (0.0, 1.0, 2.5):
        guided = model.denoised_guided(features.numpy(), level.numpy(), condition.numpy(), scale)
        np.testing.assert_allclose(guided, (u + scale * (c - u)).numpy(), atol=1e-4, rtol=1e-4)
    assert not np.array_equal(sample(model, 2.0), sample(model))
    batches: list[int] = []

    def counted(features, *rest, denoise=model.denoiser.forward):
        batches.append(len(features))
        return denoise(features, *rest)

    monkeypatch.setattr(model.denoiser, "forward", counted)
    for scale in (1.0, 0.0, 2.0):
        sample(model, scale)
    assert batches == [3, 3, 3, 3, 3, 3, 6, 6, 6]


def test_a_model_that_always_had_its_condition_has_no_guidance_scale():
    model = model_with("unet").requires_grad_(False).eval()
    refuses("guidance_scale is 2", sample, model, 2.0)
    features, level, condition = inputs()
    refuses("null_condition", model.denoise, features, level, condition, torch.tensor([True, False]))
