"""Figures of motions: lengths and smoothness."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.robots.kinematics import ForwardKinematics
from robotdiffuse.robots.robot import Robot
from robotdiffuse.types import Path, Trajectory

STEP = 0.02
"""Longest step [rad, joint-space L2] of a path whose links are followed; an arc is then 2e-5 too short."""
SAMPLE_TIME = 0.01
"""Time between the rows from which smoothness is measured [s]."""
STILL = 1e-6
"""What moves less than this in all [rad] or [m] stands still."""
CUTOFF, THRESHOLD, PADDING = 10.0, 0.05, 4
"""Of the spectral arc length, from its paper: highest frequency [Hz]; least amplitude, as a share of that at
frequency 0; zeros are appended up to 2 to this power times the length, or up to twice as many."""


class LinkPathLength:
    """The paper's path length: the sum over all moving links of the way that the origin travels [m]."""

    def __init__(self, robot: Robot) -> None:
        self._kinematics = ForwardKinematics(robot, torch.float64)
        self._links = [i for i, link in enumerate(robot.link_names) if robot.link_frame(link) > 0]

    def __call__(self, q: Float[ndarray, "n frames dof"]) -> Float[ndarray, "n"]:
        """Of motions through these configurations [rad]."""
        with torch.inference_mode():
            T = self._kinematics.links(torch.from_numpy(np.asarray(q, np.float64)))
        at = T[..., self._links, :3, 3].numpy()
        return np.linalg.norm(np.diff(at, axis=-3), axis=-1).sum(axis=(-2, -1))


@dataclass(frozen=True)
class Measures:
    """Figures of one motion: the lengths and the turning of its path, the rest of its trajectory."""

    joint_length: float
    """Euclidean length in joint space [rad]."""
    link_length: float
    """The paper's path length: the way of the origins of all moving links together [m]."""
    tip_length: float
    """Way of the origin of the robot's tip [m]."""
    turning: float
    """Sum of the angles between successive segments in joint space [rad]; 0 for a straight line."""
    duration: float
    """[s]"""
    jerk: float
    """Logarithm of the dimensionless jerk in joint space, see `log_dimensionless_jerk`; less is smoother."""
    sparc_joint: float
    """Spectral arc length of the joint-space speed, see `spectral_arc_length`; nearer to 0 is smoother."""
    sparc_tip: float
    """Of the speed of the origin of the robot's tip."""


class MotionMeasures:
    """Measures motions of one robot."""

    def __init__(self, robot: Robot) -> None:
        self._kinematics, self._tip = ForwardKinematics(robot, torch.float64), robot.tip
        self._link_length = LinkPathLength(robot)

    def __call__(self, path: Path, trajectory: Trajectory) -> Measures:
        """Of a path and the same motion with times.

        Motions that stand still have the value 0 in everything but the duration.
        """
        q = _fine(path.positions)
        even, step = _evenly(trajectory)
        with torch.inference_mode():
            tip = self._kinematics.link(torch.from_numpy(q), self._tip)[:, :3, 3].numpy()
            jacobian = self._kinematics.jacobian(torch.from_numpy(even.positions), self._tip)[:, :3].numpy()
        tip_velocities = np.einsum("nij,nj->ni", jacobian, even.velocities)
        return Measures(
            joint_length=path.length,
            link_length=float(self._link_length(q[None])[0]),
            tip_length=float(np.linalg.norm(np.diff(tip, axis=0), axis=1).sum()),
            turning=turning(path.positions),
            duration=trajectory.duration,
            jerk=log_dimensionless_jerk(trajectory),
            sparc_joint=spectral_arc_length(np.linalg.norm(even.velocities, axis=1), step),
            sparc_tip=spectral_arc_length(np.linalg.norm(tip_velocities, axis=1), step),
        )


def turning(positions: Float[ndarray, "n dof"]) -> float:
    """Sum of the angles between successive segments that have a length [rad]."""
    steps = np.diff(positions, axis=0)
    steps = steps[np.linalg.norm(steps, axis=1) > STILL]
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    # Unlike the arc cosine of their product, this keeps the digits of nearly straight turns.
    half = np.linalg.norm(np.diff(steps, axis=0), axis=1) / 2
    return float(2 * np.arcsin(np.minimum(half, 1.0)).sum())


def log_dimensionless_jerk(trajectory: Trajectory) -> float:
    """ln(T^5 / L^2 * integral of |q'''|^2 dt) with duration T and joint-space length L (N. Hogan and D.
    Sternad, "Sensitivity of smoothness measures to movement duration, amplitude, and arrests", 2009).

    6.579 = ln 720 for a straight minimum-jerk motion, 0 for one that stands still. Jerk is the difference of
    accelerations over SAMPLE_TIME; before and after the motion they are zero. Where an acceleration jumps, as
    in time-optimal motions, the integral is inverse to that time: only figures of equal one can be compared.
    """
    length = float(np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1).sum())
    if length < STILL:
        return 0.0
    even, step = _evenly(trajectory)
    accelerations = np.pad(even.accelerations, ((1, 1), (0, 0)))
    squared_jerk = float((np.diff(accelerations, axis=0) ** 2).sum()) / step
    return float(np.log(trajectory.duration**5 / length**2 * squared_jerk)) if squared_jerk > 0 else 0.0


def spectral_arc_length(speed: Float[ndarray, "n"], step: float) -> float:
    """SPARC of a speed profile with rows `step` [s] apart (S. Balasubramanian, A. Melendez-Calderon, A.
    Roby-Brami and E. Burdet, "On the analysis of movement smoothness", 2015).

    Minus the length of the curve of the amplitude of its Fourier spectrum, 1 at frequency 0, over the
    frequency as a share of the last one up to CUTOFF whose amplitude is at least THRESHOLD. -1.4 for a
    minimum-jerk motion, less for less smooth ones; 0 for one that stands still.
    """
    if speed.sum() * step < STILL:
        return 0.0
    count = 2 ** (int(np.ceil(np.log2(len(speed)))) + PADDING)
    amplitude = np.abs(np.fft.rfft(speed, count)) / speed.sum()
    frequency = np.arange(len(amplitude)) / (count * step)
    # In motions of a few milliseconds the first frequency above 0 is past the cut-off.
    last = max(int(np.flatnonzero((amplitude >= THRESHOLD) & (frequency <= CUTOFF))[-1]), 1)
    return -float(np.hypot(1 / last, np.diff(amplitude[: last + 1])).sum())


def _evenly(trajectory: Trajectory) -> tuple[Trajectory, float]:
    """With rows at even times, from the first to the last, as near to SAMPLE_TIME apart as fits; and that
    time [s]."""
    count = max(round(trajectory.duration / SAMPLE_TIME), 1)
    times = np.linspace(0.0, trajectory.duration, count + 1)

    def at(rows: Float[ndarray, "m dof"]) -> Float[ndarray, "n dof"]:
        return np.stack([np.interp(times, trajectory.times, column) for column in rows.T], axis=1)

    rows = (at(trajectory.positions), at(trajectory.velocities), at(trajectory.accelerations))
    return Trajectory(trajectory.joint_names, times, *rows), trajectory.duration / count


def _fine(positions: Float[ndarray, "n dof"]) -> Float[ndarray, "m dof"]:
    """Configurations along a path at most STEP apart, its waypoints among them."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    counts = np.maximum(np.ceil(steps / STEP).astype(int), 1)
    starts = np.repeat(np.arange(len(counts)), counts)
    share = np.concatenate([np.arange(n) / n for n in counts]) if len(counts) else np.zeros(0)
    between = positions[:-1][starts] + share[:, None] * np.diff(positions, axis=0)[starts]
    return np.concatenate([between, positions[-1:]])
