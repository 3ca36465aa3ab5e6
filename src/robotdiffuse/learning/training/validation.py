"""Validations that plan: what a network in training would solve by itself, without search, and without
guidance unless it sees no scene.

Covering spheres decide, not the validator: it is for curves of training, which compare a network with itself.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.clearance_features import link_clearances
from robotdiffuse.learning.guidance import CollisionGuidance
from robotdiffuse.learning.motion_model import MotionModel
from robotdiffuse.learning.training.batches import TrajectoryData, encode_scenes
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene_arrays import PackedScenes

SAMPLING_STEPS = 6
"""Of every network alike, so that all of the levels do not take longer than the training."""
PRIOR_GUIDANCE = 4
"""Gradient steps that a prior, which sees no scene, is helped by at each step of the second half."""
BETWEEN = 6
"""Places that are checked in each step from waypoint to waypoint."""


def planning_success(
    model: MotionModel,
    robot: Robot,
    data: TrajectoryData,
    problems: int,
    candidates: int,
    rng: np.random.Generator,
) -> float:
    """Share of sampled trajectories that are free, for the first so many problems that are not trivial.

    nan if the data hold no such problem.
    """
    rows = np.flatnonzero(~data.trivial)[:problems].tolist()
    free = [_sampled_free(model, robot, data, row, candidates, rng).mean() for row in rows]
    return float(np.mean(free)) if free else float("nan")


def _sampled_free(
    model: MotionModel,
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
    elif data.clouds is not None and model.encoder is not None:
        with torch.inference_mode():
            code = model.encoder(torch.from_numpy(data.clouds[row : row + 1].astype(np.float32)))[0].numpy()
    elif model.encoder is not None:
        code = encode_scenes(model.encoder, data.scenes[row : row + 1], rng)[0]
    guidance = CollisionGuidance(checker)

    def guide(q: ndarray, _level: float) -> ndarray:
        return guidance(q, PRIOR_GUIDANCE)[0]

    start, goal = q[0].astype(np.float64), q[-1].astype(np.float64)
    clearances = link_clearances(checker, model.settings)
    steps = min(SAMPLING_STEPS, model.schedule.steps)
    guided = guide if model.encoder is None else None
    q = model.sample(code.astype(np.float32), start, goal, candidates, rng, clearances, steps, guided)
    return free_in(checker, q)


def free_in(checker: CollisionChecker, q: Float[ndarray, "n waypoints dof"]) -> Bool[ndarray, "n"]:
    """Which motions are free in one scene, at their waypoints and at places between them."""
    share = np.linspace(0, 1, BETWEEN, endpoint=False)[:, None]
    dense = q[:, :-1, None] + share * np.diff(q, axis=1)[:, :, None]
    every = np.concatenate([dense.reshape(len(q), -1, q.shape[-1]), q[:, -1:]], 1)
    free = checker.free(every.reshape(-1, q.shape[-1])).reshape(len(q), -1)
    return np.all(free, axis=1, keepdims=True)[:, 0]


def motions_free(
    robot: Robot, scenes: PackedScenes, q: Float[ndarray, "n waypoints dof"]
) -> Bool[ndarray, "n"]:
    """Which motions are free, each in a scene of its own."""
    checkers = (CollisionChecker(robot, scenes.scene(i)) for i in range(len(scenes)))
    return np.array([free_in(of, motion)[0] for of, motion in zip(checkers, q[:, None], strict=True)], bool)
