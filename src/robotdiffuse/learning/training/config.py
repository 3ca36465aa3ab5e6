"""Settings of the two training runs."""

from dataclasses import dataclass, field

from robotdiffuse.errors import InputError, unknown_name
from robotdiffuse.learning.denoisers import DENOISERS, DenoiserSettings
from robotdiffuse.learning.diffusion import NoiseSchedule, ScheduleSettings
from robotdiffuse.learning.encoders import ENCODERS, EncoderSettings
from robotdiffuse.learning.motion_model import check_gradients
from robotdiffuse.learning.objectives import objective_for
from robotdiffuse.learning.parametrization import parametrization
from robotdiffuse.learning.representation import TARGETS
from robotdiffuse.learning.samplers import SAMPLERS
from robotdiffuse.learning.settings import check_kind, of_kind
from robotdiffuse.learning.training.losses import LossSettings


def check_length(samples: int | None, minutes: float | None) -> None:
    """Raises InputError unless exactly one of them is given, and positive."""
    if (samples is None) == (minutes is None):
        raise InputError(f"samples is {samples} and minutes is {minutes}; give exactly one of them")
    if (samples or minutes or 0) <= 0:
        raise InputError(f"samples is {samples} and minutes is {minutes}; the one given must be positive")


@dataclass(frozen=True)
class EncoderTraining:
    """Training of an auto-encoder of point clouds alone; it is frozen afterwards (paper, eq. l_AE)."""

    name: str = "point_autoencoder"
    """Which one; an encoder that is trained alone."""
    minutes: float | None = 5.0
    """Length of the run in wall time [min]; the learning rate reaches 0 at its end. None: by `samples`."""
    samples: int | None = None
    """Length of the run in clouds. Runs of a given length are reproducible, timed ones are not."""
    seed: int = 0
    batch: int = 32
    """Clouds per step."""
    learning_rate: float = 2e-3
    """Peak, for AdamW."""
    warmup_steps: int = 200
    max_obstacles: int = 12
    """Most obstacles in a training scene."""
    points: int = 256
    """Most points of a training cloud; each step takes between an eighth and all of them. An encoder for
    clouds of one size gets that size."""
    regularization: float = 1e-7
    """The paper's lambda: weight of the sum of squared weights, in the unit of the reconstruction's loss."""
    threads: int = 1
    """Threads of PyTorch: one thread beside other work is several times faster than two."""
    device: str | None = None
    """cpu or cuda; None: cuda if there is one."""
    checkpoint_seconds: float = 60.0
    encoder: EncoderSettings | None = field(default=None, metadata=of_kind("name", ENCODERS))
    """None: the defaults of that encoder."""

    def __post_init__(self) -> None:
        check_length(self.samples, self.minutes)
        alone = [name for name, (network, _) in ENCODERS.items() if network.trained == "alone"]
        if self.name in ENCODERS and self.name not in alone:
            raise InputError(
                f"name is {self.name}, an encoder that is trained jointly with the planner, not alone; "
                f"alone: {', '.join(alone)}"
            )
        check_kind("name", self.name, self.encoder, ENCODERS)


@dataclass(frozen=True)
class PlannerTraining:
    """Training of the motion predictor on planned trajectories."""

    data: str
    """Folder of a data set of `robotdiffuse data generate`."""
    encoder: str
    """Folder with a trained encoder, which stays as it is; or the name of an encoder, pointnet or dgcnn, say,
    that starts untrained and is trained along, by the planner's loss, on clouds drawn anew each time."""
    robot: str = "panda"
    """Bundled name, or path to a URDF: the robot that the data are for."""
    minutes: float | None = 70.0
    """Length of the run in wall time [min]; the learning rate reaches 0 at its end. None: by `samples`."""
    samples: int | None = None
    """Length of the run in training samples. Runs of a given length are reproducible, timed ones are not."""
    seed: int = 0
    batch: int = 128
    """Samples per step (paper: 64)."""
    learning_rate: float = 6e-4
    """Peak, for AdamW (paper: 3e-4)."""
    warmup_steps: int = 500
    weight_decay: float = 0.01
    gradient_norm: float = 1.0
    """Gradients are scaled down to this norm."""
    average: float = 0.9995
    """Decay of the moving average of the weights; the average is what is kept."""
    weight_limit: float = 5.0
    """Most that a noise level weighs in the loss, see NoiseSchedule.weight."""
    losses: LossSettings = field(default_factory=LossSettings)
    """The paper's losses of joints, points and collision."""
    trivial_share: float = 0.1
    """Share of the batch whose straight line is free. They teach to leave the line alone."""
    turns: int = 5
    """Copies of each trajectory turned about the vertical with their scenes, if the first joint is so."""
    smooth_noise: bool = True
    """Noise with the covariance of the trajectories over the frames; otherwise white (the paper's)."""
    validation_problems: int = 32
    """Held-out problems that are planned, without guidance, at every checkpoint."""
    bad_steps: int = 10
    """So many steps in a row with a loss that is not finite take training back to the last checkpoint."""
    threads: int = 1
    """Threads of PyTorch: one thread beside other work is several times faster than two."""
    device: str | None = None
    """cpu or cuda; None: cuda if there is one."""
    checkpoint_seconds: float = 120.0
    encoder_settings: EncoderSettings | None = field(default=None, metadata=of_kind("encoder", ENCODERS))
    """Of an encoder that is trained along; None: its defaults."""
    denoiser: str = "transformer"
    """Which denoiser."""
    denoiser_settings: DenoiserSettings | None = field(default=None, metadata=of_kind("denoiser", DENOISERS))
    """None: the defaults of that denoiser."""
    condition_drop: float = 0.0
    """Share of the samples whose condition [z, start, goal] is hidden from the denoiser, for classifier-free
    guidance (paper: "randomly masked", no share given; Ho and Salimans 2022: 0.1 or 0.2). 0: no guidance."""
    schedule: ScheduleSettings = field(default_factory=ScheduleSettings)
    sampler: str = "ddim"
    """That planning will use: ddpm (the paper's), ddim, dpm_solver or euler."""
    sampling_steps: int | None = 6
    """Calls of the denoiser that planning will use; None: all levels of the schedule (the paper's)."""
    frames: int = 48
    """Frames of a trajectory (paper: 254)."""
    parametrization: str = "frames"
    """What is diffused: frames (the paper's) or b_spline control points."""
    rows: int | None = None
    """As many; None: as there are frames."""
    target: str = "residual"
    """What rows are relative to: residual, to the straight line; absolute (the paper's)."""
    objective: str = "clean"
    """What the network predicts: clean (the paper's), noise or velocity."""
    sees_clearances: bool = True
    """Whether the denoiser is told the links' clearances along the noisy trajectory (beyond the paper)."""
    sees_gradients: bool = False
    """Whether it is told too which way each frame's joints would take the arm too close to obstacles."""

    def __post_init__(self) -> None:
        check_length(self.samples, self.minutes)
        if self.turns < 0:
            raise InputError(f"turns is {self.turns}; it must be at least 0")
        if not 0.0 <= self.trivial_share <= 1.0:
            raise InputError(f"trivial_share is {self.trivial_share}; it must be between 0 and 1")
        if not 0.0 <= self.condition_drop < 1.0:
            raise InputError(f"condition_drop is {self.condition_drop}; it must be at least 0 and below 1")
        check_gradients(self.sees_gradients, self.sees_clearances)
        check_kind("denoiser", self.denoiser, self.denoiser_settings, DENOISERS)
        if self.sampler not in SAMPLERS:
            raise unknown_name("sampler", self.sampler, SAMPLERS)
        if self.target not in TARGETS:
            raise unknown_name("target", self.target, TARGETS)
        schedule = NoiseSchedule(self.schedule)
        objective_for(self.objective, schedule)
        if self.sampling_steps is not None:
            schedule.sampling_levels(self.sampling_steps)
        if self.frames < 3:
            raise InputError(f"frames is {self.frames}; it must be at least 3")
        parametrization(self.parametrization, self.frames, self.rows or self.frames)
        if self.encoder_settings is not None:
            check_kind("encoder", self.encoder, self.encoder_settings, ENCODERS)

    @property
    def jointly(self) -> bool:
        """Whether the encoder is trained along."""
        return self.encoder in ENCODERS
