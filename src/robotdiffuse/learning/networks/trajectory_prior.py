"""An unconditional diffusion prior over joint trajectories: the network of MPD and of EDMP.

- *MPD*: J. Carvalho, A. Le, M. Baierl, D. Koert, J. Peters, "Motion Planning Diffusion: Learning and Planning
  of Robot Motions with Diffusion Models", IROS 2023.
- *EDMP*: K. Saha et al., "EDMP: Ensemble-of-costs-guided Diffusion for Motion Planning", ICRA 2024.

Both train the temporal U-Net of Diffuser (M. Janner et al., ICML 2022), which sees noisy trajectories and the
noise level but no scene, to predict the noise; both hold start and goal at their values in every noisy
trajectory (in-painting), and both bring in the scene by gradients of costs on the mean of every denoising
step. So one trained network serves both; each samples by levels, noise and guides of its own, which are in
`planners.mpd` and `planners.edmp`.

Differences from the papers, with their values:

- One network for both. Waypoints: 48, as all our data (MPD 64, EDMP 50). Joint positions alone as in EDMP
(MPD
  adds velocities), scaled to the joint limits as in both.
- T = 255 levels of the cosine schedule, as EDMP; MPD trains with 25 levels of an exponential schedule. Its
  sampler takes the 25 of these levels that are nearest to it in signal-to-noise ratio (`exponential_levels`).
- Width 32 at resolutions 1, 2, 4 (0.7 million numbers); MPD 32 at 1, 2, 4, 8 (about 4 million). It trains at
  1,200 samples/s on a core of a CPU. Layer norms over channels and condition by scale and shift, as our U-Net
  has, in place of group norms and an added time embedding.
- Trained on trajectories of all scenes mixed, as EDMP; MPD trains a prior per environment. A tenth of a batch
  are motions whose straight line is free, and half of it is reversed, as for our own model.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.errors import InputError
from robotdiffuse.learning.denoisers.layers import Linear
from robotdiffuse.learning.denoisers.unet import UNet, UNetSettings
from robotdiffuse.learning.diffusion import NoiseSchedule, ScheduleSettings
from robotdiffuse.learning.guidance import CollisionGuidance
from robotdiffuse.learning.motion_model import one_thread
from robotdiffuse.learning.networks.base import BaselineNetwork
from robotdiffuse.learning.objectives import objective_for
from robotdiffuse.learning.robot_identity import RobotIdentity
from robotdiffuse.learning.samplers.ddpm import ancestral
from robotdiffuse.learning.training.batches import TrajectoryData, fast_bf16
from robotdiffuse.learning.training.validation import motions_free
from robotdiffuse.robots.robot import Robot
from robotdiffuse.settings import Bound, Settings, Share

SUCCESS_PROBLEMS = 24
"""Motions that `success` tries."""
SUCCESS_STEPS = 25
"""Denoising steps of each, of which the last quarter is guided."""
SUCCESS_GUIDANCE = 4
"""Gradient steps at each of those."""
EXPONENTIAL_BETAS = (1e-4, 1.0)
"""Variance that the first and last step of MPD's exponential schedule add."""


@dataclass(frozen=True)
class TrajectoryPriorSettings(Settings, name="trajectory_prior"):
    waypoints: Annotated[int, Bound(least=3.0)] = 48
    """Of a trajectory, evenly spaced along it (MPD: 64, EDMP: 50)."""
    unet: UNetSettings = field(
        default_factory=lambda: UNetSettings(width=32, multiples=(1, 2, 4), kernel=5, condition_width=64)
    )
    schedule: ScheduleSettings = field(default_factory=lambda: ScheduleSettings(steps=255, kind="cosine"))
    """EDMP's; of MPD's 25 exponential levels a part, see the head of this file."""
    trivial_share: Share = 0.1
    """Share of a batch whose straight lines are free."""


Guide = Callable[[ndarray, int], ndarray]
"""The mean of a denoising step [count, waypoints, dof] [rad], and how many steps are still to come (0 at
the last one and in the steps without noise after it), to the mean after steps down the guide's costs."""


class TrajectoryPrior(BaselineNetwork):
    """The U-Net and its noise schedule; see the head of this file."""

    settings: TrajectoryPriorSettings
    training_defaults: ClassVar[dict[str, Any]] = {"batch": 128, "learning_rate": 2e-3}

    def __init__(self, robot: RobotIdentity, settings: TrajectoryPriorSettings) -> None:
        super().__init__(robot, settings)
        self.schedule = NoiseSchedule(settings.schedule)
        self.objective = objective_for("noise", self.schedule)
        # the U-Net wants a condition: one number that is always zero
        self.denoiser = UNet(settings.unet, settings.waypoints, self.dof, self.dof, 1)

    def for_inference(self) -> "TrajectoryPrior":
        """Freeze, and keep the matrices in bf16 where that is fast, here by a sixth. Returns self."""
        super().for_inference()
        if fast_bf16():
            for module in self.denoiser.modules():
                if isinstance(module, Linear):
                    module.to(torch.bfloat16)
        return self

    def forward(
        self, x: Float[Tensor, "batch waypoints dof"], level: Float[Tensor, "batch"]
    ) -> Float[Tensor, "batch waypoints dof"]:
        """The noise in x; `level` is t / T. In bf16 where the CPU multiplies it fast."""
        with torch.autocast("cpu", torch.bfloat16, enabled=fast_bf16() and x.device.type == "cpu"):
            return self.denoiser(x, level, x.new_zeros(len(x), 1)).float()

    def loss(
        self, data: TrajectoryData, count: int, fraction: float, rng: np.random.Generator
    ) -> Float[Tensor, ""]:
        """The squared error of the noise of all waypoints but the ends, which are held (Ho et al. 2020, eq.
        14).

        Raises InputError if the data have another number of waypoints.
        """
        waypoints, schedule = self.settings.waypoints, self.schedule
        if data.q.shape[1] != waypoints:
            raise InputError(
                f"the data have {data.q.shape[1]} waypoints and trajectory_prior.waypoints is {waypoints}; "
                "they must be the same"
            )
        q = data.q[data.draw(count, self.settings.trivial_share, rng)]
        back = rng.random(count) < 0.5
        q[back] = q[back, ::-1]
        clean = self.normalizer.to_unit(q.astype(np.float32))
        # One level from each of `count` equal parts of the range: less variance than independent draws.
        parts = (np.arange(count) + rng.random(count)) / count
        levels = np.minimum(1 + (parts * schedule.steps).astype(np.int64), schedule.steps)
        signal, noise_level = (
            a[levels].astype(np.float32)[:, None, None] for a in (schedule.signal, schedule.noise)
        )
        noise = rng.standard_normal(clean.shape, np.float32)
        noisy = signal * clean + noise_level * noise
        noisy[:, [0, -1]] = clean[:, [0, -1]]
        device = next(self.parameters()).device
        of_levels = torch.from_numpy((levels / schedule.steps).astype(np.float32)).to(device)
        predicted = self(torch.from_numpy(noisy).to(device), of_levels)
        target = torch.from_numpy(noise).to(device)
        return (predicted - target)[:, 1:-1].square().mean()

    def success(self, data: TrajectoryData, robot: Robot, rng: np.random.Generator) -> float | None:
        """Share of motions that are free, of one sample each under simple guidance with all of the costs.

        The guidance is `CollisionGuidance`, which is stronger than either paper's; None if there is no motion
        that is not trivial.
        """
        rows = np.flatnonzero(~data.trivial)[:SUCCESS_PROBLEMS]
        if not len(rows):
            return None
        scenes, q = data.scenes[rows], data.q[rows]
        guidance = [CollisionGuidance(CollisionChecker(robot, scenes.scene(i))) for i in range(len(scenes))]

        def guide(q: ndarray, left: int) -> ndarray:
            if left >= SUCCESS_STEPS // 4:
                return q
            return np.concatenate(
                [of(motion[None], SUCCESS_GUIDANCE)[0] for of, motion in zip(guidance, q, strict=True)]
            )

        levels = self.schedule.sampling_levels(SUCCESS_STEPS)[:-1]
        sampled = self.sample(q[:, 0], q[:, -1], levels, rng, guide)
        assert sampled is not None
        return float(motions_free(robot, scenes, sampled).mean())

    def sample(
        self,
        starts: Float[ndarray, "count dof"],
        goals: Float[ndarray, "count dof"],
        levels: Int[ndarray, "steps"],
        rng: np.random.Generator,
        guide: Guide | None = None,
        noise_scale: float = 1.0,
        quiet_steps: int = 0,
        stop: Callable[[], bool] = lambda: False,
    ) -> Float[ndarray, "count waypoints dof"] | None:
        """A trajectory from each start to its goal, float32, within the limits but for the ends themselves.

        levels, noise_scale: see `ancestral`.
        quiet_steps: more steps at the last level, to which no noise is added (MPD: 5).
        stop: asked before every step; None is returned if it says so.
        """
        ends = self.normalizer.to_unit(np.stack([starts, goals], 1).astype(np.float32))
        device = next(self.parameters()).device

        def predict(x: ndarray, level: int) -> ndarray:
            if stop():
                raise StoppedError
            x[:, [0, -1]] = ends
            of_levels = torch.full((len(x),), level / self.schedule.steps, device=device)
            noise = self(torch.from_numpy(x).to(device), of_levels).cpu().numpy()
            signal, noise_level = float(self.schedule.signal[level]), float(self.schedule.noise[level])
            # predictions beyond the limits are none that the data have
            return np.clip(self.objective.clean(x, noise, signal, noise_level), -1.0, 1.0)

        def move(x: ndarray, left: int) -> ndarray:
            return x if guide is None else self.normalizer.to_unit(guide(self.normalizer.from_unit(x), left))

        def draw_noise() -> ndarray:
            return rng.standard_normal((len(ends), self.settings.waypoints, self.dof), np.float32)

        with torch.inference_mode(), one_thread():
            try:
                x = ancestral(predict, self.schedule, draw_noise, levels, move, noise_scale)
                for _ in range(quiet_steps):
                    x = move(predict(x, int(levels[-1])), 0)
            except StoppedError:
                return None
        q = self.normalizer.from_unit(np.clip(x, -1.0, 1.0))
        q[:, 0], q[:, -1] = starts, goals
        return q


class StoppedError(Exception):
    """Time ran out while trajectories were sampled."""


def exponential_levels(schedule: NoiseSchedule, steps: int) -> Int[ndarray, "steps"]:
    """The levels nearest to those of MPD's exponential schedule in log signal-to-noise ratio, falling from T.

    Its betas grow by a constant factor; levels that would fall together are moved apart. Raises InputError
    unless there are that many levels.
    """
    _check_steps(schedule, steps)
    betas = np.geomspace(*EXPONENTIAL_BETAS, steps)
    alpha_bar = np.cumprod(1 - betas)[:-1]
    wanted = 0.5 * np.log(alpha_bar / (1 - alpha_bar))
    nearest = np.abs(schedule.half_log_snr[1:, None] - wanted).argmin(0) + 1
    return _falling(np.append(nearest, schedule.steps), schedule.steps)


def quadratic_levels(schedule: NoiseSchedule, steps: int) -> Int[ndarray, "steps"]:
    """A part of the levels, falling from T, closer where there is little noise (Song et al. 2021, D.2).

    For fewer steps than levels: evenly spaced ones end where there is much noise left, of which an error of
    the network stays in the samples. Raises InputError unless there are that many levels.
    """
    _check_steps(schedule, steps)
    wanted = schedule.steps * (np.arange(1, steps + 1) / steps) ** 2
    return _falling(np.maximum(wanted.round().astype(np.int64), 1), schedule.steps)


def _check_steps(schedule: NoiseSchedule, steps: int) -> None:
    if not 2 <= steps <= schedule.steps:
        raise InputError(f"sampling steps is {steps}; it must be between 2 and {schedule.steps}")


def _falling(levels: Int[ndarray, "steps"], most: int) -> Int[ndarray, "steps"]:
    """Rising levels, those that are the same moved apart, up to `most`; the other way round."""
    at = np.arange(len(levels))
    apart = np.maximum.accumulate(levels - at) + at
    return np.minimum(apart, most - at[::-1])[::-1].copy()
