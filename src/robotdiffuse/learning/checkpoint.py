"""Writes and reads files of trained networks with PyTorch; `weight_files` describes their content.

All networks are written and read in the same way: the diffusion model, the baselines' networks, the encoder
that is trained alone and the completion network. Encoder and completion network belong to no robot. Files are
written atomically.
"""

import copy
import hashlib
import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import nn

from robotdiffuse.core.errors import InputError, described
from robotdiffuse.core.files import JsonObject, write_atomically
from robotdiffuse.learning.completion_network import CompletionNetwork
from robotdiffuse.learning.encoders import ENCODERS, encoder_name
from robotdiffuse.learning.encoders.networks import Encoder
from robotdiffuse.learning.network import Network, SavedModule
from robotdiffuse.learning.weight_files import (
    FORMAT,
    NETWORKS,
    checked_bytes,
    completion_folder,
    identity,
    kept_by_stamp,
    read_description,
    weights_folder,
)
from robotdiffuse.robots.robot import Robot


def fingerprint(module: nn.Module) -> str:
    """The first 16 digits of the SHA-256 of weights and buffers."""
    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        data = tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8)
        digest.update(name.encode() + data.numpy().tobytes())
    return digest.hexdigest()[:16]


def save_network(name: str, network: Any, folder: str | Path, training: JsonObject) -> None:
    """Write NAME.safetensors, NAME.json and the ONNX files; `name` as in NETWORKS, or "encoder".

    training: information for people, such as the data's fingerprint and the number of samples.
    """
    about: JsonObject = {"network": encoder_name(network) if isinstance(network, Encoder) else name}
    if isinstance(network, Network):
        about["robot"] = network.robot.to_json()
    about |= {"settings": network.settings.to_json(), "training": training}
    _save(network, Path(folder), name, about)


def _save(module: SavedModule, folder: Path, stem: str, about: JsonObject) -> None:
    """Write STEM.safetensors, the ONNX files, and last STEM.json with the SHA-256 of these files."""
    # weight matrices of layers in fp16, other tensors unchanged
    kinds = (nn.Linear, nn.Conv3d)
    half = {f"{name}.weight" for name, part in module.named_modules() if isinstance(part, kinds)}
    packed = {name: t.half() if name in half else t for name, t in module.state_dict().items()}
    weights = save({name: tensor.detach().contiguous() for name, tensor in packed.items()})
    digest = hashlib.sha256(weights).hexdigest()
    write_atomically(folder / f"{stem}.safetensors", weights, make_folder=True)
    stored = copy.deepcopy(module).cpu()
    stored.load_state_dict(packed)  # export the rounded weights, which a reader of the file gets
    parts = stored.exports()
    for ending, data in parts.items():
        write_atomically(folder / f"{stem}{ending}", data)
    onnx = {ending: hashlib.sha256(data).hexdigest() for ending, data in parts.items()}
    about = {"format": FORMAT, **about, "weights_sha256": digest} | ({"onnx_sha256": onnx} if onnx else {})
    write_atomically(folder / f"{stem}.json", json.dumps(about, indent=1) + "\n", make_folder=True)


def _load(name: str, folder: Path) -> Any:
    """The network of a folder, frozen. Raises InputError if a file is missing or damaged."""
    about = read_description(folder, name)
    location = f"{folder / name}.json"
    weights = folder / f"{name}.safetensors"
    data = checked_bytes(weights, about.get("weights_sha256"), f"{name}.json")
    table, entry = (ENCODERS, about.get("network", "")) if name == "encoder" else (NETWORKS, name)
    kind = table.load(entry)
    settings: Any = table.settings(entry)
    arguments = [settings.from_json(about.get("settings"), f"{location}: settings")]
    if issubclass(kind, Network):
        arguments.insert(0, identity(name, folder))
    try:
        network = kind(*arguments)
    except (RuntimeError, TypeError, MemoryError, OverflowError) as error:
        # PyTorch's errors for impossible sizes
        raise InputError(
            f"{location}: no network can be made from these settings: {described(error)}"
        ) from None
    try:
        network.load_state_dict(load(data))
    except (RuntimeError, SafetensorError) as error:
        raise InputError(f"{weights} does not fit its description: {str(error)[:200]}") from None
    # PyTorch's default may be another type
    return network.float().requires_grad_(False).eval()


def load_encoder(folder: str | Path) -> Encoder:
    """The trained encoder of a folder, frozen. Raises InputError if it is missing or damaged."""
    return _load("encoder", Path(folder))


def load_completion(folder: str | Path | None = None) -> CompletionNetwork:
    """The occupancy completion network of a folder, frozen; None: the network that comes with the package.

    Raises InputError for damaged files, and if there is no network, naming the command that trains it.
    """
    return _load("completion", completion_folder(folder))


def load_network(name: str, folder: str | Path | None, robot: Robot) -> Any:
    """The trained network of the folder that `weights_folder` finds, ready to use.

    Raises InputError if there is no network, naming the command that trains it, and for files that are
    damaged or made for another robot.
    """
    place = weights_folder(name, folder, robot)
    network = _loaded(name, place)
    network.robot.check(robot, str(place / f"{name}.json"))
    return network


_loaded = kept_by_stamp(_load)


def export_weights(folder: str | Path) -> list[str]:
    """Export all networks in a folder again from their weights. Returns the names of the networks.

    Raises InputError if the folder holds no network, or a damaged one.
    """
    place = Path(folder)
    written = list[str]()
    for name in NETWORKS:
        if not (place / f"{name}.json").is_file():
            continue
        about = read_description(place, name)
        about = {key: about[key] for key in about if not key.endswith("_sha256")}
        _save(_load(name, place), place, name, about)
        written.append(name)
    if not written:
        raise InputError(f"{folder} holds no trained network")
    return written
