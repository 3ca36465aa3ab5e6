"""Certificate: what was proved of a motion, and the bounds that prove it; and its files (.json)."""

import json
import math
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.certificates.bounds import Claim, Plane, Stretches
from robotdiffuse.core.bounds import MAX_RATE, numbers, within
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.input_files import read_json
from robotdiffuse.core.output_files import check_output, write_atomically
from robotdiffuse.core.types import Path, Trajectory

if TYPE_CHECKING:
    from robotdiffuse.certificates.checker import Findings
    from robotdiffuse.problems.problem import Problem

MARK, VERSION = "robotdiffuse certificate", 1
AGREEMENT = 1e-6
"""Bounds may be this far from what a certificate says [m] or [rad]: they are rounded there."""
DECIMALS = 7
"""Of bounds in files [m]."""
ROWS = ("times", "velocities", "accelerations")
FIELDS = ("claims", "start", "stop", "by_planes", "clearance", "displacement", "planes")


@dataclass(frozen=True)
class Tolerances:
    """How exactly a motion was validated, as of `VerifySettings`, whose defaults these are."""

    limit_slack: float = 1e-6
    """[rad] or [m]"""
    start_tolerance: float = 1e-6
    goal_tolerance: float = 1e-4
    goal_distance: float = 0.01
    """[m]"""
    goal_angle: float = float(np.radians(15))
    """[rad]"""
    goal_slack: float = 1e-5
    rest: float = 1e-6
    """[rad/s]"""
    rate_slack: float = 0.01
    """Share of the robot's limits."""
    chord: float = 1e-3
    """How far the cubics through the rows may leave the straight lines that were certified [rad] or [m]."""


@dataclass(frozen=True, eq=False)
class Proof:
    """Stretches of the motion, claim by claim, with what shows that each is free."""

    claims: tuple[Claim, ...]
    stretches: Stretches
    by_planes: Bool[ndarray, "n"]
    """By planes between convex meshes, else by spheres."""
    clearance: Float[ndarray, "n"]
    """In the middle of each stretch [m], rounded down."""
    displacement: Float[ndarray, "n"]
    """Of any point of the link from there, at most [m], rounded up."""
    planes: tuple[Plane, ...]


@dataclass(frozen=True, eq=False)
class Certificate:
    """A motion, what it was proved for, and the proof."""

    robot: str
    robot_parts: dict[str, str]
    """Content hashes by part."""
    scene_parts: dict[str, str]
    """By obstacle."""
    motion_hash: str
    """Of the motion, exactly as it is."""
    tolerances: Tolerances
    motion: Path | Trajectory
    between: Float[ndarray, "k"]
    """Times of further configurations on the cubics through the rows [s]; of a path, rows plus shares."""
    scene_clearance: float
    """No point of a moving link is nearer to an obstacle all along the motion [m]."""
    self_clearance: float
    """The same of links that are checked against each other."""
    proof: Proof
    problem: dict[str, Any] | None = None
    """As in a problem file, if the robot can be found again."""
    request_parts: dict[str, str] = field(default_factory=dict)
    """Content hashes of obstacles that move and path constraints."""
    moving: Proof | None = None
    """Stretches that are free of obstacles that move; None without such."""
    constraints: tuple[tuple[str, float], ...] = ()
    """For each quantity of a path constraint, what it is at most all along [m] or [rad]."""
    looks: Float[ndarray, "looks"] = field(default_factory=lambda: np.zeros(0))
    """Where, between the rows, torques of a payload are looked at too, as `between`."""
    torques: tuple[tuple[str, float], ...] = ()
    """For each joint, what it bears at most all along with the payload [N m] or [N]."""

    def check(self, problem: "Problem | None" = None, at_most: Tolerances | None = None) -> "Findings":
        """Re-check everything for a problem, by default the one that is in here, with tolerances of at most
        these, by default the validator's. See `checker.check`."""
        from robotdiffuse.certificates.checker import check

        return check(self, problem, at_most or Tolerances())

    def save(self, file: str | FilePath) -> None:
        """Write .json. Raises InputError for another ending or a file that cannot be written."""
        path = check_output(file, (".json",))
        write_atomically(path, json.dumps(_record(self), allow_nan=False, separators=(",", ":")) + "\n")


def load_certificate(file: str | FilePath) -> Certificate:
    """Read a certificate file; InputError for one that cannot be read, or is none."""
    record = read_json(file)
    if not is_certificate(record):
        raise InputError(f"{file} is not a certificate; write one by `robotdiffuse verify --certificate`")
    try:
        if record.get("version") != VERSION:
            raise InputError(f"version is {shown(record.get('version'))}; this version reads {VERSION}")
        return _certificate(record)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{file} is damaged: {type(error).__name__} {shown(str(error))}") from None


def is_certificate(record: object) -> bool:
    """Whether this is the content of a certificate file."""
    return isinstance(record, dict) and record.get("is") == MARK


def _record(certificate: Certificate) -> dict[str, Any]:
    motion, proof = certificate.motion, certificate.proof
    timed = isinstance(motion, Trajectory)
    return {
        "is": MARK,
        "version": VERSION,
        "robot": certificate.robot,
        "robot_parts": certificate.robot_parts,
        "scene_parts": certificate.scene_parts,
        "motion_hash": certificate.motion_hash,
        "tolerances": asdict(certificate.tolerances),
        "scene_clearance": certificate.scene_clearance,
        "self_clearance": certificate.self_clearance,
        "problem": certificate.problem,
        "motion": {
            "joint_names": list(motion.joint_names),
            "positions": motion.positions.tolist(),
            **({name: getattr(motion, name).tolist() for name in ROWS} if timed else {}),
        },
        "between": certificate.between.tolist(),
        "proof": _proof_record(proof),
        "request_parts": certificate.request_parts,
        "moving": None if certificate.moving is None else _proof_record(certificate.moving),
        "constraints": [list(one) for one in certificate.constraints],
        "looks": certificate.looks.tolist(),
        "torques": [list(one) for one in certificate.torques],
    }


def _proof_record(proof: Proof) -> list[dict[str, Any]]:
    return [_claim_record(proof, k, claim) for k, claim in enumerate(proof.claims)]


def _claim_record(proof: Proof, k: int, claim: Claim) -> dict[str, Any]:
    rows = np.flatnonzero(proof.stretches.claim == k)
    first, end = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
    return {
        "link": claim.link,
        "against": claim.against,
        "start": proof.stretches.start[rows].tolist(),
        "stop": proof.stretches.stop[rows].tolist(),
        "clearance": np.round(proof.clearance[rows], DECIMALS).tolist(),
        "displacement": np.round(proof.displacement[rows], DECIMALS).tolist(),
        "by_planes": np.flatnonzero(proof.by_planes[rows]).tolist(),
        "planes": [
            [plane.stretch - first, plane.part, plane.other, *plane.normal]
            for plane in proof.planes
            if first <= plane.stretch < end
        ],
    }


def _certificate(record: dict[str, Any]) -> Certificate:
    tolerances = record["tolerances"]
    names = {f.name for f in fields(Tolerances)}
    if not isinstance(tolerances, dict) or set(tolerances) != names:
        raise InputError(f"tolerances must have the fields {', '.join(sorted(names))}")
    problem = record.get("problem")
    if problem is not None and not isinstance(problem, dict):
        raise InputError("problem must be an object")
    return Certificate(
        str(record["robot"]),
        _texts("robot_parts", record["robot_parts"]),
        _texts("scene_parts", record["scene_parts"]),
        str(record["motion_hash"]),
        Tolerances(**{name: _number(name, value) for name, value in tolerances.items()}),
        _motion(record["motion"]),
        _vector("between", record["between"]),
        _number("scene_clearance", record["scene_clearance"]),
        _number("self_clearance", record["self_clearance"]),
        _proof(record["proof"]),
        problem,
        _texts("request_parts", record.get("request_parts", {})),
        None if record.get("moving") is None else _proof(record["moving"]),
        _named(record.get("constraints", [])),
        _vector("looks", record.get("looks", [])),
        _named(record.get("torques", [])),
    )


def _motion(record: dict[str, Any]) -> Path | Trajectory:
    names = tuple(map(str, record["joint_names"]))
    rows = {name: numbers(record[name]) for name in ("positions", *ROWS) if name in record}
    shape = (len(rows["positions"]) if rows["positions"] is not None else 0, len(names))
    for name, array in rows.items():
        wanted = shape[:1] if name == "times" else shape
        if array is None or array.shape != wanted or not len(array) or not within(array, MAX_RATE):
            raise InputError(f"motion.{name} must be finite numbers of shape {'x'.join(map(str, wanted))}")
    if len(rows) == 1:
        return Path(names, rows["positions"])  # type: ignore[arg-type]
    return Trajectory(names, **rows)  # type: ignore[arg-type]


def _proof(record: list[dict[str, Any]]) -> Proof:
    claims, columns, planes = [], {name: [np.zeros(0)] for name in ("claim", *FIELDS[1:6])}, []
    begin = 0
    for k, entry in enumerate(record):
        claims.append(Claim(str(entry["link"]), str(entry["against"])))
        found = {name: _vector(name, entry[name]) for name in FIELDS[1:6] if name != "by_planes"}
        count = len(found["start"])
        if any(len(values) != count for values in found.values()):
            raise InputError(f"proof of {claims[-1].link}: its columns must be of one length")
        marked = np.zeros(count)
        marked[[int(i) for i in entry["by_planes"]]] = 1
        for name, values in (("claim", np.full(count, k)), ("by_planes", marked), *found.items()):
            columns[name].append(values)
        for stretch, part, other, *normal in entry["planes"]:
            if not 0 <= int(stretch) < count:
                raise InputError(f"proof of {claims[-1].link}: there is no stretch {shown(stretch)}")
            plane = Plane(begin + int(stretch), int(part), int(other), tuple(map(float, normal)))  # type: ignore[arg-type]
            if len(normal) != 3 or not 0 < np.linalg.norm(normal) < np.inf:
                raise InputError(f"proof of {claims[-1].link}: {shown(normal)} is no normal of a plane")
            planes.append(plane)
        begin += count
    joined = {name: np.concatenate(values) for name, values in columns.items()}
    stretches = Stretches(joined["claim"].astype(int), joined["start"], joined["stop"])
    by_planes = joined["by_planes"] > 0
    return Proof(
        tuple(claims), stretches, by_planes, joined["clearance"], joined["displacement"], tuple(planes)
    )


def _named(rows: list[Any]) -> tuple[tuple[str, float], ...]:
    return tuple((str(name), _number(str(name), most)) for name, most in rows)


def _texts(name: str, value: object) -> dict[str, str]:
    if not isinstance(value, dict) or not all(isinstance(text, str) for text in value.values()):
        raise InputError(f"{name} must map names to hashes")
    return value


def _vector(name: str, value: object) -> ndarray:
    array = np.zeros(0) if value == [] else numbers(value)
    if array is None or array.ndim != 1 or not within(array, MAX_RATE):
        raise InputError(f"{name} must be a list of finite numbers")
    return array


def _number(name: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{name} is {shown(value)}; it must be a finite number")
    return float(value)
