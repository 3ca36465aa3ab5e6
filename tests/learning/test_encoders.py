"""Encoders of the scene: what all guarantee, what each learns, and joint training with the planner."""

from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from helpers.box_arm import box_arm
from helpers.commands import Said
from helpers.refusals import refuses
from helpers.stores import write_store
from robotdiffuse.datasets.surface_clouds import surface_clouds
from robotdiffuse.learning import encoders
from robotdiffuse.learning.checkpoint import fingerprint, load_encoder, load_network, save_network
from robotdiffuse.learning.denoisers import CrossAttentionSettings, TransformerSettings
from robotdiffuse.learning.encoders import networks
from robotdiffuse.learning.exported_model import exported_model
from robotdiffuse.learning.motion_model import MotionModelSettings
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.training import tasks as training
from robotdiffuse.learning.training.batches import Batches, load_data, random_scenes, scene_clouds
from robotdiffuse.learning.training.config import EncoderTraining, PlannerTraining
from robotdiffuse.learning.training.tasks import train_encoder, train_planner
from robotdiffuse.learning.weight_files import RobotIdentity
from robotdiffuse.scenes.packed_scenes import SPHERE
from robotdiffuse.scenes.surface_points import PANDA_REGION

SMALL = {
    "compression_autoencoder": encoders.CompressionAutoencoderSettings(code=8, cloud=40, hidden=(32, 16)),
    "point_autoencoder": encoders.PointAutoencoderSettings(code=8, points=(16, 24), hidden=16, decoded=12),
    "pointnet": encoders.PointNetSettings(
        code=8, cloud=32, first=(8, 12), second=(12, 24), transform=(8, 8), transform_head=(8,), head=(16,)
    ),
    "dgcnn": encoders.DGCNNSettings(code=8, cloud=32, neighbors=4, edges=(8, 12), embedding=16, head=(16,)),
    "points": encoders.PointsSettings(code=24, cloud=8),
}
ALONE = [name for name, entry in encoders.ENCODERS.items() if entry.kind == "alone"]
every_encoder = pytest.mark.parametrize("name", encoders.ENCODERS)


def small(name, seed=0):
    torch.manual_seed(seed)
    return encoders.make_encoder(name, SMALL[name])


def cloud(n, batch=1, seed=0):
    low, size = torch.tensor([[-0.5, -0.5, 0.1], [1.0, 1.0, 0.8]])
    return low + size * torch.rand(batch, n, 3, generator=torch.Generator().manual_seed(seed))


def denoiser_for(encoder: str) -> dict[str, Any]:
    if encoder == "points":
        return {"denoiser": "cross_attention", "denoiser_settings": CrossAttentionSettings(32, 2, 2, 48, 8)}
    return {"denoiser_settings": TransformerSettings(32, 2, 2, 48, 8)}


def test_every_encoder_is_tested():
    assert set(SMALL) == set(encoders.ENCODERS)
    assert {encoders.encoder_name(small(name)) for name in encoders.ENCODERS} == set(encoders.ENCODERS)


@every_encoder
def test_any_number_of_obstacles(name):
    encoder = small(name)
    scenes = random_scenes(13, 12, np.random.default_rng(0))
    params = scenes.params
    scenes.kinds[:] = np.where(np.arange(12) < np.arange(13)[:, None], SPHERE, 0)
    params[..., :3] = np.random.default_rng(1).uniform([-0.5, -0.5, 0.2], [0.5, 0.5, 1.2], (13, 12, 3))
    params[..., 3] = 0.1
    clouds = scene_clouds(encoder, scenes, np.random.default_rng(0))
    z = encoder(clouds)
    assert clouds.shape == (13, encoder.settings.cloud, 3) and z.isfinite().all()
    torch.testing.assert_close(z[0], encoder(torch.zeros(1, 1, 3))[0], msg="no obstacle is no point")
    assert len(z.detach().round(decimals=6).unique(dim=0)) == 13


@every_encoder
@settings(max_examples=10, deadline=None)
@given(n=st.integers(1, 300), seed=st.integers(0, 1000))
def test_any_number_of_points_in_any_order_and_repeated(name, n, seed):
    encoder = small(name)
    points = cloud(n, 2, seed)
    z = encoder(points)
    assert z.shape == (2, SMALL[name].code) and z.dtype == torch.float32 and z.isfinite().all()
    assert torch.equal(encoder(points), z), "the same cloud has the same code"
    order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    torch.testing.assert_close(encoder(points[:, order]), z, atol=2e-5, rtol=1e-5)
    if name != "dgcnn":  # for which repeated points are each other's nearest neighbors
        torch.testing.assert_close(encoder(points.repeat(1, 3, 1)), z, atol=2e-5, rtol=1e-5)


@every_encoder
def test_points_out_of_the_region_do_not_count(name):
    encoder = small(name)
    points = cloud(20)
    out = torch.tensor([[[3.0, 0.0, 0.5], [0.3, 0.0, -0.2], [0.0, 0.0, 0.0]]])
    torch.testing.assert_close(encoder(torch.cat([out, points], 1)), encoder(points), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(encoder(out), encoder(torch.zeros(1, 1, 3)))
    assert not torch.allclose(encoder(points), encoder(out))
    both = torch.cat([points, out], 1)
    np.testing.assert_array_equal(encoder.near(both)[:, :-1], PANDA_REGION.holds(both.numpy())[:, :-1])


@pytest.mark.parametrize("name", [name for name in encoders.ENCODERS if name != "points"])
def test_gradients_reach_every_parameter(name):
    """Some clouds are empty, and one has fewer points than neighbors; nevertheless no gradient may be NaN."""
    encoder = small(name)
    clouds = torch.cat([cloud(40, 6), torch.zeros(2, 40, 3)])
    clouds[5, 2:] = 0.0
    loss = encoder(clouds).square().sum() + encoder(0 * clouds[:, :1]).square().sum()
    if isinstance(encoder, networks.Autoencoder):
        loss = loss + encoder.loss(clouds, np.random.default_rng(0))[0]
    loss.backward()
    for parameter, p in encoder.named_parameters():
        assert p.grad is not None and p.grad.isfinite().all() and p.grad.abs().max() > 0, parameter


@every_encoder
def test_files(name, tmp_path):
    encoder = small(name)
    if isinstance(encoder, networks.Autoencoder):
        with torch.no_grad():
            encoder.standardize(encoder.encode(cloud(40, 30)))
    save_network("encoder", encoder, tmp_path, {})
    loaded = load_encoder(tmp_path)
    assert type(loaded) is encoders.ENCODERS.load(name) and loaded.settings == encoder.settings
    assert not any(p.requires_grad for p in loaded.parameters())
    points = cloud(40)
    torch.testing.assert_close(loaded(points), encoder(points), atol=0.02, rtol=0)  # stored in fp16
    save_network("encoder", loaded, tmp_path / "again", {})
    assert fingerprint(load_encoder(tmp_path / "again")) == fingerprint(loaded)


@every_encoder
def test_settings_are_read_by_name(name):
    settings = MotionModelSettings(encoder=name, encoder_settings=SMALL[name], **denoiser_for(name))
    assert MotionModelSettings.from_json(settings.to_json(), "x") == settings
    z = MotionNetwork(RobotIdentity.of(box_arm()), settings).encode(cloud(3000)[0].numpy().astype(np.float64))
    assert z.shape == (SMALL[name].code,)
    other = next(other for other in SMALL.values() if other is not SMALL[name])
    refuses(f"encoder is {name}, but its settings are {type(other).__name__}", replace, settings, encoder_settings=other)


def test_arranged_clouds():
    """Points are sorted along the curve, and evenly thinned or repeated."""
    encoder = encoders.make_encoder("points", encoders.PointsSettings(code=120, cloud=40))
    scenes = random_scenes(20, 12, np.random.default_rng(0))
    clouds = surface_clouds(scenes, 40, torch.Generator().manual_seed(0), region=encoder.settings.region)
    ordered = encoder.arrange(clouds)
    keys = encoders.curve_keys(ordered)
    assert (keys.diff(dim=1) >= 0).all()
    torch.testing.assert_close(keys, encoders.curve_keys(clouds).sort(1).values, atol=0, rtol=0)
    every = ordered[:, 1::4]  # of 40 for 10, the middle one of each four
    few = encoders.make_encoder("points", encoders.PointsSettings(code=30, cloud=10))
    torch.testing.assert_close(few.arrange(clouds), ordered[:, 2::4], atol=0, rtol=0)
    torch.testing.assert_close(encoder.arrange(every), every.repeat_interleave(4, 1), atol=0, rtol=0)


def test_edge_convolution_is_the_maximum_over_edges():
    """Compares with the layer as in the paper, computed edge by edge."""
    torch.manual_seed(0)
    layer = networks.EdgeConvolution(5, 7, 4)
    few = networks.neighbors(torch.tensor([[[0.0], [1.0], [3.0], [1.1]]]), torch.arange(4)[None] < 3, 4)[0]
    assert [set(row.tolist()) for row in few] == [{0, 1, 2}] * 3 + [{0, 1, 2, 3}]
    x = torch.randn(2, 12, 5)
    near = torch.ones(2, 12, dtype=torch.bool)
    index = networks.neighbors(x, near, 4)
    for b in range(2):
        apart = torch.cdist(x[b], x[b])
        for i in range(12):
            assert set(index[b, i].tolist()) == set(apart[i].argsort()[:4].tolist())
    # h(x_i, x_j - x_i) = own x_i + other (x_i + (x_j - x_i))
    edges = torch.stack([x[b][index[b]] for b in range(2)])
    h = layer.own(x)[:, :, None] + layer.other(x[:, :, None] + (edges - x[:, :, None]))
    wanted = torch.nn.functional.leaky_relu(layer.norm(h.amax(2)), 0.2)
    torch.testing.assert_close(layer(x, near), wanted, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("name", ALONE)
def test_training_alone(name, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "STANDARDIZATION_SCENES", 256)
    short: dict[str, Any] = {"samples": 1600, "batch": 16, "points": 64, "warmup_steps": 10}
    training_settings = EncoderTraining(name=name, minutes=None, encoder=SMALL[name], **short)
    clouds = Mock(wraps=scene_clouds)
    monkeypatch.setattr(training, "scene_clouds", clouds)
    before = train_encoder(replace(training_settings, samples=16), str(tmp_path / "short"))
    report = train_encoder(training_settings, str(tmp_path / "long"))
    error = "chamfer" if name == "point_autoencoder" else "reconstruction"
    assert report[error] < 0.9 * before[error]
    sizes = {call.args[3] for call in clouds.call_args_list if len(call.args) > 3} - {None}
    if SMALL[name].any_size:
        assert sizes <= set(range(8, 65)) and len(sizes) > 30
    else:
        assert sizes == {40}
    encoder = load_encoder(tmp_path / "long")
    assert encoders.encoder_name(encoder) == name
    z = encoder(scene_clouds(encoder, random_scenes(300, 12, np.random.default_rng(5)), np.random.default_rng(6)))
    torch.testing.assert_close(z.std(0), torch.ones(8), atol=0.35, rtol=0)


def test_training_from_the_command_line(tmp_path, said: Said, monkeypatch):
    monkeypatch.setattr(training, "STANDARDIZATION_SCENES", 32)
    out = str(tmp_path / "out")
    command = ["train", "encoder", "--samples", "4", "--batch-size", "2", "--out", out, "--encoder"]
    assert "reconstruction: " in said(0, *command, "compression_autoencoder")
    assert load_encoder(out).settings == encoders.CompressionAutoencoderSettings()
    assert "known: compression_autoencoder, point_autoencoder" in said(2, *command, "pointnett")


@pytest.fixture
def data(tmp_path, monkeypatch):
    arm = box_arm()
    monkeypatch.setattr(training, "load_robot", lambda name: arm)
    write_store(tmp_path / "data", arm, (60,))
    return tmp_path / "data"


def planner(data, encoder, **changes) -> PlannerTraining:
    sizes: dict[str, Any] = {"samples": 96, "batch": 16, "warmup_steps": 1, "validation_problems": 1}
    return replace(PlannerTraining(data=str(data), encoder=encoder, minutes=None, **sizes, **denoiser_for(encoder)), **changes)


@pytest.mark.slow
@every_encoder
def test_joint_training_changes_the_encoder(name, data, tmp_path):
    fresh = small(name)
    train_planner(planner(data, name, encoder_settings=SMALL[name], learning_rate=1e-2), str(tmp_path / "out"))
    model = load_network("model", tmp_path / "out", box_arm())
    assert model.encoder is not None and type(model.encoder) is encoders.ENCODERS.load(name)
    trained = dict(model.encoder.named_parameters())
    moved = {key for key, p in fresh.named_parameters() if (trained[key] - p).abs().max() > 3e-4}
    own = ("decoder", "query") if name in ALONE else ()  # what only reconstructs takes no part
    assert {key for key in trained if not key.startswith(own) and "empty" not in key} <= moved
    assert not (data / "codes").exists()
    exported = exported_model("model", tmp_path / "out", box_arm())
    for points in (0, 1, 100, 3000):
        given = cloud(points)[0].numpy().astype(np.float64)
        z = exported.encode(given)
        np.testing.assert_allclose(z, model.encode(given), atol=1e-5 * np.abs(z).max())


@pytest.mark.parametrize("name", ["point_autoencoder", "pointnet"])
@pytest.mark.usefixtures("no_export")
def test_a_frozen_encoder_stays_as_it_is(name, data, tmp_path):
    save_network("encoder", small(name), tmp_path / "encoder", {})
    before = fingerprint(load_encoder(tmp_path / "encoder"))
    train_planner(planner(data, str(tmp_path / "encoder")), str(tmp_path / "out"))
    encoder = load_network("model", tmp_path / "out", box_arm()).encoder
    assert encoder is not None and fingerprint(encoder) == before and fingerprint(load_encoder(tmp_path / "encoder")) == before


def test_batches_with_clouds_instead_of_codes(data):
    arm = box_arm()
    settings = MotionModelSettings(encoder="dgcnn", encoder_settings=small("dgcnn").settings)
    model = MotionNetwork(RobotIdentity.of(arm), settings)
    kept = load_data(str(data), arm, None, settings.waypoints, lambda text: None)
    assert kept.embeddings is None
    batches = Batches(kept, model, lambda scenes, q: np.ones((*q.shape[:2], 3)), 0.1, 5.0)
    first, again = (batches.draw(8, np.random.default_rng(3)) for _ in range(2))
    assert first.clouds is not None and again.clouds is not None
    assert first.clouds.shape == (8, 32, 3) and torch.equal(first.clouds, again.clouds)
    assert (first.condition[:, :8] == 0).all() and (first.condition[:, 8:] != 0).any()


def test_parts_that_do_not_fit_are_refused():
    for kind, parts, message in (
        (PlannerTraining, {"encoder": "points"}, "encoder is points and denoiser is .* need each other"),
        (PlannerTraining, {"encoder": "e", "denoiser": "cross_attention"}, "encoder is e .* need each other"),
        (PlannerTraining, {"encoder": "e", "encoder_settings": SMALL["pointnet"]}, "unknown encoder 'e'"),
        (EncoderTraining, {"minutes": 3.0, "samples": 4}, "exactly one"),
        (encoders.PointAutoencoderSettings, {"points": ()}, r"encoder.points is \(\)"),
        (encoders.PointNetSettings, {"second": (8, 0)}, r"encoder.second\[1\] is"),
        (encoders.DGCNNSettings, {"neighbors": 0}, "encoder.neighbors is 0"),
        (encoders.PointsSettings, {"cloud": 20}, "points.code is 96; it must be three times cloud, 60"),
        (EncoderTraining, {"name": "pointnet"}, "unknown encoder that is trained alone .pointnet.; known"),
        (MotionModelSettings, {"encoder": "points", "encoder_settings": SMALL["points"]}, "need each other"),
    ):
        refuses(message, kind, **({"data": "data"} if kind is PlannerTraining else {}), **parts)
