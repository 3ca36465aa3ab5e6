"""The trained diffusion model as planning runs it: by ONNX Runtime, without PyTorch."""

from pathlib import Path

import numpy as np
import onnxruntime
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.motion_model import (
    Cloud,
    Conditions,
    Dropped,
    Embedding,
    Features,
    Levels,
    MotionModel,
    MotionModelSettings,
    Outputs,
    Statistics,
)
from robotdiffuse.learning.weight_files import (
    exported_files,
    identity,
    kept_by_stamp,
    read_arrays,
    read_description,
    weights_folder,
)
from robotdiffuse.robots.robot import Robot

EXTERNAL_DATA = b"\x0a\x08location"
"""Bytes in an ONNX file that keeps a tensor in another file: the key of an entry of `external_data`. ONNX
Runtime would look for that file in the current folder."""


class OnnxNetwork:
    """An exported network with one output."""

    def __init__(self, data: bytes, name: str) -> None:
        """data: contents of an .onnx file. name: the file's name, for messages. Raises InputError if ONNX
        Runtime cannot run the network."""
        if EXTERNAL_DATA in data:
            raise InputError(
                f"{name} keeps weights in another file, which is not read; export it in one file"
            )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3  # errors only
        try:
            self._session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime's own classes of errors have no common base
            raise InputError(f"{name} is no network that ONNX Runtime can run: {str(error)[:200]}") from None

    def __call__(self, **inputs: ndarray) -> ndarray:
        """The output for these inputs."""
        output = self._session.run(None, inputs)[0]
        assert isinstance(output, np.ndarray)
        return output


class ExportedModel(MotionModel):
    """The model of a folder with weights."""

    def __init__(self, name: str, folder: Path) -> None:
        """name: "model" or "trajectory_prior". Raises InputError, naming the file, for a missing or damaged
        file."""
        about = read_description(folder, name)
        location = str(folder / f"{name}.json")
        settings = MotionModelSettings.from_json(about.get("settings"), f"{location}: settings")
        super().__init__(identity(name, folder), settings)
        parts = exported_files(folder, name, about)
        needed = {".onnx"} if self.settings.encoder is None else {".onnx", ".encoder.onnx"}
        if parts.keys() != needed:
            raise InputError(
                f"{location} names the ONNX files {sorted(parts)}; it must name {sorted(needed)}"
            )
        networks = {ending: OnnxNetwork(data, f"{folder / name}{ending}") for ending, data in parts.items()}
        self._denoiser = networks[".onnx"]
        self._encoder = networks.get(".encoder.onnx")
        initial = Statistics.without_data(self.waypoints, self.dof)
        self.statistics = initial._replace(**read_arrays(folder, name, about, Statistics._fields))
        # networks and statistics must fit the description
        fits = [a.shape == b.shape for a, b in zip(self.statistics, initial, strict=True)]
        features = np.zeros((1, self.waypoints, self.feature_count), np.float32)
        condition = np.zeros((1, self.condition_count), np.float32)
        try:
            output = self.denoised(features, np.ones(1, np.float32), condition)
            fits.append(output.shape == (1, self.waypoints, self.dof))
            if self._encoder is not None:
                fits.append(self.encode(np.zeros((0, 3))).shape == (self.settings.code,))
        except Exception as error:  # ONNX Runtime's own classes of errors have no common base
            raise InputError(f"{location} does not fit its ONNX files: {str(error)[:200]}") from None
        if not all(fits):
            raise InputError(f"{location} does not fit its weights: they are for other sizes")

    def denoised(
        self,
        features: Features,
        level: Levels,
        condition: Conditions,
        dropped: Dropped | None = None,
    ) -> Outputs:
        """See `MotionModel`."""
        inputs = {"features": features, "level": level, "condition": condition}
        if self.settings.null_condition:
            inputs["dropped"] = np.zeros(len(features), np.bool_) if dropped is None else dropped
        return self._denoiser(**inputs)

    def embedding_of(self, cloud: Cloud) -> Embedding:
        """See `MotionModel`."""
        assert self._encoder is not None
        return self._encoder(cloud=cloud[None])[0]


def exported_model(name: str, folder: str | Path | None, robot: Robot) -> MotionModel:
    """The model of `folder`, loaded once; if `folder` is None, of the user's own or the bundled weights for
    the robot.

    name: "model" or "trajectory_prior". Raises InputError if there is no model, naming the command that
    trains it, and for files that are damaged or made for another robot.
    """
    place = weights_folder(name, folder, robot)
    model = _loaded(name, place)
    model.robot.check(robot, str(place / f"{name}.json"))
    return model


_loaded = kept_by_stamp(ExportedModel)
