"""Augmentation: copies of motions turned about the vertical, which cost no planning.

If the first joint turns about the base's z axis, a scene turned by an angle needs the same motion with that
angle added to the first joint. Only the base link does not turn (nor do the floor's corners, which are out of
reach): copies that would touch the base link are left out.
"""

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.scene_arrays import PackedScenes


def turns_about_vertical(robot: Robot) -> bool:
    """Whether the first joint turns about the z axis of the base, and all of the robot with it."""
    T_base_joint = robot.frame_offsets[0]
    on_axis = np.allclose(T_base_joint[:2, 3], 0.0, atol=1e-6) and bool(robot.moved_by[1:, 0].all())
    return not robot.prismatic[0] and on_axis and bool(np.isclose(T_base_joint[2, 2], 1.0, atol=1e-9))


def turned(
    robot: Robot,
    q: Float32[ndarray, "n waypoints dof"],
    scenes: PackedScenes,
    rng: np.random.Generator,
) -> tuple[Float32[ndarray, "n waypoints dof"], PackedScenes, Bool[ndarray, "n"]]:
    """Turn each motion and its scene by a random angle, uniform within the limits of the first joint.

    Returns the motions, the scenes and which motions are free of collision with the base.
    `turns_about_vertical` must hold for the robot.
    """
    first = q[:, :, 0]
    low = np.maximum(robot.lower[0] - first.min(1), -np.pi)
    high = np.minimum(robot.upper[0] - first.max(1), np.pi)
    angle = rng.uniform(np.minimum(low, 0.0), np.maximum(high, 0.0)).astype(np.float32)
    q = q.copy()
    q[:, :, 0] = np.clip(first + angle[:, None], robot.lower[0], robot.upper[0])
    free = CollisionChecker(robot, Scene([])).free(q.reshape(-1, q.shape[-1])).reshape(len(q), -1)
    return q, scenes.turned(angle), free.min(axis=1)
