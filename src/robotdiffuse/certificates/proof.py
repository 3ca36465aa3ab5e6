"""The proof of a motion as values: what was proved, and the bounds that prove it."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.certificates.bounds import Claim, Plane, Stretches
from robotdiffuse.core.types import Path, Trajectory

BOUND_TOLERANCE = 1e-6
"""A recomputed bound may differ from the written one by this [m] or [rad], because files round."""
DECIMALS = 7
"""Decimals of bounds in files [m]."""


@dataclass(frozen=True)
class Tolerances:
    """The tolerances of a validation; names, meanings and defaults are those of `VerifySettings`."""

    limit_slack: float = 1e-6
    """[rad] or [m]"""
    start_tolerance: float = 1e-6
    """[rad] or [m]"""
    goal_tolerance: float = 1e-4
    """[rad] or [m]"""
    goal_distance: float = 0.01
    """[m]"""
    goal_angle: float = float(np.radians(15))
    """[rad]"""
    goal_slack: float = 1e-5
    """[m] or [rad]"""
    rest: float = 1e-6
    """[rad/s]"""
    rate_slack: float = 0.01
    """Share of the robot's limits."""
    chord: float = 1e-3
    """How far the cubics through the rows may leave the straight lines that were certified [rad] or [m]."""


@dataclass(frozen=True, eq=False)
class StretchProof:
    """Stretches of the motion, claim by claim, and the bounds that show each stretch to be free."""

    claims: tuple[Claim, ...]
    stretches: Stretches
    by_planes: Bool[ndarray, "n"]
    """Whether planes between convex meshes prove the stretch; else the covering spheres do."""
    clearance: Float[ndarray, "n"]
    """Clearance in the middle of each stretch [m], rounded down."""
    displacement: Float[ndarray, "n"]
    """Upper bound on the displacement of any point of the link from there [m], rounded up."""
    planes: tuple[Plane, ...]


@dataclass(frozen=True, eq=False)
class MotionProof:
    """A motion, what was proved of it, and the proof."""

    robot: str
    robot_parts: dict[str, str]
    """Content hashes of the robot's parts, by name."""
    scene_parts: dict[str, str]
    """Content hashes of the obstacles, by name."""
    motion_hash: str
    """Hash of the motion, without any rounding."""
    tolerances: Tolerances
    motion: Path | Trajectory
    between: Float[ndarray, "k"]
    """Further certified configurations between the rows: times on the cubics through the rows [s]; for a
    path, row plus share of the way to the next."""
    scene_clearance: float
    """Lower bound on the distance of all moving links to all obstacles, all along the motion [m]."""
    self_clearance: float
    """The same between links that are checked against each other [m]."""
    proof: StretchProof
    problem: dict[str, Any] | None = None
    """The problem as in a problem file; None if the robot cannot be loaded by a name or file."""
    request_parts: dict[str, str] = field(default_factory=dict)
    """Content hashes of moving obstacles, path constraints and payload, by name."""
    moving: StretchProof | None = None
    """Proof among moving obstacles; None without such obstacles."""
    constraints: tuple[tuple[str, float], ...] = ()
    """For each quantity of a path constraint its name and an upper bound all along the motion [m] or
    [rad]."""
    torque_samples: Float[ndarray, "samples"] = field(default_factory=lambda: np.zeros(0))
    """Places between the rows at which torques are computed besides the rows, given as `between`."""
    torques: tuple[tuple[str, float], ...] = ()
    """For each joint its name and an upper bound of its torque with the payload all along [N m] or [N]."""
    jerks: tuple[tuple[str, float], ...] = ()
    """For each joint its name and its largest jerk, accelerations being linear between rows [rad/s³] or
    [m/s³]; empty for a path, and where accelerations jump at the ends."""
