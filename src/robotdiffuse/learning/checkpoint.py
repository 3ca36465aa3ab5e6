"""Writes and reads files of trained networks with PyTorch; `weight_files` describes their content.

All networks are written and read in the same way: the diffusion model, the baselines' networks, the encoder
that is trained alone and the completion network. Encoder and completion network belong to no robot. Files are
written atomically.
"""

import copy
import hashlib
import json
import struct
from pathlib import Path as FilePath
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from robotdiffuse.core.errors import InputError, shortened
from robotdiffuse.core.output_files import write_atomically
from robotdiffuse.learning.completion import CompletionSettings
from robotdiffuse.learning.completion_network import CompletionNetwork
from robotdiffuse.learning.encoders import ENCODERS, encoder_name
from robotdiffuse.learning.encoders.networks import Encoder
from robotdiffuse.learning.network import Network, SavedModule
from robotdiffuse.learning.weight_files import (
    FORMAT,
    NETWORKS,
    RobotIdentity,
    checked_bytes,
    completion_folder,
    kept_by_stamp,
    read_description,
    weights_folder,
)
from robotdiffuse.robots.robot import Robot


def write_tensors(file: FilePath, tensors: dict[str, Tensor], notes: dict[str, Any]) -> str:
    """Write tensors and JSON notes into one safetensors file. Returns its SHA-256."""
    contiguous = {name: tensor.detach().contiguous() for name, tensor in tensors.items()}
    data = save(contiguous, metadata={"notes": json.dumps(notes)})
    write_atomically(file, data, make_folder=True)
    return hashlib.sha256(data).hexdigest()


def read_tensors(file: FilePath) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and notes of a file of `write_tensors`. Raises InputError if it is missing or damaged."""
    try:
        with safe_open(str(file), framework="pt") as opened:
            notes = json.loads((opened.metadata() or {}).get("notes", "{}"))
            return {name: opened.get_tensor(name) for name in opened.keys()}, notes  # noqa: SIM118
    except FileNotFoundError:
        raise InputError(f"{file} does not exist") from None
    except (SafetensorError, OSError, ValueError, RecursionError, struct.error) as error:
        raise InputError(f"{file} is damaged or no safetensors file: {str(error).splitlines()[0]}") from None


def fingerprint(module: nn.Module) -> str:
    """The first 16 digits of the SHA-256 of weights and buffers."""
    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        data = tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8)
        digest.update(name.encode() + data.numpy().tobytes())
    return digest.hexdigest()[:16]


def save_network(name: str, network: Any, folder: str | FilePath, training: dict[str, Any]) -> None:
    """Write NAME.safetensors and NAME.json; `name` as in NETWORKS, or encoder or completion.

    training: information for people, such as the data's fingerprint and the number of samples.
    """
    about: dict[str, Any] = {"network": encoder_name(network) if isinstance(network, Encoder) else name}
    if isinstance(network, Network):
        about["robot"] = network.robot.to_json()
    about |= {"settings": network.settings.to_json(), "training": training}
    _save(network, FilePath(folder), name, about)


def _save(module: SavedModule, folder: FilePath, stem: str, about: dict[str, Any]) -> None:
    """Write STEM.safetensors, the ONNX files, and last STEM.json with the SHA-256 of these files."""
    # weight matrices of layers in fp16, other tensors unchanged
    kinds = (nn.Linear, nn.Conv3d)
    half = {f"{name}.weight" for name, part in module.named_modules() if isinstance(part, kinds)}
    packed = {name: t.half() if name in half else t for name, t in module.state_dict().items()}
    digest = write_tensors(folder / f"{stem}.safetensors", packed, {})
    stored = copy.deepcopy(module).cpu()
    stored.load_state_dict(packed)  # export the rounded weights, which a reader of the file gets
    parts = stored.exports()
    for ending, data in parts.items():
        write_atomically(folder / f"{stem}{ending}", data)
    onnx = {ending: hashlib.sha256(data).hexdigest() for ending, data in parts.items()}
    about = {"format": FORMAT, **about, "weights_sha256": digest} | ({"onnx_sha256": onnx} if onnx else {})
    write_atomically(folder / f"{stem}.json", json.dumps(about, indent=1) + "\n", make_folder=True)


def _load(name: str, folder: FilePath) -> Any:
    """The network of a folder, frozen. Raises InputError if a file is missing or damaged."""
    about = read_description(folder, name)
    location = f"{folder / name}.json"
    weights = folder / f"{name}.safetensors"
    checked_bytes(weights, about.get("weights_sha256"), f"{name}.json")
    kind: Any = CompletionNetwork
    settings: Any = CompletionSettings
    if name != "completion":
        table, entry = (ENCODERS, about.get("network", "")) if name == "encoder" else (NETWORKS, name)
        kind = table.load(entry)
        settings = table.settings(entry)
    parts = [settings.from_json(about.get("settings"), f"{location}: settings")]
    if name in NETWORKS:
        parts.insert(0, RobotIdentity.from_json(about.get("robot"), f"{location}: robot"))
    try:
        network = kind(*parts)
    except (RuntimeError, TypeError, MemoryError, OverflowError) as error:
        # PyTorch's errors for impossible sizes
        raise InputError(
            f"{location}: no network can be made from these settings: {shortened(str(error))}"
        ) from None
    try:
        network.load_state_dict(read_tensors(weights)[0])
    except RuntimeError as error:
        raise InputError(f"{weights} does not fit its description: {str(error)[:200]}") from None
    return network.requires_grad_(False).eval()


def load_encoder(folder: str | FilePath) -> Encoder:
    """The trained encoder of a folder, frozen. Raises InputError if it is missing or damaged."""
    return _load("encoder", FilePath(folder))


def load_completion(folder: str | FilePath | None = None) -> CompletionNetwork:
    """The occupancy completion network of a folder, frozen; None: the network that comes with the package.

    Raises InputError for damaged files, and if there is no network, naming the command that trains it.
    """
    return _load("completion", completion_folder(folder))


def load_network(name: str, folder: str | FilePath | None, robot: Robot) -> Any:
    """The trained network of a folder, ready to use; None: with the weights that `weights_for` finds.

    Raises InputError if there is no network, naming the command that trains it, and for files that are
    damaged or made for another robot.
    """
    place = weights_folder(name, folder, robot)
    network = _loaded(name, place)
    network.robot.check(robot, str(place / f"{name}.json"))
    return network


_loaded = kept_by_stamp(_load)


def export_weights(folder: str | FilePath) -> list[str]:
    """Export all networks in a folder again from their weights. Returns the names of the networks.

    Raises InputError if the folder holds no network, or a damaged one.
    """
    place = FilePath(folder)
    written = list[str]()
    for name in ("completion", *NETWORKS):
        if not (place / f"{name}.json").is_file():
            continue
        about = read_description(place, name)
        about = {key: about[key] for key in about if not key.endswith("_sha256")}
        _save(_load(name, place), place, name, about)
        written.append(name)
    if not written:
        raise InputError(f"{folder} holds no trained network")
    return written
