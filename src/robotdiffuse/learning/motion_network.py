"""The diffusion model as a PyTorch module, for training."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor, nn

from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.denoisers import DENOISERS
from robotdiffuse.learning.denoisers.networks import Denoiser, TrajectoryTransformer
from robotdiffuse.learning.diffusion import noise_factor
from robotdiffuse.learning.encoders import make_encoder
from robotdiffuse.learning.encoders.networks import fp32
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
from robotdiffuse.learning.network import Network, exported
from robotdiffuse.learning.weight_files import RobotIdentity


def block_means(
    waypoints: int, block: int
) -> tuple[Float[Tensor, "blocks waypoints"], Float[Tensor, "waypoints blocks"], Float[ndarray, "blocks"]]:
    """The matrix that takes means of blocks of waypoints, the matrix that interpolates linearly between the
    middles of the blocks, and these middles as indices of waypoints. The first and the last waypoint are
    blocks of their own; `block` must divide waypoints - 2."""
    index = np.r_[0, 1 + np.arange(waypoints - 2) // block, 1 + (waypoints - 2) // block]
    member = np.eye(index[-1] + 1)[:, index]
    means = member / member.sum(1, keepdims=True)
    at = np.arange(waypoints)
    centers = means @ at
    interpolation = np.stack([np.interp(at, centers, row) for row in np.eye(len(centers))], 1)
    return torch.from_numpy(means).float(), torch.from_numpy(interpolation).float(), centers


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
        fitted = settings.target != "limits"
        for name, values in Statistics.without_data(self.waypoints, self.dof)._asdict().items():
            persistent = fitted and (name != "residual_mean" or settings.target == "absolute")
            self.register_buffer(name, torch.from_numpy(values), persistent=persistent)
        self.encoder = (
            None if settings.encoder is None else make_encoder(settings.encoder, settings.encoder_settings)
        )
        sizes = self.waypoints, self.dof, self.feature_count, self.condition_count
        self.denoiser: Denoiser = DENOISERS.load(settings.denoiser)(settings.denoiser_settings, *sizes)
        self.block = 1
        """Number of waypoints whose mean is one token of the denoiser; see `coarsen`."""
        null = nn.Parameter(torch.zeros(self.condition_count)) if settings.null_condition else None
        self.register_parameter("null_condition", null)

    @property
    def statistics(self) -> Statistics:
        """See `MotionModel`; the network must be on the CPU."""
        return Statistics(*(getattr(self, name).numpy() for name in Statistics._fields))

    def fit_statistics(self, q: Float[ndarray, "n waypoints dof"], smooth_noise: bool) -> None:
        """Set, from trajectories [rad], the scale of residuals, their mean (0 unless the target is
        `absolute`) and the factor of the noise.

        Sets nothing for the target `limits`, for which x is the joint values in units of their limits.
        """
        if self.settings.target == "limits":
            return
        self.residual_scale.fill_(1.0)
        self.residual_mean.fill_(0.0)
        x = self.normalize(q, self.reference(q[:, 0], q[:, -1]))
        if self.settings.target == "absolute":
            mean = x[:, 1:-1].mean((0, 1))
            self.residual_mean.copy_(torch.from_numpy(mean))
            x = x - mean
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
        """`MotionModel.denoised` for tensors. Raises InputError for `dropped` unless the settings have
        `null_condition`."""
        if dropped is not None:
            if self.null_condition is None:
                raise InputError("null_condition of the model is False; its condition cannot be dropped")
            condition = torch.where(dropped[:, None], self.null_condition, condition)
        if self.block == 1:
            return self.denoiser(features, level, condition)
        with fp32(features):
            features = self._means @ features
        output = self.denoiser(features, level, condition)
        with fp32(output):
            return self._interpolation @ output

    def coarsen(self, block: int) -> None:
        """Give the denoiser the means of blocks of `block` waypoints as its tokens; 1: single waypoints.

        The noise must be white, and the denoiser a transformer with a token per waypoint. The mean of white
        noise over a block is white noise again, with less variance. If the motion hardly changes within a
        block, the mean carries nearly as much information as the single waypoints. The denoiser's output is
        interpolated to all waypoints.
        """
        if block == self.block:
            return
        assert isinstance(self.denoiser, TrajectoryTransformer)
        self.block = block
        means, interpolation, centers = block_means(self.waypoints, block)
        self._means = means.to(self.residual_scale.device)
        self._interpolation = interpolation.to(self.residual_scale.device)
        self.denoiser.set_positions(centers)

    def denoised(
        self,
        features: Features,
        level: Levels,
        condition: Conditions,
        dropped: Dropped | None = None,
    ) -> Outputs:
        """See `MotionModel`."""
        dropped_mask = None if dropped is None else torch.from_numpy(dropped)
        with torch.inference_mode():
            inputs = torch.from_numpy(features), torch.from_numpy(level), torch.from_numpy(condition)
            return self.denoise(*inputs, dropped_mask).numpy()

    def embedding_of(self, cloud: Cloud) -> Embedding:
        """See `MotionModel`."""
        assert self.encoder is not None
        with torch.inference_mode():
            return self.encoder.code_of_ordered(torch.from_numpy(cloud)[None])[0].numpy()

    def exports(self) -> dict[str, bytes]:
        """The denoiser, and the encoder if the model has an encoder."""
        inputs = {
            "features": torch.zeros(3, self.waypoints, self.feature_count),
            "level": torch.ones(3),
            "condition": torch.zeros(3, self.condition_count),
        }
        if self.null_condition is not None:
            inputs["dropped"] = torch.zeros(3, dtype=torch.bool)
        files = {".onnx": exported(self, self.denoise, inputs, {name: {0: "batch"} for name in inputs})}
        if self.encoder is not None:
            settings = self.encoder.settings
            cloud = {"cloud": torch.rand(1, settings.cloud, 3)}
            axes = {"cloud": {1: "points"}} if settings.any_size else {}
            files[".encoder.onnx"] = exported(self.encoder, self.encoder.code_of_ordered, cloud, axes)
        return files

    def joints_at(
        self,
        x: Float[Tensor, "n waypoints dof"],
        base: Float[Tensor, "n waypoints dof"],
        at: list[int],
    ) -> Float[Tensor, "n {len(at)} dof"]:
        """Joint values [rad] of the waypoints with indices `at`, differentiable in x. base:
        `Reference.base`."""
        return self.from_unit(base[:, at] + x[:, at] * self.residual_scale)
