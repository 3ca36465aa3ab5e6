"""The diffusion model of trained weights, as planning runs it: by ONNX Runtime, without PyTorch."""

from functools import lru_cache
from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.motion_model import MotionModel, MotionModelSettings
from robotdiffuse.learning.onnx_session import OnnxNetwork
from robotdiffuse.learning.representation import Statistics
from robotdiffuse.learning.robot_identity import RobotIdentity
from robotdiffuse.learning.weight_files import exported_files, read_arrays, read_description, stamp
from robotdiffuse.learning.weights_registry import weights_folder
from robotdiffuse.robots.robot import Robot


class ExportedModel(MotionModel):
    """The model of a folder with weights."""

    def __init__(self, folder: FilePath, name: str) -> None:
        """name: in NETWORKS. Raises InputError, naming the file, if one is missing or damaged."""
        about, where = read_description(folder, name), str(folder / f"{name}.json")
        robot = RobotIdentity.from_json(about.get("robot"), f"{where}: robot")
        super().__init__(robot, MotionModelSettings.from_json(about.get("settings"), f"{where}: settings"))
        parts = exported_files(folder, name, about)
        needed = {".onnx"} if self.settings.encoder is None else {".onnx", ".encoder.onnx"}
        if parts.keys() != needed:
            raise InputError(f"{where} names the ONNX files {sorted(parts)}; it must name {sorted(needed)}")
        networks = {ending: OnnxNetwork(data, f"{folder / name}{ending}") for ending, data in parts.items()}
        self._denoiser, self._encoder = networks[".onnx"], networks.get(".encoder.onnx")
        initial = Statistics.without_data(self.waypoints, self.dof)
        self._statistics = initial._replace(**read_arrays(folder, name, about, Statistics._fields))
        self._check_sizes(where)

    def _check_sizes(self, where: str) -> None:
        """Raises InputError unless networks and statistics fit the description."""
        initial = Statistics.without_data(self.waypoints, self.dof)
        fits = [a.shape == b.shape for a, b in zip(self._statistics, initial, strict=True)]
        features = np.zeros((1, self.waypoints, self.feature_count), np.float32)
        condition = np.zeros((1, self.condition_count), np.float32)
        try:
            output = self.denoised(features, np.ones(1, np.float32), condition)
            fits.append(output.shape == (1, self.waypoints, self.dof))
            if self._encoder is not None:
                fits.append(self.code_of(np.zeros((0, 3), np.float32)).shape == (self.settings.code,))
        except Exception as error:  # ONNX Runtime's own classes of errors have no common base
            reason = " ".join(str(error).split())[:200]
            raise InputError(f"{where} does not fit its ONNX files: {reason}") from None
        if not all(fits):
            raise InputError(f"{where} does not fit its weights: they are for other sizes")

    @property
    def statistics(self) -> Statistics:
        """See `TrajectoryRepresentation`."""
        return self._statistics

    def denoised(
        self,
        features: Float32[ndarray, "batch waypoints features"],
        level: Float32[ndarray, "batch"],
        condition: Float32[ndarray, "batch condition"],
        dropped: Bool[ndarray, "batch"] | None = None,
    ) -> Float32[ndarray, "batch waypoints dof"]:
        """See `MotionModel`."""
        inputs = {"features": features, "level": level, "condition": condition}
        if self.settings.null_condition:
            inputs["dropped"] = np.zeros(len(features), np.bool_) if dropped is None else dropped
        return self._denoiser(**inputs)

    def code_of(self, cloud: Float32[ndarray, "points 3"]) -> Float32[ndarray, "code"]:
        """See `MotionModel`."""
        assert self._encoder is not None and self.settings.encoder_settings is not None
        return self._encoder(cloud=self.settings.encoder_settings.prepared(cloud)[None])[0]


def exported_model(name: str, folder: str | FilePath | None, robot: Robot) -> MotionModel:
    """The model of a folder, loaded once; None: of the weights found for the robot by `weights_for`.

    name: "model" or "trajectory_prior". Raises InputError if there is none, naming the command that trains
    it, and for files that are damaged or made for another robot.
    """
    place = weights_folder(name, folder, robot)
    return _checked(name, place, stamp(place, name), robot)


@lru_cache(maxsize=16)
def _checked(name: str, folder: FilePath, written: tuple[int, int] | None, robot: Robot) -> MotionModel:
    model = _loaded(name, folder, written)
    model.robot.check(robot, str(folder / f"{name}.json"))
    return model


@lru_cache(maxsize=16)
def _loaded(name: str, folder: FilePath, _stamp: tuple[int, int] | None) -> ExportedModel:
    return ExportedModel(folder, name)
