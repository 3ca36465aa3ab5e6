"""The training loop: steps that are not finite."""

import pytest
import torch

from helpers.training_log import read_log
from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.training.config import EncoderTraining
from robotdiffuse.learning.training.loop import TrainingRun, Validation
from robotdiffuse.learning.training.processes import Processes


def test_losses_that_are_not_finite_are_skipped(tmp_path):
    torch.manual_seed(0)
    module = torch.nn.Linear(2, 1)
    settings = EncoderTraining(
        minutes=None, samples=40, batch=1, warmup_steps=1, checkpoint_seconds=0.0, average=0.9, bad_steps=3
    )
    run = TrainingRun(
        module,
        str(tmp_path),
        settings,
        identity={},
        processes=Processes("cpu"),
    )
    calls = []

    def loss(rng):
        calls.append(len(calls))
        bad = calls[-1] in (4, 10, 11, 12)
        return (module.weight * (float("nan") if bad else 1.0)).square().sum()

    run.loop(loss, lambda: Validation(0.0), "test")
    assert torch.isfinite(module.weight).all()
    assert run.at.samples == 40
    assert run.at.rollbacks == 1
    assert run.at.skipped == 4
    assert int(read_log(tmp_path)[-1]["skipped"]) == 4


def test_hopeless_training_stops(tmp_path):
    module = torch.nn.Linear(2, 1)
    settings = EncoderTraining(minutes=None, samples=40, batch=1, average=0.9, bad_steps=3)
    run = TrainingRun(
        module,
        str(tmp_path),
        settings,
        identity={},
        processes=Processes("cpu"),
    )
    with pytest.raises(InputError, match="not finite"):
        run.loop(lambda rng: module.weight.sum() * float("nan"), lambda: Validation(0.0), "test")
