"""Settings of training runs: what all share, and those of an encoder, the diffusion model and a baseline."""

from dataclasses import dataclass, field
from typing import Annotated

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import (
    Bound,
    Count,
    Natural,
    NotNegative,
    OneOf,
    Positive,
    Settings,
    SettingsOf,
    Share,
)
from robotdiffuse.learning.denoisers import DENOISERS
from robotdiffuse.learning.denoisers.base import DenoiserSettings
from robotdiffuse.learning.encoders import COMPLETES, ENCODERS
from robotdiffuse.learning.encoders.base import EncoderSettings
from robotdiffuse.learning.motion_model import MOST_WAYPOINTS, ModelParts
from robotdiffuse.learning.networks import NETWORKS
from robotdiffuse.learning.training.losses import LossSettings

ShareBelowOne = Annotated[float, Bound(least=0.0, below=1.0)]
DEVICES = ("cpu", "cuda")


@dataclass(frozen=True, kw_only=True)
class TrainingSettings(Settings):
    """What every training run is told."""

    minutes: Positive | None = 40.0
    """Length of the run in wall time [min]; the learning rate reaches 0 at its end. None: by `samples`."""
    samples: Count | None = None
    """Length of the run in training samples. Runs of a given length are reproducible, timed ones are not."""
    seed: Natural = 0
    batch: Count = 128
    """Samples per step."""
    learning_rate: Positive = 1e-3
    """Peak, for AdamW."""
    warmup_steps: Natural = 500
    weight_decay: NotNegative = 0.0
    gradient_norm: Positive = 1.0
    """Gradients are scaled down to this norm."""
    average: ShareBelowOne = 0.9995
    """Decay of the moving average of the weights; the average is what is kept."""
    bad_steps: Count = 10
    """So many steps in a row with a loss that is not finite take training back to the last checkpoint."""
    threads: Count = 1
    """Threads of PyTorch: one thread beside other work is several times faster than two."""
    device: Annotated[str, OneOf(DEVICES)] | None = None
    """cpu or cuda; None: cuda if there is one."""
    checkpoint_seconds: NotNegative = 120.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.samples is None) == (self.minutes is None):
            raise InputError(
                f"samples is {self.samples} and minutes is {self.minutes}; give exactly one of them"
            )


@dataclass(frozen=True, kw_only=True)
class EncoderTraining(TrainingSettings):
    """Training of an auto-encoder of point clouds alone; it is frozen afterwards (paper, eq. l_AE)."""

    name: Annotated[str, OneOf(ENCODERS)] = "point_autoencoder"
    """Which one; an encoder that is trained alone."""
    minutes: Positive | None = 5.0
    batch: Count = 32
    """Clouds per step."""
    learning_rate: Positive = 2e-3
    warmup_steps: Natural = 200
    average: ShareBelowOne = 0.999
    checkpoint_seconds: NotNegative = 60.0
    max_obstacles: Natural = 12
    """Most obstacles in a training scene."""
    points: Count = 256
    """Most points of a training cloud; each step takes between an eighth and all of them. An encoder for
    clouds of one size gets that size."""
    regularization: NotNegative = 1e-7
    """The paper's lambda: weight of the sum of squared weights, in the unit of the reconstruction's loss."""
    encoder: Annotated[EncoderSettings | None, SettingsOf("name", ENCODERS)] = None
    """None: the defaults of that encoder."""

    def __post_init__(self) -> None:
        super().__post_init__()
        alone = [name for name, entry in ENCODERS.items() if entry.kind == "alone"]
        if self.name not in alone:
            completes = ENCODERS[self.name].kind == COMPLETES
            how = "by train completion" if completes else "jointly with the planner"
            raise InputError(
                f"name is {self.name}, an encoder that is trained {how}, not alone; alone: {', '.join(alone)}"
            )


@dataclass(frozen=True, kw_only=True)
class MotionTraining(TrainingSettings):
    """Training on planned trajectories."""

    data: str
    """Folder of a data set of `robotdiffuse data generate`."""
    robot: str = "panda"
    """Bundled name, or path to a URDF: the robot that the data are for."""
    waypoints: Annotated[int, Bound(least=3.0, most=MOST_WAYPOINTS)] = 48
    """Waypoints of a trajectory (paper: 254)."""
    turns: Natural = 5
    """Copies of each trajectory turned about the vertical with their scenes, if the first joint is so."""


@dataclass(frozen=True, kw_only=True)
class PlannerTraining(MotionTraining, ModelParts):
    """Training of the diffusion model."""

    encoder: str | None
    """Folder with a trained encoder, or with a completing network, or completing_autoencoder for the one that
    comes with the package: they stay as they are. Or the name of another encoder, pointnet or dgcnn, say,
    that starts untrained and is trained along, by the planner's loss, on clouds drawn anew each time. None
    for a prior, which sees no scene."""
    views: bool = False
    """Whether the encoder is told what one camera sees of each scene, and not of all its surfaces."""
    minutes: Positive | None = 70.0
    learning_rate: Positive = 6e-4
    """Peak, for AdamW (paper: 3e-4)."""
    weight_decay: NotNegative = 0.01
    weight_limit: Positive | None = 5.0
    """Most that a noise level weighs in the loss, see NoiseSchedule.weight; None: all weigh the same."""
    losses: LossSettings = field(default_factory=LossSettings)
    """The paper's losses of joints, points and collision."""
    trivial_share: Share = 0.1
    """Share of the batch whose straight line is free. They teach to leave the line alone."""
    smooth_noise: bool = True
    """Noise with the covariance of the trajectories over the waypoints; otherwise white (the paper's)."""
    validation_problems: Natural = 32
    """Held-out problems that are planned, without guidance, at every checkpoint."""
    encoder_settings: Annotated[EncoderSettings | None, SettingsOf("encoder", ENCODERS)] = None
    """Of an encoder that is trained along; None: its defaults."""
    denoiser_settings: Annotated[DenoiserSettings | None, SettingsOf("denoiser", DENOISERS)] = None
    """None: the defaults of that denoiser."""
    condition_drop: ShareBelowOne = 0.0
    """Share of the samples whose condition [z, start, goal] is hidden from the denoiser, for classifier-free
    guidance (paper: "randomly masked", no share given; Ho and Salimans 2022: 0.1 or 0.2). 0: no guidance."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.target == "limits" and self.smooth_noise:
            raise InputError("target is limits and smooth_noise is True; in units of the limits it is white")
        if self.views and self.encoder is None:
            raise InputError("views is True and encoder is None; without an encoder no scene is seen at all")
        if self.encoder_settings is not None and ENCODERS.entry(self.encoder).kind == COMPLETES:
            raise InputError(f"encoder_settings are given; {self.encoder} comes trained, with its own")

    @property
    def jointly(self) -> bool:
        """Whether the encoder is trained along."""
        return self.encoder in ENCODERS and ENCODERS.entry(self.encoder).kind != COMPLETES


@dataclass(frozen=True, kw_only=True)
class BaselineTraining(MotionTraining):
    """Training of a baseline's network."""

    name: Annotated[str, OneOf(NETWORKS)]
    """Which network."""
    device: Annotated[str, OneOf(("cpu",))] | None = "cpu"
    """The networks are small."""
