"""Settings of training runs: settings that all trainings share, and settings of encoders, the diffusion model
and baselines."""

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple

from robotdiffuse.core.errors import InputError, check_name
from robotdiffuse.core.settings import (
    AtLeastTwo,
    Bound,
    Count,
    Natural,
    NotNegative,
    OneOf,
    Positive,
    Settings,
    SettingsOf,
    Share,
    ShareBelowOne,
)
from robotdiffuse.learning.denoisers import (
    DENOISERS,
    PAPER_SIZES,
    DenoiserSettings,
    TransformerSettings,
    UNetSettings,
)
from robotdiffuse.learning.diffusion import ScheduleSettings
from robotdiffuse.learning.encoders import ENCODERS, EncoderSettings
from robotdiffuse.learning.motion_model import ModelParts, Waypoints, check_points
from robotdiffuse.learning.training.losses import LossSettings
from robotdiffuse.learning.weight_files import NETWORKS

STAGES = ((0.72, 9), (0.90, 4), (1.0, 1))
"""Stages of progressive training (`PlannerTraining.progressive`). Each has the share of the training at which
it ends, and the number of waypoints in a block: in this stage, each token is the mean of a block."""


def block_at(fraction: float) -> int:
    """Waypoints in a block when this fraction of progressive training is done."""
    return next((block for end, block in STAGES if fraction < end), STAGES[-1][1])


def one_length(given: dict[str, Any]) -> dict[str, Any]:
    """The given settings. If `minutes` is given, `samples` becomes None; if only `samples` is given,
    `minutes` becomes None. Without this, the default of the other setting would hold as well."""
    if given.get("minutes") is not None:
        return given | {"samples": None}
    return given if given.get("samples") is None else given | {"minutes": None}


@dataclass(frozen=True, kw_only=True)
class TrainingSettings(Settings):
    """Settings of every training run."""

    minutes: Positive | None = 40.0
    """Length of the run in wall time [min]; the learning rate reaches 0 at its end. None: `samples` sets the
    length."""
    samples: Count | None = None
    """Length of the run in training samples. Such runs are reproducible; runs by `minutes` are not."""
    seed: Annotated[int, Bound(least=0.0, below=2.0**63)] = 0
    batch: Count = 128
    """Number of samples in a training step."""
    learning_rate: Positive = 1e-3
    """Peak learning rate of AdamW."""
    warmup_steps: Natural = 500
    decay_share: Annotated[float, Bound(above=0.0, most=1.0)] = 1.0
    """Share of the run, at its end, in which the learning rate falls along half a cosine."""
    weight_decay: NotNegative = 0.0
    gradient_norm: Positive = 1.0
    """Gradients with a larger norm are scaled down to this norm."""
    average: ShareBelowOne = 0.9995
    """Decay of the moving average of the weights; the average is what is saved."""
    bad_steps: Count = 10
    """After this number of consecutive steps in which the loss or its gradient is not finite, training ends
    with an error."""
    threads: Annotated[int, Bound(least=1.0, most=1024.0)] = 1
    """Number of threads of PyTorch. While other processes keep the cores busy, one thread is several times
    faster than two."""
    device: Annotated[str, OneOf(("cpu", "cuda"))] | None = None
    """cpu or cuda; None: cuda if there is one."""
    checkpoint_seconds: NotNegative = 120.0
    """Time between checkpoints [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.samples is None) == (self.minutes is None):
            raise InputError(
                f"samples is {self.samples} and minutes is {self.minutes}; give exactly one of them"
            )


@dataclass(frozen=True, kw_only=True)
class EncoderTraining(TrainingSettings):
    """Training of an auto-encoder of point clouds without a planner (paper, eq. l_AE). Planners that are
    trained with it later leave it unchanged."""

    name: str = "point_autoencoder"
    """Name of an encoder that is trained alone."""
    minutes: Positive | None = 5.0
    batch: Count = 32
    """Number of clouds in a training step."""
    learning_rate: Positive = 2e-3
    warmup_steps: Natural = 200
    average: ShareBelowOne = 0.999
    checkpoint_seconds: NotNegative = 60.0
    scenes: Annotated[str, OneOf(("mixed", "rop"))] = "mixed"
    """Training scenes. mixed: of every kind; rop: with two large obstacles each, as in the paper's data."""
    max_obstacles: AtLeastTwo = 12
    """Largest number of obstacles in a mixed training scene."""
    points: Count = 256
    """Largest number of points of a training cloud; the clouds of a step have between an eighth of this
    number and all of it. An encoder for clouds of a fixed size gets clouds of that size."""
    encoder: Annotated[EncoderSettings | None, SettingsOf("name", ENCODERS)] = None
    """Settings of the encoder; None: its defaults."""

    def __post_init__(self) -> None:
        super().__post_init__()
        alone = [name for name, entry in ENCODERS.items() if entry.kind == "alone"]
        check_name("encoder that is trained alone", self.name, alone)


@dataclass(frozen=True, kw_only=True)
class MotionTraining(TrainingSettings):
    """Training on planned trajectories."""

    data: str
    """Folder of a data set of `robotdiffuse data generate`."""
    robot: str = "panda"
    """Name of a bundled robot, or path to a URDF: the robot of the data."""
    waypoints: Waypoints = 48
    """Number of waypoints of a trajectory (paper: 254)."""
    turned_copies: Natural = 5
    """Number of copies of each trajectory, turned about the vertical together with their scenes, if the axis
    of the first joint is vertical."""


@dataclass(frozen=True, kw_only=True)
class PlannerTraining(MotionTraining, ModelParts):
    """Training of the diffusion model."""

    encoder: str | None
    """One of: a folder with a trained encoder, which stays frozen; a name in ENCODERS, such as `pointnet`:
    this encoder is trained jointly, by the planner's loss, on new clouds for every batch (`points` has no
    weights, and needs the denoiser `cross_attention`); None for a prior, whose inputs do not include the
    scene."""
    minutes: Positive | None = 70.0
    learning_rate: Positive = 6e-4
    """Peak learning rate of AdamW (paper: 3e-4)."""
    weight_decay: NotNegative = 0.01
    weight_limit: Positive | None = 5.0
    """Largest weight of a noise level in the loss, see NoiseSchedule.weight; None: all levels have equal
    weight."""
    losses: LossSettings = field(default_factory=LossSettings)
    """The paper's losses of joints, points and collision."""
    trivial_share: Share = 0.1
    """Share of trivial trajectories in each batch: the straight line from start to goal is free. From them
    the network learns to keep straight lines."""
    smooth_noise: bool = True
    """Whether the noise is correlated between waypoints as the trajectories are; otherwise it is white, as in
    the paper."""
    progressive: bool = False
    """Whether the denoiser's tokens are means of blocks of waypoints in most of the training, and single
    waypoints only at its end; see `STAGES`. Steps with fewer tokens take a fraction of the time."""
    validation_problems: Natural = 32
    """Number of held-out problems for which motions are sampled at every checkpoint: with guidance for a
    prior, otherwise without guidance."""
    encoder_settings: Annotated[EncoderSettings | None, SettingsOf("encoder", ENCODERS)] = None
    """Settings of an encoder that is trained jointly; None: its defaults."""
    denoiser_settings: Annotated[DenoiserSettings | None, SettingsOf("denoiser", DENOISERS)] = None
    """Settings of the denoiser; None: its defaults."""
    condition_drop: ShareBelowOne = 0.0
    """Share of the samples whose condition [z, start, goal] is hidden from the denoiser, for classifier-free
    guidance (paper: "randomly masked", without a number; Ho and Salimans 2022: 0.1 or 0.2). 0: the model
    cannot be used without its condition."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.target == "limits" and self.smooth_noise:
            raise InputError("target is limits and smooth_noise is True; smooth_noise must be False then")
        if self.encoder_settings is not None:
            ENCODERS.entry(self.encoder)  # refuses a folder, whose encoder has its own settings
        check_points("encoder", self.encoder, self.denoiser)
        if not self.progressive:
            return
        patch = getattr(self.denoiser_settings, "patch", TransformerSettings.patch)
        if self.smooth_noise or self.denoiser != "transformer" or self.objective != "clean" or patch != 1:
            raise InputError(
                "progressive is True; it needs smooth_noise False, the denoiser transformer with patch 1, "
                "and the objective clean"
            )
        for _, block in STAGES:
            if (self.waypoints - 2) % block:
                raise InputError(
                    f"progressive is True and waypoints is {self.waypoints}; blocks of {block} must "
                    f"divide the {self.waypoints - 2} waypoints between start and goal"
                )

    @property
    def jointly(self) -> bool:
        """Whether the encoder is trained with the planner, and not frozen."""
        return self.encoder in ENCODERS


@dataclass(frozen=True, kw_only=True)
class BaselineTraining(MotionTraining):
    """Training of a baseline's network."""

    name: Annotated[str, OneOf(NETWORKS)]
    """Name of the network."""
    device: Annotated[str, OneOf(("cpu",))] | None = "cpu"
    """The networks are small: they train on the CPU."""


JOINT_POINT = LossSettings(point=0.3, waypoints=4)
JOINT_POINT_COLLISION = LossSettings(point=0.3, collision=0.05, begin=0.3, waypoints=4)
"""Weights of the losses; the paper gives none. With these weights, the three losses are about equally large
for predictions with an error of 5 cm."""

_TABLE2_ROW = {"clearance_features": False, "condition_drop": 0.1, "losses": JOINT_POINT_COLLISION}
"""What the configs of the rows of the paper's table 2 share; "paper" and "points" use it as well."""


class Config(NamedTuple):
    description: str
    changes: dict[str, Any]
    """Changes to the defaults of PlannerTraining."""


CONFIGS: dict[str, Config] = {
    "compact": Config(
        "the bundled weights: 48 waypoints, 1.7 M parameters, clearances and their gradients as inputs",
        {
            "minutes": None,
            "samples": 2_400_000,
            "clearance_gradients": True,
            "condition_drop": 0.1,
            "losses": JOINT_POINT_COLLISION,
        },
    ),
    "paper": Config(
        "the paper's: 254 waypoints, 8 layers of width 512, T = 200, batch 64, 25,000 iterations",
        {
            "minutes": None,
            "samples": 64 * 25_000,
            "batch": 64,
            "learning_rate": 3e-4,
            "waypoints": 254,
            "turned_copies": 0,
            "target": "absolute",
            "smooth_noise": False,
            "progressive": True,
            "decay_share": 0.2,
            "average": 0.999,
            "schedule": ScheduleSettings(log_snr_shift=math.log(25)),
            "sampler": "ddpm",
            "sampling_steps": None,
            "validation_problems": 100,
            "checkpoint_seconds": 1_800.0,
            "denoiser_settings": PAPER_SIZES["transformer"],
            **_TABLE2_ROW,
        },
    ),
    "points": Config(
        "no clearances: waypoints attend to 32 points of the obstacles, not to one embedding of the scene",
        {
            **_TABLE2_ROW,
            "minutes": None,
            "samples": 2_400_000,
            "encoder": "points",
            "denoiser": "cross_attention",
            "turned_copies": 15,
        },
    ),
    "table2_pointnet": Config("encoder PointNet, trained jointly", {**_TABLE2_ROW, "encoder": "pointnet"}),
    "table2_dgcnn": Config("encoder DGCNN, trained jointly", {**_TABLE2_ROW, "encoder": "dgcnn"}),
    "table2_unet": Config("temporal U-Net", {**_TABLE2_ROW, "denoiser": "unet"}),
    "table2_transformer": Config(
        "encoder-decoder transformer", {**_TABLE2_ROW, "denoiser": "encoder_decoder"}
    ),
    "table2_decoder_only": Config("decoder-only transformer", {**_TABLE2_ROW, "denoiser": "decoder_only"}),
    "table2_noise": Config(
        "the noise is predicted instead of x_0", {**_TABLE2_ROW, "objective": "noise", "smooth_noise": False}
    ),
    "table2_joint": Config("L_joint alone", {**_TABLE2_ROW, "losses": LossSettings()}),
    "table2_joint_point": Config("L_joint and L_point", {**_TABLE2_ROW, "losses": JOINT_POINT}),
    "table2_jpc": Config("L_joint, L_point and L_collision", _TABLE2_ROW),
    "trajectory_prior": Config(
        "the prior of MPD and EDMP, without the scene as input: temporal U-Net, T = 255, noise predicted",
        {
            "minutes": 40.0,
            "learning_rate": 2e-3,
            "weight_decay": 0.0,
            "encoder": None,
            "denoiser": "unet",
            "denoiser_settings": UNetSettings(32, (1, 2, 4), 5, condition_width=64),
            "schedule": ScheduleSettings(steps=255),
            "sampler": "ddpm",
            "sampling_steps": 25,
            "target": "limits",
            "objective": "noise",
            "clearance_features": False,
            "smooth_noise": False,
            "weight_limit": None,
            "validation_problems": 24,
        },
    ),
}


def planner_training(name: str, given: dict[str, Any]) -> PlannerTraining:
    """The training settings of a config, with the given changes.

    Raises InputError for an unknown name, listing the known ones, and if neither config nor changes name an
    encoder.
    """
    check_name("config", name, CONFIGS)
    changes = CONFIGS[name].changes | one_length(given)
    if "encoder" not in changes:
        raise InputError(f"config {name} needs an encoder: name the folder of a trained encoder")
    return PlannerTraining(**changes)
