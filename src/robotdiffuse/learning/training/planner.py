"""Training of the motion predictor, with a frozen encoder or one that is trained along."""

import copy
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from robotdiffuse.collision.arrays import robot_groups
from robotdiffuse.learning.checkpoint import fingerprint, load_encoder, save_model
from robotdiffuse.learning.clearances import packed_clearances
from robotdiffuse.learning.denoisers import DENOISERS
from robotdiffuse.learning.encoders import Encoder, encoder_name, make_encoder
from robotdiffuse.learning.motion_model import MotionModel, MotionModelConfig
from robotdiffuse.learning.settings import settings_to_json
from robotdiffuse.learning.training.batches import Batch, Batches, TrajectoryData, load_data
from robotdiffuse.learning.training.config import PlannerTraining
from robotdiffuse.learning.training.growing_data import GrowingData
from robotdiffuse.learning.training.losses import POINT_UNIT, ArmDistance, SurfacePoints, hinge
from robotdiffuse.learning.training.processes import Processes, on_cpu
from robotdiffuse.learning.training.run import TrainingRun, Validation
from robotdiffuse.learning.training.validation import planning_success
from robotdiffuse.learning.versions import versions
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.kinematics import ForwardKinematics
from robotdiffuse.robots.robot import Robot

VALIDATION_SAMPLES = 4
"""Trajectories sampled for each problem of a validation."""
HELD_OUT = 2000
"""Most trajectories of the split for validation that are looked at."""


def moving_links(robot: Robot) -> tuple[str, ...]:
    """Links with collision spheres that some planned joint moves, in the order of link clearances."""
    return tuple(link for link in robot_groups(robot) if robot.link_frame(link) > 0)


def train_planner(settings: PlannerTraining, out: str) -> dict[str, float]:
    """Train the motion predictor; write model.safetensors and model.json, all that planning needs.

    The same call continues a run that was interrupted. Returns `validation`, the loss on trajectories kept
    aside, `success`, the share of the motions that it samples for them by itself that are free, and
    `samples`. Raises InputError if the data, the encoder or the folder do not fit, and KeyboardInterrupt,
    after a checkpoint, on Ctrl-C.

    While the data factory is still filling the folder, the shards that are there are used, and new ones from
    the next checkpoint on; such a run is not reproducible, see `GrowingData`. Where torchrun started several
    processes, all call this and get the same result, see `TrainingRun`.
    """
    processes = Processes(settings.device)
    robot = load_robot(settings.robot)
    torch.manual_seed(settings.seed)
    frozen = None if settings.jointly else load_encoder(settings.encoder)
    encoder = frozen or make_encoder(settings.encoder, settings.encoder_settings)
    model = MotionModel(_model_config(settings, robot, encoder))
    # codes are made on the CPU: the frozen one stays there
    model.encoder = copy.deepcopy(encoder)

    def read(report: Callable[[str], None]) -> TrajectoryData:
        return load_data(settings.data, robot, frozen, model.config.frames, report, settings.turns)

    data = GrowingData(settings.data, read, processes)
    kept, held_out = data.now.split(HELD_OUT)
    hard = kept.q[~kept.trivial]
    model.fit_statistics((hard if len(hard) else kept.q)[:20_000], settings.smooth_noise)
    run = TrainingRun(
        model.to(processes.device),
        out,
        settings,
        average=settings.average,
        weight_decay=settings.weight_decay,
        gradient_norm=settings.gradient_norm,
        bad_steps=settings.bad_steps,
        identity={"robot": robot.name, "encoder_fingerprint": fingerprint(encoder)},
        processes=processes,
    )
    # batches are made, and validations planned, on the CPU
    here = on_cpu(model)

    clearances = packed_clearances(robot, model.config)

    def batches_of(rows: TrajectoryData) -> Batches:
        return Batches(rows, here, clearances, settings.trivial_share, settings.weight_limit)

    batches = batches_of(kept)
    loss_of = _Loss(model, robot, settings, processes)

    def take_in_new_data() -> None:
        nonlocal batches, held_out
        if data.grow():
            kept, held_out = data.now.split(HELD_OUT)
            batches = batches_of(kept)

    def validate() -> Validation:
        if not len(held_out):
            return Validation(float("nan"))
        rng = np.random.default_rng(7)
        source = batches_of(held_out)
        if here is not model:
            here.load_state_dict(model.state_dict())
        with torch.no_grad():
            parts = [loss_of(source.draw(settings.batch, rng), run.fraction, rng).item() for _ in range(8)]
        count = settings.validation_problems
        success = planning_success(here, robot, held_out, count, VALIDATION_SAMPLES, rng)
        return Validation(float(np.mean(parts)), success)

    def loss(rng: np.random.Generator) -> Float[Tensor, ""]:
        batch = batches.draw(settings.batch, rng)
        dropped = None
        if settings.condition_drop > 0:
            dropped = torch.from_numpy(rng.random(settings.batch) < settings.condition_drop)
        return loss_of(batch, run.fraction, rng, dropped)

    run.loop(loss, validate, "planner", take_in_new_data)
    if not processes.first:
        return processes.share(None)
    with run.averaged():
        held_out_loss, success = validate()
        report = {"validation": held_out_loss, "samples": float(run.at.samples)}
        if success is not None:
            report["success"] = success
        about = {
            "settings": settings_to_json(settings),
            "data": data.now.digest,
            "trajectories": len(data.now),
            "encoder": fingerprint(model.encoder),
            "minutes": round(run.at.seconds / 60, 2),
            **report,
            **versions(),
        }
        save_model(model, out, about)
    return processes.share(report)


def _model_config(settings: PlannerTraining, robot: Robot, encoder: Encoder) -> MotionModelConfig:
    return MotionModelConfig(
        robot=robot.name,
        joint_names=robot.joint_names,
        lower=tuple(robot.lower.tolist()),
        upper=tuple(robot.upper.tolist()),
        frame_offsets=tuple(tuple(tuple(row) for row in T) for T in robot.frame_offsets.tolist()),
        links=moving_links(robot),
        encoder=encoder_name(encoder),
        encoder_settings=encoder.settings,
        denoiser=settings.denoiser,
        denoiser_settings=settings.denoiser_settings or DENOISERS[settings.denoiser][1](),
        null_condition=settings.condition_drop > 0,
        schedule=settings.schedule,
        sampler=settings.sampler,
        sampling_steps=settings.sampling_steps,
        frames=settings.frames,
        parametrization=settings.parametrization,
        rows=settings.rows,
        target=settings.target,
        objective=settings.objective,
        sees_clearances=settings.sees_clearances,
        sees_gradients=settings.sees_gradients,
    )


class _Loss:
    """The loss of a batch: the objective's on the rows, L_point and L_collision (paper, eq. L)."""

    def __init__(
        self, model: MotionModel, robot: Robot, settings: PlannerTraining, processes: Processes
    ) -> None:
        self.model, self.settings, self.processes = model, settings.losses, processes
        kinematics = ForwardKinematics(robot, device=processes.device)
        rng = np.random.default_rng(settings.seed)
        self.points = (
            SurfacePoints(kinematics, self.settings.points, rng) if self.settings.point > 0 else None
        )
        self.arm = ArmDistance(kinematics) if self.settings.collision > 0 else None

    def __call__(
        self,
        batch: Batch,
        fraction: float,
        rng: np.random.Generator,
        dropped: Bool[Tensor, "n"] | None = None,
    ) -> Float[Tensor, ""]:
        """`fraction` of the training is done; `dropped`: samples whose condition is hidden."""
        model, losses, device = self.model, self.settings, self.processes.device
        features, level, condition, target, weight = (
            torch.from_numpy(a).to(device)
            for a in (batch.features, batch.level, batch.condition, batch.target, batch.weight)
        )
        with self.processes.autocast():
            if batch.clouds is not None:
                z = model.encoder(batch.clouds.to(device))
                condition = torch.cat([z, condition[:, z.shape[1] :]], 1)
            hidden = None if dropped is None else dropped.to(device)
            output = model.denoise(features, level, condition, hidden)
        error = weight * losses.joint * (output - target)[:, 1:-1].square().mean((1, 2))
        collision_weight = losses.collision_weight(fraction)
        if self.points is not None or collision_weight > 0:
            clean_weight = torch.from_numpy(batch.clean_weight).to(device)
            error = error + clean_weight * self._in_space(batch, output, collision_weight, rng)
        return error.mean()

    def _in_space(
        self,
        batch: Batch,
        output: Float[Tensor, "n rows dof"],
        collision_weight: float,
        rng: np.random.Generator,
    ) -> Float[Tensor, "n"]:
        """L_point and L_collision of each sample, at a few frames."""
        model, losses = self.model, self.settings
        last = model.config.frames - 1
        frames = sorted(rng.choice(np.arange(1, last), min(losses.frames, last - 1), replace=False).tolist())
        noisy, signal, noise_level, clean, base = (
            torch.from_numpy(np.ascontiguousarray(a)).to(output.device)
            for a in (batch.noisy, batch.signal, batch.noise_level, batch.clean, batch.base)
        )
        predicted = model.objective.clean(noisy, output, signal, noise_level)
        # the ends are held, whatever is predicted there
        predicted = torch.cat([clean[:, :1], predicted[:, 1:-1], clean[:, -1:]], 1)
        q = model.joints_at(predicted, base, frames)
        error = q.new_zeros(len(q))
        if self.points is not None:
            moved = self.points(q) - self.points(model.joints_at(clean, base, frames))
            error = error + losses.point * (moved / POINT_UNIT).square().sum(-1).mean((1, 2))
        if self.arm is not None and collision_weight > 0:
            near = hinge(self.arm(q, batch.scenes), losses.safe_distance) / POINT_UNIT
            error = error + collision_weight * near.sum(-1).mean(1)
        return error
