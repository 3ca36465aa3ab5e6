"""Configs by name, metrics of motions, and the runner of Table 2."""

from pathlib import Path

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.refusals import refuses
from robotdiffuse.cli import main
from robotdiffuse.evaluation import ablation
from robotdiffuse.learning.denoisers import DENOISERS
from robotdiffuse.learning.encoders import make_encoder
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.training.config import CONFIGS, planner_training
from robotdiffuse.learning.training.tasks import model_settings
from robotdiffuse.learning.weight_files import RobotIdentity

PANDA = rd.load_robot("panda")


@pytest.mark.parametrize("name", CONFIGS)
def test_every_config_makes_a_model(name: str) -> None:
    given = {"data": "data"} if "encoder" in CONFIGS[name].changes else {"data": "data", "encoder": "folder"}
    settings = planner_training(name, given)
    encoder = settings.encoder if settings.jointly else "compression_autoencoder"
    made = None if settings.encoder is None else make_encoder(encoder or "")
    model = MotionNetwork(RobotIdentity.of(PANDA), model_settings(settings, made))
    assert isinstance(model.denoiser, DENOISERS.load(settings.denoiser))
    assert (settings.minutes is None) != (settings.samples is None)


def test_what_is_given_beside_a_config_wins() -> None:
    settings = planner_training("paper", {"data": "d", "encoder": "e", "minutes": 3.0, "batch": 8})
    assert (settings.minutes, settings.samples, settings.batch) == (3.0, None, 8)
    refuses("table2_unet", planner_training, "papr", {"data": "d", "encoder": "e"})
    refuses("config compact needs an encoder", planner_training, "compact", {"data": "d"})


def test_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base = ["reproduce", "table2", "--data", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main([*base, "--rows", "Ourz"]) == 2 and "known: " in capsys.readouterr().err
    assert main([*base, "--family", "ropp"]) == 2
    assert "known: cabinet, clutter, crate" in capsys.readouterr().err
    assert main(base) == 2 and "no data set" in capsys.readouterr().err


def test_the_mean_of_two_trainings_leaves_unsolved_problems_out() -> None:
    def evaluation(single: list[float], length: list[float]) -> ablation.Evaluation:
        each = np.array(single, float)
        return ablation.Evaluation(each, each, each, np.array(length, float), each)

    nan = float("nan")
    mean = ablation.Evaluation.mean([evaluation([0, 1, 0], [nan, 4, nan]), evaluation([1, 1, 0], [3, 6, nan])])
    np.testing.assert_array_equal(mean.single, [0.5, 1, 0])
    np.testing.assert_array_equal(mean.length, [3, 5, nan])
    assert [ablation.Training("table2_jpc", seed).folder for seed in (0, 1)] == ["table2_jpc", "table2_jpc_seed1"]
