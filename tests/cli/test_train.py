"""The command `train`: options, and data that are generated during the training."""

import multiprocessing
import time
from dataclasses import replace
from pathlib import Path

import pytest

from helpers.commands import run
from robotdiffuse.cli.train_generate import generate_meanwhile
from robotdiffuse.datasets.manifest import read_manifest, write_manifest
from robotdiffuse.datasets.shards import check_shard, shard_indices
from robotdiffuse.generation import GenerationSettings
from robotdiffuse.generation.factory import manifest_of
from robotdiffuse.learning.denoisers.unet import UNetSettings
from robotdiffuse.learning.diffusion import ScheduleSettings
from robotdiffuse.learning.training.config import PlannerTraining
from robotdiffuse.learning.training.configs import CONFIGS

TRAIN = ["train", "planner", "--data", "d", "--encoder", "dgcnn", "--out", "o"]


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_unknown_config_lists_them_with_what_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*TRAIN, "--config", "papre") == 2
    error = capsys.readouterr().err
    assert error.startswith("robotdiffuse: error: unknown config 'papre'; known:\n")
    for name, config in CONFIGS.items():
        assert f"  {name}: {config.description}\n" in error


def test_parts_replace_those_of_the_config(monkeypatch: pytest.MonkeyPatch) -> None:
    trained: list[PlannerTraining] = []

    def train_planner(settings: PlannerTraining, out: str) -> dict[str, float]:
        trained.append(settings)
        return {}

    monkeypatch.setattr("robotdiffuse.learning.training.planner.train_planner", train_planner)
    parts = ["--objective", "velocity", "--sampler", "euler", "--schedule", "flow", "--waypoints", "64"]
    spline = ["--parametrization", "b_spline", "--rows", "12", "--condition-drop", "0.2"]
    spline += ["--target", "residual"]
    assert run(*TRAIN, "--config", "paper", "--denoiser", "unet", *parts, *spline, "--device", "cpu") == 0
    assert run(*TRAIN, "--config", "paper") == 0
    assert run(*TRAIN, "--config", "table2_unet", "--denoiser", "decoder_only") == 0
    changed, paper, row = trained
    assert changed == replace(
        paper,
        denoiser="unet",
        denoiser_settings=UNetSettings.paper_size(),
        objective="velocity",
        sampler="euler",
        schedule=ScheduleSettings(kind="flow"),
        target="residual",
        waypoints=64,
        parametrization="b_spline",
        rows=12,
        condition_drop=0.2,
        device="cpu",
    )
    assert row.denoiser == "decoder_only" and row.denoiser_settings is None


def test_data_are_made_meanwhile(tmp_path: Path) -> None:
    """The factory goes on by the manifest while the folder is used; it leaves whole shards and no process."""
    out = tmp_path / "data"
    settings = GenerationSettings(trajectories=10_000, shard=2, waypoints=16)
    out.mkdir()
    write_manifest(out, manifest_of(settings))
    with generate_meanwhile(str(out), 1, "panda"):
        first = len(shard_indices(out))
        assert first > 0
        end = time.monotonic() + 300
        while len(shard_indices(out)) == first:
            assert time.monotonic() < end
            time.sleep(0.05)
        assert len(multiprocessing.active_children()) == 1
    assert not multiprocessing.active_children()
    made = shard_indices(out)
    assert not list(out.glob(".shard*")) and len(made) < settings.shards
    for index in made:
        check_shard(out, index, read_manifest(out))


def test_data_that_cannot_be_made_meanwhile(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line, before training begins."""
    out = tmp_path / "data"
    out.mkdir()
    manifest = manifest_of(GenerationSettings())
    write_manifest(out, replace(manifest, versions=manifest.versions | {"numpy": "0"}))
    assert run(*TRAIN, "--data", out, "--generate", 1) == 2
    error = capsys.readouterr().err
    assert "was begun with numpy 0" in error and error.count("\n") == 1
    assert not multiprocessing.active_children()
