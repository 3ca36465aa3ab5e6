"""`train planner --robot` generates data and weights for an arm, and continues after interruptions."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

import robotdiffuse as rd
from helpers.commands import Said
from helpers.factory_runs import in_this_process
from robotdiffuse.cli import train as train_robot
from robotdiffuse.cli.train import data_settings, train_for_robot
from robotdiffuse.generation import factory
from robotdiffuse.generation.factory import GenerationSettings
from robotdiffuse.learning.denoisers import TransformerSettings
from robotdiffuse.learning.training.config import planner_training
from robotdiffuse.learning.weight_files import user_weights, weights_for
from robotdiffuse.planning.diffusion import Diffusion

STEPS = 20
BATCH = 8
SMALL = TransformerSettings(width=16, layers=1, heads=2, hidden=24, patch=8)
TINY = {"samples": STEPS * BATCH, "batch": BATCH, "denoiser_settings": SMALL, "validation_problems": 2}


@pytest.fixture(autouse=True)
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path / "robots"))
    monkeypatch.setattr(factory, "on_this_machine", in_this_process)

    def few(*asked: object) -> GenerationSettings:
        return replace(data_settings(*asked), mix={"rop": 1.0}, shard=4)  # type: ignore[arg-type]

    monkeypatch.setattr(train_robot, "data_settings", few)


def made(robot: str, out: Path | None = None) -> Path:
    make = partial(planner_training, "compact")
    report, kept = train_for_robot(robot, TINY, make, None if out is None else str(out), motions=12)
    assert report["samples"] == STEPS * BATCH
    return kept


@pytest.mark.slow
def test_an_arm_of_five_joints_plans_with_its_trained_network(tmp_path: Path) -> None:
    robot = rd.load_robot("so101")
    assert weights_for("model", robot) is None
    kept = made("so101")
    assert kept == tmp_path / "robots" / "so101" / "weights" == weights_for("model", robot)
    planner = Diffusion()
    assert planner.network(robot).dof == 5
    start = 0.5 * (robot.lower + robot.upper)
    problem = rd.Problem(robot, rd.Scene(), start, rd.JointGoal(start + 0.2))
    result = planner.plan(problem, 20.0)
    assert result.solved and result.stage == "network"
    assert weights_for("model", replace(rd.load_robot("ur5e"), name="so101")) is None


def test_data_are_in_the_size_of_the_arm() -> None:
    large, small = (data_settings(name, rd.load_robot(name), None, None) for name in ("ur5e", "so101"))
    assert large.search.safety_distance == 0.05 and small.search.safety_distance == pytest.approx(0.02)


def test_bad_input_is_a_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said) -> None:
    error = partial(said, 2, "train", "planner")
    assert "unknown robot 'ur5x'; known: " in error("--robot", "ur5x")
    assert "give --robot to generate data" in error()
    assert "--data needs --out" in error("--data", str(tmp_path))
    assert "--trajectories is for data to be generated" in error(
        *("--data", str(tmp_path), "--out", "x", "--trajectories", "3")
    )
    full = type("Usage", (), {"free": 1_000_000})
    with monkeypatch.context() as patch:
        patch.setattr(train_robot.shutil, "disk_usage", lambda folder: full)
        assert "free some space, or name another folder with --out" in error("--robot", "ur5e")
    (tmp_path / "half" / "data").mkdir(parents=True)
    (tmp_path / "half" / "data" / "manifest.json").write_text("{")
    assert "manifest.json is damaged" in error("--robot", "ur5e", "--out", str(tmp_path / "half"))
    file = user_weights(rd.load_robot("ur5e")) / "model.json"
    file.parent.mkdir(parents=True)
    file.write_text(json.dumps({"format": 2}))
    with pytest.raises(rd.InputError, match=r"weights/model\.json: robot is None"):
        weights_for("model", rd.load_robot("ur5e"))
