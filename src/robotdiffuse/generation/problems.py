"""Random problems as in the paper: a scene, a start, a target of the tip, goals by inverse kinematics."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.errors import InputError
from robotdiffuse.generation.settings import GenerationSettings
from robotdiffuse.problems.families.furniture import (
    FurnitureSettings,
    Region,
    sample_furniture,
    sample_target,
)
from robotdiffuse.problems.families.rop import RopSettings, sample_scene
from robotdiffuse.problems.rop_problems import base_spheres, free_configuration
from robotdiffuse.robots.inverse_kinematics import InverseKinematicsSettings, inverse_kinematics
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

SCENES = 100
"""Scenes given up, for want of a start or of a goal, before the settings are called impossible."""
AT_LIMIT = 1e-3
"""Joints closer than this to a limit count as clipped [rad]."""
FULL_POSE = InverseKinematicsSettings(max_rounds=4, patience=2)
"""A few rounds: a target inside an obstacle is better drawn anew than searched for long."""
POSITION_ONLY = replace(FULL_POSE, position_only=True)


@dataclass(frozen=True, eq=False)
class TargetProblem:
    """A problem whose goals all bring the tip to one target."""

    family: int
    """In the order of the mix."""
    scene: Scene
    """The floor first, if the family has one."""
    start: Float32[ndarray, "dof"]
    goals: Float32[ndarray, "k dof"]
    T_base_tip: Float[ndarray, "4 4"]
    """The target; where only its position is given, the orientation is that of the first goal."""


def draw_problem(settings: GenerationSettings, robot: Robot, rng: Generator) -> TargetProblem:
    """A random problem; the same state of `rng` gives the same one.

    Target `position`: the positions of the tip at start and goal are uniform in the family's region, as the
    authors' are; configurations come from inverse kinematics. Target `pose`: the start, and the first goal,
    whose tip pose is the target, are uniform among the free configurations with the tip in the region. Among
    furniture start and goal are poses with the fingers in two of its regions. Scenes that leave no start or
    no goal are drawn anew. Raises InputError if the settings leave none at all.
    """
    shares = np.array(list(settings.mix.values()))
    family = int(rng.choice(len(shares), p=shares / shares.sum()))
    name, rules = list(settings.families.items())[family]
    keep_out = base_spheres(robot)
    for _ in range(SCENES):
        if isinstance(rules, FurnitureSettings):
            furnished = sample_furniture(rules, rng, keep_out)
            scene = furnished.scene
            found = _by_region(robot, furnished.regions, CollisionChecker(robot, scene), settings.goals, rng)
        else:
            scene = sample_scene(rules, rng, keep_out)
            ends = _by_position if settings.target == "position" else _by_pose
            found = ends(robot, rules, CollisionChecker(robot, scene), settings.goals, rng)
        if found is not None:
            return TargetProblem(family, scene, *found)
    raise InputError(
        f"no free start and goal in {SCENES} scenes of {name} for {robot.name}: its tip "
        f"{robot.tip} cannot be where these scenes want it"
    )


_Ends = tuple[Float32[ndarray, "dof"], Float32[ndarray, "k dof"], Float[ndarray, "4 4"]]


def _by_position(
    robot: Robot, rules: RopSettings, checker: CollisionChecker, count: int, rng: Generator
) -> _Ends | None:
    start = _reaching(robot, _random_position(rules, rng), 1, checker, rng, POSITION_ONLY)
    if not len(start):
        return None
    goals = _reaching(robot, _random_position(rules, rng), count, checker, rng, POSITION_ONLY)
    if not len(goals):
        return None
    return start[0], goals, link_pose(robot, goals[0].astype(np.float64), robot.tip)


def _by_pose(
    robot: Robot, rules: RopSettings, checker: CollisionChecker, count: int, rng: Generator
) -> _Ends | None:
    start, goal = (free_configuration(robot, rules, checker, rng) for _ in range(2))
    if start is None or goal is None:
        return None
    T_base_tip = link_pose(robot, goal, robot.tip)
    goals = goal[None].astype(np.float32)
    if count > 1:
        others = _reaching(robot, T_base_tip, count - 1, checker, rng, FULL_POSE)
        goals = np.concatenate([goals, others])
    return start.astype(np.float32), goals, T_base_tip


def _by_region(
    robot: Robot, regions: tuple[Region, ...], checker: CollisionChecker, count: int, rng: Generator
) -> _Ends | None:
    """From one place among the furniture to another."""
    first, second = (regions[i] for i in rng.choice(len(regions), 2, replace=False))
    start = _reaching(robot, sample_target(first, rng), 1, checker, rng, FULL_POSE)
    if not len(start):
        return None
    T_base_tip = sample_target(second, rng)
    goals = _reaching(robot, T_base_tip, count, checker, rng, FULL_POSE)
    return (start[0], goals, T_base_tip) if len(goals) else None


def _random_position(rules: RopSettings, rng: Generator) -> Float[ndarray, "4 4"]:
    T_base_tip = np.eye(4)
    T_base_tip[:3, 3] = [rng.uniform(*rules.tip_x), rng.uniform(*rules.tip_y), rng.uniform(*rules.tip_z)]
    return T_base_tip


def _reaching(
    robot: Robot,
    T_base_tip: Float[ndarray, "4 4"],
    count: int,
    checker: CollisionChecker,
    rng: Generator,
    settings: InverseKinematicsSettings,
) -> Float32[ndarray, "k dof"]:
    """Free configurations, rounded to what the data hold, so that the judge sees exactly these.

    Solutions with a joint at a limit, where the solver clips it, would be far too many, and are left out.
    """

    def accept(q: Float[ndarray, "n dof"]) -> Bool[ndarray, "n"]:
        inside = ((q > robot.lower + AT_LIMIT) & (q < robot.upper - AT_LIMIT)).all(axis=1)
        return inside & checker.free(q)

    q = inverse_kinematics(robot, robot.tip, T_base_tip, count, rng=rng, accept=accept, settings=settings)
    return q.astype(np.float32)
