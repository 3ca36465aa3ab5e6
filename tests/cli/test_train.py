"""`train`: options, data that are generated during the training, and weights for an arm, also after interruptions."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

import robotdiffuse as rd
from helpers.commands import Said, run
from helpers.factory_runs import in_this_process
from helpers.refusals import refuses
from robotdiffuse.cli import train as train_command
from robotdiffuse.cli.train import data_settings, train_for_robot
from robotdiffuse.generation import factory
from robotdiffuse.learning.denoisers import PAPER_SIZES, TransformerSettings
from robotdiffuse.learning.training.config import CONFIGS, PlannerTraining
from robotdiffuse.learning.weight_files import user_weights, weights_for
from robotdiffuse.planning.diffusion import Diffusion

TRAIN = ["train", "planner", "--data", "d", "--encoder", "dgcnn", "--out", "o"]


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[PlannerTraining]:
    """Records the settings of requested trainings instead of training."""
    trained: list[PlannerTraining] = []
    monkeypatch.setattr(train_command, "train_planner", lambda settings, out: trained.append(settings) or {})
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
    assert run(*TRAIN, "--config", "paper", "--denoiser", "unet", *parts, "--target", "residual", "--device", "cpu") == 0
    assert run(*TRAIN, "--config", "paper") == 0
    assert run(*TRAIN, "--config", "table2_unet", "--denoiser", "decoder_only") == 0
    # regression: values that the config has already turned its progressive training off
    assert run(*TRAIN, "--config", "paper", "--waypoints", "254", "--objective", "clean") == 0
    assert run(*TRAIN, "--target", "limits") == 0
    changed, paper, row, same, limits = trained
    assert same == paper and not limits.smooth_noise
    wanted = {"denoiser": "unet", "denoiser_settings": PAPER_SIZES["unet"], "objective": "noise", "sampler": "ddim"}
    wanted |= {"target": "residual", "waypoints": 64, "progressive": False, "condition_drop": 0.2, "device": "cpu"}
    assert changed == replace(paper, **wanted)
    assert row.denoiser == "decoder_only" and row.denoiser_settings is None


def test_the_bundled_encoder_is_taken_where_none_is_named(trained: list[PlannerTraining]) -> None:
    assert run("train", "planner", "--data", "d", "--out", "o") == 0
    assert trained[0].encoder == str(Path("o", "encoder")) and Path("o", "encoder", "encoder.json").is_file()
    assert run("train", "planner", "--data", "d", "--out", "o", "--config", "table2_pointnet") == 0
    assert trained[1].encoder == "pointnet"


def test_cross_attention_without_points_is_refused_before_anything_is_made(said: Said) -> None:
    for data in (("--data", "d"), ("--robot", "ur5e")):
        error = said(2, "train", "planner", *data, "--out", "o", "--denoiser", "cross_attention")
        assert "denoiser cross_attention need each other" in error and not Path("o").exists()


@pytest.mark.parametrize(("config", "encoder"), [("points", "points"), ("trajectory_prior", None)])
def test_the_encoder_of_the_config_is_that_of_an_arm_too(config: str, encoder: str | None, trained, monkeypatch) -> None:
    monkeypatch.setattr("robotdiffuse.cli.train.generate", lambda *_, **__: None)
    assert run("train", "planner", "--robot", "panda", "--out", "o", "--config", config) == 0
    assert trained[0].encoder == encoder and not Path("o", "encoder").exists()
    assert trained[0].minutes == CONFIGS[config].changes.get("minutes"), "regression: all had 2.4 million samples"


SMALL = TransformerSettings(width=16, layers=1, heads=2, hidden=24, patch=8)
TINY = {"samples": 160, "batch": 8, "denoiser_settings": SMALL, "validation_problems": 2}


@pytest.fixture(autouse=True)
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path / "robots"))
    monkeypatch.setattr(factory, "on_this_machine", in_this_process)

    def few(*asked: object) -> factory.GenerationSettings:
        return replace(data_settings(*asked), mix={"rop": 1.0}, shard=4)  # type: ignore[arg-type]

    monkeypatch.setattr(train_command, "data_settings", few)


@pytest.mark.slow
def test_an_arm_of_five_joints_plans_with_its_trained_network(tmp_path: Path) -> None:
    robot = rd.load_robot("so101")
    assert weights_for("model", robot) is None
    report, kept = train_for_robot("so101", TINY, "compact", None, motions=12)
    assert report["samples"] == TINY["samples"] and kept == weights_for("model", robot)
    assert kept == tmp_path / "robots" / "so101" / "weights"
    planner = Diffusion()
    assert planner.network(robot).dof == 5
    start = 0.5 * (robot.lower + robot.upper)
    result = planner.plan(rd.Problem(robot, rd.Scene(), start, rd.JointGoal(start + 0.2)), 20.0)
    assert result.solved and result.stage == "network"
    assert weights_for("model", replace(rd.load_robot("ur5e"), name="so101")) is None


@pytest.mark.parametrize("kind", ["planner", "baseline mpnet"])
def test_the_folder_is_checked_before_the_data_are_read(kind: str, tmp_path: Path, said: Said) -> None:
    (tmp_path / "file").touch()
    assert "it is a file" in said(2, "train", *kind.split(), "--data", tmp_path / "missing", "--out", tmp_path / "file")


def test_data_are_in_the_size_of_the_arm() -> None:
    large, small = (data_settings(name, rd.load_robot(name), None, None) for name in ("ur5e", "so101"))
    assert large.search.safety_distance == 0.05 and small.search.safety_distance == pytest.approx(0.02)


def test_bad_input_is_a_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said) -> None:
    error = partial(said, 2, "train", "planner")
    assert "unknown robot 'ur5x'; known: " in error("--robot", "ur5x")
    assert "give --robot to generate data" in error()
    assert "--data needs --out" in error("--data", str(tmp_path))
    assert "--trajectories is for data to be generated" in error("--data", tmp_path, "--out", "x", "--trajectories", 3)
    with monkeypatch.context() as patch:
        patch.setattr(train_command.shutil, "disk_usage", lambda folder: type("Usage", (), {"free": 1_000_000}))
        assert "free some space, or name another folder with --out" in error("--robot", "ur5e")
    (tmp_path / "half" / "data").mkdir(parents=True)
    (tmp_path / "half" / "data" / "manifest.json").write_text("{")
    assert "manifest.json is damaged" in error("--robot", "ur5e", "--out", str(tmp_path / "half"))
    file = user_weights(rd.load_robot("ur5e")) / "model.json"
    file.parent.mkdir(parents=True)
    file.write_text(json.dumps({"format": 2}))
    refuses(r"weights/model\.json: robot is None", weights_for, "model", rd.load_robot("ur5e"))
