"""Smooth noise: what the diffusion model begins with, for arms that have no weights.

The noise of the model that comes with the Panda has the covariance of its training trajectories about the
straight lines between their ends. Its eigenvectors are nearly sines of k half waves, its eigenvalues fall as
k^-3.5, and its standard deviation is an eighth of half the range of a joint. So it has a closed form for any
arm. Under the guidance of many steps it stands in for the network's draws, without any network.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.robots.robot import Robot

SPREAD = 0.127
"""Standard deviation over the waypoints, of half the range of a joint: the mean over the Panda's joints."""
WIDEST = np.pi
"""Half the range of a joint counts as no more than this [rad]: continuous joints have none."""
WAVES = 8
"""Sines; what more would add is less than a hundredth."""
FALL = 3.5
"""Their variances fall as k to this power."""


def smooth_noise(
    start: Float[ndarray, "dof"],
    goals: Float[ndarray, "k dof"],
    count: int,
    waypoints: int,
    robot: Robot,
    rng: np.random.Generator,
) -> Float[ndarray, "count waypoints dof"]:
    """Straight lines from the start to goals, which take turns, and smooth noise; within the limits, but for
    the ends themselves; float32."""
    t = np.linspace(0.0, 1.0, waypoints)
    waves = np.arange(1, WAVES + 1)
    deviations = waves ** (-FALL / 2)
    deviations *= SPREAD * np.sqrt(2) / np.linalg.norm(deviations)  # a sine's mean square is a half
    basis = np.sin(np.pi * t[:, None] * waves) * deviations
    half = np.minimum(0.5 * (robot.upper - robot.lower), WIDEST)
    lines = start + t[:, None] * (goals[np.arange(count) % len(goals), None] - start)
    q = lines + half * (basis @ rng.normal(size=(count, WAVES, len(start))))
    q = np.clip(q, robot.lower, robot.upper).astype(np.float32)
    q[:, 0], q[:, -1] = lines[:, 0], lines[:, -1]
    return q
