"""Training of the diffusion model: it learns, resumes exactly, and shares its work between processes."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import robotdiffuse as rd
from helpers.refusals import refuses
from helpers.small_model import SMALL_ENCODER, nothing_near
from helpers.trainings import read_log
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.files import lock_folder
from robotdiffuse.learning.checkpoint import load_encoder, load_network
from robotdiffuse.learning.denoisers import DENOISERS, TransformerSettings, UNetSettings
from robotdiffuse.learning.diffusion import OBJECTIVES
from robotdiffuse.learning.encoders import make_encoder
from robotdiffuse.learning.exported_model import exported_model
from robotdiffuse.learning.motion_model import SamplingSettings, link_clearances
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.training import loop as training_run, tasks as training
from robotdiffuse.learning.training.batches import Batch, Batches, fast_bf16, load_data
from robotdiffuse.learning.training.config import EncoderTraining, PlannerTraining
from robotdiffuse.learning.training.loop import Processes, TrainingRun
from robotdiffuse.learning.training.losses import LossSettings
from robotdiffuse.learning.training.tasks import train_encoder, train_planner
from robotdiffuse.learning.weight_files import RobotIdentity
from robotdiffuse.scenes.packed_scenes import PackedScenes
from robotdiffuse.scenes.surface_points import sample_surface

SMALL_DENOISER = TransformerSettings(width=32, layers=2, heads=2, hidden=48, patch=8)
WAYPOINTS = 48
START = np.array([-1.0, 0.2, 0.5])
GOAL = np.array([1.0, -0.3, 0.4])


def planner_settings(data, **changes) -> PlannerTraining:
    settings = PlannerTraining(data=str(data), encoder=str(data.parent / "encoder"), denoiser_settings=SMALL_DENOISER)
    short = {"minutes": None, "samples": 160, "batch": 16, "warmup_steps": 3, "learning_rate": 3e-3, "validation_problems": 1}
    return replace(settings, turned_copies=0, **short | changes)


@pytest.mark.slow
@pytest.mark.usefixtures("no_export")
def test_two_processes_are_one_run(tmp_path, data, monkeypatch):
    """A step of two processes equals one on both batches together; they resume and skip bad steps together."""
    out = tmp_path / "two"
    settings = planner_settings(data, samples=160, gradient_norm=1e6, device="cpu")
    file = tmp_path / "two.json"
    file.write_text(json.dumps(settings.to_json()))
    script = Path(__file__).parents[2] / "helpers" / "training_processes.py"
    command = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", script, file, out)
    run = subprocess.run(command, capture_output=True, text=True, timeout=500)
    said = run.stdout + run.stderr
    assert run.returncode == 0, said
    assert said.count("model: 100.0%, 160 samples") == 2, "the first process alone reports"
    first, second = json.loads((out / "seen.json").read_text())
    assert first == second and first["report"] == first["again"] and first["skipped"] == 1 and first["samples"] == 20
    files = [out / part / "model.safetensors" for part in ("whole", "parts")]
    assert files[0].read_bytes() == files[1].read_bytes()
    refuses("processes = '2', not '1'", train_planner, settings, str(out / "parts"))
    draw = Batches.draw
    gradients = {}

    def both(self, count, rng):
        if gradients:
            return draw(self, count, rng)
        parts = [draw(self, count // 2, np.random.default_rng(seed)) for seed in (0, [0, 1])]
        fields = ((name, [getattr(part, name) for part in parts]) for name in vars(parts[0]))
        of: dict[type, Any] = {PackedScenes: PackedScenes.joined, np.ndarray: np.concatenate}
        joined = {name: None if a is None else of[type(a)]([a, b]) for name, (a, b) in fields}
        return Batch(**joined)  # type: ignore[arg-type]

    def step(self):
        original(self)
        gradients.update({str(i): p.grad.clone() for i, p in enumerate(self.parameters)} if not gradients else {})

    original = TrainingRun.step
    monkeypatch.setattr(Batches, "draw", both)
    monkeypatch.setattr(TrainingRun, "step", step)
    train_planner(replace(settings, samples=32, batch=32), str(tmp_path / "one"))
    averaged = load_file(out / "first_step.safetensors")
    assert averaged.keys() == gradients.keys()
    wanted, found = (torch.cat([g[name].flatten() for name in averaged]) for g in (gradients, averaged))
    # products in bf16 have 8 digits, and are rounded for each batch
    assert (found - wanted).norm() < (0.01 if fast_bf16() else 1e-5) * wanted.norm()


@pytest.mark.parametrize("denoiser", DENOISERS)
def test_losses_are_computed_where_the_model_is(denoiser, data, arm):
    """On the meta device, which has no numbers but, like a GPU, refuses tensors of other devices."""
    losses = LossSettings(point=1.0, collision=1.0)
    changes = {"encoder": "points"} if denoiser == "cross_attention" else {}
    settings = planner_settings(data, denoiser=denoiser, denoiser_settings=None, losses=losses, condition_drop=0.5, **changes)
    encoder = make_encoder("points") if changes else load_encoder(data.parent / "encoder")
    model = MotionNetwork(RobotIdentity.of(arm), training.model_settings(settings, encoder))
    loaded = load_data(str(data), arm, encoder, WAYPOINTS, lambda text: None)
    rng = np.random.default_rng(0)
    batch = Batches(loaded, model, lambda _, q: nothing_near(q), 0.1, 5.0).draw(4, rng)
    elsewhere = Processes("cpu")
    elsewhere.device = torch.device("meta")
    model = model.to("meta")
    loss = training.PlannerLoss(model, arm, settings, elsewhere)(batch, 1.0, rng, torch.arange(4) > 1)
    loss.backward()
    assert loss.device.type == "meta" and all(p.grad is not None for p in model.denoiser.parameters())


def test_device_is_checked(data, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for name, message in (("tpu", "unknown device 'tpu'; known: cpu, cuda"), ("cuda", "no CUDA device")):
        refuses(message, lambda name=name: train_planner(planner_settings(data, device=name), str(tmp_path / "out")))
    Processes("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: True)
    refuses("has trained on cpu; start a new process", Processes, "cuda")
    monkeypatch.setitem(sys.modules, "accelerate", None)
    refuses(r"pip install \"robotdiffuse\[train\]\"", Processes, None)
    monkeypatch.setattr(torch, "get_default_dtype", lambda: torch.float64)
    refuses(r"default dtype is torch\.float64; training needs .*\(torch\.float32\)", Processes, "cpu")


@pytest.mark.parametrize("kind", ["encoder", "planner"])
@pytest.mark.usefixtures("no_export")
def test_interrupted_training_ends_the_same(kind, tmp_path, data, monkeypatch):
    monkeypatch.setattr(training, "STANDARDIZATION_SCENES", 256)

    def train(out):
        if kind == "encoder":
            settings = EncoderTraining(minutes=None, samples=96, batch=8, points=32, encoder=SMALL_ENCODER)
            return train_encoder(settings, str(out))
        return train_planner(planner_settings(data), str(out))

    whole = train(tmp_path / "whole")

    def interrupted(self, step=TrainingRun.step):
        step(self)
        if self.at.step == 5:
            self.save()
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(TrainingRun, "step", interrupted)
        train(tmp_path / "parts")
    assert train(tmp_path / "parts") == whole
    name = "encoder" if kind == "encoder" else "model"
    files = [tmp_path / part / f"{name}.safetensors" for part in ("whole", "parts")]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert train(tmp_path / "parts") == whole, "a finished run is left as it is"


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"target": "absolute", "smooth_noise": False, "objective": "noise"},
        {"clearance_features": False, "sampler": "ddpm", "losses": LossSettings(point=0.1, collision=0.1, waypoints=4)},
    ],
    ids=lambda changes: "-".join(map(str, changes)),
)
def test_every_choice_trains_and_plans(changes, tmp_path, data, arm, monkeypatch):
    monkeypatch.setattr(training_run, "LOG_EVERY", 10)
    out = tmp_path / "out"
    train_planner(planner_settings(data, samples=16 * 60, **changes), str(out))
    losses = [float(row["loss"]) for row in read_log(out)]
    assert np.mean(losses[-3:]) < losses[0]
    model = exported_model("model", out, arm)
    settings = SamplingSettings(samples=3, sampling_steps=8)
    q = model.sample(START, GOAL, model.encode(np.zeros((0, 3))), nothing_near, np.random.default_rng(0), settings)
    assert q.shape == (3, WAYPOINTS, 3) and np.isfinite(q).all() and (q[:, 0] == START).all() and (q[:, -1] == GOAL).all()
    assert (q >= arm.lower).all() and (q <= arm.upper).all()


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_errors_in_the_workspace_have_the_same_weight_for_every_objective(data, arm, objective):
    """With the weight of the output's error, the loss would be 10,000 times too large for noise at the last level."""
    encoder = load_encoder(data.parent / "encoder")
    loaded = load_data(str(data), arm, None, WAYPOINTS, print)
    settings = planner_settings(data, objective=objective)
    model = MotionNetwork(RobotIdentity.of(arm), training.model_settings(settings, encoder))
    batches = Batches(loaded, model, lambda _, q: np.zeros((*q.shape[:2], 3), np.float32), 0.1, 5.0)
    levels = np.arange(1, model.schedule.steps + 1)
    batch = batches.at(np.zeros(len(levels), np.int64), levels, np.random.default_rng(0))
    of_clean = model.schedule.weight(levels, 5.0)
    assert (batch.clean_weight > 0).all() and (batch.clean_weight <= of_clean * (1 + 1e-5)).all()
    if objective == "clean":
        np.testing.assert_allclose(batch.clean_weight, of_clean, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.usefixtures("no_export")
def test_planner_learns_which_side(tmp_path, data, arm):
    out = tmp_path / "out"
    report = train_planner(planner_settings(data, samples=16 * 300, losses=LossSettings(point=0.01)), str(out))
    rows = read_log(out)
    assert float(rows[-1]["loss"]) < 0.3 * float(rows[0]["loss"])
    assert report["samples"] == 4800
    assert 0.0 <= report["success"] <= 1.0 and float(rows[-1]["success"]) == pytest.approx(report["success"])
    assert list((out / "tensorboard").iterdir()), "the extra `train` is installed: a log for TensorBoard"
    model = load_network("model", out, arm)
    loaded = load_data(str(data), arm, model.encoder, WAYPOINTS, print)
    assert json.loads((out / "model.json").read_text())["training"]["trajectories"] == len(loaded)
    rng = np.random.default_rng(0)
    for side in (-1.0, 1.0):
        scene = rd.Scene([rd.Box([0, 0, -0.05], [2, 2, 0.1]), rd.Sphere([0.0, 0.5 * side, 1.0], 0.2)])
        z = model.encode(sample_surface(scene, 256, rng))
        clearances = link_clearances(CollisionChecker(arm, scene), model.settings)
        q = model.sample(START, GOAL, z, clearances, rng, SamplingSettings(samples=4))
        bow = q[:, WAYPOINTS // 2] - (START + GOAL) / 2
        assert (bow * side > 0.1).all()
        np.testing.assert_allclose(bow.mean(), 0.5 * side, atol=0.2)


@pytest.mark.usefixtures("no_export")
def test_other_settings_and_a_damaged_checkpoint_are_refused(tmp_path, data):
    out = str(tmp_path / "out")
    train_planner(planner_settings(data, samples=16), out)
    again = train_planner, planner_settings(data), out
    refuses(r"learning_rate = 0\.003, not 0\.1", train_planner, planner_settings(data, learning_rate=0.1), out)
    with lock_folder(tmp_path / "out"):
        refuses("another process", *again)
    file = tmp_path / "out" / "training.safetensors"
    file.write_bytes(file.read_bytes()[:1000])
    refuses(r"training\.safetensors is damaged", *again)
    refuses("name of the folder .* is not UTF-8", train_planner, planner_settings(data), str(tmp_path / "\udcff"))


@pytest.mark.usefixtures("no_export")
def test_trains_without_some_conditions(data, tmp_path, arm):
    small = UNetSettings(width=8, multiples=(1, 2), kernel=3, condition_width=16)
    settings = planner_settings(data, condition_drop=0.5, denoiser="unet", denoiser_settings=small)
    assert np.isfinite(train_planner(settings, str(tmp_path / "out"))["validation"])
    model = load_network("model", tmp_path / "out", arm)
    assert model.null_condition is not None and model.null_condition.abs().min() > 0
