"""MotionModel: the learned part of planning, which combines encoder, denoiser and sampler.

Everything here is NumPy. The encoder and the denoiser are functions that a subclass provides: exported
networks in planning (`exported_model`), PyTorch modules in training (`motion_network`).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from math import ceil
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.batched_clearances import packed_clearances_and_gradients
from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Bound, Count, OneOf, Settings, SettingsOf, Share
from robotdiffuse.core.types import Configuration, Points
from robotdiffuse.learning.denoisers import DENOISERS, DenoiserSettings, TransformerSettings
from robotdiffuse.learning.diffusion import (
    OBJECTIVES,
    SAMPLERS,
    NoiseSchedule,
    Predict,
    ScheduleSettings,
    white_noise_factor,
)
from robotdiffuse.learning.encoders import ENCODERS, EncoderSettings, PointAutoencoderSettings
from robotdiffuse.learning.weight_files import RobotIdentity
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.packed_scenes import PackedScenes

Joints = Float[ndarray, "*batch dof"]
Trajectories = Float[ndarray, "*batch waypoints dof"]
Features = Float32[ndarray, "batch waypoints features"]
Levels = Float32[ndarray, "batch"]
Conditions = Float32[ndarray, "batch condition"]
Outputs = Float32[ndarray, "batch waypoints dof"]
Dropped = Bool[ndarray, "batch"]
Cloud = Float32[ndarray, "points 3"]
Embedding = Float32[ndarray, "code"]
TARGETS = ("residual", "absolute", "limits")


class Reference(NamedTuple):
    """The trajectory that the diffused variable x (see `MotionModel`) is relative to, and the fixed first and
    last waypoint of x."""

    base: Trajectories
    """Normalized joint values; x stands for the trajectory `base + residual_scale * x`."""
    start: Float[ndarray, "*batch 1 dof"]
    """The first waypoint of x."""
    goal: Float[ndarray, "*batch 1 dof"]
    """The last waypoint of x."""


class Statistics(NamedTuple):
    """Statistics of the training data, by which x is scaled; float32."""

    residual_scale: Configuration
    """Standard deviation of the trajectories about their reference, in units of the joint limits."""
    residual_mean: Configuration
    """Mean of the trajectories in units of the joint limits, for the target `absolute`; else zero."""
    noise_factor: Float[ndarray, "waypoints waypoints"]
    """Matrix that turns white noise into the noise of the forward process, see `diffusion.noise_factor`."""

    @staticmethod
    def without_data(waypoints: int, dof: int) -> "Statistics":
        """Statistics that change nothing: for the target `limits`, and for any target before training."""
        white = white_noise_factor(waypoints).astype(np.float32)
        return Statistics(np.ones(dof, np.float32), np.zeros(dof, np.float32), white)


@dataclass(frozen=True)
class SamplingSettings(Settings, name="sampling"):
    samples: Count = 16
    """Number of trajectories in a batch."""
    sampling_steps: Count | None = None
    """Number of calls of the denoiser for a batch; None: the number that is stored with the weights."""
    sampler: Annotated[str, OneOf(SAMPLERS)] | None = None
    """Name in `learning.diffusion.SAMPLERS`; None: the sampler that is stored with the weights."""
    eta: Share = 0.0
    """Amount of new noise in each denoising step: 0 is DDIM, 1 is ancestral sampling. Ignored by the sampler
    ddpm, for which it is 1."""
    guided_share: Share = 0.5
    """Share of the denoising steps, the last ones, that the `guide` of `MotionModel.sample` improves: 0 none,
    1 all (the paper's)."""
    guidance_scale: float = 1.0
    """Scale of classifier-free guidance: 1 uses the network's prediction as it is, larger values strengthen
    the condition, 0 ignores it. Values other than 1 need weights that were trained with a condition_drop
    above 0."""


MIN_CLEARANCE = -0.1
MAX_CLEARANCE = 0.4
"""Clearances are clipped to this range before they enter the denoiser [m]."""
GRADIENT_MARGIN = 0.1
"""Only links closer to an obstacle than this contribute to the gradients [m]."""
GRADIENT_UNIT = 2.0
"""Gradients are divided by this and clipped to [-1, 1] before they enter the denoiser [m/rad]."""
MAX_POINTS = 2048
"""Clouds with more points are reduced to this many random points before they are encoded; for an encoder that
needs clouds of a fixed size, to that size."""

ClearanceFn = Callable[[ndarray], ndarray]
"""A function from joint values [count, waypoints, dof] (float32) to the clearances of the links [count,
waypoints, links] [m]. For a model with `clearance_gradients` it returns [count, waypoints, links + dof], see
`CollisionChecker.clearances_and_gradients`."""
GuideFn = Callable[[ndarray, float], ndarray]
"""A function from predicted joint values [count, waypoints, dof] (float32) and the noise level in (0, 1] to
improved joint values."""


Waypoints = Annotated[int, Bound(least=3.0, most=4096.0)]
"""A number of waypoints. The upper bound limits the memory of the waypoints x waypoints matrices."""


@dataclass(frozen=True)
class ModelParts(Settings):
    """The settings that a model and its training have in common."""

    waypoints: Waypoints = 48
    """Number of waypoints of a trajectory, evenly spaced in joint-space length (paper: 254)."""
    denoiser: Annotated[str, OneOf(DENOISERS)] = "transformer"
    schedule: ScheduleSettings = field(default_factory=ScheduleSettings)
    sampler: Annotated[str, OneOf(SAMPLERS)] = "ddim"
    """Default sampler: ddim, or ddpm (the paper's)."""
    sampling_steps: Count | None = 6
    """Default number of calls of the denoiser for a batch; None: all levels of the schedule (the paper's)."""
    target: Annotated[str, OneOf(TARGETS)] = "residual"
    """What trajectories are relative to: the straight line from start to goal (residual), the mean of the
    data (absolute, the paper's), or nothing: joint values in units of their limits (limits)."""
    objective: Annotated[str, OneOf(OBJECTIVES)] = "clean"
    """What the network predicts: the clean trajectory (clean, the paper's) or the noise."""
    clearance_features: bool = True
    """Whether the links' clearances along the noisy trajectory are network inputs; the paper's network has no
    such inputs."""
    clearance_gradients: bool = False
    """Whether gradients are network inputs as well: the direction in joint space that brings the arm closer
    to obstacles, see `CollisionChecker.clearances_and_gradients`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.clearance_gradients and not self.clearance_features:
            raise InputError(
                "clearance_gradients is True and clearance_features is False; gradients need clearances too"
            )
        if self.sampling_steps is not None:
            NoiseSchedule(self.schedule).sampling_levels(self.sampling_steps)


def check_points(where: str, encoder: str | None, denoiser: str) -> None:
    """Raises InputError if only one of encoder and denoiser works on points. where: name of the setting that
    holds the encoder, for the message."""
    if (encoder == "points") != (denoiser == "cross_attention"):
        raise InputError(
            f"{where} is {encoder} and denoiser is {denoiser}; "
            "the encoder points and the denoiser cross_attention need each other"
        )


@dataclass(frozen=True)
class MotionModelSettings(ModelParts, name="model"):
    """The parts of the model and its defaults for sampling."""

    encoder: Annotated[str, OneOf(ENCODERS)] | None = "point_autoencoder"
    """Encoder of the scene. None for a prior, which has no condition: it reads start and goal from the ends
    of the noisy trajectory."""
    encoder_settings: Annotated[EncoderSettings | None, SettingsOf("encoder", ENCODERS)] = field(
        default_factory=PointAutoencoderSettings
    )
    denoiser_settings: Annotated[DenoiserSettings, SettingsOf("denoiser", DENOISERS)] = field(
        default_factory=TransformerSettings
    )
    null_condition: bool = False
    """Whether the model has a learned stand-in for a dropped condition, for classifier-free guidance."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.encoder is None) != (self.encoder_settings is None):
            raise InputError(
                f"model.encoder is {self.encoder} and encoder_settings are {self.encoder_settings}; "
                "either both are None or neither"
            )
        if self.encoder is None and self.denoiser == "encoder_decoder":
            raise InputError("model.denoiser is encoder_decoder and encoder is None; it needs a condition")
        check_points("model.encoder", self.encoder, self.denoiser)

    @property
    def network(self) -> str:
        """The model's name in NETWORKS."""
        return "trajectory_prior" if self.encoder is None else "model"

    @property
    def code(self) -> int:
        """Size of z, the embedding of the scene; 0 without an encoder."""
        return 0 if self.encoder_settings is None else self.encoder_settings.code


class MotionModel(ABC):
    """The diffusion model over trajectories.

    The diffused variable x is a trajectory: its waypoints, normalized, relative to a reference, and scaled.
    With the targets `residual` and `absolute`, x is in units of the training data's standard deviation, and
    relative to the straight line from start to goal (residual) or to the mean of the data (absolute, the
    paper's). With the target `limits`, x is the joint values scaled so that their limits are -1 and 1, the
    noise is white, and nothing is taken from the data, as in MPD and EDMP. The first and the last waypoint
    are start and goal: they are written over the ends of x at every step (the paper's noise interpolation).
    """

    statistics: Statistics
    """The statistics of the training data; a subclass sets or computes them."""

    def __init__(self, robot: RobotIdentity, settings: MotionModelSettings) -> None:
        self.robot = robot
        self.settings = settings
        self.normalizer = robot.normalizer()
        self.waypoints = settings.waypoints
        self.dof = robot.dof
        self.schedule = NoiseSchedule(settings.schedule)
        self.objective = OBJECTIVES[settings.objective]
        self.is_unit_joints = settings.target == "limits"
        """Whether x is the normalized joint values themselves, relative to nothing."""

    def clipped(self, x: Trajectories) -> Trajectories:
        """A predicted x, clipped to the joint limits for the target `limits`; unchanged for other targets."""
        return np.clip(x, -1.0, 1.0) if self.is_unit_joints else x

    def reference(self, start: Joints, goal: Joints) -> Reference:
        """The reference of trajectories from start to goal [rad]."""
        a, b = (self._unit(q)[..., None, :] for q in (start, goal))
        if self.settings.target == "residual":
            base = a + (b - a) * np.linspace(0.0, 1.0, self.waypoints, dtype=np.float32)[:, None]
            zero = np.zeros((*base.shape[:-2], 1, self.dof), np.float32)
            return Reference(base, zero, zero)
        scale, mean = self.statistics[:2]
        base = np.broadcast_to(mean, (*a.shape[:-2], self.waypoints, self.dof))
        return Reference(base, (a - mean) / scale, (b - mean) / scale)

    def _unit(self, q: Joints) -> Joints:
        return self.normalizer.to_unit(np.asarray(q, np.float32))

    def normalize(self, q: Trajectories, reference: Reference) -> Trajectories:
        """Converts trajectories [rad] to x, with the ends of the reference."""
        return self.hold_ends((self._unit(q) - reference.base) / self.statistics.residual_scale, reference)

    def joints(self, x: Trajectories, reference: Reference) -> Trajectories:
        """Joint values of x [rad]."""
        return self.normalizer.from_unit(self.unit_joints(x, reference))

    def unit_joints(self, x: Trajectories, reference: Reference) -> Trajectories:
        """Joint values of x in units of their limits."""
        return reference.base + x * self.statistics.residual_scale

    def hold_ends(self, x: Trajectories, reference: Reference) -> Trajectories:
        """Write start and goal over the ends of x, in place (noise interpolation). Returns x."""
        x[..., :1, :] = reference.start
        x[..., -1:, :] = reference.goal
        return x

    def draw_noise(self, count: int, rng: Generator) -> Float[ndarray, "count waypoints dof"]:
        """Standard noise of the forward process; zero at both ends."""
        white = rng.standard_normal((count, self.waypoints, self.dof), dtype=np.float32)
        return self.statistics.noise_factor @ white

    @property
    def feature_count(self) -> int:
        """Number of features of a waypoint, see `features`."""
        settings = self.settings
        clearances = len(self.robot.links) if settings.clearance_features else 0
        gradients = self.dof if settings.clearance_gradients else 0
        return (1 if self.is_unit_joints else 2) * self.dof + clearances + gradients

    @property
    def condition_count(self) -> int:
        """Size of the condition, see `condition`."""
        return 1 if self.settings.encoder is None else self.settings.code + 2 * self.dof

    @abstractmethod
    def denoised(
        self,
        features: Features,
        level: Levels,
        condition: Conditions,
        dropped: Dropped | None = None,
    ) -> Outputs:
        """The denoiser's output, which `objective` converts to the clean trajectory.

        dropped: samples whose condition is hidden from the denoiser (Ho and Salimans 2022; paper: C is
            randomly masked). Their features still contain start, goal and clearances. Only for models with
            `null_condition`.
        """

    @abstractmethod
    def embedding_of(self, cloud: Cloud) -> Embedding:
        """z of a cloud from `EncoderSettings.prepared`. The model must have an encoder."""

    def encode(self, points: Points, rng: Generator | None = None) -> Embedding:
        """z of a point cloud of the obstacles' surfaces (base frame, [m]); an empty cloud is allowed.

        Without an encoder, z is empty.
        """
        encoder_settings = self.settings.encoder_settings
        if encoder_settings is None:
            return np.zeros(0, np.float32)
        points = np.asarray(points, np.float32).reshape(-1, 3)
        points = points[encoder_settings.region.holds(points)]
        max_points = MAX_POINTS if encoder_settings.any_size else encoder_settings.cloud
        if len(points) > max_points:
            rng = rng or np.random.default_rng(0)
            points = points[rng.choice(len(points), max_points, replace=False)]
        return self.embedding_of(encoder_settings.prepared(points))

    def features(
        self, x: Float[ndarray, "batch waypoints dof"], reference: Reference, clearances: ClearanceFn
    ) -> Features:
        """The denoiser's input for a noisy x: x; the normalized joint values, unless they are x itself; and,
        if the settings include them, the clearances of the links and their gradients."""
        unit = self.unit_joints(x, reference)
        parts = [x] if self.is_unit_joints else [x, unit]
        if not self.settings.clearance_features:
            return np.concatenate(parts, axis=-1)
        inputs = clearances(self.normalizer.from_unit(unit))
        scaled = np.clip(inputs[..., : len(self.robot.links)], MIN_CLEARANCE, MAX_CLEARANCE)
        scaled = (scaled - (MIN_CLEARANCE + MAX_CLEARANCE) / 2) * (2 / (MAX_CLEARANCE - MIN_CLEARANCE))
        parts.append(scaled.astype(np.float32, copy=False))
        if self.settings.clearance_gradients:
            parts.append(np.clip(inputs[..., -self.dof :] / np.float32(GRADIENT_UNIT), -1, 1))
        return np.concatenate(parts, axis=-1)

    def condition(
        self,
        embedding: Float[ndarray, "*batch code"],
        start: Joints,
        goal: Joints,
    ) -> Float[ndarray, "*batch condition"]:
        """C = [z, start, goal], where this function normalizes start and goal [rad]. Without an encoder, C is
        a single zero: the condition of a denoiser must not be empty."""
        if self.settings.encoder is None:
            return np.zeros((*np.shape(start)[:-1], 1), np.float32)
        ends = [self._unit(q) for q in (start, goal)]
        return np.concatenate([embedding, *ends], axis=-1, dtype=np.float32)

    def denoised_guided(
        self,
        features: Features,
        level: Levels,
        condition: Conditions,
        scale: float,
    ) -> Outputs:
        """Classifier-free guidance: u + scale (c - u), where c and u are the outputs with and without the
        condition.

        A scale of 1 needs only c, and a scale of 0 only u; any other scale needs a batch of twice the size.
        """
        if scale == 1.0:
            return self.denoised(features, level, condition)
        if scale == 0.0:
            return self.denoised(features, level, condition, np.ones(len(level), np.bool_))
        dropped = np.arange(2 * len(level)) >= len(level)
        features, level, condition = (np.concatenate([part] * 2) for part in (features, level, condition))
        conditional, unconditional = np.split(self.denoised(features, level, condition, dropped), 2)
        return unconditional + np.float32(scale) * (conditional - unconditional)

    def sample(
        self,
        start: Configuration,
        goal: Configuration,
        embedding: Float[ndarray, "code"],
        clearances: ClearanceFn,
        rng: Generator,
        settings: SamplingSettings | None = None,
        guide: GuideFn | None = None,
    ) -> Float[ndarray, "samples waypoints dof"]:
        """Trajectories from start to goal [rad], float64; they begin and end exactly there.

        embedding: z of the scene, from `encode`.
        clearances: see ClearanceFn.
        settings: None: the defaults.
        guide: improves the predicted clean trajectories in the guided steps (paper, section Motion Guided
            Generation). It may move the first and the last waypoint, which are restored.

        Raises InputError for more steps than the schedule has, and for a guidance_scale other than 1 if the
        model was trained without dropping its condition.
        """
        settings = settings or SamplingSettings()
        scale = settings.guidance_scale
        if scale != 1.0 and not self.settings.null_condition:
            raise InputError(
                f"guidance_scale is {scale}; it must be 1, for this model was trained with "
                "condition_drop 0 and cannot predict without its condition"
            )
        draw = SAMPLERS.load(settings.sampler or self.settings.sampler)
        steps = settings.sampling_steps or self.settings.sampling_steps or self.schedule.steps
        reference = self.reference(start[None], goal[None])
        predict_unguided = self.predictor(
            reference, self.condition(embedding, start, goal), clearances, scale
        )
        unguided_steps = steps - ceil(settings.guided_share * steps - 1e-9)
        guided_levels: Int[ndarray, "n"] = self.schedule.sampling_levels(steps)[unguided_steps:-1]

        def predict(x: ndarray, level: int) -> ndarray:
            clean = predict_unguided(x, level)
            if guide is not None and level in guided_levels:
                improved = guide(self.joints(clean, reference), level / self.schedule.steps)
                clean = self.normalize(improved, reference)
            return clean

        x = draw(predict, self.schedule, lambda: self.draw_noise(settings.samples, rng), steps, settings.eta)
        q = self.joints(x, reference).astype(np.float64)
        np.clip(q, self.robot.lower, self.robot.upper, out=q)
        q[:, 0] = start
        q[:, -1] = goal
        return q

    def predictor(
        self,
        reference: Reference,
        condition: Float[ndarray, "*batch condition"],
        clearances: ClearanceFn,
        guidance_scale: float = 1.0,
    ) -> Predict:
        """The function that samplers call: it predicts the clean x from a noisy x. The first and the last
        waypoint of both are those of the reference.

        guidance_scale: see `denoised_guided`.
        """
        signal, noise = (a.astype(np.float32) for a in (self.schedule.signal, self.schedule.noise))

        def predict(x: ndarray, level: int) -> ndarray:
            x = self.hold_ends(x.copy(), reference)
            inputs = self.features(x, reference, clearances)
            at = np.full(len(x), level / self.schedule.steps, np.float32)
            conditions = np.array(np.broadcast_to(condition, (len(x), condition.shape[-1])))
            output = self.denoised_guided(inputs, at, conditions, guidance_scale)
            clean = self.objective.clean(x, output, signal[level], noise[level])
            return self.hold_ends(self.clipped(clean), reference)

        return predict


PackedClearanceFn = Callable[[PackedScenes, ndarray], ndarray]
"""A `ClearanceFn` that also takes scenes, one for each trajectory."""


def link_clearances(checker: CollisionChecker, settings: MotionModelSettings) -> ClearanceFn:
    """The clearance inputs of a model in planning, where all trajectories are in the checker's scene."""
    arm_links, carriers = _carriers(checker)

    def clearances(q: ndarray) -> ndarray:
        configurations = q.reshape(-1, q.shape[-1])
        if settings.clearance_gradients:
            links, gradients = checker.clearances_and_gradients(
                configurations, MAX_CLEARANCE, GRADIENT_MARGIN
            )
            inputs = np.concatenate([_of_bare_arm(links, arm_links, carriers), gradients], axis=-1)
        else:
            inputs = _of_bare_arm(checker.link_clearances(configurations, MAX_CLEARANCE), arm_links, carriers)
        return inputs.reshape(*q.shape[:2], -1)

    return clearances


def _carriers(checker: CollisionChecker) -> tuple[int, list[int]]:
    """The number of the checker's links that belong to the bare arm, and the carrier of each attached body.
    Attached bodies follow the arm's links in `checker.links`.

    The carrier is the index of the arm's link to which the body is fixed. If `checker.links` lacks that link,
    the carrier is the last of the arm's links whose frame number is at most that of the body's frame.
    """
    robot = checker.robot
    arm = [link for link in checker.links if link in robot.arm.link_names]
    fixed_to = {body.name: body.link for body in robot.attached}

    def carrier(link: str) -> int:
        while link in fixed_to:
            link = fixed_to[link]
        frames = [robot.link_frame(arm_link) for arm_link in arm]
        before = [i for i, frame in enumerate(frames) if frame <= robot.link_frame(link)]
        return max(before, key=lambda i: (arm[i] == link, frames[i], i), default=len(arm) - 1)

    return len(arm), [carrier(link) for link in checker.links[len(arm) :]]


def _of_bare_arm(links: ndarray, arm_links: int, carriers: list[int]) -> ndarray:
    """Clearances [n, links] of the links of the bare arm, since networks have inputs only for these. An
    attached body counts as a part of the link that carries it."""
    of_arm = links[:, :arm_links].copy() if carriers else links
    for body, carrier in enumerate(carriers, start=arm_links):
        of_arm[:, carrier] = np.minimum(of_arm[:, carrier], links[:, body])
    return of_arm


def packed_clearances(robot: Robot, settings: MotionModelSettings) -> PackedClearanceFn:
    """The clearance inputs of a model in training, where each trajectory has its own scene."""
    arrays = compile_robot(robot)

    def clearances(scenes: PackedScenes, q: ndarray) -> ndarray:
        arguments = arrays, scenes, q, MAX_CLEARANCE
        if settings.clearance_gradients:
            return np.concatenate(packed_clearances_and_gradients(*arguments, GRADIENT_MARGIN), axis=-1)
        return packed_clearances_and_gradients(*arguments)[0]

    return clearances
