"""What a model is told of the obstacles along a noisy trajectory: in planning, and in training."""

from collections.abc import Callable

import numpy as np
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.arrays import compile_robot
from robotdiffuse.collision.packed import packed_clearances_and_gradients, packed_link_clearances
from robotdiffuse.learning.motion_model import ClearanceFn, MotionModelSettings
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.packed import PackedScenes

PackedClearanceFn = Callable[[PackedScenes, ndarray], ndarray]
"""A scene for each trajectory and joint values [n, rows, dof] to what `ClearanceFn` gives."""


def link_clearances(checker: CollisionChecker, settings: MotionModelSettings) -> ClearanceFn:
    """What a model of these settings is told of the obstacles."""
    limit = settings.clearance_high

    def clearances(q: ndarray) -> ndarray:
        rows = q.reshape(-1, q.shape[-1])
        if settings.sees_gradients:
            told = checker.clearances_and_gradients(rows, limit, settings.gradient_margin)
            return np.concatenate(told, axis=-1).reshape(*q.shape[:2], -1)
        return checker.link_clearances(rows, limit).reshape(*q.shape[:2], -1)

    return clearances


def packed_clearances(robot: Robot, settings: MotionModelSettings) -> PackedClearanceFn:
    """The same for training, each trajectory in a scene of its own."""
    arrays = compile_robot(robot)

    def clearances(scenes: PackedScenes, q: ndarray) -> ndarray:
        given = arrays, scenes, q, settings.clearance_high
        if settings.sees_gradients:
            told = packed_clearances_and_gradients(*given, settings.gradient_margin)
            return np.concatenate(told, axis=-1)
        return packed_link_clearances(*given)

    return clearances
