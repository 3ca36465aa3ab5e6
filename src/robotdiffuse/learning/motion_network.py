"""The diffusion model as a PyTorch module, for training."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from torch import Tensor, nn

from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.denoisers import DENOISERS
from robotdiffuse.learning.denoisers.networks import Denoiser, TrajectoryTransformer
from robotdiffuse.learning.diffusion import noise_factor
from robotdiffuse.learning.encoders.networks import Encoder, fp32, make_encoder
from robotdiffuse.learning.motion_model import MotionModel, MotionModelSettings
from robotdiffuse.learning.network import Network, exported
from robotdiffuse.learning.representation import Statistics
from robotdiffuse.learning.robot_identity import RobotIdentity


class WaypointMeans(NamedTuple):
    """Means of blocks of waypoints; the first and the last waypoint are alone."""

    of_waypoints: Float[Tensor, "blocks waypoints"]
    """The matrix of the means."""
    interpolation: Float[Tensor, "waypoints blocks"]
    """The matrix of linear interpolation between the middles of the blocks."""
    centers: Float[ndarray, "blocks"]
    """Middles of the blocks [waypoints]."""

    @classmethod
    def of_blocks(cls, waypoints: int, block: int) -> "WaypointMeans":
        """Raises InputError unless blocks of that size divide the inner waypoints."""
        if (waypoints - 2) % block:
            raise InputError(
                f"waypoints is {waypoints}; blocks of {block} must divide the {waypoints - 2} inner ones"
            )
        index = np.r_[0, 1 + np.arange(waypoints - 2) // block, 1 + (waypoints - 2) // block]
        member = np.eye(index[-1] + 1)[:, index]
        means = member / member.sum(1, keepdims=True)
        at = np.arange(waypoints)
        centers = means @ at
        interpolation = np.stack([np.interp(at, centers, row) for row in np.eye(len(centers))], 1)
        return cls(torch.from_numpy(means).float(), torch.from_numpy(interpolation).float(), centers)

    def to(self, device: torch.device) -> "WaypointMeans":
        return WaypointMeans(self.of_waypoints.to(device), self.interpolation.to(device), self.centers)


class MotionNetwork(Network, MotionModel):
    """Encoder, denoiser, and the statistics of the training data."""

    settings: MotionModelSettings
    residual_scale: Tensor
    residual_mean: Tensor
    noise_factor: Tensor
    null_condition: nn.Parameter | None

    def __init__(self, robot: RobotIdentity, settings: MotionModelSettings) -> None:
        Network.__init__(self)
        MotionModel.__init__(self, robot, settings)
        fitted = self.target != "limits"
        for name, values in Statistics.without_data(self.waypoints, self.dof)._asdict().items():
            kept = fitted and (name != "residual_mean" or self.target == "absolute")
            self.register_buffer(name, torch.from_numpy(values), persistent=kept)
        self.encoder = (
            None if settings.encoder is None else make_encoder(settings.encoder, settings.encoder_settings)
        )
        sizes = self.waypoints, self.dof, self.feature_count, self.condition_count
        self.denoiser: Denoiser = DENOISERS.load(settings.denoiser)(settings.denoiser_settings, *sizes)
        self.block = 1
        """Waypoints whose mean the denoiser sees as one; see `coarsen`."""
        self._means = WaypointMeans.of_blocks(self.waypoints, 1)
        null = nn.Parameter(torch.zeros(self.condition_count)) if settings.null_condition else None
        self.register_parameter("null_condition", null)

    @property
    def statistics(self) -> Statistics:
        """See `TrajectoryRepresentation`; of a network on the CPU."""
        return Statistics(self.residual_scale.numpy(), self.residual_mean.numpy(), self.noise_factor.numpy())

    def fit_statistics(self, q: Float[ndarray, "n waypoints dof"], smooth_noise: bool) -> None:
        """Set scale, mean and covariance of the noise from trajectories [rad].

        The target `limits` has no such statistics: nothing happens.
        """
        if self.target == "limits":
            return
        self.residual_scale.fill_(1.0)
        self.residual_mean.fill_(0.0)
        if self.target == "absolute":
            x = self.normalize(q, self.reference(q[:, 0], q[:, -1]))
            self.residual_mean.copy_(torch.from_numpy(x[:, 1:-1].mean((0, 1))))
        x = self.normalize(q, self.reference(q[:, 0], q[:, -1]))
        scale = np.maximum(np.sqrt((x[:, 1:-1] ** 2).mean((0, 1))), 1e-4)
        self.residual_scale.copy_(torch.from_numpy(scale))
        self.noise_factor.copy_(torch.from_numpy(noise_factor(x / scale, smooth_noise)))

    def denoise(
        self,
        features: Float[Tensor, "batch waypoints features"],
        level: Float[Tensor, "batch"],
        condition: Float[Tensor, "batch condition"],
        dropped: Bool[Tensor, "batch"] | None = None,
    ) -> Float[Tensor, "batch waypoints dof"]:
        """`MotionModel.denoised` of tensors. Raises InputError for `dropped` unless the settings have
        `null_condition`."""
        if dropped is not None:
            if self.null_condition is None:
                raise InputError("null_condition of the model is False; its condition cannot be dropped")
            condition = torch.where(dropped[:, None], self.null_condition, condition)
        if self.block == 1:
            return self.denoiser(features, level, condition)
        with fp32(features):
            features = self._means.of_waypoints @ features
        output = self.denoiser(features, level, condition)
        with fp32(output):
            return self._means.interpolation @ output

    def coarsen(self, block: int) -> None:
        """Have the denoiser see the means of blocks of `block` waypoints; 1: single waypoints.

        For white noise and a transformer with a token per waypoint. The mean of white noise over a block is
        white noise again, so that a token tells as much as all its waypoints. The denoiser's output is
        interpolated to all waypoints.
        """
        if block == self.block:
            return
        assert isinstance(self.denoiser, TrajectoryTransformer)
        self.block = block
        self._means = WaypointMeans.of_blocks(self.waypoints, block).to(self.residual_scale.device)
        self.denoiser.set_positions(self._means.centers)

    def denoised(
        self,
        features: Float32[ndarray, "batch waypoints features"],
        level: Float32[ndarray, "batch"],
        condition: Float32[ndarray, "batch condition"],
        dropped: Bool[ndarray, "batch"] | None = None,
    ) -> Float32[ndarray, "batch waypoints dof"]:
        """See `MotionModel`."""
        hidden = None if dropped is None else torch.from_numpy(dropped)
        with torch.inference_mode(), one_thread():
            inputs = torch.from_numpy(features), torch.from_numpy(level), torch.from_numpy(condition)
            return self.denoise(*inputs, hidden).numpy()

    def code_of(self, cloud: Float32[ndarray, "points 3"]) -> Float32[ndarray, "code"]:
        """See `MotionModel`."""
        assert self.encoder is not None
        with torch.inference_mode(), one_thread():
            return self.encoder(torch.from_numpy(cloud)[None])[0].numpy()

    def exports(self) -> dict[str, bytes]:
        """The denoiser; and the encoder, if there is one."""
        inputs = {
            "features": torch.zeros(3, self.waypoints, self.feature_count),
            "level": torch.ones(3),
            "condition": torch.zeros(3, self.condition_count),
        }
        if self.null_condition is not None:
            inputs["dropped"] = torch.zeros(3, dtype=torch.bool)
        found = {".onnx": exported(_Denoise(self), inputs, {name: {0: "batch"} for name in inputs})}
        if self.encoder is not None:
            settings = self.encoder.settings
            cloud = {"cloud": torch.rand(1, settings.cloud, 3)}
            axes = {"cloud": {1: "points"}} if settings.any_size else {}
            found[".encoder.onnx"] = exported(_Encode(self.encoder), cloud, axes)
        return found

    def joints_at(
        self,
        x: Float[Tensor, "n waypoints dof"],
        base: Float[Tensor, "n waypoints dof"],
        at: list[int],
    ) -> Float[Tensor, "n {len(at)} dof"]:
        """Joint values [rad] of the waypoints with these indices, differentiable in x."""
        return self.from_unit(base[:, at] + x[:, at] * self.residual_scale)


class _Denoise(nn.Module):
    """`MotionNetwork.denoise` as a module, for export."""

    def __init__(self, network: MotionNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, features: Tensor, level: Tensor, condition: Tensor, dropped: Tensor | None = None
    ) -> Tensor:
        return self.network.denoise(features, level, condition, dropped)


class _Encode(nn.Module):
    """`Encoder.code_of_ordered` as a module, for export."""

    def __init__(self, encoder: Encoder) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, cloud: Tensor) -> Tensor:
        return self.encoder.code_of_ordered(cloud)


@contextmanager
def one_thread() -> Iterator[None]:
    """Runs PyTorch on one thread. For batches this small, synchronising a second thread costs more than it
    saves, and where other processes keep the cores busy it takes a hundred times as long."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
