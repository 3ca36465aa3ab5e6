"""Validations that plan: what a network in training would solve by itself, without guidance or search.

Covering spheres decide, not the judge: it is for curves of training, which compare a network with itself.
"""

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.clearances import link_clearances
from robotdiffuse.learning.motion_model import MotionModel
from robotdiffuse.learning.training.batches import TrajectoryData, encode_scenes
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.packed import unpack_scene
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box

FLOOR = Scene([Box((0.0, 0.0, -0.05), (2.0, 2.0, 0.1), name="floor")])
"""Part of every scene of the data, as in ROP."""
SAMPLING_STEPS = 6
"""Of every network alike, so that all of the levels do not take longer than the training."""
BETWEEN = 6
"""Places that are checked in each step from frame to frame."""


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
    kinds, params, q = data.kinds[row], data.params[row], data.q[row]
    checker = row_checker(robot, kinds, params)
    if data.codes is None:
        code = encode_scenes(model.encoder, kinds[None], params[None], rng)[0]
    else:
        code = data.codes[row]
    start, goal = q[0].astype(np.float64), q[-1].astype(np.float64)
    clearances = link_clearances(checker, model.config)
    steps = min(SAMPLING_STEPS, model.schedule.steps)
    q = model.sample(code.astype(np.float32), start, goal, candidates, rng, clearances, steps)
    return free_in(checker, q)


def row_checker(robot: Robot, kinds: ndarray, params: ndarray) -> CollisionChecker:
    """The checker for a packed scene of the data, kinds [k] and params [k, 10], with its floor."""
    return CollisionChecker(robot, Scene([*FLOOR.shapes, *unpack_scene(kinds, params).shapes]))


def free_in(checker: CollisionChecker, q: Float[ndarray, "n frames dof"]) -> Bool[ndarray, "n"]:
    """Which motions are free in one scene, at their frames and at places between them."""
    share = np.linspace(0, 1, BETWEEN, endpoint=False)[:, None]
    dense = q[:, :-1, None] + share * np.diff(q, axis=1)[:, :, None]
    every = np.concatenate([dense.reshape(len(q), -1, q.shape[-1]), q[:, -1:]], 1)
    free = checker.free(every.reshape(-1, q.shape[-1])).reshape(len(q), -1)
    return np.all(free, axis=1, keepdims=True)[:, 0]


def motions_free(
    robot: Robot, kinds: ndarray, params: ndarray, q: Float[ndarray, "n frames dof"]
) -> Bool[ndarray, "n"]:
    """Which motions are free, each in a packed scene of its own, kinds [n, k] and params [n, k, 10]."""
    rows = zip(kinds, params, q[:, None], strict=True)
    return np.array([free_in(row_checker(robot, *scene), motion)[0] for *scene, motion in rows], bool)
