"""The occupancy completion network, which predicts obstacles where no camera saw; trained on random
scenes."""

from collections.abc import Callable
from functools import cache
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

from jaxtyping import Float32
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.completion.samples import pack
from robotdiffuse.learning.weight_files import exported_files, read_description
from robotdiffuse.learning.weights_registry import completion_folder

if TYPE_CHECKING:
    from robotdiffuse.perception.observed_volume import ObservedVolume

Completion = Callable[[ndarray, ndarray], ndarray]
"""From a packed volume, as by `samples.pack`, to the probability of each voxel of 2 cm."""


def predict(volume: "ObservedVolume", network: Completion | None = None) -> Float32[ndarray, "112 112 64"]:
    """The probability that each voxel of 2 cm holds an obstacle.

    It is 0 in voxels that were seen free, and farther than 1 m from a Panda's shoulder, which training did
    not cover. The grid begins at the volume's LOW. network: None for the one that comes with the package.
    """
    return (network or exported_completion())(*pack(volume))


@cache
def exported_completion(folder: str | FilePath | None = None) -> Completion:
    """The network of a folder, loaded once; None: the one that comes with the package.

    Raises InputError for damaged files, and if there is none, naming the command that trains it.
    """
    from robotdiffuse.learning.onnx_session import OnnxNetwork  # imports ONNX Runtime

    place = completion_folder(folder)
    parts = exported_files(place, "completion", read_description(place, "completion"))
    if parts.keys() != {".onnx"}:
        raise InputError(
            f"{place / 'completion.json'} names the ONNX files {sorted(parts)}; it must name .onnx"
        )
    network = OnnxNetwork(parts[".onnx"], str(place / "completion.onnx"))
    return lambda seen, behind: network(seen=seen, behind=behind)
