"""Writing certificates: the search for a proof that the checker can re-check without one.

A motion that the validator calls valid is cut, for each claim apart, until every stretch is proved by the bounds
that the checker uses. Where spheres are too coarse, planes are laid through the middle between the nearest
points of convex bodies, which Coal finds.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.certificates.bounds import CAP, SCENE, Plane, Prover, Stretches
from robotdiffuse.certificates.checker import hash_of
from robotdiffuse.certificates.constraints import kept
from robotdiffuse.certificates.content import request_parts, robot_parts, scene_parts
from robotdiffuse.certificates.moving_obstacles import MovingProver
from robotdiffuse.certificates.planes import PlaneFinder
from robotdiffuse.certificates.proof import DECIMALS, Certificate, Proof, Tolerances
from robotdiffuse.certificates.requests import configurations, not_covered
from robotdiffuse.certificates.torques import most_torques
from robotdiffuse.core.errors import InputError, check_type
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.problems.problem import Problem, check_problem
from robotdiffuse.validation.validator import DEFAULT, VerifySettings, check_motion, verify, verify_trajectory

SHARE = 0.5
"""Of the clearances that the validator certifies: what the certificate proves. More takes more stretches."""
MOST_PARTS = 8
"""A stretch is cut into at most this many at a time."""
PLANES_BELOW = 0.02
"""Sphere clearance [m] below which planes are looked for: spheres stick out by about as much."""
DISPLACED = 0.1
"""Longest displacement of stretches that planes are looked for [m]."""
SPARE = 2e-6
"""What is left over at least, for rounding [m]."""
MOST_STRETCHES = 200_000
PLACE_DECIMALS = 7
HALVINGS = 20
"""Of the way between two configurations until path constraints are shown to be kept there."""


class NotValidError(InputError):
    """The motion is not valid, so that there is nothing to certify."""


def certify(problem: Problem, motion: Path | Trajectory, settings: VerifySettings = DEFAULT) -> Certificate:
    """A certificate for a motion that the validator calls valid.

    Raises `NotValidError`, an InputError, with what the validator found if it does not; and InputError for
    obstacles and requests that certificates do not know, and where no proof is found in reasonable size.
    """
    check_problem(problem)
    check_motion("motion", motion, (Path, Trajectory))
    check_type("settings", settings, VerifySettings, "VerifySettings")
    beside = not_covered(problem, motion)
    if beside:
        raise InputError(
            f"the problem has {', '.join(beside)}, which certificates do not prove anything about"
        )
    validator = verify_trajectory if isinstance(motion, Trajectory) else verify
    report = validator(problem, motion, settings)  # type: ignore[arg-type]
    if report.violation is not None:
        raise NotValidError(
            f"the motion is not valid: {report.violation.message} (at {report.violation.time:.3f})"
        )
    least = {SCENE: SHARE * (report.scene_clearance or 0.0), "": SHARE * (report.self_clearance or 0.0)}
    tolerances = Tolerances(**{name: getattr(settings, name) for name in Tolerances.__dataclass_fields__})
    if problem.constraints:
        tolerances = replace(tolerances, chord=settings.constraint_chord)
    between, bounds = _keeping(problem, motion, _between(motion, tolerances.chord), tolerances.chord)
    looks, torques = _bearing(problem, motion, tolerances.rate_slack)
    q = configurations(motion, between)
    proof, left = _prove(Prover(problem.robot, problem.scene, q), least)
    moving = None
    if problem.moving and isinstance(motion, Trajectory):
        times = np.sort(np.concatenate([motion.times, between]), kind="stable")
        moving, others = _prove(MovingProver(problem.robot, problem.moving, q, times), {"": 0.0})
        left[SCENE] = min(left[SCENE], others[""])
    return Certificate(
        problem.robot.name,
        robot_parts(problem.robot),
        scene_parts(problem.scene),
        hash_of(motion),
        tolerances,
        motion,
        between,
        left[SCENE],
        left[""],
        proof,
        _record(problem),
        request_parts(problem),
        moving,
        bounds,
        looks,
        torques,
    )


def _keeping(
    problem: Problem, motion: Path | Trajectory, between: Float[ndarray, "k"], chord: float
) -> tuple[Float[ndarray, "m"], tuple[tuple[str, float], ...]]:
    """Times, or places of a path, between the rows from which to which all path constraints are shown to be
    kept; and what they are at most."""
    if not problem.constraints:
        return between, ()
    timed = isinstance(motion, Trajectory)
    rows = motion.times if timed else np.arange(len(motion.positions), dtype=float)
    for _ in range(HALVINGS):
        shown = kept(problem, configurations(motion, between), chord)
        open_ = np.any([one.bounds > one.limit for one in shown], axis=0)
        if not open_.any():
            return between, tuple((one.name, float(one.bounds.max())) for one in shown)
        at = np.sort(np.concatenate([rows, between]), kind="stable")
        more = (at[:-1] + at[1:])[open_[: len(at) - 1]] / 2
        between = np.sort(np.concatenate([between, more]))
        if len(between) > MOST_STRETCHES:
            break
    raise InputError("no proof was found for the path constraints: the motion is too near to their limits")


def _bearing(
    problem: Problem, motion: Path | Trajectory, slack: float
) -> tuple[Float[ndarray, "k"], tuple[tuple[str, float], ...]]:
    """Times, or places of a path, between the rows from which to which all torques are shown to be within
    their limits; and what they are at most."""
    looks = np.zeros(0)
    if problem.payload is None:
        return looks, ()
    timed = isinstance(motion, Trajectory)
    rows = motion.times if timed else np.arange(len(motion.positions), dtype=float)
    for _ in range(HALVINGS):
        most = most_torques(problem, motion, looks)
        open_ = (most > problem.robot.effort * (1 + slack)).any(axis=1)
        if not open_.any():
            return looks, tuple(zip(problem.robot.joint_names, most.max(axis=0).tolist(), strict=True))
        at = np.sort(np.concatenate([rows, looks]))
        if len(at) == 1 or len(at) > MOST_STRETCHES:
            break
        looks = np.sort(np.concatenate([looks, ((at[:-1] + at[1:]) / 2)[open_]]))
    raise InputError("no proof was found for the torques: the motion is too near to their limits")


def _record(problem: Problem) -> dict[str, object] | None:
    from robotdiffuse.problems.files import problem_record

    try:
        return problem_record(problem)
    except InputError:  # a robot that only this program has
        return None


def _between(motion: Path | Trajectory, chord: float) -> Float[ndarray, "k"]:
    """Times between the rows at which the cubics through them leave the straight lines by at most `chord`."""
    if not isinstance(motion, Trajectory) or len(motion.times) < 2:
        return np.zeros(0)
    h = np.diff(motion.times)[:, None]
    mean, v0, v1 = np.diff(motion.positions, axis=0) / h, motion.velocities[:-1], motion.velocities[1:]
    bend = np.maximum(np.abs(6 * mean - 4 * v0 - 2 * v1), np.abs(6 * mean - 2 * v0 - 4 * v1)) / h
    off = (bend * h**2 / 8).max(axis=1, initial=0.0)
    parts = np.maximum(np.ceil(np.sqrt(off / chord)), 1).astype(int)
    if parts.sum() > MOST_STRETCHES:
        raise InputError("the motion bends too much between its rows to be certified; give more rows")
    within = [t + d * np.arange(1, n) / n for t, d, n in zip(motion.times, h[:, 0], parts, strict=False)]
    return np.concatenate([np.zeros(0), *within])


class _Found(NamedTuple):
    stretches: Stretches
    by_planes: ndarray
    clearance: ndarray
    displacement: ndarray
    planes: list[Plane]


def _prove(prover: Prover, least: dict[str, float]) -> tuple[Proof, dict[str, float]]:
    """Stretches that are proved for all claims, and what is left over of each kind."""
    count, last = len(prover.claims), float(len(prover.q) - 1)
    todo = Stretches(np.arange(count), np.zeros(count), np.full(count, last))
    against_scene = np.array([claim.against == SCENE for claim in prover.claims], bool)
    targets = np.where(against_scene, least.get(SCENE, 0.0), least[""]) + SPARE
    in_time = isinstance(prover, MovingProver)
    tools = None if in_time else PlaneFinder(prover)
    done: list[_Found] = []
    total = 0
    while len(todo.claim) or not done:  # robots without bodies have nothing to prove
        n = len(todo.claim)
        found = prover.bounds(todo, np.zeros(n, bool), [])
        clearance, displacement = _down(found.clearance), _up(found.displacement)
        by_planes, planes, target = np.zeros(n, bool), list[Plane](), targets[todo.claim]
        close = (clearance - displacement < target) & (clearance < PLANES_BELOW) & (displacement < DISPLACED)
        if tools is not None and close.any():
            rows = np.flatnonzero(close)
            planes = tools.planes(todo, rows, displacement[rows] + target[rows])
            again = prover.bounds(todo.some(rows), np.ones(len(rows), bool), _renumbered(planes, rows))
            better, less = _down(again.clearance), _up(again.displacement)
            by_planes[rows] = better - less > clearance[rows] - displacement[rows]
            chosen = by_planes[rows]
            clearance[rows[chosen]], displacement[rows[chosen]] = better[chosen], less[chosen]
        proved = clearance - displacement >= target
        done.append(_kept(todo, proved, by_planes, clearance, displacement, planes))
        total += n
        if total > MOST_STRETCHES:
            raise InputError(f"no proof of less than {MOST_STRETCHES:,} stretches was found for the motion")
        todo = _cut(todo, clearance, displacement, target, ~proved)
    return _joined(prover, done)


def _renumbered(planes: list[Plane], rows: ndarray) -> list[Plane]:
    number = {row: k for k, row in enumerate(rows.tolist())}
    return [plane._replace(stretch=number[plane.stretch]) for plane in planes]


def _kept(
    todo: Stretches,
    proved: ndarray,
    by_planes: ndarray,
    clearance: ndarray,
    displacement: ndarray,
    planes: list[Plane],
) -> _Found:
    number = np.cumsum(proved) - 1
    kept = [
        plane._replace(stretch=int(number[plane.stretch]))
        for plane in planes
        if proved[plane.stretch] and by_planes[plane.stretch]
    ]
    return _Found(todo.some(proved), by_planes[proved], clearance[proved], displacement[proved], kept)


def _cut(
    todo: Stretches, clearance: ndarray, displacement: ndarray, target: ndarray, which: ndarray
) -> Stretches:
    """Those that are not proved, in as many parts as their displacement asks for."""
    spare = np.maximum(clearance - target, displacement / MOST_PARTS)
    # where spheres are too near, until planes may help
    asked = np.where(clearance < PLANES_BELOW, displacement / DISPLACED, 1.2 * displacement / spare)
    parts = np.clip(np.ceil(asked), 2, MOST_PARTS).astype(int)
    claims, starts, stops = [], [], []
    for i in np.flatnonzero(which).tolist():
        low, high, n = float(todo.start[i]), float(todo.stop[i]), int(parts[i])
        edges = np.round(low + (high - low) * np.arange(n + 1) / n, PLACE_DECIMALS)
        edges[0], edges[-1] = low, high
        if not (np.diff(edges) > 0).all():
            raise InputError("no proof was found for the motion: it is too near to contact")
        claims.append(np.full(n, todo.claim[i]))
        starts.append(edges[:-1])
        stops.append(edges[1:])
    if not claims:
        return Stretches(np.zeros(0, int), np.zeros(0), np.zeros(0))
    return Stretches(np.concatenate(claims), np.concatenate(starts), np.concatenate(stops))


def _joined(prover: Prover, done: list[_Found]) -> tuple[Proof, dict[str, float]]:
    claim, start, stop = (np.concatenate(parts) for parts in zip(*(f.stretches for f in done), strict=True))
    order = np.lexsort((start, claim))
    place = np.empty(len(order), int)
    place[order] = np.arange(len(order))
    offsets = np.cumsum([0] + [len(f.stretches.claim) for f in done])
    planes = [
        plane._replace(stretch=int(place[offset + plane.stretch]))
        for f, offset in zip(done, offsets, strict=False)
        for plane in f.planes
    ]
    clearance, displacement, by_planes = (
        np.concatenate([getattr(f, name) for f in done])[order]
        for name in ("clearance", "displacement", "by_planes")
    )
    stretches = Stretches(claim[order], start[order], stop[order])
    left = clearance - displacement
    of_scene = np.array([c.against == SCENE for c in prover.claims], bool)[stretches.claim]
    least = {
        SCENE: float(_down(left[of_scene]).min(initial=CAP)),
        "": float(_down(left[~of_scene]).min(initial=CAP)),
    }
    planes.sort()
    proof = Proof(prover.claims, stretches, by_planes, clearance, displacement, tuple(planes))
    return proof, least


def _down(values: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    return np.floor(values * 10.0**DECIMALS) / 10.0**DECIMALS


def _up(values: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    return np.ceil(values * 10.0**DECIMALS) / 10.0**DECIMALS
