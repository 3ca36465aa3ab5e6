"""Certificate: the proof of a motion with its checker, and its files (.json)."""

import json
import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from numpy import ndarray

from robotdiffuse.certificates.bounds import Claim, Plane, Stretches
from robotdiffuse.certificates.checker import Findings, check
from robotdiffuse.certificates.proof import DECIMALS, MotionProof, StretchProof, Tolerances
from robotdiffuse.core.bounds import MAX_RATE, numbers, one_line, within
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.input_files import read_json
from robotdiffuse.core.output_files import check_output, write_atomically
from robotdiffuse.core.types import Path, Trajectory, check_motion_arrays
from robotdiffuse.problems.problem import Problem

FILE_MARK, VERSION = "robotdiffuse certificate", 1
RATE_ROWS = ("times", "velocities", "accelerations")
FIELDS = {
    *("is", "version", "robot", "robot_parts", "scene_parts", "motion_hash", "tolerances", "scene_clearance"),
    *("self_clearance", "problem", "motion", "between", "proof", "request_parts", "moving", "constraints"),
    *("looks", "torques", "jerks"),
}
"""Of a certificate file."""
STRETCH_FIELDS = ("start", "stop", "by_planes", "clearance", "displacement")


@dataclass(frozen=True, eq=False)
class Certificate(MotionProof):
    """A motion, what was proved of it, and the proof, which can be checked and saved."""

    def __repr__(self) -> str:
        return one_line(self)

    def check(self, problem: Problem | None = None, at_most: Tolerances | None = None) -> Findings:
        """Re-check everything for a problem, by default the one in the certificate.

        The tolerances of the proof must not exceed `at_most`, by default the validator's. See
        `checker.check`.
        """
        return check(self, problem, at_most or Tolerances())

    def save(self, file: str | FilePath) -> None:
        """Write a .json file. Raises InputError for another ending or if the file cannot be written."""
        path = check_output(file, (".json",))
        write_atomically(path, json.dumps(_record(self), allow_nan=False, separators=(",", ":")) + "\n")


def load_certificate(file: str | FilePath) -> Certificate:
    """The certificate of a file. Raises InputError if the file cannot be read or holds no certificate."""
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
    """Whether a JSON value is the content of a certificate file."""
    return isinstance(record, dict) and record.get("is") == FILE_MARK


def _record(certificate: Certificate) -> dict[str, Any]:
    motion, proof = certificate.motion, certificate.proof
    timed = isinstance(motion, Trajectory)
    return {
        "is": FILE_MARK,
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
            **({name: getattr(motion, name).tolist() for name in RATE_ROWS} if timed else {}),
        },
        "between": certificate.between.tolist(),
        "proof": _proof_record(proof),
        "request_parts": certificate.request_parts,
        "moving": None if certificate.moving is None else _proof_record(certificate.moving),
        "constraints": [list(one) for one in certificate.constraints],
        "looks": certificate.torque_samples.tolist(),
        "torques": [list(one) for one in certificate.torques],
        "jerks": [list(one) for one in certificate.jerks],
    }


def _proof_record(proof: StretchProof) -> list[dict[str, Any]]:
    return [_claim_record(proof, k, claim) for k, claim in enumerate(proof.claims)]


def _claim_record(proof: StretchProof, k: int, claim: Claim) -> dict[str, Any]:
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
    unknown = sorted(record.keys() - FIELDS)
    if unknown:
        raise InputError(f"{unknown[0]} is unknown; the fields are {', '.join(sorted(FIELDS))}")
    tolerances = record["tolerances"]
    names = {f.name for f in fields(Tolerances)}
    if not isinstance(tolerances, dict) or set(tolerances) != names:
        raise InputError(f"tolerances must have the fields {', '.join(sorted(names))}")
    problem = record.get("problem")
    if problem is not None and not isinstance(problem, dict):
        raise InputError("problem must be an object")
    return Certificate(
        str(record["robot"]),
        _hashes("robot_parts", record["robot_parts"]),
        _hashes("scene_parts", record["scene_parts"]),
        str(record["motion_hash"]),
        Tolerances(**{name: _number(name, value) for name, value in tolerances.items()}),
        _motion(record["motion"]),
        _vector("between", record["between"]),
        _number("scene_clearance", record["scene_clearance"]),
        _number("self_clearance", record["self_clearance"]),
        _proof(record["proof"]),
        problem,
        _hashes("request_parts", record.get("request_parts", {})),
        None if record.get("moving") is None else _proof(record["moving"]),
        _named_bounds(record.get("constraints", [])),
        _vector("looks", record.get("looks", [])),
        _named_bounds(record.get("torques", [])),
        _named_bounds(record.get("jerks", [])),
    )


def _motion(record: dict[str, Any]) -> Path | Trajectory:
    arrays = {name: record[name] for name in ("positions", *RATE_ROWS) if name in record}
    names, checked = check_motion_arrays(record["joint_names"], arrays, "motion.")
    return Path(names, **checked) if len(checked) == 1 else Trajectory(names, **checked)


def _proof(record: list[dict[str, Any]]) -> StretchProof:
    claims, columns, planes = [], {name: [np.zeros(0)] for name in ("claim", *STRETCH_FIELDS)}, []
    begin = 0
    for k, entry in enumerate(record):
        claims.append(Claim(str(entry["link"]), str(entry["against"])))
        found = {name: _vector(name, entry[name]) for name in STRETCH_FIELDS if name != "by_planes"}
        count = len(found["start"])
        if any(len(values) != count for values in found.values()):
            raise InputError(f"proof of {claims[-1].link}: its columns must have equal lengths")
        marked = np.zeros(count)
        marked[[int(i) for i in entry["by_planes"]]] = 1
        for name, values in (("claim", np.full(count, k)), ("by_planes", marked), *found.items()):
            columns[name].append(values)
        for stretch, part, other, *normal in entry["planes"]:
            if not 0 <= int(stretch) < count:
                raise InputError(f"proof of {claims[-1].link}: it has no stretch {shown(stretch)}")
            plane = Plane(begin + int(stretch), int(part), int(other), tuple(map(float, normal)))  # type: ignore[arg-type]
            if len(normal) != 3 or not 0 < math.hypot(*normal) < math.inf:
                raise InputError(f"proof of {claims[-1].link}: {shown(normal)} is not the normal of a plane")
            planes.append(plane)
        begin += count
    joined = {name: np.concatenate(values) for name, values in columns.items()}
    stretches = Stretches(joined["claim"].astype(int), joined["start"], joined["stop"])
    by_planes = joined["by_planes"] > 0
    return StretchProof(
        tuple(claims), stretches, by_planes, joined["clearance"], joined["displacement"], tuple(planes)
    )


def _named_bounds(rows: list[Any]) -> tuple[tuple[str, float], ...]:
    return tuple((str(name), _number(str(name), most)) for name, most in rows)


def _hashes(name: str, value: object) -> dict[str, str]:
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
