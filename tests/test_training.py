"""Training: it learns, resumes exactly, survives bad steps, and refuses data that do not fit."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from box_arm import box_arm
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.errors import InputError
from robotdiffuse.learning import training
from robotdiffuse.learning.batches import load_data, random_scenes
from robotdiffuse.learning.checkpoint import load_encoder, load_model, save_encoder
from robotdiffuse.learning.config import EncoderTraining, PlannerTraining
from robotdiffuse.learning.denoisers import TransformerSettings
from robotdiffuse.learning.encoders import PointAutoencoder, PointAutoencoderSettings
from robotdiffuse.learning.training import moving_links, train_encoder, train_planner
from robotdiffuse.learning.training_run import TrainingRun
from robotdiffuse.scenes.sampling import BOX, SPHERE, sample_surfaces_batch
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Sphere

SMALL_ENCODER = PointAutoencoderSettings(code=8, points=(16, 24), hidden=16, decoded=12)
SMALL_DENOISER = TransformerSettings(width=32, layers=2, heads=2, hidden=48, patch=8)
FRAMES = 48


@pytest.fixture
def arm(monkeypatch):
    robot = box_arm()
    monkeypatch.setattr(training, "load_robot", lambda name: robot)
    return robot


@pytest.fixture
def data(tmp_path, arm):
    """Two shards of bows to the side that the obstacle lies on; too far for clearances to tell."""
    folder = tmp_path / "data"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for i, n in enumerate((100, 60)):
        side = rng.choice([-1.0, 1.0], n)
        ends = rng.uniform(-1.5, 1.5, (2, n, 1, arm.dof))
        s = np.linspace(0, 1, FRAMES)[:, None]
        q = ends[0] * (1 - s) + ends[1] * s + 0.5 * side[:, None, None] * np.sin(np.pi * s)
        kinds, params = np.zeros((n, 2 + i), np.int8), np.zeros((n, 2 + i, 10), np.float32)
        kinds[:, 0] = SPHERE
        params[:, 0, :4] = np.stack([0 * side, 0.5 * side, 0 * side + 1, 0 * side + 0.2], -1)
        trivial = rng.random(n) < 0.3
        np.savez(
            folder / f"shard_{i}.npz", q=q.astype(np.float32), kinds=kinds, params=params, trivial=trivial
        )
    torch.manual_seed(0)
    save_encoder(PointAutoencoder(SMALL_ENCODER), tmp_path / "encoder", {})
    return folder


def planner_settings(data, **changes) -> PlannerTraining:
    settings = PlannerTraining(
        data=str(data),
        encoder=str(data.parent / "encoder"),
        minutes=None,
        samples=160,
        batch=16,
        warmup_steps=3,
        learning_rate=3e-3,
        denoiser=SMALL_DENOISER,
    )
    return replace(settings, **changes)


def read_log(folder):
    with open(folder / "log.csv") as file:
        return list(csv.DictReader(file))


def stop_at(monkeypatch, step):
    """Interrupt training after so many steps, as Ctrl-C would."""
    original = TrainingRun.step

    def interrupted(self, loss):
        original(self, loss)
        if self.at.step == step:
            self.save()
            raise KeyboardInterrupt

    monkeypatch.setattr(TrainingRun, "step", interrupted)
    return lambda: monkeypatch.setattr(TrainingRun, "step", original)


def test_random_scenes():
    kinds, params = random_scenes(300, 12, np.random.default_rng(0))
    assert set(np.unique(kinds)) == {0, SPHERE, BOX}
    assert (params[kinds == 0] == 0).all()
    assert (params[kinds == SPHERE, 3] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(params[kinds != 0, 6:], axis=1), 1, atol=1e-5)
    assert (kinds != 0).sum(1).max() == 12
    assert np.isfinite(sample_surfaces_batch(kinds, params, 20, np.random.default_rng(0))).all()


def test_encoder_learns(tmp_path):
    settings = EncoderTraining(
        minutes=None, samples=1600, batch=16, points=64, warmup_steps=10, encoder=SMALL_ENCODER
    )
    report = train_encoder(settings, str(tmp_path))
    losses = [float(row["loss"]) for row in read_log(tmp_path)]
    assert losses[-1] < 0.8 * losses[0]
    assert report["distance"] < 0.8 * report["distance_of_constant"]
    codes = load_encoder(tmp_path)(torch.zeros(1, 0, 3))
    assert codes.shape == (1, 8)


@pytest.mark.parametrize("kind", ["encoder", "planner"])
def test_interrupted_training_ends_the_same(kind, tmp_path, data, monkeypatch):
    def train(out):
        if kind == "encoder":
            settings = EncoderTraining(minutes=None, samples=96, batch=8, points=32, encoder=SMALL_ENCODER)
            return train_encoder(settings, str(out))
        return train_planner(planner_settings(data), str(out))

    whole = train(tmp_path / "whole")
    resume = stop_at(monkeypatch, 5)
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path / "parts")
    resume()
    assert train(tmp_path / "parts") == whole
    name = "encoder" if kind == "encoder" else "model"
    files = [tmp_path / part / f"{name}.safetensors" for part in ("whole", "parts")]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert train(tmp_path / "parts") == whole, "a finished run is left as it is"


def test_planner_learns_which_side(tmp_path, data, arm):
    out = tmp_path / "out"
    report = train_planner(planner_settings(data, samples=16 * 250, point_weight=0.01), str(out))
    rows = read_log(out)
    assert float(rows[-1]["loss"]) < 0.3 * float(rows[0]["loss"])
    assert report["samples"] == 4000
    model = load_model(out, arm)
    about = json.loads((out / "model.json").read_text())
    assert about["training"]["trajectories"] == 160
    rng = np.random.default_rng(0)
    start, goal = np.array([-1.0, 0.2, 0.5]), np.array([1.0, -0.3, 0.4])
    for side in (-1.0, 1.0):
        kinds, params = np.array([[SPHERE]], np.int8), np.zeros((1, 1, 10), np.float32)
        params[0, 0, :4] = 0.0, 0.5 * side, 1.0, 0.2
        z = model.encode(sample_surfaces_batch(kinds, params, 256, rng)[0])
        checker = CollisionChecker(arm, Scene([training.FLOOR.shapes[0], Sphere(params[0, 0, :3], 0.2)]))

        def clearances(q, checker=checker):
            return checker.link_clearances(q.reshape(-1, 3)).reshape(*q.shape[:2], 3)

        q = model.sample(z, start, goal, 4, rng, clearances)
        bow = q[:, FRAMES // 2] - (start + goal) / 2
        np.testing.assert_allclose(bow, 0.5 * side, atol=0.2)


def test_codes_are_kept_beside_the_data(data, arm):
    encoder = load_encoder(data.parent / "encoder")
    said = []
    first = load_data(str(data), arm, encoder, FRAMES, said.append)
    kept = sorted((data / "codes").iterdir())
    assert len(kept) == 2
    assert "160 trajectories" in said[-1]
    assert first.kinds.shape == (160, 3)
    kept[0].write_bytes(b"damaged")
    again = load_data(str(data), arm, encoder, FRAMES, said.append)
    np.testing.assert_array_equal(again.codes, first.codes)
    assert again.digest == first.digest


def test_losses_that_are_not_finite_are_skipped(tmp_path):
    torch.manual_seed(0)
    module = torch.nn.Linear(2, 1)
    settings = EncoderTraining(minutes=None, samples=40, batch=1, warmup_steps=1, checkpoint_seconds=0.0)
    run = TrainingRun(
        module,
        str(tmp_path),
        settings,
        average=0.9,
        weight_decay=0.0,
        gradient_norm=1.0,
        bad_steps=3,
        identity={},
    )
    calls = []

    def loss(rng):
        calls.append(len(calls))
        bad = calls[-1] in (4, 10, 11, 12)
        return (module.weight * (float("nan") if bad else 1.0)).square().sum()

    run.loop(loss, lambda: 0.0, "test")
    assert torch.isfinite(module.weight).all()
    assert run.at.samples == 40
    assert run.at.rollbacks == 1
    assert run.at.skipped == 4
    assert int(read_log(tmp_path)[-1]["skipped"]) == 4


def test_hopeless_training_stops(tmp_path):
    module = torch.nn.Linear(2, 1)
    settings = EncoderTraining(minutes=None, samples=40, batch=1)
    run = TrainingRun(
        module,
        str(tmp_path),
        settings,
        average=0.9,
        weight_decay=0.0,
        gradient_norm=1.0,
        bad_steps=3,
        identity={},
    )
    with pytest.raises(InputError, match="not finite"):
        run.loop(lambda rng: module.weight.sum() * float("nan"), lambda: 0.0, "test")


def test_other_settings_need_another_folder(tmp_path, data):
    train_planner(planner_settings(data, samples=16), str(tmp_path / "out"))
    with pytest.raises(InputError, match=r"learning_rate = 0\.003, now it is 0\.1"):
        train_planner(planner_settings(data, learning_rate=0.1), str(tmp_path / "out"))


def test_damaged_checkpoint_is_named(tmp_path, data):
    train_planner(planner_settings(data, samples=16), str(tmp_path / "out"))
    file = tmp_path / "out" / "training.safetensors"
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(InputError, match=r"training\.safetensors is damaged"):
        train_planner(planner_settings(data), str(tmp_path / "out"))


@pytest.mark.parametrize("case", ["none", "damaged", "missing", "frames", "nan", "rows"])
def test_bad_data_give_one_line(case, data, arm):
    file = data / "shard_1.npz"
    arrays = dict(np.load(file))
    if case == "none":
        for shard in data.glob("*.npz"):
            shard.unlink()
    elif case == "damaged":
        file.write_bytes(file.read_bytes()[:5000])
    else:
        if case == "missing":
            del arrays["trivial"]
        elif case == "frames":
            arrays["q"] = arrays["q"][:, :40]
        elif case == "nan":
            arrays["q"][3, 4, 1] = np.nan
        elif case == "rows":
            arrays["kinds"] = arrays["kinds"][:-1]
        np.savez(file, **arrays)
    encoder = load_encoder(data.parent / "encoder")
    with pytest.raises(InputError, match="holds no shard" if case == "none" else "shard_1.npz") as caught:
        load_data(str(data), arm, encoder, FRAMES, lambda text: None)
    assert "\n" not in str(caught.value)


def test_length_is_given_once():
    with pytest.raises(InputError, match="exactly one"):
        EncoderTraining(minutes=3.0, samples=4)


def test_moving_links(arm):
    assert moving_links(arm) == ("l1", "l2", "l3")
