"""The checker: is what a certificate says so? It searches for nothing, and shares no code with the validator.

Every claim that the robot gives rise to must be there, its stretches must cover the motion without a gap, and
of each the clearance and the displacement are worked out anew: they must be what the certificate says, and
leave something over. So a certificate that passes is a proof, whoever wrote it.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
from numpy import ndarray

from robotdiffuse.certificates.bounds import CAP, SCENE, Claim, Prover
from robotdiffuse.certificates.content import (
    differences,
    motion_hash,
    request_parts,
    robot_parts,
    scene_parts,
)
from robotdiffuse.certificates.moving_obstacles import MovingProver
from robotdiffuse.certificates.proof import AGREEMENT, Certificate, Proof, Tolerances
from robotdiffuse.certificates.requests import configurations, wrong
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.problems.problem import Problem

VALIDATOR = Tolerances()


@dataclass(frozen=True)
class Findings:
    """What re-checking found."""

    differences: tuple[str, ...]
    """A line for each thing that is not as the certificate says; none if the proof holds."""

    @property
    def valid(self) -> bool:
        return not self.differences


def check(
    certificate: Certificate, problem: Problem | None = None, at_most: Tolerances = VALIDATOR
) -> Findings:
    """Re-check a certificate for a problem, by default the one that it holds, made with tolerances of at most
    these.

    Robot, scene and motion must be those that were certified, by content; the motion must keep the limits,
    begin at the start and end at the goal; and every stretch must be proved. Stops at waypoints, twitching,
    and whether rates agree with positions beyond their limits are left to the validator. Raises InputError for a
    certificate without a problem where none is given, and for shapes that certificates do not know.
    """
    if problem is None:
        if certificate.problem is None:
            raise InputError("the certificate holds no problem; give the problem that it is for")
        from robotdiffuse.problems.files import problem_from_record

        problem = problem_from_record(certificate.problem)
    found = [
        *differences("robot", certificate.robot_parts, robot_parts(problem.robot)),
        *differences("scene", certificate.scene_parts, scene_parts(problem.scene)),
        *differences("requests", certificate.request_parts, request_parts(problem)),
    ]
    for name, most in asdict(at_most).items():
        if getattr(certificate.tolerances, name) > most:
            said = getattr(certificate.tolerances, name)
            found.append(f"tolerances: {name} is {said:g}, looser than {most:g}")
    if certificate.motion_hash != hash_of(certificate.motion):
        found.append("motion: it is not the one that was certified: its hash differs")
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # what is not finite is a difference
        found += wrong(problem, certificate)
        if tuple(certificate.motion.joint_names) == problem.robot.joint_names:
            found += _unproved(problem, certificate)
            found += _unproved_in_time(problem, certificate)
    return Findings(tuple(found))


def hash_of(motion: Path | Trajectory) -> str:
    """Of the motion, exactly as it is."""
    rates = (motion.times, motion.velocities, motion.accelerations) if isinstance(motion, Trajectory) else ()
    return motion_hash(motion.joint_names, motion.positions, *rates)


def _unproved(problem: Problem, certificate: Certificate) -> Iterator[str]:
    prover = Prover(problem.robot, problem.scene, configurations(certificate.motion, certificate.between))
    proof = certificate.proof
    said = {"scene": certificate.scene_clearance, "self": certificate.self_clearance}
    of_pairs = np.array([claim.against != SCENE for claim in proof.claims], bool)[proof.stretches.claim]
    yield from _of_proof(prover, proof, {"scene": ~of_pairs, "self": of_pairs}, said)


def _unproved_in_time(problem: Problem, certificate: Certificate) -> Iterator[str]:
    """Of obstacles that move."""
    motion, proof = certificate.motion, certificate.moving
    if not problem.moving or not isinstance(motion, Trajectory) or not (np.diff(motion.times) > 0).all():
        return
    if proof is None:
        yield "proof: nothing is said of obstacles that move"
        return
    times = np.sort(np.concatenate([motion.times, certificate.between]), kind="stable")
    prover = MovingProver(problem.robot, problem.moving, configurations(motion, certificate.between), times)
    every, said = np.ones(len(proof.stretches.claim), bool), {"scene": certificate.scene_clearance}
    yield from _of_proof(prover, proof, {"scene": every}, said)


def _of_proof(
    prover: Prover, proof: Proof, kinds: dict[str, ndarray], said: dict[str, float]
) -> Iterator[str]:
    """What is wrong with a proof that leaves so much of each kind of stretches."""
    stretches, known = proof.stretches, {claim: k for k, claim in enumerate(prover.claims)}
    for claim in proof.claims:
        if claim not in known:
            yield f"proof: nothing is to be proved of {described(claim)}"
            return
    for missing in known.keys() - set(proof.claims):
        yield f"proof: nothing is said of {described(missing)}"
    if len(set(proof.claims)) < len(proof.claims):
        yield "proof: a claim is there twice"
        return
    gaps = list(_gaps(proof, float(len(prover.q) - 1)))
    if gaps or not len(stretches.claim):
        yield from gaps
        return
    wrong_planes = [plane for plane in proof.planes if not proof.by_planes[plane.stretch]]
    if wrong_planes:
        yield "proof: planes are given for stretches that are proved by spheres"
        return
    own = np.array([known[claim] for claim in proof.claims])[stretches.claim]
    bounds = prover.bounds(stretches._replace(claim=own), proof.by_planes, list(proof.planes))
    for what in ("clearance", "displacement"):
        written, right = getattr(proof, what), getattr(bounds, what)
        off = np.flatnonzero(np.abs(written - right) > AGREEMENT)
        if len(off):
            i = int(off[0])
            more = f" ({len(off) - 1} more)" if len(off) > 1 else ""
            yield f"proof: {what} of {_place(proof, i)} is {right[i]:.6f} m, not {written[i]:.6f} m{more}"
    left = bounds.clearance - bounds.displacement
    for what, which in kinds.items():
        least = said[what]
        if not least > 0:
            yield f"proof: a {what} clearance of {least:g} m is none"
        unproved = np.flatnonzero(which & (left < min(least, CAP) - AGREEMENT))
        if len(unproved):
            i = int(unproved[0])
            yield f"proof: {_place(proof, i)} is clear by {left[i]:.6f} m, not by {least:.6f} m"
        nothing = np.flatnonzero(which & ~(left > 0))
        if len(nothing):
            i = int(nothing[0])
            yield f"proof: {_place(proof, i)} is not shown to be free: {left[i]:.6f} m are left"


def _gaps(proof: Proof, last: float) -> Iterator[str]:
    """Where the stretches of a claim do not follow each other from the first row to the last."""
    stretches = proof.stretches
    for k, claim in enumerate(proof.claims):
        rows = np.flatnonzero(stretches.claim == k)
        start, stop = stretches.start[rows], stretches.stop[rows]
        edges = np.concatenate([[0.0], stop]), np.concatenate([start, [last]])
        # without stretches a motion of one row has no gap, and yet nothing is said of it
        empty = not len(rows)
        broken = np.flatnonzero((edges[0] != edges[1]) | np.append(stop < start, empty))
        if len(broken):
            low, high = (float(side[broken[0]]) for side in edges)
            yield f"proof: nothing is said of {described(claim)} from row {low:g} to row {high:g}"


def described(claim: Claim) -> str:
    return f"{claim.link} against {'the scene' if claim.against == SCENE else claim.against}"


def _place(proof: Proof, i: int) -> str:
    stretches = proof.stretches
    claim = proof.claims[int(stretches.claim[i])]
    return f"{described(claim)} from row {stretches.start[i]:g} to row {stretches.stop[i]:g}"
