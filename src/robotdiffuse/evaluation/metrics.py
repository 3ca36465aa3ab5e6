"""Metrics of motions. A metric that is added to _METRICS appears in all records, and in the bench's
tables of metrics."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.exact_meshes import forward_frames
from robotdiffuse.core.types import (
    Configurations,
    Path,
    PlanResult,
    State,
    Trajectory,
    Values,
    frozen_dataclass,
    step_lengths,
)
from robotdiffuse.datasets.shards import resample
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories.straight_line import straight_line_time
from robotdiffuse.validation.report import Report
from robotdiffuse.validation.tolerances import sample_path

STEP = 0.02
"""Longest step along a path for measuring lengths of link paths [rad, joint-space L2]. Measured lengths are
too short by at most 0.002 %."""
SAMPLE_TIME = 0.01
"""Time between the states at which smoothness is measured [s]."""
STANDSTILL = 1e-6
"""A motion shorter than this counts as standing still [rad] or [m]."""
CUTOFF = 10.0
THRESHOLD = 0.05
PADDING = 4
"""Parameters of the spectral arc length, from its paper. CUTOFF: highest frequency [Hz]. THRESHOLD: smallest
amplitude, as a fraction of the amplitude at frequency 0. PADDING: zeros are appended up to a power of two,
between 2^PADDING and 2^(PADDING + 1) times the number of samples."""
BENDING_SAMPLES = 129
"""Number of evenly spaced samples of a path for measuring bending."""
DIGITS = 7
"""Number of significant digits of values in records."""


Verdict = Report | PlanResult
"""A result with the clearances of a motion that passed the validator."""


def link_length(robot: Robot, q: Float[ndarray, "n waypoints dof"]) -> Values:
    """The paper's path length: the path lengths of the origins of all links that joints move, such as links 1
    to 7 of the Panda, added up [m].

    Links that are fixed to these links, such as the hand, are left out, since they would count the last link
    several times. The paper's arm has no hand.
    """
    at = forward_frames(robot, q)[..., 1:, :3, 3]
    return np.linalg.norm(np.diff(at, axis=1), axis=-1).sum(axis=(1, 2))


@frozen_dataclass
class Motion:
    """A motion to be measured. Values that several metrics need are computed once."""

    robot: Robot
    path: Path
    trajectory: Trajectory | None
    """The timed motion; None for a path without times, for which metrics of time are None."""
    verdict: Verdict | None

    @cached_property
    def fine(self) -> Configurations:
        """The path, sampled with steps of at most STEP."""
        return sample_path(self.path.positions, STEP)[1]


Measure = Callable[[Motion], float | None]
"""Returns the value of a metric in SI units, as in records; None if the motion has no such value."""


@dataclass(frozen=True)
class Metric:
    """A number that is computed for each motion."""

    name: str
    """Name of the metric in records. Tables show it with spaces in place of underscores."""
    unit: str
    """Unit in tables."""
    better: Literal["more", "less", ""]
    """Whether larger ("more") or smaller values ("less") are better; empty if neither."""
    format: str
    """Format of numbers, such as `.2f`."""
    measure: Measure
    scale: float = 1.0
    """Factor from SI units to the unit of tables."""

    @property
    def heading(self) -> str:
        return self.name.replace("_", " ")


def _clearance(name: str) -> Measure:
    """A metric that reads a field of the verdict: a lower bound of the clearance along the motion [m]."""
    return lambda motion: getattr(motion.verdict, name, None)


def _timed(measure: Callable[[Trajectory, Robot], float | None]) -> Measure:
    """A metric that only timed motions have."""
    return lambda motion: None if motion.trajectory is None else measure(motion.trajectory, motion.robot)


def _over_straight_line(trajectory: Trajectory, robot: Robot) -> float | None:
    """The duration of the motion, divided by the shortest time along the straight line from its first to its
    last configuration. For the straight line, obstacles and jerk limits are ignored. None if a limit of
    velocity or acceleration is not positive, or if both configurations are equal."""
    if min(robot.velocity.min(), robot.acceleration.min()) <= 0:
        return None
    q = trajectory.positions
    straight_time = float(straight_line_time(q[0], q[-1], robot.velocity, robot.acceleration))
    return trajectory.duration / straight_time if straight_time > 0 else None


def _joint_jerk(statistic: Callable[[ndarray, ndarray], float]) -> Measure:
    """A metric that `statistic` computes from two arrays: the largest jerk of any joint in each step between
    rows, and the durations of the steps."""

    def value(trajectory: Trajectory, _: Robot) -> float | None:
        steps = np.diff(trajectory.times)
        if not len(steps):
            return None
        jerks = np.abs(np.diff(trajectory.accelerations, axis=0)) / steps[:, None]
        return float(statistic(jerks.max(axis=1), steps))

    return _timed(value)


def _sparc(tip: bool) -> Measure:
    """The metric spectral arc length, of the speed of the tip or of the joints (the norm of their
    velocities)."""

    def value(trajectory: Trajectory, robot: Robot) -> float:
        state, step = _evenly(trajectory)
        rates = state.velocities
        if tip:
            jacobians = robot.jacobian(state.positions)[:, :3]
            rates = (jacobians @ rates[..., None])[..., 0]
        return spectral_arc_length(np.linalg.norm(rates, axis=1), step)

    return _timed(value)


_METRICS = (
    # joint_length: Euclidean length in joint space; link_length: see the function
    Metric("joint_length", "rad", "less", ".3f", lambda m: m.path.length),
    Metric("link_length", "m", "less", ".2f", lambda m: link_length(m.robot, m.fine[None])[0]),
    Metric(
        "tip_length",
        "m",
        "less",
        ".2f",
        lambda m: Path((), m.robot.fk(m.fine)[:, :3, 3]).length,
    ),
    # sum of the angles between successive segments in joint space; 0 for a straight line
    Metric("turning", "rad", "less", ".2f", lambda m: turning(m.path.positions)),
    Metric("bending", "", "less", ".0f", lambda m: bending(m.path.positions)),
    # min_clearance is the smaller of scene_clearance (to obstacles) and self_clearance (of the arm to itself)
    *(
        Metric(name, "mm", "more", ".1f", _clearance(name), 1000.0)
        for name in ("min_clearance", "scene_clearance", "self_clearance")
    ),
    Metric("duration", "s", "less", ".2f", _timed(lambda t, _: t.duration)),
    Metric("over_straight_line", "", "less", ".3f", _timed(_over_straight_line)),
    Metric("stops", "", "less", ".2f", _timed(lambda t, _: float(len(t.stops)))),
    Metric("peak_jerk", "rad/s³", "less", ".0f", _joint_jerk(lambda j, _: j.max())),
    Metric("mean_jerk", "rad/s³", "less", ".0f", _joint_jerk(lambda j, dt: np.average(j, weights=dt))),
    # logarithm of the dimensionless jerk
    Metric("jerk", "", "less", ".2f", _timed(lambda t, _: log_dimensionless_jerk(t))),
    Metric("sparc_joint", "", "more", ".2f", _sparc(tip=False)),
    Metric("sparc_tip", "", "more", ".2f", _sparc(tip=True)),
)
METRICS = {metric.name: metric for metric in _METRICS}
"""Metrics by name, in the order of tables."""


def measured(
    robot: Robot, path: Path, trajectory: Trajectory | None = None, verdict: Verdict | None = None
) -> dict[str, float]:
    """Values of METRICS by name, without metrics that the motion does not have."""
    motion = Motion(robot, path, trajectory, verdict)
    values = {name: metric.measure(motion) for name, metric in METRICS.items()}
    return {name: float(f"{x:.{DIGITS}g}") for name, x in values.items() if x is not None}


def bending(positions: Configurations) -> float:
    """The integral of |q''(u)|^2 du for u in [0, 1], divided by the squared length of the path; 0 for a
    straight line. u is the fraction of the path length; the path is sampled at BENDING_SAMPLES values of
    u."""
    length = Path((), positions).length
    if length < STANDSTILL:
        return 0.0
    even = resample(positions[None], BENDING_SAMPLES)[0]
    second = np.diff(even, 2, axis=0) * (BENDING_SAMPLES - 1) ** 2
    return float((second**2).sum() / (BENDING_SAMPLES - 1) / length**2)


def turning(positions: Configurations) -> float:
    """Sum of the angles between successive segments [rad]; segments up to STANDSTILL are left out."""
    steps = np.diff(positions, axis=0)
    steps = steps[np.linalg.norm(steps, axis=1) > STANDSTILL]
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    # unlike the arc cosine of the unit vectors' dot product, this is accurate for small angles
    half = step_lengths(steps) / 2
    return float(2 * np.arcsin(np.minimum(half, 1.0)).sum())


def log_dimensionless_jerk(trajectory: Trajectory) -> float:
    """ln(T^5 / L^2 * integral of |q'''|^2 dt) with duration T and joint-space length L (N. Hogan and D.
    Sternad, "Sensitivity of smoothness measures to movement duration, amplitude, and arrests", 2009).

    It is 6.579 = ln 720 for a straight minimum-jerk motion, and set to 0 for a motion that stands still. Jerk
    is computed as the difference of successive accelerations divided by the time between them (SAMPLE_TIME);
    before and after the motion, the acceleration is zero. If accelerations jump, as in time-optimal motions,
    the integral is inversely proportional to SAMPLE_TIME, so only values with the same SAMPLE_TIME can be
    compared.
    """
    length = Path((), trajectory.positions).length
    if length < STANDSTILL:
        return 0.0
    even, step = _evenly(trajectory)
    accelerations = np.pad(even.accelerations, ((1, 1), (0, 0)))
    squared_jerk = float((np.diff(accelerations, axis=0) ** 2).sum()) / step
    return float(np.log(trajectory.duration**5 / length**2 * squared_jerk)) if squared_jerk > 0 else 0.0


def spectral_arc_length(speed: Values, step: float) -> float:
    """SPARC of a speed profile with samples `step` [s] apart (S. Balasubramanian, A. Melendez-Calderon, A.
    Roby-Brami and E. Burdet, "On the analysis of movement smoothness", 2015).

    The amplitude of the Fourier spectrum of the speed is scaled to 1 at frequency 0. The spectrum ends at the
    last frequency up to CUTOFF that has an amplitude of at least THRESHOLD, and frequencies are scaled to [0,
    1]. The result is minus the length of the curve of amplitude over frequency. It is -1.4 for a minimum-jerk
    motion, lower for less smooth motions, and set to 0 for a motion that stands still.
    """
    if speed.sum() * step < STANDSTILL:
        return 0.0
    count = 2 ** (int(np.ceil(np.log2(len(speed)))) + PADDING)
    amplitude = np.abs(np.fft.rfft(speed, count)) / speed.sum()
    frequency = np.arange(len(amplitude)) / (count * step)
    # at least one frequency above 0: for motions of a few milliseconds, the first one exceeds CUTOFF
    last = max(int(np.flatnonzero((amplitude >= THRESHOLD) & (frequency <= CUTOFF))[-1]), 1)
    return -float(np.hypot(1 / last, np.diff(amplitude[: last + 1])).sum())


def _evenly(trajectory: Trajectory) -> tuple[State, float]:
    """States of the trajectory at evenly spaced times about SAMPLE_TIME apart, and the time between them
    [s]."""
    count = max(round(trajectory.duration / SAMPLE_TIME), 1)
    return trajectory.at(np.linspace(0.0, trajectory.duration, count + 1)), trajectory.duration / count
