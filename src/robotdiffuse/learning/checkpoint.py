"""Files: tensors as safetensors, everything else as JSON; written whole or not at all."""

import hashlib
import json
import struct
from pathlib import Path as FilePath
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from robotdiffuse.errors import InputError, unknown_name
from robotdiffuse.files import write_atomically
from robotdiffuse.learning.encoders import ENCODERS, Encoder, encoder_name, make_encoder
from robotdiffuse.learning.motion_model import MotionModel, MotionModelConfig
from robotdiffuse.learning.settings import settings_from_json, settings_to_json
from robotdiffuse.robots.robot import Robot

FORMAT = 1
BUNDLED = FilePath(__file__).parent / "weights"
"""Weights that come with the package, one folder per robot."""


def write_tensors(file: FilePath, tensors: dict[str, Tensor], notes: dict[str, Any]) -> str:
    """Write tensors and JSON notes into one safetensors file. Returns its SHA-256."""
    contiguous = {name: tensor.detach().contiguous() for name, tensor in tensors.items()}
    data = save(contiguous, metadata={"notes": json.dumps(notes)})
    write_atomically(file, data, make_folder=True)
    return hashlib.sha256(data).hexdigest()


def read_tensors(file: FilePath) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and notes of `write_tensors`. Raises InputError if it is missing or damaged."""
    try:
        with safe_open(str(file), framework="pt") as opened:
            notes = json.loads((opened.metadata() or {}).get("notes", "{}"))
            return {name: opened.get_tensor(name) for name in opened.keys()}, notes  # noqa: SIM118
    except FileNotFoundError:
        raise InputError(f"{file} does not exist") from None
    except (SafetensorError, OSError, ValueError, struct.error) as error:
        raise InputError(f"{file} is damaged or no safetensors file: {str(error).splitlines()[0]}") from None


def fingerprint(module: nn.Module) -> str:
    """SHA-256 of the weights and buffers, the first 16 digits."""
    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(name.encode() + tensor.detach().cpu().contiguous().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:16]


def _pack(module: nn.Module) -> dict[str, Tensor]:
    """Matrices of layers in fp16, which is finer than the bf16 that they are used in; the rest as it is."""
    half = {f"{name}.weight" for name, part in module.named_modules() if isinstance(part, nn.Linear)}
    return {name: t.half() if name in half else t for name, t in module.state_dict().items()}


def save_module(module: nn.Module, folder: FilePath, stem: str, about: dict[str, Any]) -> None:
    """Write STEM.safetensors and, with the SHA-256 of it, STEM.json."""
    digest = write_tensors(folder / f"{stem}.safetensors", _pack(module), {})
    about = {"format": FORMAT, **about, "weights_sha256": digest}
    write_atomically(folder / f"{stem}.json", json.dumps(about, indent=1) + "\n", make_folder=True)


def load_tensors(folder: FilePath, stem: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Weights and description of `save_module`. Raises InputError if they are missing or damaged."""
    file = folder / f"{stem}.json"
    try:
        about = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{folder} holds no trained model: {file.name} is missing") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{file} is damaged: {error}") from None
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise InputError(f"{file} is not a model description of format {FORMAT}")
    weights = folder / f"{stem}.safetensors"
    try:
        digest = hashlib.sha256(weights.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"cannot read {weights}: {error.strerror}") from None
    if digest != about.get("weights_sha256"):
        raise InputError(f"{weights} is damaged or does not belong to {file.name}: its SHA-256 differs")
    return read_tensors(weights)[0], about


def fill(module: nn.Module, tensors: dict[str, Tensor], file: FilePath) -> None:
    """Give a module its weights. Raises InputError, naming the file, if they are another's."""
    try:
        module.load_state_dict(tensors)
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{file} does not fit its description: {reason}") from None


def save_encoder(encoder: Encoder, folder: str | FilePath, training: dict[str, Any]) -> None:
    """Write encoder.safetensors and encoder.json. `training`: how it was trained, for the reader."""
    about = {
        "encoder": encoder_name(encoder),
        "settings": settings_to_json(encoder.settings),
        "training": training,
    }
    save_module(encoder, FilePath(folder), "encoder", about)


def load_encoder(folder: str | FilePath) -> Encoder:
    """The trained encoder of a folder, frozen. Raises InputError if it is missing or damaged."""
    tensors, about = load_tensors(FilePath(folder), "encoder")
    where = str(FilePath(folder) / "encoder.json")
    if about.get("encoder") not in ENCODERS:
        raise unknown_name(f"encoder in {where}:", about.get("encoder"), ENCODERS)
    settings = ENCODERS[about["encoder"]][1]
    encoder = make_encoder(
        about["encoder"], settings_from_json(settings, about.get("settings"), f"{where}: settings")
    )
    fill(encoder, tensors, FilePath(folder) / "encoder.safetensors")
    return encoder.requires_grad_(False).eval()


def save_model(model: MotionModel, folder: str | FilePath, training: dict[str, Any]) -> None:
    """Write model.safetensors and model.json, all that planning needs.

    `training`: the data's fingerprint, the number of samples and so on, for the reader.
    """
    about = {"model": settings_to_json(model.config), "training": training}
    save_module(model, FilePath(folder), "model", about)


def load_model(folder: str | FilePath, robot: Robot | None = None) -> MotionModel:
    """The trained model of a folder, or of a bundled robot's name, ready for sampling.

    Raises InputError, naming the file, if it is missing, damaged, or made for another robot than `robot`.
    """
    folder = FilePath(folder)
    if not folder.is_dir() and (BUNDLED / folder.name).is_dir():
        folder = BUNDLED / folder.name
    tensors, about = load_tensors(folder, "model")
    where = f"{folder / 'model.json'}: model"
    config = settings_from_json(MotionModelConfig, about.get("model"), where)
    if robot is not None:
        config.check_robot(robot, str(folder / "model.json"))
    model = MotionModel(config)
    fill(model, tensors, folder / "model.safetensors")
    return model.for_inference()
