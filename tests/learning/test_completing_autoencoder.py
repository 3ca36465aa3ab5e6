"""The completing network's bottleneck as an encoder: what it is told, its components, its files, its use."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.box_arm import box_arm
from helpers.stores import manifest_of, random_arrays
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.datasets.manifest import write_manifest
from robotdiffuse.datasets.shards import write_shard
from robotdiffuse.learning.checkpoint import (
    fingerprint,
    load_completion,
    load_encoder,
    load_model,
    save_code,
    save_completion,
)
from robotdiffuse.learning.completion.network import CompletionNetwork, CompletionSettings
from robotdiffuse.learning.completion.samples import OCCUPIED, pack
from robotdiffuse.learning.denoisers.transformer import TransformerSettings
from robotdiffuse.learning.encoders.completing_autoencoder import (
    CompletingAutoencoder,
    CompletingAutoencoderSettings,
)
from robotdiffuse.learning.motion_model import MotionModel, MotionModelSettings
from robotdiffuse.learning.robot_identity import RobotIdentity
from robotdiffuse.learning.training import completion as completion_training
from robotdiffuse.learning.training import planner as training
from robotdiffuse.learning.training.batches import random_scenes, scene_clouds
from robotdiffuse.learning.training.completion import CompletionTraining, train_completion
from robotdiffuse.learning.training.config import EncoderTraining, PlannerTraining
from robotdiffuse.learning.training.planner import train_planner
from robotdiffuse.perception.observed_volume import LOW, VOXEL, observe
from robotdiffuse.perception.ray_caster import looking_at, ray_cast
from robotdiffuse.planning.diffusion.diffusion import encode
from robotdiffuse.robots import load_robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box

NAME = "completing_autoencoder"
SMALL = CompletionSettings(channels=(8, 8, 8), blocks=(1, 1, 1))
PANDA = load_robot("panda")
HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])


def small() -> CompletingAutoencoder:
    torch.manual_seed(0)
    return CompletingAutoencoder(CompletingAutoencoderSettings(code=8, kept=4, network=SMALL)).eval()


def test_the_one_that_comes_with_the_package() -> None:
    """Frozen, of the bundled network; its numbers are of one size in scenes that it was not fitted to."""
    encoder = load_encoder(NAME)
    assert isinstance(encoder, CompletingAutoencoder)
    assert not any(p.requires_grad for p in encoder.parameters())
    assert fingerprint(encoder.network) == fingerprint(load_completion())
    scenes = random_scenes(24, 12, np.random.default_rng(5))
    z = encoder(scene_clouds(encoder, scenes, np.random.default_rng(6)))
    assert z.shape == (24, encoder.settings.code)
    assert z.abs().mean() < 2 and 0.2 < z.std() < 3


def test_points_fill_voxels_and_nothing_is_known_of_the_rest() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.5, -0.5, 0.1], [0.5, 0.5, 0.9], (50, 3)).astype(np.float32)
    outside = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.5], [0.3, 0.0, 0.01], [0.0, 0.0, 1.4]], np.float32)
    seen = small().volume(torch.from_numpy(np.concatenate([points, outside]))[None])[0].numpy()
    places = {tuple(p) for p in np.floor((points - np.array(LOW)) / VOXEL).astype(int).tolist()}
    assert {tuple(p) for p in np.argwhere(seen == OCCUPIED).tolist()} == places
    assert (seen[seen != OCCUPIED] == 0).all()


def test_views_are_told_as_they_are_when_it_completes() -> None:
    encoder = small()
    scene = Scene([Box((0.5, 0.0, 0.3), (0.1, 0.6, 0.6))])
    T = looking_at(np.array([-1.0, 0.3, 1.0]), np.array([0.5, 0.0, 0.3]))
    view = ray_cast(scene, T, (130.0, 130.0, 79.5, 59.5), (160, 120), PANDA, HOME)
    z = encoder.of_views([view], PANDA, HOME)
    seen, behind = (torch.from_numpy(a)[None] for a in pack(observe([view], PANDA, HOME)))
    assert torch.equal(z, encoder.of_volumes(seen, behind)[0])
    blank = torch.zeros_like(seen)
    assert not torch.allclose(z, encoder.of_volumes(seen & OCCUPIED, blank)[0], atol=1e-3)
    with pytest.raises(InputError, match="views is empty"):
        encoder.of_views([], PANDA, HOME)


def test_components_are_uncorrelated_and_of_variance_1() -> None:
    encoder = small()
    clouds = torch.rand(60, 300, 3) - torch.tensor([0.5, 0.5, -0.1])
    clouds[:, :, 2] *= torch.linspace(0.2, 1.0, 60)[:, None]
    volumes = encoder.volume(clouds)
    blank = torch.zeros_like(volumes)
    encoder.fit(encoder.bottleneck(volumes, blank))
    z = encoder.of_volumes(volumes, blank).double()
    torch.testing.assert_close(z.mean(0), torch.zeros(8, dtype=torch.double), atol=0.01, rtol=0)
    torch.testing.assert_close(z.T @ z / 60, torch.eye(8, dtype=torch.double), atol=0.05, rtol=0)


def test_files_beside_the_completing_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`train completion` writes them; they belong to the weights that they were made for."""
    for name in ("VALIDATION", "CALIBRATION", "CHECKED"):
        monkeypatch.setattr(completion_training, name, 1)
    monkeypatch.setattr(completion_training, "FITTED", 6)
    trained = CompletionTraining(samples=2, batch=2, workers=0, network=SMALL, families=("rop",))
    train_completion(trained, str(tmp_path))
    encoder = load_encoder(tmp_path)
    assert isinstance(encoder, CompletingAutoencoder) and encoder.settings.network == SMALL
    cloud = torch.rand(2, 200, 3)
    save_code(encoder, tmp_path)
    assert torch.equal(load_encoder(tmp_path)(cloud), encoder(cloud))
    save_completion(CompletionNetwork(SMALL), tmp_path, {})
    with pytest.raises(InputError, match=r"code\.json was made for other weights"):
        load_encoder(tmp_path)
    (tmp_path / "completion.json").unlink()
    with pytest.raises(InputError, match="train completion"):
        load_encoder(tmp_path)
    (tmp_path / "code.json").write_text(json.dumps({"format": 0}))
    with pytest.raises(InputError):
        load_encoder(tmp_path)


def test_planner_training_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It stays as it is, and the model's file holds it."""
    arm = box_arm()
    monkeypatch.setattr(training, "load_robot", lambda name: arm)
    data = tmp_path / "data"
    write_manifest(data, manifest_of(arm))
    write_shard(data, 0, random_arrays(arm, 20, np.random.default_rng(0)), {})
    settings = PlannerTraining(
        data=str(data), encoder=NAME, minutes=None, samples=16, batch=8, warmup_steps=1, turns=0,
        denoiser_settings=TransformerSettings(width=32, layers=2, heads=2, hidden=48, patch=8),
        validation_problems=1,
    )  # fmt: skip
    assert not settings.jointly
    train_planner(settings, str(tmp_path / "out"))
    model = load_model(tmp_path / "out", arm)
    assert model.encoder is not None and fingerprint(model.encoder) == fingerprint(load_encoder(NAME))
    assert model.encode(np.random.default_rng(0).random((100, 3))).shape == (96,)
    with pytest.raises(InputError, match="completing_autoencoder comes trained"):
        replace(settings, encoder_settings=CompletingAutoencoderSettings())


def test_planners_tell_it_as_many_points_as_it_wants(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[int] = []

    def z(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        told.append(len(points))
        return np.zeros(8, np.float32)

    settings = CompletingAutoencoderSettings(code=8, cloud=500, kept=4, network=SMALL)
    model = MotionModel(RobotIdentity.of(PANDA), MotionModelSettings(encoder=NAME, encoder_settings=settings))
    monkeypatch.setattr(model, "encode", z)
    checker = CollisionChecker(PANDA, Scene([Box((0.5, 0.0, 0.3), (0.1, 0.6, 0.6))]))
    encode(model, checker, 320, np.random.default_rng(0))
    assert told == [500]


def test_not_trained_alone() -> None:
    with pytest.raises(InputError, match=f"name is {NAME}.*by train completion"):
        EncoderTraining(name=NAME)
