"""MotionModel: encoder, denoiser and sampler put together; all that planning needs of the learned part."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import ceil
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor, nn

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Bound, Count, OneOf, Positive, Settings, SettingsOf
from robotdiffuse.learning.denoisers import DENOISERS
from robotdiffuse.learning.denoisers.base import Denoiser, DenoiserSettings
from robotdiffuse.learning.denoisers.layers import Linear
from robotdiffuse.learning.denoisers.transformer import TransformerSettings
from robotdiffuse.learning.diffusion import NoiseSchedule, ScheduleSettings
from robotdiffuse.learning.encoders import ENCODERS, make_encoder
from robotdiffuse.learning.encoders.base import EncoderSettings
from robotdiffuse.learning.encoders.point_autoencoder import PointAutoencoderSettings
from robotdiffuse.learning.network import Network
from robotdiffuse.learning.objectives import OBJECTIVES, objective_for
from robotdiffuse.learning.parametrization import PARAMETRIZATIONS, parametrization
from robotdiffuse.learning.representation import TARGETS, Between, TrajectoryRows
from robotdiffuse.learning.robot_identity import RobotIdentity
from robotdiffuse.learning.samplers import SAMPLERS
from robotdiffuse.learning.samplers.sampler import Predict, Sampler

MAX_POINTS = 2048
"""Larger clouds are thinned to this many points by chance before they are encoded; to as many as an encoder
is for, if it is not for clouds of any size."""

BLEND = 1 / 6
"""Share of a trajectory over which predictions blend into known waypoints. Over all of it, small errors of
the network at these grow into detours; over less, the path turns at once where they end."""

ClearanceFn = Callable[[ndarray], ndarray]
"""Joint values [count, rows, dof] (float32) to clearances of the links, [count, rows, links] [m]; for a model
that sees gradients, to [count, rows, links + dof], see `CollisionChecker.clearances_and_gradients`."""
GuideFn = Callable[[ndarray, float], ndarray]
"""Predicted joint values [count, waypoints, dof] (float32), noise level in (0, 1]; to improved joint
values."""


MOST_WAYPOINTS = 4096.0
"""Matrices are made whose sides are as long."""


@dataclass(frozen=True)
class ModelParts(Settings):
    """What a model and its training are told alike."""

    waypoints: Annotated[int, Bound(least=3.0, most=MOST_WAYPOINTS)] = 48
    """Waypoints of a trajectory, evenly spaced along it (joint-space length; paper: 254)."""
    denoiser: Annotated[str, OneOf(DENOISERS)] = "transformer"
    schedule: ScheduleSettings = field(default_factory=ScheduleSettings)
    sampler: Annotated[str, OneOf(SAMPLERS)] = "ddim"
    """How it is sampled unless something else is asked for: ddpm (the paper's), ddim, dpm_solver or euler."""
    sampling_steps: Count | None = 6
    """Calls of the denoiser for a batch; None: all levels of the schedule (the paper's)."""
    parametrization: Annotated[str, OneOf(PARAMETRIZATIONS)] = "waypoints"
    """What the rows are that are diffused: waypoints (the paper's), or b_spline control points."""
    rows: Annotated[int, Bound(least=1.0, most=MOST_WAYPOINTS)] | None = None
    """As many; None: as there are waypoints."""
    target: Annotated[str, OneOf(TARGETS)] = "residual"
    """What rows are relative to: the straight line from start to goal (residual), the mean of the data
    (absolute, the paper's), or nothing: joint values in units of their limits (limits)."""
    objective: Annotated[str, OneOf(OBJECTIVES)] = "clean"
    """What the network predicts: clean (the paper's), noise or velocity."""
    sees_clearances: bool = True
    """Whether the denoiser is told the clearances of the links along the noisy trajectory (beyond the
    paper)."""
    sees_gradients: bool = False
    """Whether it is told too which way the joints would take the arm too close to obstacles, see
    `CollisionChecker.clearances_and_gradients`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sees_gradients and not self.sees_clearances:
            raise InputError(
                "sees_gradients is True and sees_clearances is False; gradients need clearances too"
            )
        schedule = NoiseSchedule(self.schedule)
        objective_for(self.objective, schedule)
        if self.sampling_steps is not None:
            schedule.sampling_levels(self.sampling_steps)
        parametrization(self.parametrization, self.waypoints, self.rows or self.waypoints)


@dataclass(frozen=True)
class MotionModelSettings(ModelParts, name="model"):
    """What the model is made of, and how it is sampled unless something else is asked for."""

    clearance_low: float = -0.1
    """Clearances are clipped to this range before the denoiser sees them [m]."""
    clearance_high: float = 0.4
    encoder: Annotated[str, OneOf(ENCODERS)] | None = "point_autoencoder"
    """Of the scene; None for a prior, which is told neither scene nor ends: it finds the ends in the noisy
    trajectory, where they are held."""
    encoder_settings: Annotated[EncoderSettings | None, SettingsOf("encoder", ENCODERS)] = field(
        default_factory=PointAutoencoderSettings
    )
    denoiser_settings: Annotated[DenoiserSettings, SettingsOf("denoiser", DENOISERS)] = field(
        default_factory=TransformerSettings
    )
    null_condition: bool = False
    """Whether the model has a learned stand-in for a dropped condition, for classifier-free guidance."""
    gradient_margin: Positive = 0.1
    """Closer than this is too close [m]."""
    gradient_unit: Positive = 2.0
    """Such gradients are told as 1, and larger ones too [m/rad]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.encoder is None) != (self.encoder_settings is None):
            raise InputError(
                f"model.encoder is {self.encoder} and encoder_settings are {self.encoder_settings}; "
                "either both are None or neither"
            )
        if self.encoder is None and self.denoiser == "encoder_decoder":
            raise InputError("model.denoiser is encoder_decoder and encoder is None; it needs a condition")

    @property
    def network(self) -> str:
        """The name in NETWORKS that it is kept by."""
        return "trajectory_prior" if self.encoder is None else "model"

    @property
    def code(self) -> int:
        """Size of z."""
        return 0 if self.encoder_settings is None else self.encoder_settings.code


class MotionModel(TrajectoryRows, Network):
    """The diffusion model over trajectories, which are rows of numbers as in `TrajectoryRows`."""

    settings: MotionModelSettings
    null_condition: nn.Parameter | None

    def __init__(self, robot: RobotIdentity, settings: MotionModelSettings) -> None:
        waypoints = settings.waypoints
        rows = parametrization(settings.parametrization, waypoints, settings.rows or waypoints)
        super().__init__(robot.normalizer(), rows, settings.target, waypoints)
        self.robot, self.settings = robot, settings
        self.schedule = NoiseSchedule(settings.schedule)
        self.objective = objective_for(settings.objective, self.schedule)
        self.encoder = (
            None if settings.encoder is None else make_encoder(settings.encoder, settings.encoder_settings)
        )
        condition = 1 if self.encoder is None else settings.code + 2 * self.dof
        features = (1 if self.plain else 2) * self.dof + (len(robot.links) if settings.sees_clearances else 0)
        features += self.dof if settings.sees_gradients else 0
        self.denoiser: Denoiser = DENOISERS.load(settings.denoiser)(
            settings.denoiser_settings, self.rows, self.dof, features, condition
        )
        null = nn.Parameter(torch.zeros(condition)) if settings.null_condition else None
        self.register_parameter("null_condition", null)

    def for_inference(self) -> "MotionModel":
        """Freeze, and keep the denoiser's matrices in bf16 where the CPU multiplies it fast. Returns self."""
        super().for_inference()
        if torch.cpu._is_avx512_bf16_supported():
            for module in self.denoiser.modules():
                if isinstance(module, Linear):
                    module.to(torch.bfloat16)
        return self

    def encode(
        self, points: Float[ndarray, "n 3"], rng: np.random.Generator | None = None
    ) -> Float[ndarray, "code"]:
        """z of a point cloud of the obstacles' surfaces (base frame, [m]); no point at all is a scene too.

        Of no numbers for a model without an encoder.
        """
        if self.encoder is None:
            return np.zeros(0, np.float32)
        points = np.asarray(points, np.float32).reshape(-1, 3)
        points = points[self.encoder.settings.region.holds(points)]
        most = MAX_POINTS if self.encoder.any_size else self.encoder.settings.cloud
        if len(points) > most:
            rng = np.random.default_rng(0) if rng is None else rng
            points = points[rng.choice(len(points), most, replace=False)]
        with torch.inference_mode(), one_thread():
            return self.encoder(torch.from_numpy(points)[None])[0].numpy()

    def features(
        self, x: Float[ndarray, "batch rows dof"], between: Between, clearances: ClearanceFn
    ) -> Float[ndarray, "batch rows features"]:
        """The denoiser's input for noisy rows: the rows, normalised joint values where these are others,
        clearances of the links and gradients, each as far as it sees them."""
        unit = self.at_sites(x, between)
        parts = [x] if self.plain else [x, unit]
        if not self.settings.sees_clearances:
            return np.concatenate(parts, axis=-1)
        low, high = self.settings.clearance_low, self.settings.clearance_high
        told = clearances(self.normalizer.from_unit(unit))
        near = np.clip(told[..., : len(self.robot.links)], low, high)
        near = (near - (low + high) / 2) * (2 / (high - low))
        parts.append(near.astype(np.float32, copy=False))
        if self.settings.sees_gradients:
            parts.append(np.clip(told[..., -self.dof :] / np.float32(self.settings.gradient_unit), -1, 1))
        return np.concatenate(parts, axis=-1)

    def condition(
        self,
        code: Float[ndarray, "*batch code"],
        start: Float[ndarray, "*batch dof"],
        goal: Float[ndarray, "*batch dof"],
    ) -> Float[ndarray, "*batch condition"]:
        """C = [z, start, goal], normalised; without an encoder one zero, for the denoisers want a number."""
        if self.encoder is None:
            return np.zeros((*np.shape(start)[:-1], 1), np.float32)
        ends = [self.normalizer.to_unit(np.asarray(q, np.float32)) for q in (start, goal)]
        return np.concatenate([code, *ends], axis=-1)

    def denoise(
        self,
        features: Float[Tensor, "batch rows features"],
        level: Float[Tensor, "batch"],
        condition: Float[Tensor, "batch condition"],
        dropped: Bool[Tensor, "batch"] | None = None,
    ) -> Float[Tensor, "batch rows dof"]:
        """What the denoiser predicts.

        dropped: samples whose condition is hidden from it (Ho and Salimans 2022; paper: C is randomly
            masked). What the features say of ends and clearances stays. Needs `settings.null_condition`.
        """
        if dropped is not None:
            if self.null_condition is None:
                raise InputError("null_condition of the model is False; it cannot do without its condition")
            condition = torch.where(dropped[:, None], self.null_condition, condition)
        return self.denoiser(features, level, condition)

    def denoise_guided(
        self,
        features: Float[Tensor, "batch rows features"],
        level: Float[Tensor, "batch"],
        condition: Float[Tensor, "batch condition"],
        scale: float,
    ) -> Float[Tensor, "batch rows dof"]:
        """Classifier-free guidance: u + scale (c - u), of the predictions c with the condition and u without.

        1 is the prediction with it, 0 without it, both at no cost; other scales take a batch of twice the
        size.
        """
        if scale == 1.0:
            return self.denoise(features, level, condition)
        if scale == 0.0:
            return self.denoise(features, level, condition, torch.ones_like(level, dtype=torch.bool))
        dropped = torch.arange(2 * len(level), device=level.device) >= len(level)
        twice = torch.cat([features] * 2), torch.cat([level] * 2), torch.cat([condition] * 2)
        with_it, without = self.denoise(*twice, dropped).chunk(2)
        return without + scale * (with_it - without)

    def sample(
        self,
        code: Float[ndarray, "code"] | None,
        start: Float[ndarray, "dof"],
        goal: Float[ndarray, "dof"],
        count: int,
        rng: np.random.Generator,
        clearances: ClearanceFn,
        steps: int | None = None,
        guide: GuideFn | None = None,
        eta: float = 0.0,
        guidance_scale: float = 1.0,
        sampler: str | None = None,
        guided_share: float = 0.5,
        prefix: Float[ndarray, "k dof"] | None = None,
        suffix: Float[ndarray, "m dof"] | None = None,
    ) -> Float[ndarray, "count waypoints dof"]:
        """Trajectories from start to goal [rad] (float64, the ends exact), of a model from `load_model`.

        code: z of the scene, from `encode`; None: the condition is hidden, as by a guidance_scale of 0.
        clearances: see ClearanceFn.
        steps: calls of the denoiser; None: as many as the checkpoint names.
        guide: improves the predicted clean trajectories in some of the steps (paper, section Motion Guided
            Generation). It need not keep the ends, but should keep more known waypoints, and move away from
            them smoothly.
        eta: share of fresh noise per step, see `ddim`.
        guidance_scale: of classifier-free guidance, see `denoise_guided`; only 1 for a model that was trained
            without dropping its condition.
        sampler: name in SAMPLERS; None: the one that the checkpoint names.
        guided_share: share of the steps that are guided, the last ones: 0 none, 1 all.
        prefix: known first waypoints [rad], from the start on; None: the start alone.
        suffix: known last waypoints [rad], up to the goal; None: the goal alone.

        Known waypoints are in the result as they are. Like the ends, they are written over the noisy and the
        predicted trajectories, and what is unknown moves along by `regression`, so that with smooth noise the
        result goes on from them in a step like its others: with the Panda's weights and 8 known waypoints at
        most 1.8 times as long as the last known one or the median of the others (10.7 times where they are
        written over, no more). With white noise, the paper's, nothing is promised. Training knew the ends
        alone, so known waypoints should be such as the model would have sampled: of a path like its own,
        about as far apart. An arm that plans anew while it moves follows what it is committed to, and goes
        on:

            prefix = moving[i : i + 6]
            q = model.sample(
                code, prefix[0], goal, 16, rng, clearances, prefix=prefix,
                guide=lambda q, level: guidance(q, 4, prefix=6)[0],
            )
        """
        if code is None:
            code, guidance_scale = np.zeros(self.settings.code, np.float32), 0.0
        if guidance_scale != 1.0 and not self.settings.null_condition:
            raise InputError(
                f"guidance_scale is {guidance_scale}; it must be 1, for this model was trained with "
                "condition_drop 0 and knows no motions without a condition"
            )
        sampler = self.settings.sampler if sampler is None else sampler
        draw: Sampler = SAMPLERS.load(sampler)
        if not 0 <= guided_share <= 1:
            raise InputError(f"guided_share is {guided_share}; it must be between 0 and 1")
        steps = steps or self.settings.sampling_steps or self.schedule.steps
        prefix, suffix = (
            known_waypoints("prefix", prefix, start, 0),
            known_waypoints("suffix", suffix, goal, -1),
        )
        between = self.around(prefix, suffix)
        far = self.regression(between)
        predicted = self.predictor(between, self.condition(code, start, goal), clearances, guidance_scale)
        unguided = steps - ceil(guided_share * steps - 1e-9)
        guided: Int[ndarray, "n"] = self.schedule.sampling_levels(steps)[unguided:-1]

        def draw_noise() -> ndarray:
            noise = self.draw_noise(count, rng)
            return noise if far is None else noise - far @ noise

        def predict(x: ndarray, level: int) -> ndarray:
            clean = predicted(x, level)
            if guide is not None and level in guided:
                at = level / self.schedule.steps
                clean = self.to_rows(guide(self.joints(clean, between), at), between)
            return clean

        with torch.inference_mode(), one_thread():
            x = draw(predict, self.schedule, draw_noise, steps, eta)
        q = self.joints(x, between).astype(np.float64)
        np.clip(q, self.robot.lower, self.robot.upper, out=q)
        q[:, : len(prefix)], q[:, len(q[0]) - len(suffix) :] = prefix, suffix
        return q

    def predictor(
        self,
        between: Between,
        condition: Float[ndarray, "*batch condition"],
        clearances: ClearanceFn,
        guidance_scale: float = 1.0,
    ) -> Predict:
        """What samplers call: the clean rows predicted for noisy ones, the known rows held in both.

        guidance_scale: see `denoise_guided`. To be called in inference mode.
        """
        far, near = self.regression(between), self.regression(between, BLEND * self.rows)
        signal, noise = (a.astype(np.float32) for a in (self.schedule.signal, self.schedule.noise))
        given = torch.from_numpy(condition)

        def follow(x: ndarray, regression: ndarray | None) -> ndarray:
            if regression is not None:
                x += regression @ (self.hold(x.copy(), between) - x)
            return self.hold(x, between)

        def predict(x: ndarray, level: int) -> ndarray:
            x = follow(x.copy(), far)
            inputs = torch.from_numpy(self.features(x, between, clearances))
            at = torch.full((len(x),), level / self.schedule.steps)
            output = self.denoise_guided(inputs, at, given.expand(len(x), -1), guidance_scale).numpy()
            return follow(self.within(self.objective.clean(x, output, signal[level], noise[level])), near)

        return predict


def known_waypoints(
    name: str, waypoints: Float[ndarray, "k dof"] | None, end: Float[ndarray, "dof"], at: int
) -> Float[ndarray, "k dof"]:
    """Known waypoints, or the end alone for None. Raises InputError unless waypoint `at` of them is the
    end."""
    if waypoints is None:
        return end[None]
    if not len(waypoints) or not np.array_equal(waypoints[at], end):
        raise InputError(
            f"{name} must have the {'start' if at == 0 else 'goal'} as waypoint {at}, {end.tolist()}"
        )
    return waypoints


@contextmanager
def one_thread() -> Iterator[None]:
    """PyTorch on one thread: for work this small, waiting for a second costs more than it saves, and where
    other processes keep the cores busy it takes a hundred times as long."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
