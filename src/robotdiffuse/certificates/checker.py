"""The checker of proofs. It needs no search, and shares only data types, the motion of single joints,
problem files and transforms with the validator.

A claim says that a link stays clear of the scene, or of another link. It is proved for stretches (intervals)
of the motion, which may begin and end between its rows (configurations): the clearance in the middle of a
stretch exceeds the displacement, which is how far the link can move within it. The proof must contain every
claim that follows from the robot (see `bounds.py`), and the stretches of each claim must cover the motion
without a gap. The checker recomputes the clearance and displacement of every stretch. They must agree with
the proof, and the clearance must exceed the displacement. So a proof that passes is right, no matter how it
was made.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
from numpy import ndarray

from robotdiffuse.certificates.bounds import CLEARANCE_CAP, SCENE, Claim, MovingProver, Prover
from robotdiffuse.certificates.kinematics import places_of
from robotdiffuse.certificates.proof import (
    BOUND_TOLERANCE,
    MotionProof,
    StretchProof,
    Tolerances,
    differences,
    hash_of,
    request_parts,
    robot_parts,
    scene_parts,
)
from robotdiffuse.certificates.requirements import (
    configurations,
    deviations,
    place_errors,
    requirement_errors,
)
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Trajectory
from robotdiffuse.problems.files import problem_from_record
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot

VALIDATOR = Tolerances()
"""The validator's tolerances."""
NORMAL_TOLERANCE = 1e-9
"""Largest difference of the length of a plane's normal from 1."""
COVER_TOLERANCE = 1e-6
"""Largest distance of a corner of a link's meshes from the link's spheres [m]."""


@dataclass(frozen=True)
class Findings:
    """The result of checking a proof."""

    differences: tuple[str, ...]
    """One line for each difference from the proof and each requirement that is not proved; empty if the proof
    holds."""

    @property
    def valid(self) -> bool:
        return not self.differences


def check(
    certificate: MotionProof, problem: Problem | None = None, at_most: Tolerances = VALIDATOR
) -> Findings:
    """Check a proof for a problem; None: the problem in the certificate. The certificate's tolerances must
    not exceed `at_most`.

    Robot, scene and motion must have the content that was certified. The motion must keep the limits along
    the cubics that join its rows, begin at the start, stop at each waypoint or pass it within its blend, and
    end at the goal. Every stretch must be proved free. `requirements.not_checked` lists what is not checked.
    Raises InputError if there is no problem, or a damaged one in the certificate; and for what certificates
    do not support: some shapes, some names of links, and Cartesian lines whose goal is not a single pose.
    """
    if problem is None:
        if certificate.problem is None:
            raise InputError("the certificate holds no problem; give the problem that it is for")
        problem = problem_from_record(certificate.problem)
    errors = [
        *differences("robot", certificate.robot_parts, robot_parts(problem.robot)),
        *differences("scene", certificate.scene_parts, scene_parts(problem.scene)),
        *differences("requests", certificate.request_parts, request_parts(problem)),
    ]
    for name, limit in asdict(at_most).items():
        stated = getattr(certificate.tolerances, name)
        if not stated <= limit:
            errors.append(f"tolerances: {name} is {stated:g}, looser than {limit:g}")
        if not stated >= 0:
            errors.append(f"tolerances: {name} is {stated:g}; it must not be negative")
    if certificate.robot != problem.robot.name:
        errors.append(f"robot: the problem has {problem.robot.name}, the certificate {certificate.robot}")
    if certificate.motion_hash != hash_of(certificate.motion):
        errors.append("motion: it is not the one that was certified: its hash differs")
    with np.errstate(all="ignore"):  # non-finite values become differences
        errors += _cover_errors(problem.robot)
        misplaced = place_errors(problem, certificate)
        errors += misplaced
        if not misplaced:
            errors += requirement_errors(problem, certificate)
            errors += _proof_errors(problem, certificate)
    return Findings(tuple(errors))


def _cover_errors(robot: Robot) -> Iterator[str]:
    """A message for each link whose spheres do not contain all corners of its meshes: most stretches are
    proved for the spheres. Only corners are checked here; that spheres contain whole meshes is proved when a
    robot is prepared."""
    for link, meshes in robot.meshes.items():
        spheres = robot.spheres.get(link)
        if spheres is None or not len(spheres) or not meshes:
            continue
        corners = np.concatenate([mesh.vertices for mesh in meshes])
        gaps = np.linalg.norm(corners[:, None] - spheres[:, :3], axis=2) - spheres[:, 3]
        beyond = float(gaps.min(axis=1).max())
        if not beyond <= COVER_TOLERANCE:
            yield f"robot: the meshes of {link} stick out of its spheres by {beyond:.2g} m"


def _proof_errors(problem: Problem, certificate: MotionProof) -> Iterator[str]:
    """Errors in the proof for the scene and between links, and in the proof for moving obstacles."""
    motion = certificate.motion
    q = configurations(motion, certificate.between)
    off = deviations(motion, certificate.between)
    prover = Prover(problem.robot, problem.scene, q, off)
    proof = certificate.proof
    stated = {"scene": certificate.scene_clearance, "self": certificate.self_clearance}
    is_pair = np.array([claim.against != SCENE for claim in proof.claims], bool)[proof.stretches.claim]
    yield from _bound_errors(prover, proof, {"scene": ~is_pair, "self": is_pair}, stated)
    moving = certificate.moving
    if moving is not None and not problem.moving:
        yield "proof: it has a part on moving obstacles, which the problem does not have"
    elif problem.moving and isinstance(motion, Trajectory):
        if moving is None:
            yield "proof: the part on moving obstacles is missing"
            return
        times = places_of(motion, certificate.between)
        prover = MovingProver(problem.robot, problem.moving, q, times, off)
        yield from _bound_errors(
            prover, moving, {"scene": np.ones(len(moving.stretches.claim), bool)}, stated
        )


def _bound_errors(
    prover: Prover, proof: StretchProof, kinds: dict[str, ndarray], stated: dict[str, float]
) -> Iterator[str]:
    """Errors in the stretches and bounds of a proof. kinds: a mask of the stretches for each kind of
    clearance ("scene", "self"). stated: the clearance that the proof states for each kind [m]."""
    stretches = proof.stretches
    claim_indices = {claim: k for k, claim in enumerate(prover.claims)}
    for claim in proof.claims:
        if claim not in claim_indices:
            yield f"proof: {describe_claim(claim)} needs no proof"
            return
    for missing in claim_indices.keys() - set(proof.claims):
        yield f"proof: {describe_claim(missing)} is missing"
    if len(set(proof.claims)) < len(proof.claims):
        yield "proof: it contains a claim twice"
        return
    gaps = list(_gaps(proof, float(len(prover.q) - 1)))
    if gaps or not len(stretches.claim):
        yield from gaps
        return
    wrong_planes = [plane for plane in proof.planes if not proof.by_planes[plane.stretch]]
    if wrong_planes:
        yield "proof: planes are given for stretches that are proved by spheres"
        return
    # without planes, the rows of np.eye(3) stand in: they have length 1
    lengths = np.linalg.norm([plane.normal for plane in proof.planes] or np.eye(3), axis=1)
    not_unit = np.flatnonzero(~(np.abs(lengths - 1) <= NORMAL_TOLERANCE))
    if len(not_unit):
        i = int(not_unit[0])
        location = _place(proof, proof.planes[i].stretch)
        yield f"proof: a plane of {location} has a normal of length {lengths[i]:g}, not 1"
        return
    claims = np.array([claim_indices[claim] for claim in proof.claims])[stretches.claim]
    bounds = prover.bounds(stretches._replace(claim=claims), proof.by_planes, list(proof.planes))
    for quantity in ("clearance", "displacement"):
        written = getattr(proof, quantity)
        right = getattr(bounds, quantity)
        off = np.flatnonzero(~(np.abs(written - right) <= BOUND_TOLERANCE))
        if len(off):
            i = int(off[0])
            more = f" ({len(off) - 1} more)" if len(off) > 1 else ""
            yield f"proof: {quantity} of {_place(proof, i)} is {right[i]:.6f} m, not {written[i]:.6f} m{more}"
    margin = bounds.clearance - bounds.displacement
    for kind, marked in kinds.items():
        stated_clearance = stated[kind]
        if not 0 < stated_clearance <= CLEARANCE_CAP:
            yield (
                f"proof: its {kind} clearance is {stated_clearance:g} m; it must be positive, and at "
                f"most {CLEARANCE_CAP:g} m"
            )
        unproved = np.flatnonzero(marked & ~(margin >= stated_clearance - BOUND_TOLERANCE))
        if len(unproved):
            i = int(unproved[0])
            yield f"proof: {_place(proof, i)} is clear by {margin[i]:.6f} m, not by {stated_clearance:.6f} m"
        without_margin = np.flatnonzero(marked & ~(margin > 0))
        if len(without_margin):
            i = int(without_margin[0])
            yield f"proof: {_place(proof, i)} is not shown to be free: {margin[i]:.6f} m are left"


def _gaps(proof: StretchProof, last: float) -> Iterator[str]:
    """A message for each claim with stretches that are not in order, or do not cover the motion from row 0 to
    row `last` without gap or overlap."""
    stretches = proof.stretches
    for k, claim in enumerate(proof.claims):
        rows = np.flatnonzero(stretches.claim == k)
        start = stretches.start[rows]
        stop = stretches.stop[rows]
        edges = np.concatenate([[0.0], stop]), np.concatenate([start, [last]])
        # A motion of one row needs a stretch too. If it is missing, the edges do not differ: both are 0.
        broken = np.flatnonzero((edges[0] != edges[1]) | np.append(stop < start, not len(rows)))
        if len(broken):
            low, high = (float(side[broken[0]]) for side in edges)
            yield f"proof: {describe_claim(claim)} has a gap or an overlap between rows {low:g} and {high:g}"


def describe_claim(claim: Claim) -> str:
    """A claim in words, e.g. "panda_link5 against the scene"."""
    return f"{claim.link} against {'the scene' if claim.against == SCENE else claim.against}"


def _place(proof: StretchProof, i: int) -> str:
    stretches = proof.stretches
    rows = f"from row {stretches.start[i]:g} to row {stretches.stop[i]:g}"
    return f"{describe_claim(proof.claims[int(stretches.claim[i])])} {rows}"
