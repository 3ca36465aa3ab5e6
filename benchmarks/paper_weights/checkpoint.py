"""The training of config `paper` in files of at most 16 MB, beside this script: to continue it elsewhere,
or to plan with its weights.

    python benchmarks/paper_weights/checkpoint.py pack RUN
    python benchmarks/paper_weights/checkpoint.py unpack RUN
    python benchmarks/paper_weights/checkpoint.py weights FOLDER

RUN is the folder of `robotdiffuse train planner --config paper --data DATA --encoder ENCODER --out RUN`.
`pack` writes its checkpoint and encoder. After `unpack`, the same command with
`--encoder benchmarks/paper_weights` continues the training, on the same or other data. `weights` writes a
folder for `robotdiffuse plan --planner diffusion --weights FOLDER`.

The continued training is not bit for bit the same as an uninterrupted one. Of the weights, only their moving
average is kept, and matrices have 8 bits, with a scale for each row. Of Adam's moments, the first starts
again at zero, and the second is the product of its means over rows and columns.
"""

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from robotdiffuse.learning.checkpoint import load_encoder, save_network
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.training.config import PlannerTraining
from robotdiffuse.learning.training.tasks import model_settings
from robotdiffuse.learning.weight_files import RobotIdentity
from robotdiffuse.robots import load_robot

HERE = Path(__file__).resolve().parent
FILES = 2
"""Number of files for the weights."""


def network(notes: dict[str, Any]) -> MotionNetwork:
    """The network of a checkpoint with these notes, with new weights."""
    settings = PlannerTraining.from_json(notes["settings"] | {"encoder": str(HERE)}, "checkpoint")
    trained_encoder = load_encoder(HERE)
    robot = RobotIdentity.of(load_robot(notes["identity"]["robot"]))
    model = MotionNetwork(robot, model_settings(settings, trained_encoder))
    model.encoder = trained_encoder
    return model


def trained(model: MotionNetwork) -> list[nn.Parameter]:
    """The parameters in the optimizer's order."""
    return [parameter for parameter in model.parameters() if parameter.requires_grad]


def pack(run: Path) -> None:
    with safe_open(run / "training.safetensors", "pt") as stored:
        notes = json.loads(stored.metadata()["notes"])
        tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
    encoder = Path(notes["settings"]["encoder"])
    if encoder.resolve() != HERE:
        for name in ("encoder.json", "encoder.safetensors"):
            shutil.copyfile(encoder / name, HERE / name)
    model = network(notes)
    count = len(trained(model))
    files = [dict[str, Tensor]() for _ in range(FILES)]
    for i in range(count):
        average = tensors[f"average.module.{i}"]
        moment = tensors[f"{i}.exp_avg_sq"]
        parts = {"values": average, "moment": moment}
        if average.ndim == 2:
            scale = average.abs().amax(1, keepdim=True).clamp(min=1e-12) / 127
            matrix = (average / scale).round().to(torch.int8)
            parts = {"matrix": matrix, "scale": scale, "rows": moment.mean(1), "columns": moment.mean(0)}
        files[i * FILES // count] |= {f"{i}.{part}": tensor for part, tensor in parts.items()}
    buffers = {name for name, _ in model.named_buffers() if not name.startswith("encoder.")}
    files[0] |= {name: tensors[f"module.{name}"] for name in buffers if f"module.{name}" in tensors}
    for i, file in enumerate(files):
        content = {name: tensor.contiguous() for name, tensor in file.items()}
        save_file(content, HERE / f"checkpoint_{i}.safetensors")
    (HERE / "checkpoint.json").write_text(json.dumps(notes, indent=1) + "\n")


def read() -> tuple[dict[str, Any], dict[str, Tensor], MotionNetwork]:
    """Notes, tensors and network of the checkpoint beside this script."""
    notes = json.loads((HERE / "checkpoint.json").read_text())
    stored = dict[str, Tensor]()
    for i in range(FILES):
        stored |= load_file(HERE / f"checkpoint_{i}.safetensors")
    model = network(notes)
    for i, parameter in enumerate(trained(model)):
        if f"{i}.matrix" in stored:
            parameter.data = stored[f"{i}.matrix"] * stored[f"{i}.scale"]
        else:
            parameter.data = stored[f"{i}.values"]
    buffers = {name: tensor for name, tensor in stored.items() if not name[0].isdigit()}
    model.load_state_dict(model.state_dict() | buffers)
    return notes, stored, model


def unpack(run: Path) -> None:
    notes, stored, model = read()
    step = torch.tensor(float(notes["at"]["step"]))
    tensors = {f"module.{name}": tensor for name, tensor in model.state_dict().items()}
    tensors["average.n_averaged"] = step.long()
    for i, parameter in enumerate(trained(model)):
        moment = stored.get(f"{i}.moment")
        if moment is None:
            rows = stored[f"{i}.rows"]
            moment = torch.outer(rows, stored[f"{i}.columns"]) / rows.mean().clamp(min=1e-30)
        state = {"exp_avg": torch.zeros_like(moment), "exp_avg_sq": moment, "step": step}
        tensors |= {f"{i}.{name}": tensor for name, tensor in state.items()}
        tensors[f"average.module.{i}"] = parameter.detach()
    run.mkdir(parents=True)
    content = {name: tensor.clone() for name, tensor in tensors.items()}
    save_file(content, run / "training.safetensors", {"notes": json.dumps(notes)})


def weights(folder: Path) -> None:
    notes, _, model = read()
    save_network("model", model.eval(), folder, {"samples": notes["at"]["samples"]})


def main() -> None:
    commands = {"pack": pack, "unpack": unpack, "weights": weights}
    parser = argparse.ArgumentParser()
    parser.add_argument("command", choices=commands)
    parser.add_argument("folder", type=Path)
    arguments = parser.parse_args()
    commands[arguments.command](arguments.folder)


if __name__ == "__main__":
    main()
