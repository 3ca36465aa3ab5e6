"""The training loop: losses and gradients that are not finite."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from helpers.refusals import refuses
from helpers.trainings import ToyTask, read_log
from robotdiffuse.learning.training.config import EncoderTraining
from robotdiffuse.learning.training.loop import TrainingRun, train


def run_of(folder: Path, factor: Callable[[int], float]) -> TrainingRun:
    short = {"minutes": None, "samples": 40, "batch": 1, "warmup_steps": 1, "checkpoint_seconds": 0.0}
    return TrainingRun(ToyTask(EncoderTraining(average=0.9, bad_steps=3, **short), factor), str(folder))


def test_losses_that_are_not_finite_are_skipped(tmp_path: Path) -> None:
    run = run_of(tmp_path, lambda call: float("nan") if call in (4, 10, 11) else 1.0)
    run.loop()
    assert all(torch.isfinite(parameter).all() for parameter in run.module.parameters())
    assert (run.at.samples, run.at.skipped) == (40, 3) and int(read_log(tmp_path)[-1]["skipped"]) == 3
    refuses("not finite", run_of(tmp_path / "hopeless", lambda call: float("nan")).loop)


def test_steps_that_are_not_finite_are_counted_beyond_an_interruption(tmp_path: Path) -> None:
    """Regression: a resumed run counted anew, so that it ended later than an uninterrupted one, or never."""
    run = run_of(tmp_path, lambda call: float("nan"))
    run.step()
    run.step()
    run.save()
    refuses("not finite at step 3", run_of(tmp_path, lambda call: float("nan")).step)


def test_other_data_are_noted(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    run_of(tmp_path, lambda call: 1.0).save()
    monkeypatch.setattr(ToyTask, "about", lambda self: {"data": "others"})
    run_of(tmp_path, lambda call: 1.0)
    assert "training.safetensors was trained on other data; the training goes on" in capsys.readouterr().err


def test_a_checkpoint_that_a_killed_run_left_half_written_is_removed(tmp_path: Path) -> None:
    """Regression: each kill while a checkpoint was written left a file of its size for ever."""
    (tmp_path / ".training.safetensors.0123456789abcdef.tmp").write_bytes(b"half")
    run_of(tmp_path, lambda call: 1.0).loop()
    assert not list(tmp_path.glob(".*"))


def test_a_training_goes_on_without_plots(tmp_path: Path) -> None:
    """Regression: TensorBoard's error on a full disk ended the training, and later printed the traceback of a thread."""
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    for folder in (tmp_path / "plots", tmp_path):
        run_of(folder, lambda call: 1.0).loop()
        (tmp_path / "tensorboard").touch()
    plotted = events.EventAccumulator(str(tmp_path / "plots" / "tensorboard")).Reload().Scalars("loss")
    assert len(plotted) == len(read_log(tmp_path)) and plotted[-1].step == int(read_log(tmp_path)[-1]["samples"]) == 40


def test_a_short_training_that_diverged_writes_no_weights(tmp_path: Path) -> None:
    task = ToyTask(EncoderTraining(minutes=None, samples=3, batch=1), lambda call: float("nan") if call > 1 else 1.0)
    refuses("diverged: the loss or its gradient is not finite at step 3", train, task, str(tmp_path))


def test_the_average_follows_the_weights_with_the_decay_of_the_settings(tmp_path: Path) -> None:
    """The first step copies the weights; in later steps the decay is step / (step + 10), at most `average`."""
    run = run_of(tmp_path, lambda call: 1.0)
    expected = None
    for step in range(1, 8):
        run.step()
        now = run.module.get_parameter("weight").detach().clone()
        decay = min(0.9, step / (step + 10))
        expected = now if expected is None else decay * expected + (1 - decay) * now
    with run.averaged():
        torch.testing.assert_close(run.module.get_parameter("weight"), expected)
    torch.testing.assert_close(run.module.get_parameter("weight"), now)
