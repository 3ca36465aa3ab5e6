"""Networks as ONNX Runtime runs them, against PyTorch."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.box_arm import box_arm
from helpers.panda import PANDA
from helpers.refusals import refuses
from helpers.small_model import save_small_model, small_model
from robotdiffuse.learning.checkpoint import fingerprint, load_completion, load_network, save_network
from robotdiffuse.learning.completion import BITS, exported_completion
from robotdiffuse.learning.encoders import CompressionAutoencoderSettings
from robotdiffuse.learning.encoders.networks import CompressionAutoencoder
from robotdiffuse.learning.exported_model import exported_model
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.weight_files import BUNDLED
from robotdiffuse.perception.voxel_grid import SHAPE


def assert_same(exported: np.ndarray, ours: np.ndarray) -> None:
    """As a fraction of the largest number: fp32 rounds to 6e-8, and a network has some hundred roundings in a row."""
    assert exported.shape == ours.shape and exported.dtype == np.float32
    assert np.abs(exported - ours).max() < 1e-5 * np.abs(ours).max()


@pytest.mark.parametrize("name", ["model", "trajectory_prior"])
@pytest.mark.parametrize("batch", [1, 16])
def test_bundled_denoisers(name: str, batch: int) -> None:
    exported = exported_model(name, None, PANDA)
    network = load_network(name, None, PANDA)
    assert isinstance(network, MotionNetwork) and exported.settings == network.settings
    for ours, its in zip(network.statistics, exported.statistics, strict=True):
        np.testing.assert_array_equal(ours, its)
    rng = np.random.default_rng(batch)
    features = rng.normal(size=(batch, exported.waypoints, exported.feature_count)).astype(np.float32)
    condition = rng.normal(size=(batch, exported.condition_count)).astype(np.float32)
    given = features, rng.random(batch).astype(np.float32), condition
    assert_same(exported.denoised(*given), network.denoised(*given))
    if exported.settings.null_condition:
        dropped = rng.random(batch) < 0.5
        assert_same(exported.denoised(*given, dropped), network.denoised(*given, dropped))


@pytest.mark.parametrize("points", [0, 1, 320, 5000])
def test_bundled_encoder(points: int) -> None:
    cloud = np.random.default_rng(points).uniform(-0.7, 0.7, (points, 3))
    assert_same(exported_model("model", None, PANDA).encode(cloud), load_network("model", None, PANDA).encode(cloud))


def test_bundled_completion_network() -> None:
    rng = np.random.default_rng(0)
    seen = rng.integers(0, sum(BITS) + 1, SHAPE).astype(np.uint8)
    behind = rng.integers(0, 256, SHAPE).astype(np.uint8)
    with torch.inference_mode():
        ours = load_completion().probabilities(torch.from_numpy(seen)[None], torch.from_numpy(behind)[None])
    assert_same(exported_completion()(seen, behind), ours[0].numpy())


def test_every_bundled_file_is_small_and_has_no_path_in_it() -> None:
    files = [file for file in BUNDLED.rglob("*") if file.is_file()]
    assert {file.suffix for file in files} == {".json", ".onnx", ".safetensors"}
    for file in files:
        data = file.read_bytes()
        assert len(data) < 16e6 and b".py" not in data, file


def test_a_cloud_in_order_is_that_of_the_compression_autoencoder() -> None:
    encoder = CompressionAutoencoder(CompressionAutoencoderSettings(cloud=40))
    for points in (0, 1, 7, 40, 90):
        cloud = np.random.default_rng(points).uniform([-0.5, -0.5, 0.1], 0.8, (points, 3)).astype(np.float32)
        ours = encoder.arrange(torch.from_numpy(cloud)[None])[0].numpy()
        np.testing.assert_allclose(encoder.settings.prepared(cloud), ours, atol=1e-6)


def test_weights_that_are_trained_anew_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_small_model(tmp_path)
    monkeypatch.setattr(MotionNetwork, "exports", lambda _: {})  # it takes seconds
    first = exported_model("model", tmp_path, box_arm())
    assert exported_model("model", tmp_path, box_arm()) is first
    _described(tmp_path, "settings", {"sampling_steps": 3})
    assert exported_model("model", tmp_path, box_arm()).settings.sampling_steps == 3
    before = load_network("model", tmp_path, box_arm())
    assert load_network("model", tmp_path, box_arm()) is before
    save_network("model", small_model(1), tmp_path, {})
    assert fingerprint(load_network("model", tmp_path, box_arm())) != fingerprint(before)


def _described(folder: Path, field: str, change: dict) -> None:
    about = json.loads((folder / "model.json").read_text())
    about[field] = about[field] | change if change else {}
    (folder / "model.json").write_text(json.dumps(about))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda at: (at / "model.onnx").write_bytes(b"ONNX"), r"model\.onnx is damaged"),
        (lambda at: (at / "model.encoder.onnx").unlink(), r"model\.encoder\.onnx does not exist"),
        (lambda at: (at / "model.safetensors").unlink(), r"model\.safetensors does not exist"),
        (lambda at: _described(at, "onnx_sha256", {}), "without the ONNX files .* train export"),
        (lambda at: _described(at, "settings", {"waypoints": 20}), r"model\.json does not fit its ONNX"),
    ],
)
def test_damaged_files_give_one_line(tmp_path: Path, damage: Any, message: str) -> None:
    save_small_model(tmp_path)
    damage(tmp_path)
    refuses(message, exported_model, "model", tmp_path, box_arm())
