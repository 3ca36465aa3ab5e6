"""Data classes for the proof of a motion: what was proved, and the bounds that prove it. Also content hashes
of the parts of robots, scenes and motions, by which the checker names the parts that differ."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from robotdiffuse.certificates.bounds import Claim, Plane, Stretches
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Number, Settings
from robotdiffuse.core.types import Mask, Path, Trajectory, Values, array_names, frozen_dataclass
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot, hashed_content
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import PointCloud, Shape, Triangulated

BOUND_TOLERANCE = 1e-6
"""A recomputed bound may differ from the bound in the proof by this [m] or [rad], since files round
bounds."""
DECIMALS = 7
"""Number of decimals of bounds [m] in files."""


@dataclass(frozen=True)
class Tolerances(Settings):
    """The tolerances of a validation; names, meanings and defaults are those of `VerifySettings`."""

    limit_slack: Number = 1e-6
    """[rad] or [m]"""
    start_tolerance: Number = 1e-6
    """[rad] or [m]"""
    goal_tolerance: Number = 1e-4
    """[rad] or [m]"""
    goal_distance: Number = 0.01
    """[m]"""
    goal_angle: Number = float(np.radians(15))
    """[rad]"""
    goal_slack: Number = 1e-5
    """[m] or [rad]"""
    rest: Number = 1e-6
    """[rad/s] or [m/s]"""
    rate_slack: Number = 0.01
    """Fraction of the robot's limits."""
    chord: Number = 1e-3
    """How far the cubic of a joint between two rows may leave the straight line that is certified [rad] or
    [m]."""


@frozen_dataclass
class StretchProof:
    """Stretches (intervals) of the motion for each claim, with the bounds that prove each stretch free. A
    claim is that a link is free of the scene, of a moving obstacle or of another link."""

    claims: tuple[Claim, ...]
    stretches: Stretches
    by_planes: Mask
    """Whether planes between convex meshes prove the stretch; otherwise the covering spheres do."""
    clearance: Values
    """Clearance of the link in the middle of each stretch [m], rounded down."""
    displacement: Values
    """Upper bound on the clearance that is lost anywhere on the stretch, compared with its middle, as the
    link and the other body move [m], rounded up."""
    planes: tuple[Plane, ...]


NOTHING = np.zeros(0)
EMPTY = StretchProof((), Stretches(NOTHING.astype(int), NOTHING, NOTHING), NOTHING > 0, NOTHING, NOTHING, ())


def joined(claims: tuple[Claim, ...], proofs: Iterable[StretchProof]) -> StretchProof:
    """The stretches of several proofs, one after the other, as a proof of these claims."""
    parts = [EMPTY, *proofs]
    offsets = np.cumsum([len(part.by_planes) for part in parts])
    planes = [
        plane._replace(stretch=plane.stretch + int(offset))
        for offset, part in zip(offsets, parts[1:], strict=False)
        for plane in part.planes
    ]
    by_planes, clearance, displacement = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("by_planes", "clearance", "displacement")
    )
    stretches = Stretches(*map(np.concatenate, zip(*(part.stretches for part in parts), strict=True)))
    return StretchProof(claims, stretches, by_planes, clearance, displacement, tuple(planes))


@frozen_dataclass
class MotionProof:
    """A motion, what was proved of it, and the proof."""

    robot: str
    """Name of the robot."""
    robot_parts: dict[str, str]
    """Content hashes of the robot's parts, by name."""
    scene_parts: dict[str, str]
    """Content hashes of the obstacles and of their allowed contacts, by name."""
    motion_hash: str
    """Hash of the motion, without any rounding."""
    tolerances: Tolerances
    """The tolerances that the proof uses."""
    motion: Path | Trajectory
    """The motion."""
    between: Values
    """Places between the rows at which the proof has further configurations: times on the cubics between rows
    [s]; for a path, the index of a row plus the fraction of the way to the next row."""
    scene_clearance: float
    """Lower bound on the distance of all moving links to all obstacles that they may not touch, along the
    whole motion [m]."""
    self_clearance: float
    """Lower bound on the distance between links that are checked against each other, along the whole motion
    [m]."""
    proof: StretchProof
    """The proof that the arm collides neither with the scene nor with itself."""
    problem: dict[str, Any] | None = None
    """The problem as in a problem file; None if the robot cannot be loaded by a name or file."""
    request_parts: dict[str, str] = field(default_factory=dict)
    """Content hashes of moving obstacles, path constraints and payload, by name."""
    moving: StretchProof | None = None
    """The proof that the arm collides with no moving obstacle; None without such obstacles."""
    constraints: tuple[tuple[str, float], ...] = ()
    """Name of each quantity that a path constraint limits, and its upper bound along the whole motion [m] or
    [rad]."""
    torque_samples: Values = field(default_factory=lambda: NOTHING)
    """Places between the rows at which torques are computed too; in the form of `between`."""
    torques: tuple[tuple[str, float], ...] = ()
    """Name of each joint, and an upper bound of its torque with the payload along the whole motion [N m] or
    [N]."""
    jerks: tuple[tuple[str, float], ...] = ()
    """Name of each joint and its largest jerk along the cubics [rad/s³] or [m/s³]. Empty for a path, and for
    a trajectory with accelerations that jump or are not those of its cubics."""


HASH_LENGTH = 16
"""Number of hexadecimal digits of the hash of a part."""
LIMITS = ("lower", "upper", "velocity", "acceleration")


def robot_parts(robot: Robot) -> dict[str, str]:
    """Hashes of everything in a robot that proofs depend on, except the inertias and effort limits, which
    `request_parts` hashes."""
    parts = {
        "planned joints": _hash([robot.base, *robot.joint_names]),
        "allowed collisions": _hash(sorted(sorted(pair) for pair in robot.allowed_collisions)),
    }
    for joint in robot.joints:
        numbers = [joint.T_parent_joint, joint.axis, *(getattr(joint, name) for name in LIMITS)]
        locked_value = robot.locked.get(joint.name)
        names = [joint.name, joint.kind, joint.parent, joint.child, locked_value is None]
        parts[f"joint {joint.name}"] = _hash(names, *numbers, 0.0 if locked_value is None else locked_value)
    for link, spheres in robot.spheres.items():
        parts[f"spheres of {link}"] = _hash(link, spheres)
    for link, meshes in robot.meshes.items():
        arrays = [array for mesh in meshes for array in (mesh.vertices, mesh.faces)]
        parts[f"meshes of {link}"] = _hash(link, *arrays)
    return parts


def scene_parts(scene: Scene) -> dict[str, str]:
    """Hashes of the obstacles, by name, and of the allowed contacts."""
    parts = {shape.name: _hash(shape.kind, *_numbers(shape)) for shape in scene.shapes}
    for name, links in scene.allowed_contacts:
        parts[f"links that may touch {name}"] = _hash(links if isinstance(links, str) else sorted(links))
    return parts


def request_parts(problem: Problem) -> dict[str, str]:
    """Hashes of moving obstacles with their motions, of path constraints, and of the payload. The payload's
    hash includes the inertias, the effort limits and the base's pose."""
    parts = {}
    if problem.payload is not None:
        robot = problem.robot
        carried = problem.payload
        links = sorted(robot.inertias)
        rows = [robot.inertias[link].values for link in links]
        payload_numbers = [carried.mass, *carried.com, *carried.moments]
        T_world_base = problem.T_world_base
        T_base = np.eye(4) if T_world_base is None else T_world_base
        parts["payload"] = _hash([carried.link, *links], payload_numbers, T_base, robot.effort, rows)
    for obstacle in problem.moving:
        motion = (obstacle.velocity, obstacle.times, obstacle.poses, obstacle.max_speed)
        shape = obstacle.shape
        parts[f"moving {obstacle.name}"] = _hash(shape.kind, *_numbers(shape), *motion)
    for i, constraint in enumerate(problem.constraints):
        values = [getattr(constraint, f.name) for f in fields(constraint)]
        texts = [constraint.kind, *(value for value in values if isinstance(value, str))]
        rows = [value for value in values if not isinstance(value, str)]
        parts[f"constraints[{i}]"] = _hash(texts, *rows)
    return parts


def hash_of(motion: Path | Trajectory) -> str:
    """Hash of a motion's exact numbers and joint names."""
    digest = hashlib.sha256(json.dumps(list(motion.joint_names)).encode())
    for name in array_names(motion):
        array = getattr(motion, name)
        digest.update(str(array.shape).encode() + np.ascontiguousarray(array, np.float64).tobytes())
    return digest.hexdigest()


def differences(what: str, certified: Mapping[str, str], here: Mapping[str, str]) -> list[str]:
    """A line for each part that is missing, added or changed since it was certified."""
    lines = [f"{what}: {name} is missing" for name in certified if name not in here]
    lines += [f"{what}: {name} was added" for name in here if name not in certified]
    changed = (name for name in certified if name in here and certified[name] != here[name])
    return lines + [f"{what}: {name} has changed" for name in changed]


def _numbers(shape: Shape) -> list[object]:
    if isinstance(shape, PointCloud):
        return [shape.points, shape.point_radius]
    if isinstance(shape, Triangulated):
        mesh = shape.mesh
        return [mesh.vertices, mesh.faces, mesh.xyz, mesh.wxyz]
    names = [name for name in ("center", "radius", "size", "height", "wxyz") if hasattr(shape, name)]
    if not names:
        raise InputError(f"{shape.name}: a {type(shape).__name__} cannot be certified")
    return [getattr(shape, name) for name in names]


def _hash(names: object, *numbers: object) -> str:
    arrays = [NOTHING if values is None else values for values in numbers]
    return hashlib.sha256(hashed_content(names, *arrays)).hexdigest()[:HASH_LENGTH]
