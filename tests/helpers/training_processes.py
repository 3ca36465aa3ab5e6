"""Trainings that two processes share: torchrun ... training_processes.py SETTINGS.json OUT."""

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from safetensors.torch import save_file

from helpers.box_arm import box_arm
from helpers.trainings import ToyTask
from robotdiffuse.core.interrupts import exit_fast
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.training import tasks as training
from robotdiffuse.learning.training.config import EncoderTraining, PlannerTraining
from robotdiffuse.learning.training.loop import Processes, TrainingRun

STOP_AFTER = 3


def two(settings: PlannerTraining, out: Path) -> None:
    """Trains without an interruption, then with one; and a toy training whose second process gets a loss that is not finite."""
    original = TrainingRun.step

    def first_step_kept(self):
        original(self)
        if self.at.step == 1 and self.processes.first:
            gradients = {str(i): p.grad for i, p in enumerate(self.parameters) if p.grad is not None}
            save_file(gradients, out / "first_step.safetensors")

    def cut(self):
        original(self)
        if self.at.step == STOP_AFTER:
            self.save()
            raise KeyboardInterrupt

    TrainingRun.step = first_step_kept
    report = training.train_planner(settings, str(out / "whole"))
    TrainingRun.step = cut
    try:
        training.train_planner(settings, str(out / "parts"))
    except KeyboardInterrupt:
        TrainingRun.step = original
    again = training.train_planner(settings, str(out / "parts"))
    processes = Processes("cpu")
    found = processes.gather({"report": report, "again": again} | bad_step_in_one(str(out / "toy")))
    if processes.first:
        (out / "seen.json").write_text(json.dumps(found))


def bad_step_in_one(out: str) -> dict[str, float]:
    settings = EncoderTraining(minutes=None, samples=20, batch=2, average=0.9, bad_steps=3)
    index = Processes("cpu").index
    run = TrainingRun(ToyTask(settings, lambda call: float("nan") if call == 2 and index else 1.0 + index), out)
    run.loop()
    return {"skipped": run.at.skipped, "samples": run.at.samples, "weight": run.module.get_parameter("weight").sum().item()}


if __name__ == "__main__":
    values, folder = sys.argv[1:]
    arm = box_arm()
    training.load_robot = lambda name: arm
    MotionNetwork.exports = lambda self: {}  # ONNX files take seconds, and no test of these runs reads them
    given = PlannerTraining.from_json(json.loads(Path(values).read_text()), "settings")

    def run() -> int:
        two(given, Path(folder))
        return 0

    exit_fast(run)
