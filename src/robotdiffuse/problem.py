"""Problem: a robot, a scene, a start and a goal."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.errors import InputError
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

LIMIT_SLACK = 1e-5
"""Configurations that exceed a joint limit by no more than this are clamped, with a note [rad]."""


@dataclass(frozen=True, eq=False)
class JointGoal:
    """Any of these configurations (one row each)."""

    positions: Float[ndarray, "n dof"]


@dataclass(frozen=True, eq=False)
class PoseGoal:
    """A pose of a link; the path must end within 1 cm and 15 degrees of it (the paper's tolerances)."""

    frame: str
    """Name of the link."""
    T_base_frame: Float[ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class Problem:
    """`goal` may be given as a configuration, a list of them, a JointGoal or a PoseGoal."""

    robot: Robot
    scene: Scene
    start: Float[ndarray, "dof"]
    goal: JointGoal | PoseGoal
    notes: tuple[str, ...] = ()
    """What was changed in the input, e.g. a start clamped to a limit."""
