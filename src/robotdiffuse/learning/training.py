"""Training of the motion predictor, with a frozen encoder or one that is trained along."""

import sys

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from robotdiffuse.collision.arrays import compile_robot, robot_groups
from robotdiffuse.collision.packed import packed_link_clearances
from robotdiffuse.learning.batches import Batch, Batches, fast_bf16, load_data
from robotdiffuse.learning.checkpoint import fingerprint, load_encoder, save_model
from robotdiffuse.learning.config import PlannerTraining, settings_to_json
from robotdiffuse.learning.denoisers import DENOISERS
from robotdiffuse.learning.encoders import Encoder, encoder_name, make_encoder
from robotdiffuse.learning.motion_model import MotionModel, MotionModelConfig
from robotdiffuse.learning.training_run import TrainingRun
from robotdiffuse.learning.versions import versions
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.kinematics import ForwardKinematics
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box

HELD_OUT = 2000
"""Most trajectories of the split for validation that are looked at."""
FLOOR = Scene([Box((0.0, 0.0, -0.05), (2.0, 2.0, 0.1), name="floor")])
"""Part of every scene of the data, as in ROP."""
POINT_UNIT = 0.1
"""[m] in L_point, so that it is of the size of the joint loss."""
POINT_FRAMES = 6
"""L_point looks at every so-manieth frame, which costs less and says the same."""


def moving_links(robot: Robot) -> tuple[str, ...]:
    """Links with collision spheres that some planned joint moves, in the order of link clearances."""
    return tuple(link for link in robot_groups(robot) if robot.link_frame(link) > 0)


def train_planner(settings: PlannerTraining, out: str) -> dict[str, float]:
    """Train the motion predictor; write model.safetensors and model.json, all that planning needs.

    The same call continues a run that was interrupted. Returns `validation`, the loss on trajectories kept
    aside, and `samples`. Raises InputError if the data, the encoder or the folder do not fit, and
    KeyboardInterrupt, after a checkpoint, on Ctrl-C.
    """
    robot = load_robot(settings.robot)
    torch.manual_seed(settings.seed)
    if settings.jointly:
        encoder = make_encoder(settings.encoder, settings.encoder_settings)
    else:
        encoder = load_encoder(settings.encoder)
    model = MotionModel(_model_config(settings, robot, encoder))
    model.encoder = encoder
    data = load_data(
        settings.data,
        robot,
        None if settings.jointly else encoder,
        model.config.frames,
        lambda text: print(text, file=sys.stderr),
    )
    kept, held_out = data.split(HELD_OUT)
    hard = kept.q[~kept.trivial]
    model.fit_statistics((hard if len(hard) else kept.q)[:20_000], settings.smooth_noise)
    run = TrainingRun(
        model,
        out,
        settings,
        average=settings.average,
        weight_decay=settings.weight_decay,
        gradient_norm=settings.gradient_norm,
        bad_steps=settings.bad_steps,
        identity={"robot": robot.name, "encoder_fingerprint": fingerprint(encoder)},
    )

    arrays = compile_robot(robot)

    def clearances(kinds: np.ndarray, params: np.ndarray, q: np.ndarray) -> np.ndarray:
        return packed_link_clearances(arrays, kinds, params, q, FLOOR, model.config.clearance_high)

    batches = Batches(kept, model, clearances, settings.trivial_share, settings.weight_limit)
    objective = _Objective(model, robot, settings)

    def validate() -> float:
        if not len(held_out):
            return float("nan")
        rng = np.random.default_rng(7)
        source = Batches(held_out, model, clearances, settings.trivial_share, settings.weight_limit)
        with torch.no_grad():
            return float(np.mean([objective(source.draw(settings.batch, rng)).item() for _ in range(8)]))

    def loss(rng: np.random.Generator) -> Float[Tensor, ""]:
        batch = batches.draw(settings.batch, rng)
        if settings.condition_drop == 0:
            return objective(batch)
        return objective(batch, torch.from_numpy(rng.random(settings.batch) < settings.condition_drop))

    run.loop(loss, validate, "planner")
    with run.averaged():
        report = {"validation": validate(), "samples": float(run.at.samples)}
        about = {
            "settings": settings_to_json(settings),
            "data": data.digest,
            "trajectories": len(data),
            "encoder": fingerprint(encoder),
            "minutes": round(run.at.seconds / 60, 2),
            **report,
            **versions(),
        }
        save_model(model, out, about)
    return report


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
    )


class _Objective:
    """The loss of a batch: L_simple on the joints, and L_point through forward kinematics (paper, eq. L)."""

    def __init__(self, model: MotionModel, robot: Robot, settings: PlannerTraining) -> None:
        self.model, self.settings = model, settings
        self.kinematics = ForwardKinematics(robot)
        self.links = [robot.link_names.index(link) for link in moving_links(robot)]
        self.half_range = torch.from_numpy(model.normalizer.half_range)
        self.middle = torch.from_numpy(model.normalizer.middle)
        self.bf16 = fast_bf16()

    def __call__(self, batch: Batch, dropped: Bool[Tensor, "n"] | None = None) -> Float[Tensor, ""]:
        """`dropped`: samples whose condition is hidden from the denoiser."""
        features, level, condition = (
            torch.from_numpy(a) for a in (batch.features, batch.level, batch.condition)
        )
        clean, weight = torch.from_numpy(batch.clean), torch.from_numpy(batch.weight)
        with torch.autocast("cpu", torch.bfloat16, enabled=self.bf16):
            if batch.clouds is not None:
                z = self.model.encoder(batch.clouds)
                condition = torch.cat([z, condition[:, z.shape[1] :]], 1)
            predicted = self.model.denoise(features, level, condition, dropped)
        error = (predicted - clean)[:, 1:-1].square().mean((1, 2))
        if self.settings.point_weight > 0:
            frames = slice(POINT_FRAMES // 2, None, POINT_FRAMES)
            line = torch.from_numpy(batch.line[:, frames].copy())
            moved = self._origins(predicted[:, frames], line) - self._origins(clean[:, frames], line)
            error = error + self.settings.point_weight * (moved / POINT_UNIT).square().sum(-1).mean((1, 2))
        return (weight * error).mean()

    def _origins(self, x: Float[Tensor, "n frames dof"], line: Tensor) -> Float[Tensor, "n frames links 3"]:
        q = (line + x * self.model.residual_scale) * self.half_range + self.middle
        return self.kinematics.links(q)[..., self.links, :3, 3]
