"""What a model is told of the obstacles along a noisy trajectory: in planning, and in training."""

from collections.abc import Callable

import numpy as np
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.batched_clearances import packed_clearances_and_gradients, packed_link_clearances
from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.learning.motion_model import ClearanceFn, MotionModelSettings
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene_arrays import PackedScenes

PackedClearanceFn = Callable[[PackedScenes, ndarray], ndarray]
"""A scene for each trajectory and joint values [n, rows, dof] to what `ClearanceFn` gives."""


def link_clearances(checker: CollisionChecker, settings: MotionModelSettings) -> ClearanceFn:
    """What a model of these settings is told of the obstacles."""
    limit = settings.clearance_high
    arm, carriers = _carriers(checker)

    def clearances(q: ndarray) -> ndarray:
        rows = q.reshape(-1, q.shape[-1])
        if settings.sees_gradients:
            links, gradients = checker.clearances_and_gradients(rows, limit, settings.gradient_margin)
            told = np.concatenate([_of_arm(links, arm, carriers), gradients], axis=-1)
            return told.reshape(*q.shape[:2], -1)
        return _of_arm(checker.link_clearances(rows, limit), arm, carriers).reshape(*q.shape[:2], -1)

    return clearances


def _carriers(checker: CollisionChecker) -> tuple[int, list[int]]:
    """How many of the checker's links are the bare arm's, and for each body after them, the one of these that
    carries it: the link that it is fixed to, or the last one that moves as that does or before."""
    robot = checker.robot
    arm = [link for link in checker.links if link in robot.arm.link_names]
    fixed_to = {body.name: body.link for body in robot.attached}

    def carrier(link: str) -> int:
        while link in fixed_to:
            link = fixed_to[link]
        order = [(link == other, min(robot.link_frame(other) - robot.link_frame(link), 0)) for other in arm]
        before = [i for i, other in enumerate(arm) if robot.link_frame(other) <= robot.link_frame(link)]
        return max(before or range(len(arm)), key=lambda i: (*order[i], i))

    return len(arm), [carrier(link) for link in checker.links[len(arm) :]]


def _of_arm(links: ndarray, arm: int, carriers: list[int]) -> ndarray:
    """Clearances [n, links] of the bare arm's links, which are all that a network knows: what it holds counts
    as a part of the link that carries it."""
    told = links[:, :arm].copy() if carriers else links
    for held, carrier in enumerate(carriers, start=arm):
        told[:, carrier] = np.minimum(told[:, carrier], links[:, held])
    return told


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
