"""The command `train`: options, and data that are generated during the training."""

from dataclasses import replace
from pathlib import Path

import pytest

from helpers.commands import Said, run
from robotdiffuse.learning.denoisers import PAPER_SIZES
from robotdiffuse.learning.training.config import CONFIGS, PlannerTraining

TRAIN = ["train", "planner", "--data", "d", "--encoder", "dgcnn", "--out", "o"]


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[PlannerTraining]:
    """Records the settings of requested trainings instead of training."""
    trained: list[PlannerTraining] = []

    def train_planner(settings: PlannerTraining, out: str) -> dict[str, float]:
        trained.append(settings)
        return {}

    monkeypatch.setattr("robotdiffuse.cli.train.train_planner", train_planner)
    return trained


def test_unknown_configs_and_those_without_their_encoder_are_refused(said: Said) -> None:
    error = said(2, *TRAIN, "--config", "papre")
    assert error.startswith("robotdiffuse: error: unknown config 'papre'; known:\n")
    for name, config in CONFIGS.items():
        assert f"  {name}: {config.description}\n" in error
    command = ("train", "planner", "--config", "paper", "--out", "o")
    for rest in (("--data", "d"), ("--robot", "panda")):
        assert "--config paper needs --encoder" in said(2, *command, *rest)


def test_parts_replace_those_of_the_config(trained: list[PlannerTraining]) -> None:
    parts = ["--objective", "noise", "--sampler", "ddim", "--waypoints", "64", "--condition-drop", "0.2"]
    parts += ["--target", "residual"]
    assert run(*TRAIN, "--config", "paper", "--denoiser", "unet", *parts, "--device", "cpu") == 0
    assert run(*TRAIN, "--config", "paper") == 0
    assert run(*TRAIN, "--config", "table2_unet", "--denoiser", "decoder_only") == 0
    changed, paper, row = trained
    wanted = {"denoiser": "unet", "denoiser_settings": PAPER_SIZES["unet"], "objective": "noise", "sampler": "ddim"}
    wanted |= {"target": "residual", "waypoints": 64, "progressive": False, "condition_drop": 0.2, "device": "cpu"}
    assert changed == replace(paper, **wanted)
    assert row.denoiser == "decoder_only" and row.denoiser_settings is None


def test_the_bundled_encoder_is_taken_where_none_is_named(trained: list[PlannerTraining]) -> None:
    assert run("train", "planner", "--data", "d", "--out", "o") == 0
    assert trained[0].encoder == str(Path("o", "encoder")) and Path("o", "encoder", "encoder.json").is_file()
    assert run("train", "planner", "--data", "d", "--out", "o", "--config", "table2_pointnet") == 0
    assert trained[1].encoder == "pointnet"


@pytest.mark.parametrize("data", [("--data", "d"), ("--robot", "ur5e")])
def test_cross_attention_without_points_is_refused_before_anything_is_made(data: tuple[str, str], said: Said) -> None:
    assert "denoiser cross_attention need each other" in said(
        2, "train", "planner", *data, "--out", "o", "--denoiser", "cross_attention"
    )
    assert not Path("o").exists()


@pytest.mark.parametrize(("config", "encoder"), [("points", "points"), ("trajectory_prior", None)])
def test_the_encoder_of_the_config_is_that_of_an_arm_too(
    config: str, encoder: str | None, trained: list[PlannerTraining], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("robotdiffuse.cli.train.generate", lambda *_, **__: None)
    assert run("train", "planner", "--robot", "panda", "--out", "o", "--config", config) == 0
    assert trained[0].encoder == encoder and not Path("o", "encoder").exists()
