"""Network inputs about the obstacles along a noisy trajectory: clearances of the links and their
gradients."""

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
"""From one scene for each trajectory and joint values [n, waypoints, dof] to the output of a
`ClearanceFn`."""


def link_clearances(checker: CollisionChecker, settings: MotionModelSettings) -> ClearanceFn:
    """The inputs for a model with these settings, in planning: all trajectories in the checker's scene."""
    limit = settings.clearance_high
    arm_links, carriers = _carriers(checker)

    def clearances(q: ndarray) -> ndarray:
        configurations = q.reshape(-1, q.shape[-1])
        if settings.clearance_gradients:
            margin = settings.gradient_margin
            links, gradients = checker.clearances_and_gradients(configurations, limit, margin)
            inputs = np.concatenate([_of_bare_arm(links, arm_links, carriers), gradients], axis=-1)
        else:
            inputs = _of_bare_arm(checker.link_clearances(configurations, limit), arm_links, carriers)
        return inputs.reshape(*q.shape[:2], -1)

    return clearances


def _carriers(checker: CollisionChecker) -> tuple[int, list[int]]:
    """The number of the checker's links that belong to the bare arm; and for each body after them, the index
    of the arm's link that carries it: the link that it is fixed to, or the last one that moves no later than
    it."""
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


def _of_bare_arm(links: ndarray, arm_links: int, carriers: list[int]) -> ndarray:
    """Clearances [n, links] of the bare arm's links, the only ones that a network has inputs for: an attached
    body counts as a part of the link that carries it."""
    of_arm = links[:, :arm_links].copy() if carriers else links
    for body, carrier in enumerate(carriers, start=arm_links):
        of_arm[:, carrier] = np.minimum(of_arm[:, carrier], links[:, body])
    return of_arm


def packed_clearances(robot: Robot, settings: MotionModelSettings) -> PackedClearanceFn:
    """The inputs for a model with these settings, in training: each trajectory in a scene of its own."""
    arrays = compile_robot(robot)

    def clearances(scenes: PackedScenes, q: ndarray) -> ndarray:
        arguments = arrays, scenes, q, settings.clearance_high
        if settings.clearance_gradients:
            return np.concatenate(
                packed_clearances_and_gradients(*arguments, settings.gradient_margin), axis=-1
            )
        return packed_link_clearances(*arguments)

    return clearances
