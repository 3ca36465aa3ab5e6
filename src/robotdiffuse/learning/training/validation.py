"""Validation by sampling: the share of problems that a network in training solves without search, and without
guidance unless the scene is not among its inputs.

Collision checks of the covering spheres decide, not the validator: the figures are for training curves, which
compare a network with itself.
"""

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.clearance_features import link_clearances
from robotdiffuse.learning.guidance import CollisionGuidance
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.sampling import SamplingSettings
from robotdiffuse.learning.training.batches import TrajectoryData, encode_scenes
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene_arrays import PackedScenes

SAMPLING_STEPS = 6
"""Sampling steps of every network, so that validation takes less time than the training."""
PRIOR_GUIDANCE_STEPS = 4
"""Guidance of a prior, whose inputs do not include the scene: gradient steps in each guided sampling step."""
CHECKS_PER_SEGMENT = 6
"""Configurations that are checked in each segment from waypoint to waypoint."""


def planning_success(
    model: MotionNetwork,
    robot: Robot,
    data: TrajectoryData,
    problems: int,
    candidates: int,
    rng: np.random.Generator,
) -> float:
    """Share of free trajectories among `candidates` samples for each of the first non-trivial problems.

    nan if the data hold no such problem.
    """
    rows = np.flatnonzero(~data.trivial)[:problems].tolist()
    free = [_sampled_free(model, robot, data, row, candidates, rng).mean() for row in rows]
    return float(np.mean(free)) if free else float("nan")


def _sampled_free(
    model: MotionNetwork,
    robot: Robot,
    data: TrajectoryData,
    row: int,
    candidates: int,
    rng: np.random.Generator,
) -> Bool[ndarray, "candidates"]:
    q, checker = data.q[row], CollisionChecker(robot, data.scenes.scene(row))
    code = np.zeros(0)
    if data.codes is not None:
        code = data.codes[row]
    elif model.encoder is not None:
        code = encode_scenes(model.encoder, data.scenes[row : row + 1], rng)[0]
    guidance = CollisionGuidance(checker)

    def guide(q: ndarray, _level: float) -> ndarray:
        return guidance(q, PRIOR_GUIDANCE_STEPS)[0]

    start, goal = q[0].astype(np.float64), q[-1].astype(np.float64)
    clearances = link_clearances(checker, model.settings)
    settings = SamplingSettings(samples=candidates, sampling_steps=min(SAMPLING_STEPS, model.schedule.steps))
    guided = guide if model.encoder is None else None
    q = model.sample(start, goal, code.astype(np.float32), clearances, rng, settings, guided)
    return free_in_scene(checker, q)


def free_in_scene(checker: CollisionChecker, q: Float[ndarray, "n waypoints dof"]) -> Bool[ndarray, "n"]:
    """Which motions are free in the checker's scene, at their waypoints and between them."""
    share = np.linspace(0, 1, CHECKS_PER_SEGMENT, endpoint=False)[:, None]
    dense = q[:, :-1, None] + share * np.diff(q, axis=1)[:, :, None]
    every = np.concatenate([dense.reshape(len(q), -1, q.shape[-1]), q[:, -1:]], 1)
    free = checker.free(every.reshape(-1, q.shape[-1])).reshape(len(q), -1)
    return np.all(free, axis=1, keepdims=True)[:, 0]


def motions_free(
    robot: Robot, scenes: PackedScenes, q: Float[ndarray, "n waypoints dof"]
) -> Bool[ndarray, "n"]:
    """Which motions are free, each in its own scene."""
    checkers = (CollisionChecker(robot, scenes.scene(i)) for i in range(len(scenes)))
    return np.array(
        [free_in_scene(of, motion)[0] for of, motion in zip(checkers, q[:, None], strict=True)], bool
    )
