"""Files of trained networks, read without PyTorch.

NAME.json describes a network and holds the SHA-256 of its other files: NAME.safetensors, the weights that
training reads, and NAME.onnx and others with that ending, the exported parts that planning runs.
"""

import hashlib
import os
import struct
from collections.abc import Iterable
from pathlib import Path as FilePath
from typing import Any

from numpy import ndarray
from safetensors import SafetensorError
from safetensors.numpy import load

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.input_files import read_bytes, read_json

FORMAT = 2


def stamp(folder: FilePath, name: str) -> tuple[int, int] | None:
    """Time [ns] and inode of NAME.json, which is written last; None if there is none.

    Loaded networks are kept for as long as it stays the same.
    """
    try:
        status = (folder / f"{name}.json").stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_ino


def read_description(folder: FilePath, name: str) -> dict[str, Any]:
    """The contents of NAME.json. Raises InputError if it is missing or damaged."""
    file = folder / f"{name}.json"
    try:
        about = read_json(file)
    except InputError as error:
        if not os.path.lexists(file):
            raise InputError(f"{folder} holds no trained model: {file.name} is missing") from None
        raise InputError(f"{file} is damaged: {error}") from None
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise InputError(f"{file} is not a model description of format {FORMAT}")
    return about


def checked_bytes(file: FilePath, digest: object, description: str) -> bytes:
    """The contents of a file. Raises InputError if it cannot be read or its SHA-256 is not that of the
    description."""
    data = read_bytes(file, "weight file")
    if hashlib.sha256(data).hexdigest() != digest:
        raise InputError(f"{file} is damaged or does not belong to {description}: its SHA-256 differs")
    return data


def exported_files(folder: FilePath, name: str, about: dict[str, Any]) -> dict[str, bytes]:
    """The exported parts of a network by their ending. Raises InputError if there are none or one is
    damaged."""
    digests = about.get("onnx_sha256")
    if not isinstance(digests, dict) or not digests:
        raise InputError(
            f"{folder} holds weights of the network {name} without the ONNX files that planning runs; write "
            f"them: robotdiffuse train export {folder}"
        )
    return {
        ending: checked_bytes(folder / f"{name}{ending}", digest, f"{name}.json")
        for ending, digest in digests.items()
    }


def read_arrays(
    folder: FilePath, name: str, about: dict[str, Any], keys: Iterable[str]
) -> dict[str, ndarray]:
    """Those of the named tensors that NAME.safetensors holds. Raises InputError if it cannot be read."""
    file = folder / f"{name}.safetensors"
    data = checked_bytes(file, about.get("weights_sha256"), f"{name}.json")
    try:
        held = load(data)
    except (SafetensorError, ValueError, struct.error) as error:
        raise InputError(f"{file} is no safetensors file: {str(error).splitlines()[0]}") from None
    return {key: held[key] for key in keys if key in held}
