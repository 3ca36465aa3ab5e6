"""Certificate: the proof of a motion with its checker, and its files (.json)."""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from robotdiffuse.certificates.bounds import Claim, Plane, Stretches
from robotdiffuse.certificates.checker import Findings, check
from robotdiffuse.certificates.proof import DECIMALS, MotionProof, StretchProof, Tolerances, joined
from robotdiffuse.core.errors import MAX_RATE, InputError, numbers, one_line, reading, shown, within
from robotdiffuse.core.files import JsonObject, check_output, known_ending, read_json, write_atomically
from robotdiffuse.core.settings import Number, converted
from robotdiffuse.core.types import (
    RATES,
    Path,
    Trajectory,
    array_names,
    check_motion_arrays,
    frozen_dataclass,
)
from robotdiffuse.problems.problem import Problem
from robotdiffuse.scenes.files import required_fields

FILE_MARK = "robotdiffuse certificate"
VERSION = 1
STRETCH_FIELDS = ("start", "stop", "clearance", "displacement")


@frozen_dataclass
class Certificate(MotionProof):
    """A motion and its proof, which can be checked and saved."""

    def __repr__(self) -> str:
        return one_line(self)

    def check(self, problem: Problem | None = None, at_most: Tolerances | None = None) -> Findings:
        """Check the whole proof again.

        Args:
            problem: The problem that the motion is to solve; None: the problem in the certificate.
            at_most: Largest tolerances that the proof may use; None: the validator's default tolerances.

        Returns:
            Each difference from the proof, and each requirement that is not proved.

        Raises:
            InputError: If there is no problem, and for shapes that certificates do not support.
        """
        return check(self, problem, at_most or Tolerances())

    def save(self, file: str | FilePath) -> None:
        """Write the certificate.

        Args:
            file: A file whose name ends in .json.

        Raises:
            InputError: For another ending, or a file that cannot be written.
        """
        path = check_output(file, (".json",))
        record = {"is": FILE_MARK, "version": VERSION}
        for name, field in FIELDS.items():
            record[name] = field.write(getattr(self, field.attribute or name))
        write_atomically(path, json.dumps(record, allow_nan=False, separators=(",", ":")) + "\n")


def load_certificate(file: str | FilePath) -> Certificate:
    """Read a certificate.

    Args:
        file: A file that `Certificate.save` or `robotdiffuse verify --certificate` wrote.

    Returns:
        The motion and its proof, which is not checked yet.

    Raises:
        InputError: For a file that cannot be read, and for one that is not a valid certificate file.

    Examples:
        >>> problem = rd.Problem(rd.load_robot("panda"), rd.Scene(), "ready", "extended")
        >>> rd.certify(problem, rd.plan(problem, until="first").path).save("proof.json")
        >>> rd.load_certificate("proof.json").check(problem).valid
        True
    """
    known_ending(file, "certificate", (".json",))
    record = read_json(file)
    if not isinstance(record, dict) or record.get("is") != FILE_MARK:
        raise InputError(f"{file} is not a certificate; write one with `robotdiffuse verify --certificate`")
    with reading(file):
        if record.get("version") != VERSION:
            version = shown(record.get("version"))
            raise InputError(f"its format has version {version}; this release reads version {VERSION}")
        field_names = {"is", "version", *FIELDS}
        unknown = sorted(record.keys() - field_names)
        if unknown:
            raise InputError(f"{unknown[0]} is unknown; the fields are {', '.join(sorted(field_names))}")
        values = {
            field.attribute or name: field.read(name, record[name])
            for name, field in FIELDS.items()
            if name in record or name in REQUIRED
        }
        return Certificate(**values)


def _motion_record(motion: Path | Trajectory) -> JsonObject:
    rows = {name: getattr(motion, name).tolist() for name in array_names(motion)}
    return {"joint_names": list(motion.joint_names), **rows}


def _proof_record(proof: StretchProof | None) -> list[JsonObject] | None:
    return proof and [_claim_record(proof, k, claim) for k, claim in enumerate(proof.claims)]


def _claim_record(proof: StretchProof, k: int, claim: Claim) -> JsonObject:
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


def _motion(_: str, record: JsonObject) -> Path | Trajectory:
    arrays = {name: record[name] for name in ("positions", "times", *RATES) if name in record}
    names, checked = check_motion_arrays(record["joint_names"], arrays, "motion.")
    return Path(names, **checked) if len(checked) == 1 else Trajectory(names, **checked)


def _proof(_: str, record: list[JsonObject] | None) -> StretchProof | None:
    if record is None:
        return None
    parts = [_claim_proof(k, entry) for k, entry in enumerate(record)]
    return joined(tuple(claim for part in parts for claim in part.claims), parts)


def _claim_proof(k: int, entry: JsonObject) -> StretchProof:
    claim = Claim(str(entry["link"]), str(entry["against"]))
    start, stop, clearance, displacement = (_vector(name, entry[name]) for name in STRETCH_FIELDS)
    count = len(start)
    if not len(stop) == len(clearance) == len(displacement) == count:
        lengths = ", ".join(f"{name} has {len(entry[name])} numbers" for name in STRETCH_FIELDS)
        raise InputError(f"proof of {claim.link}: {lengths}; these lists must have equal lengths")
    by_planes = np.zeros(count, bool)
    by_planes[[int(i) for i in entry["by_planes"]]] = True
    planes = []
    for stretch, part, partner, *normal in entry["planes"]:
        if not 0 <= int(stretch) < count:
            raise InputError(f"proof of {claim.link}: it has no stretch {shown(stretch)}")
        x, y, z = map(float, normal)
        if not 0 < math.hypot(x, y, z) < math.inf:
            raise InputError(f"proof of {claim.link}: {shown(normal)} is not the normal of a plane")
        planes.append(Plane(int(stretch), int(part), int(partner), (x, y, z)))
    stretches = Stretches(np.full(count, k), start, stop)
    return StretchProof((claim,), stretches, by_planes, clearance, displacement, tuple(planes))


def _named_bounds(_: str, rows: list[Any]) -> tuple[tuple[str, float], ...]:
    return tuple((str(name), converted(str(name), Number, bound)) for name, bound in rows)


def _vector(name: str, value: object) -> ndarray:
    array = np.zeros(0) if value == [] else numbers(value)
    if array is None or array.ndim != 1 or not within(array, MAX_RATE):
        raise InputError(f"{name} is {shown(value)}; it must be a list of numbers within ±{MAX_RATE:g}")
    return array


def _tolerances(name: str, value: Any) -> Tolerances:
    """All tolerances must be in the file: none is taken from the defaults."""
    tolerances = Tolerances.from_json(value, name)
    missing = [field.name for field in fields(Tolerances) if field.name not in value]
    if missing:
        raise InputError(f"{name} has no {', '.join(missing)}")
    return tolerances


class Field(NamedTuple):
    """A field of a certificate file."""

    read: Callable[[str, Any], Any]
    """Checks and converts a JSON value, given the field's name and the value."""
    write: Callable[[Any], Any] = lambda value: value
    """Converts the attribute to a JSON value."""
    attribute: str = ""
    """Name of the attribute of `Certificate`; empty: the field's name."""


def _typed(kind: Any) -> Field:
    """A field whose value `converted` converts to this type."""
    return Field(lambda name, value: converted(name, kind, value))


HASHES = _typed(dict[str, str])
NUMBERS = Field(_vector, lambda array: array.tolist())
FIELDS = {
    "robot": _typed(str),
    "robot_parts": HASHES,
    "scene_parts": HASHES,
    "motion_hash": _typed(str),
    "tolerances": Field(_tolerances, asdict),
    "scene_clearance": _typed(Number),
    "self_clearance": _typed(Number),
    "problem": _typed(dict | None),
    "motion": Field(_motion, _motion_record),
    "between": NUMBERS,
    "proof": Field(lambda name, value: _proof(name, converted(name, list, value)), _proof_record),
    "request_parts": HASHES,
    "moving": Field(_proof, _proof_record),
    "constraints": Field(_named_bounds),
    "looks": NUMBERS._replace(attribute="torque_samples"),  # the name of torque_samples in these files
    "torques": Field(_named_bounds),
    "jerks": Field(_named_bounds),
}
"""Fields of files after the mark and the version, in their order."""
REQUIRED = required_fields(MotionProof)
