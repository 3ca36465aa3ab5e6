"""Training: the auto-encoder of point clouds alone, then the motion predictor with the frozen encoder."""

import sys
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from robotdiffuse.collision.arrays import compile_robot, robot_groups
from robotdiffuse.collision.packed import packed_link_clearances
from robotdiffuse.learning.batches import Batch, Batches, fast_bf16, load_data, random_scenes
from robotdiffuse.learning.checkpoint import fingerprint, load_encoder, save_encoder, save_model
from robotdiffuse.learning.config import EncoderTraining, PlannerTraining, settings_to_json
from robotdiffuse.learning.encoders import PointAutoencoder
from robotdiffuse.learning.encoders.point_autoencoder import chamfer, nearest, pick
from robotdiffuse.learning.motion_model import MotionModel, MotionModelConfig
from robotdiffuse.learning.training_run import TrainingRun
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.kinematics import ForwardKinematics
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.sampling import sample_surfaces_batch
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box

QUERIES = 96
"""Points per cloud at which the distance field is reconstructed."""
DISTANCE_CAP = 0.5
"""Reconstructed distances are capped [m]."""
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


def train_encoder(settings: EncoderTraining, out: str) -> dict[str, float]:
    """Train the point cloud auto-encoder; write encoder.safetensors and encoder.json into the folder `out`.

    The same call continues a run that was interrupted. Returns errors on fresh clouds: `chamfer` [m], both
    ways added; `distance`, mean error of the reconstructed distance field [m]; `distance_of_constant`,
    that of a constant. Raises InputError if the folder holds a different run, and KeyboardInterrupt, after a
    checkpoint, on Ctrl-C.
    """
    torch.manual_seed(settings.seed)
    module = PointAutoencoder(settings.encoder)
    run = TrainingRun(
        module, out, settings, average=0.999, weight_decay=0.0, gradient_norm=1.0, bad_steps=10, identity={}
    )

    def loss(rng: np.random.Generator) -> Float[Tensor, ""]:
        points = int(rng.integers(settings.points // 8, settings.points + 1))
        apart, field, _ = _reconstruction(module, settings, settings.batch, points, rng)
        theta = torch.stack([p.square().sum() for p in module.parameters()]).sum()
        return apart + settings.distance_weight * field + settings.regularization * theta

    def validate() -> float:
        with torch.no_grad():
            rng = np.random.default_rng(123)
            apart, field, _ = _reconstruction(module, settings, 128, settings.points, rng)
            return float(apart + settings.distance_weight * field)

    run.loop(loss, validate, "encoder")
    with run.averaged(), torch.no_grad():
        rng = np.random.default_rng(settings.seed + 1)
        clouds = _random_clouds(settings, 4096, settings.points // 2, rng)
        module.standardize(torch.cat([module.encode(part) for part in torch.from_numpy(clouds).split(256)]))
        reached = _reconstruction(module, settings, 512, settings.points, rng)
        report = {
            "chamfer": float(reached[0]),
            "distance": float(reached[2][0]),
            "distance_of_constant": float(reached[2][1]),
        }
        about = {"settings": settings_to_json(settings), "samples": run.at.samples, **report, **_versions()}
        save_encoder(module, out, about)
    return report


def _random_clouds(
    settings: EncoderTraining, count: int, points: int, rng: np.random.Generator
) -> Float[np.ndarray, "count points 3"]:
    scenes = random_scenes(count, settings.max_obstacles, rng)
    return sample_surfaces_batch(*scenes, points, rng, settings.encoder.region)


def _reconstruction(
    module: PointAutoencoder, settings: EncoderTraining, count: int, points: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """On random clouds: Chamfer distance, loss of the distance field, mean errors of it and of a constant."""
    clouds = _random_clouds(settings, count, points, rng)
    spots = rng.uniform([-1.0, -1.0, 0.0], [1.0, 1.0, 1.3], (count, QUERIES, 3)).astype(np.float32)
    half = QUERIES // 2  # uniform ones, and ones close to the surfaces
    close = clouds[:, rng.integers(0, points, half)]
    close = close + 0.1 * rng.standard_normal(close.shape, dtype=np.float32)
    within = settings.encoder.region.holds(close)
    spots[:, :half] = np.where(within[..., None], close, spots[:, :half])
    cloud, at = torch.from_numpy(clouds), torch.from_numpy(spots)
    near = module.near(cloud)
    index, _ = nearest(at, cloud, near)
    truth = (at - pick(cloud, index)).norm(dim=-1).clamp(max=DISTANCE_CAP)
    truth = torch.where(near.any(1)[:, None], truth, DISTANCE_CAP)
    with torch.autocast("cpu", torch.bfloat16, enabled=fast_bf16()):
        code = module.encode(cloud)
        decoded = module.decode(code)
        guess = module.distance(code, at)
    return (
        chamfer(decoded, cloud, near),
        functional.smooth_l1_loss(guess, truth, beta=0.01),
        torch.stack([(guess - truth).abs().mean(), (truth - truth.median()).abs().mean()]),
    )


def train_planner(settings: PlannerTraining, out: str) -> dict[str, float]:
    """Train the motion predictor; write model.safetensors and model.json, all that planning needs.

    The same call continues a run that was interrupted. Returns `validation`, the loss on trajectories kept
    aside, and `samples`. Raises InputError if the data, the encoder or the folder do not fit, and
    KeyboardInterrupt, after a checkpoint, on Ctrl-C.
    """
    robot = load_robot(settings.robot)
    encoder = load_encoder(settings.encoder)
    torch.manual_seed(settings.seed)
    model = MotionModel(_model_config(settings, robot, encoder))
    model.encoder = encoder
    data = load_data(
        settings.data, robot, encoder, model.config.frames, lambda text: print(text, file=sys.stderr)
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

    run.loop(lambda rng: objective(batches.draw(settings.batch, rng)), validate, "planner")
    with run.averaged():
        report = {"validation": validate(), "samples": float(run.at.samples)}
        about = {
            "settings": settings_to_json(settings),
            "data": data.digest,
            "trajectories": len(data),
            "encoder": fingerprint(encoder),
            "minutes": round(run.at.seconds / 60, 2),
            **report,
            **_versions(),
        }
        save_model(model, out, about)
    return report


def _model_config(settings: PlannerTraining, robot: Robot, encoder: PointAutoencoder) -> MotionModelConfig:
    return MotionModelConfig(
        robot=robot.name,
        joint_names=robot.joint_names,
        lower=tuple(robot.lower.tolist()),
        upper=tuple(robot.upper.tolist()),
        frame_offsets=tuple(tuple(tuple(row) for row in T) for T in robot.frame_offsets.tolist()),
        links=moving_links(robot),
        encoder_settings=encoder.settings,
        denoiser_settings=settings.denoiser,
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

    def __call__(self, batch: Batch) -> Float[Tensor, ""]:
        inputs = (torch.from_numpy(a) for a in (batch.features, batch.level, batch.condition))
        clean, weight = torch.from_numpy(batch.clean), torch.from_numpy(batch.weight)
        with torch.autocast("cpu", torch.bfloat16, enabled=self.bf16):
            predicted = self.model.denoiser(*inputs)
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


def _versions() -> dict[str, str]:
    try:
        own = version("robotdiffuse")
    except PackageNotFoundError:
        own = "from source"
    return {"robotdiffuse": own, "torch": torch.__version__, "made": datetime.now(UTC).strftime("%Y-%m-%d")}
