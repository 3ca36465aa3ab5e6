"""A validation that plans: what a network in training would solve by itself, without guidance or search."""

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.clearances import link_clearances
from robotdiffuse.learning.data.batches import TrajectoryData, encode_scenes
from robotdiffuse.learning.motion_model import MotionModel
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.rop import unpack_scene
from robotdiffuse.scenes.scene import Scene

BETWEEN = 6
"""Places that are checked in each step from frame to frame."""


def planning_success(
    model: MotionModel,
    robot: Robot,
    data: TrajectoryData,
    floor: Scene,
    problems: int,
    candidates: int,
    rng: np.random.Generator,
) -> float:
    """Share of sampled trajectories that are free, for the first so many problems that are not trivial.

    Covering spheres decide, not the judge: it is for curves of training, which compare a network with itself.
    nan if the data hold no such problem.
    """
    rows = np.flatnonzero(~data.trivial)[:problems].tolist()
    free = [_sampled_free(model, robot, data, floor, row, candidates, rng).mean() for row in rows]
    return float(np.mean(free)) if free else float("nan")


def _sampled_free(
    model: MotionModel,
    robot: Robot,
    data: TrajectoryData,
    floor: Scene,
    row: int,
    candidates: int,
    rng: np.random.Generator,
) -> Bool[ndarray, "candidates"]:
    kinds, params, q = data.kinds[row], data.params[row], data.q[row]
    checker = CollisionChecker(robot, Scene([*floor.shapes, *unpack_scene(kinds, params).shapes]))
    if data.codes is None:
        code = encode_scenes(model.encoder, kinds[None], params[None], rng)[0]
    else:
        code = data.codes[row]
    start, goal = q[0].astype(np.float64), q[-1].astype(np.float64)
    clearances = link_clearances(checker, model.config)
    sampled = model.sample(code.astype(np.float32), start, goal, candidates, rng, clearances)
    share = np.linspace(0, 1, BETWEEN, endpoint=False)[:, None]
    dense = sampled[:, :-1, None] + share * np.diff(sampled, axis=1)[:, :, None]
    free = checker.free(dense.reshape(-1, robot.dof)).reshape(candidates, -1)
    return np.all(free, axis=1, keepdims=True)[:, 0]
