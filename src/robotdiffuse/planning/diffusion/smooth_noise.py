"""Smooth noise: random trajectories like those that the diffusion model starts from, for arms without
weights.

The noise of the model that comes with the Panda has the covariance of its training trajectories about the
straight lines between their ends. Its eigenvectors are nearly sines of k half waves, its eigenvalues fall as
k^-3.5, and its standard deviation is an eighth of half the range of a joint. So the noise has
a closed form for any arm. Refined by many guidance steps, it replaces the samples of a network.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.robots.robot import Robot

SPREAD = 0.127
"""Standard deviation over the waypoints, as a fraction of half a joint's range: the mean over the Panda's
joints."""
MAX_HALF_RANGE = np.pi
"""Half a joint's range counts as no more than this [rad]: continuous joints have no limits."""
WAVES = 8
"""Number of sines; more would add less than a hundredth."""
VARIANCE_EXPONENT = 3.5
"""The variance of the sine of k half waves falls as k to this power."""


def smooth_noise(
    start: Float[ndarray, "dof"],
    goals: Float[ndarray, "k dof"],
    count: int,
    waypoints: int,
    robot: Robot,
    rng: np.random.Generator,
) -> Float[ndarray, "count waypoints dof"]:
    """Straight lines from the start to the goals in turn, plus smooth noise; float32.

    All waypoints but the ends are clipped to the joint limits.
    """
    t = np.linspace(0.0, 1.0, waypoints)
    waves = np.arange(1, WAVES + 1)
    deviations = waves ** (-VARIANCE_EXPONENT / 2)
    deviations *= SPREAD * np.sqrt(2) / np.linalg.norm(deviations)  # a sine's mean square is a half
    basis = np.sin(np.pi * t[:, None] * waves) * deviations
    half = np.minimum(0.5 * (robot.upper - robot.lower), MAX_HALF_RANGE)
    lines = start + t[:, None] * (goals[np.arange(count) % len(goals), None] - start)
    q = lines + half * (basis @ rng.normal(size=(count, WAVES, len(start))))
    q = np.clip(q, robot.lower, robot.upper).astype(np.float32)
    q[:, 0], q[:, -1] = lines[:, 0], lines[:, -1]
    return q
