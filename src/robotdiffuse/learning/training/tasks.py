"""Training of an auto-encoder of point clouds, of the diffusion model, and of baselines' networks."""

import copy
from abc import ABC, abstractmethod
from dataclasses import fields
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from numpy.random import Generator
from torch import Tensor

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import motions_free
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.checkpoint import fingerprint, load_encoder
from robotdiffuse.learning.denoisers import DENOISERS
from robotdiffuse.learning.encoders import encoder_name, make_encoder
from robotdiffuse.learning.encoders.networks import Autoencoder, Encoder, Loss
from robotdiffuse.learning.guidance import CollisionGuidance
from robotdiffuse.learning.motion_model import (
    ModelParts,
    MotionModelSettings,
    SamplingSettings,
    link_clearances,
    packed_clearances,
)
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.network import Network, Scalar
from robotdiffuse.learning.training.batches import (
    Batch,
    Batches,
    TrajectoryData,
    encode_scenes,
    fast_autocast,
    random_scenes,
    scene_clouds,
)
from robotdiffuse.learning.training.config import (
    BaselineTraining,
    EncoderTraining,
    PlannerTraining,
    block_at,
    one_length,
)
from robotdiffuse.learning.training.loop import MotionTask, Processes, TrainingTask, Validation, on_cpu, train
from robotdiffuse.learning.training.losses import (
    POINT_UNIT,
    SAFE_DISTANCE,
    ArmDistance,
    ForwardKinematics,
    SurfacePoints,
    hinge,
)
from robotdiffuse.learning.weight_files import NETWORKS, RobotIdentity
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.packed_scenes import PackedScenes

STANDARDIZATION_SCENES = 2048
"""Number of scenes over which the components of the embedding z are standardized."""
REGULARIZATION = 1e-7
"""The paper's lambda. The loss contains this times the sum of squares of the weights `penalized()`."""


def train_encoder(settings: EncoderTraining, out: str) -> dict[str, float]:
    """Train an auto-encoder; write encoder.safetensors and encoder.json into the folder `out`.

    The same call continues a run that was interrupted. Returns the errors on new clouds [m] that the
    encoder's `loss` reports, and `samples`, the number of training samples. Raises the errors of
    `loop.train`.
    """
    return train(_EncoderTask(settings, Processes(settings.device)), out)


class _EncoderTask(TrainingTask):
    title = "encoder"
    module: Autoencoder

    def __init__(self, settings: EncoderTraining, processes: Processes) -> None:
        self.settings = settings
        self.processes = processes
        self.identity = {}
        torch.manual_seed(settings.seed)
        module = make_encoder(settings.name, settings.encoder)
        assert isinstance(module, Autoencoder)  # by EncoderTraining
        self.module = module.to(processes.device)
        self._max_points = settings.points if module.settings.any_size else module.settings.cloud

    def loss(self, fraction: float, rng: Generator) -> Scalar:
        points = self._max_points
        if self.module.settings.any_size:
            points = int(rng.integers(max(1, points // 8), points + 1))
        error, _ = self._reconstruction(self.settings.batch, points, rng)
        theta = torch.stack([p.square().sum() for p in self.module.penalized()]).sum()
        return error + REGULARIZATION * theta

    def validate(self, fraction: float) -> Validation:
        return Validation(self._validation(128, 123)[0].item())

    def finish(self) -> dict[str, float]:
        settings = self.settings
        rng = np.random.default_rng(settings.seed + 1)
        scenes = self._scenes(STANDARDIZATION_SCENES, rng)
        encoder = on_cpu(self.module)
        with torch.no_grad():
            clouds = scene_clouds(encoder, scenes, rng).split(256)
            self.module.standardize(torch.cat([encoder.encode(part) for part in clouds]))
        return self._validation(512, settings.seed + 2)[1]

    def _scenes(self, count: int, rng: Generator) -> PackedScenes:
        settings = self.settings
        return random_scenes(count, settings.max_obstacles, rng, rop=settings.scenes == "rop")

    def _validation(self, count: int, seed: int) -> Loss:
        with torch.no_grad():
            return self._reconstruction(count, self._max_points, np.random.default_rng(seed))

    def _reconstruction(self, count: int, points: int, rng: Generator) -> Loss:
        scenes = self._scenes(count, rng)
        cloud = scene_clouds(self.module, scenes, rng, points).to(self.processes.device)
        with self.processes.autocast():
            return self.module.loss(cloud, rng)


SAMPLING_STEPS = 6
"""Number of sampling steps in validations, the same for all networks: few, so that a validation takes less
time than the training between two validations."""
PRIOR_GUIDANCE_STEPS = 4
"""Number of gradient steps of the guidance in each sampling step of a prior: a motion model without the scene
as input."""
CHECK_STEP = 0.02
"""No point of the arm moves further than this between two checks of a sampled motion [m]."""


def planning_success(
    model: MotionNetwork,
    robot: Robot,
    data: TrajectoryData,
    problems: int,
    candidates: int,
    rng: Generator,
) -> float | None:
    """Share of collision-free motions among the network's samples: `candidates` samples for each of the first
    `problems` problems of the data that are not trivial. It is None if there is no such problem."""
    settings = SamplingSettings(samples=candidates, sampling_steps=min(SAMPLING_STEPS, model.schedule.steps))
    free = []
    for row in np.flatnonzero(~data.trivial)[:problems].tolist():
        start, *_, goal = data.q[row].astype(np.float64)
        checker = CollisionChecker(robot, data.scenes.scene(row))
        embedding = np.zeros(0)
        guide = None
        if data.embeddings is not None:
            embedding = data.embeddings[row]
        elif model.encoder is not None:
            embedding = encode_scenes(model.encoder, data.scenes[row : row + 1], rng)[0]
        if model.encoder is None:
            guide = partial(_guided, CollisionGuidance(checker))
        clearances = link_clearances(checker, model.settings)
        q = model.sample(start, goal, embedding.astype(np.float32), clearances, rng, settings, guide)
        space = search_space(checker, CHECK_STEP)
        free.append(np.mean([motions_free(space, motion).all() for motion in q]))
    return float(np.mean(free)) if free else None


def _guided(guidance: CollisionGuidance, q: ndarray, _level: float) -> ndarray:
    return guidance(q, PRIOR_GUIDANCE_STEPS)


VALIDATION_SAMPLES = 4
"""Number of trajectories that are sampled for each problem of a validation."""
MAX_STATISTICS_TRAJECTORIES = 20_000
"""Largest number of trajectories from which the scale, mean and covariance of the motions are estimated."""


def train_planner(settings: PlannerTraining, out: str) -> dict[str, float]:
    """Train the diffusion model. Write model.safetensors, the ONNX files that planning runs, and model.json.
    For a prior (a model without the scene as input) the files are named trajectory_prior.

    The same call continues a run that was interrupted. Returns `validation`, the loss on held-out
    trajectories; `success`, the share of collision-free motions among samples for held-out problems; and
    `samples`.
    Raises the errors of `loop.train`, and InputError if the data or the encoder do not fit.
    """
    return train(PlannerTask(settings, Processes(settings.device)), out)


class PlannerTask(MotionTask):
    """The diffusion model in training."""

    def __init__(self, settings: PlannerTraining, processes: Processes) -> None:
        robot = load_robot(settings.robot)
        torch.manual_seed(settings.seed)
        frozen = encoder = None
        if settings.encoder is not None:
            frozen = None if settings.jointly else load_encoder(settings.encoder)
            encoder = frozen or make_encoder(settings.encoder, settings.encoder_settings)
        model = MotionNetwork(RobotIdentity.of(robot), model_settings(settings, encoder))
        # the model's copy moves to the device; the encoder itself stays on the CPU, where scenes are encoded
        model.encoder = copy.deepcopy(encoder)
        super().__init__(settings, robot, frozen, processes)
        self.title = model.settings.network
        hard = self.train_data.q[~self.train_data.trivial]
        model.fit_statistics(
            (hard if len(hard) else self.train_data.q)[:MAX_STATISTICS_TRAJECTORIES], settings.smooth_noise
        )
        self.module = self.model = model.to(processes.device)
        self.identity = {"robot": robot.name} | self._encoder_fingerprint("encoder_fingerprint")
        # for computing batches, and for sampling motions of the validation problems
        self._on_cpu = on_cpu(model)
        self.clearances = packed_clearances(robot, model.settings)
        self._loss = PlannerLoss(model, robot, settings, processes)

    def loss_of(self, data: TrajectoryData, fraction: float, rng: Generator) -> Scalar:
        settings = self.settings
        if settings.progressive:
            self.model.coarsen(block_at(fraction))
        batches = Batches(data, self._on_cpu, self.clearances, settings.trivial_share, settings.weight_limit)
        batch = batches.draw(settings.batch, rng)
        dropped = None
        if settings.condition_drop > 0 and data is self.train_data:
            dropped = torch.from_numpy(rng.random(settings.batch) < settings.condition_drop)
        return self._loss(batch, fraction, rng, dropped)

    def success(self, rng: Generator) -> float | None:
        if self._on_cpu is not self.model:
            self._on_cpu.load_state_dict(self.model.state_dict())
            self._on_cpu.coarsen(self.model.block)
        problems = self.settings.validation_problems
        with fast_autocast():
            return planning_success(
                self._on_cpu, self.robot, self.validation_data, problems, VALIDATION_SAMPLES, rng
            )

    def about(self) -> dict[str, Any]:
        return super().about() | self._encoder_fingerprint("encoder")

    def _encoder_fingerprint(self, name: str) -> dict[str, str]:
        return {} if self.model.encoder is None else {name: fingerprint(self.model.encoder)}


def model_settings(settings: PlannerTraining, encoder: Encoder | None) -> MotionModelSettings:
    return MotionModelSettings(
        encoder=None if encoder is None else encoder_name(encoder),
        encoder_settings=None if encoder is None else encoder.settings,
        denoiser_settings=settings.denoiser_settings or DENOISERS.defaults(settings.denoiser),
        null_condition=settings.condition_drop > 0,
        **{field.name: getattr(settings, field.name) for field in fields(ModelParts)},
    )


class PlannerLoss:
    """Computes the loss of a batch: the objective's loss plus L_point and L_collision (paper, eq. L)."""

    def __init__(
        self, model: MotionNetwork, robot: Robot, settings: PlannerTraining, processes: Processes
    ) -> None:
        self.model = model
        self.settings = settings.losses
        self.processes = processes
        kinematics = ForwardKinematics(robot, device=processes.device)
        rng = np.random.default_rng(settings.seed)
        self.points = (
            SurfacePoints(kinematics, self.settings.points, rng) if self.settings.point > 0 else None
        )
        self.arm = ArmDistance(kinematics)

    def __call__(
        self,
        batch: Batch,
        fraction: float,
        rng: Generator,
        dropped: Bool[Tensor, "n"] | None = None,
    ) -> Scalar:
        """The loss. fraction: fraction of the training that is done. dropped: samples whose condition is
        hidden."""
        model = self.model
        losses = self.settings
        device = self.processes.device
        features, level, condition, target, weight, clean_weight = (
            torch.from_numpy(getattr(batch, name)).to(device)
            for name in ("features", "level", "condition", "target", "weight", "clean_weight")
        )
        with self.processes.autocast():
            if batch.clouds is not None and model.encoder is not None:
                z = model.encoder(batch.clouds.to(device))
                condition = torch.cat([z, condition[:, z.shape[1] :]], 1)
            hidden = None if dropped is None else dropped.to(device)
            output = model.denoise(features, level, condition, hidden)
        error = weight * losses.joint * (output - target)[:, 1:-1].square().mean((1, 2))
        collision_weight = losses.collision_weight(fraction)
        if self.points is not None or collision_weight > 0:
            error = error + clean_weight * self._workspace_losses(batch, output, collision_weight, rng)
        return error.mean()

    def _workspace_losses(
        self,
        batch: Batch,
        output: Float[Tensor, "n waypoints dof"],
        collision_weight: float,
        rng: Generator,
    ) -> Float[Tensor, "n"]:
        """L_point and L_collision of each sample, at some of the waypoints."""
        model = self.model
        losses = self.settings
        last = model.settings.waypoints - 1
        waypoints = sorted(
            rng.choice(np.arange(1, last), min(losses.waypoints, last - 1), replace=False).tolist()
        )
        noisy, signal, noise_level, clean, base = (
            torch.from_numpy(np.ascontiguousarray(a)).to(output.device)
            for a in (batch.noisy, batch.signal, batch.noise_level, batch.clean, batch.base)
        )
        predicted = model.objective.clean(noisy, output, signal, noise_level)
        # start and goal are given, so predictions of these two waypoints do not count
        predicted = torch.cat([clean[:, :1], predicted[:, 1:-1], clean[:, -1:]], 1)
        q = model.joints_at(predicted, base, waypoints)
        error = q.new_zeros(len(q))
        if self.points is not None:
            moved = self.points(q) - self.points(model.joints_at(clean, base, waypoints))
            error = error + losses.point * (moved / POINT_UNIT).square().sum(-1).mean((1, 2))
        if collision_weight > 0:
            near = hinge(self.arm(q, batch.scenes), SAFE_DISTANCE) / POINT_UNIT
            error = error + collision_weight * near.sum(-1).mean(1)
        return error


class BaselineNetwork(Network, ABC):
    """A network that `train_baseline` trains; `settings` are of the class that NETWORKS names."""

    training_defaults: ClassVar[dict[str, Any]] = {}
    """The network's own defaults of fields of `BaselineTraining`, for example batch."""

    def __init__(self, robot: RobotIdentity, settings: Any) -> None:
        super().__init__()
        self.robot = robot
        self.settings = settings
        self.dof, self.normalizer = robot.dof, robot.normalizer()

    def fit_statistics(self, data: TrajectoryData) -> None:
        """Fill buffers with statistics of the training trajectories; called before a run."""

    @abstractmethod
    def loss(self, data: TrajectoryData, count: int, fraction: float, rng: Generator) -> Scalar:
        """The loss of `count` samples drawn from the data; `fraction` of the training is done, 0 to 1."""


def baseline_training(name: str, changes: dict[str, Any]) -> BaselineTraining:
    """The training settings of a baseline's network, with the given changes.

    Raises InputError for an unknown name, listing the known ones, and for a network that is no baseline.
    """
    kind = NETWORKS.load(name)
    if not issubclass(kind, BaselineNetwork):
        raise InputError(f"{name} is no baseline; train it: robotdiffuse train {NETWORKS[name].kind}")
    return BaselineTraining(name=name, **(kind.training_defaults | one_length(changes)))


def train_baseline(settings: BaselineTraining, out: str) -> dict[str, float]:
    """Train a network with its default settings; write NAME.safetensors and NAME.json into the folder `out`.

    The same call continues a run that was interrupted. Returns `validation`, the loss on held-out
    trajectories, and `samples`. Raises the errors of `loop.train`, and InputError if the data do not fit.
    """
    return train(_BaselineTask(settings, Processes(settings.device)), out)


class _BaselineTask(MotionTask):
    module: BaselineNetwork

    def __init__(self, settings: BaselineTraining, processes: Processes) -> None:
        self.title, robot = settings.name, load_robot(settings.robot)
        torch.manual_seed(settings.seed)
        kind = NETWORKS.load(settings.name)
        default_settings = NETWORKS.defaults(settings.name)
        self.module = kind(RobotIdentity.of(robot), default_settings)
        super().__init__(settings, robot, None, processes)
        self.module.fit_statistics(self.train_data)
        self.identity = {"robot": robot.name, "network": repr(default_settings)}

    def loss_of(self, data: TrajectoryData, fraction: float, rng: Generator) -> Scalar:
        return self.module.loss(data, self.settings.batch, fraction, rng)
