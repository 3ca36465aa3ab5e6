"""The search for a proof, which the checker can re-check without a search.

For each claim, a motion that the validator accepts is split until every stretch is proved by the checker's
own bounds. Where spheres are too coarse, planes between the nearest points of convex bodies, which Coal
finds, prove it.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.certificates.bounds import CLEARANCE_CAP, SCENE, Plane, Prover, Stretches
from robotdiffuse.certificates.certificate import Certificate
from robotdiffuse.certificates.checker import hash_of
from robotdiffuse.certificates.constraints import constraint_bounds
from robotdiffuse.certificates.content_hashes import request_parts, robot_parts, scene_parts
from robotdiffuse.certificates.cubics import cubics_of
from robotdiffuse.certificates.moving_obstacles import MovingProver
from robotdiffuse.certificates.planes import PlaneFinder
from robotdiffuse.certificates.proof import DECIMALS, StretchProof, Tolerances
from robotdiffuse.certificates.requirements import configurations, cubic_jerks, deviations, not_covered
from robotdiffuse.certificates.torques import torque_bounds
from robotdiffuse.core.errors import InputError, check_type
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.problems.problem import Problem, check_problem
from robotdiffuse.robots.motion_bounds import motion_radii
from robotdiffuse.validation.validator import DEFAULT, VerifySettings, check_motion, verify

CLEARANCE_SHARE = 0.5
"""The proof shows this share of the clearances that the validator certifies; a larger one needs more
stretches."""
CHORD_SHARE = 0.05
"""Straight lines that stand for the cubics displace no point by more than this share of the clearance."""
MAX_SPLIT = 8
"""A stretch is split into at most this many parts at a time."""
PLANES_BELOW = 0.02
"""Sphere clearance below which planes are tried: the spheres stick out by about as much [m]."""
PLANES_DISPLACEMENT = 0.1
"""Largest displacement of stretches for which planes are tried [m]."""
ROUNDING_RESERVE = 2e-6
"""Margin added to each target clearance so that rounded bounds still prove it [m]."""
MAX_STRETCHES = 200_000
PLACE_DECIMALS = 7
MAX_HALVINGS = 20
"""Halvings of the way between two configurations at most, to prove path constraints or torques there."""


class NotValidError(InputError):
    """The motion is not valid, so it cannot be certified."""


def certify(problem: Problem, motion: Path | Trajectory, settings: VerifySettings = DEFAULT) -> Certificate:
    """A certificate of a motion that the validator accepts with these settings.

    Raises `NotValidError`, an InputError, with the first violation if the validator rejects the motion.
    Raises InputError for obstacles and requirements that certificates do not support, and if no proof of
    reasonable size is found.
    """
    check_problem(problem)
    check_motion("motion", motion, (Path, Trajectory))
    check_type("settings", settings, VerifySettings, "VerifySettings")
    unsupported = not_covered(problem, motion)
    if unsupported:
        raise InputError(f"certificates prove nothing about {', '.join(unsupported)}, which the problem has")
    report = verify(problem, motion, settings)
    if report.violation is not None:
        raise NotValidError(f"the motion is not valid: {report.violation.line}")
    least = {
        SCENE: CLEARANCE_SHARE * (report.scene_clearance or 0.0),
        "": CLEARANCE_SHARE * (report.self_clearance or 0.0),
    }
    tolerances = Tolerances(**{name: getattr(settings, name) for name in Tolerances.__dataclass_fields__})
    if problem.constraints:
        tolerances = replace(tolerances, chord=settings.constraint_chord)
    clearances = [c for c in (report.scene_clearance, report.self_clearance) if c]
    reach = float(motion_radii(problem.robot).max(axis=0, initial=0.0).sum())
    chord = min(tolerances.chord, CHORD_SHARE * min(clearances, default=np.inf) / max(reach, 1e-3))
    between, bounds = _prove_constraints(problem, motion, _between(motion, chord), tolerances.chord)
    samples, torques = _prove_torques(problem, motion, tolerances.rate_slack)
    q, off = configurations(motion, between), deviations(motion, between)
    proof, left = _prove(Prover(problem.robot, problem.scene, q, off), least)
    moving = None
    if problem.moving and isinstance(motion, Trajectory):
        times = np.sort(np.concatenate([motion.times, between]), kind="stable")
        moving, others = _prove(MovingProver(problem.robot, problem.moving, q, times, off), {"": 0.0})
        left[SCENE] = min(left[SCENE], *others.values())  # an obstacle may be called "scene"
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
        samples,
        torques,
        _jerks(problem, motion),
    )


def _jerks(problem: Problem, motion: Path | Trajectory) -> tuple[tuple[str, float], ...]:
    """See `MotionProof.jerks`."""
    jerks = cubic_jerks(problem.robot, motion)
    return () if jerks is None else tuple(zip(motion.joint_names, jerks.tolist(), strict=True))


def _prove_constraints(
    problem: Problem, motion: Path | Trajectory, between: Float[ndarray, "k"], chord: float
) -> tuple[Float[ndarray, "m"], tuple[tuple[str, float], ...]]:
    """Places between the rows (see `MotionProof.between`) from each of which to the next all path constraints
    are proved, and upper bounds of the constraints' quantities."""
    if not problem.constraints:
        return between, ()
    timed = isinstance(motion, Trajectory)
    rows = motion.times if timed else np.arange(len(motion.positions), dtype=float)
    for _ in range(MAX_HALVINGS):
        shown = constraint_bounds(problem, configurations(motion, between), chord)
        open_ = np.any([one.bounds > one.limit for one in shown], axis=0)
        if not open_.any():
            return between, tuple((one.name, float(one.bounds.max())) for one in shown)
        at = np.sort(np.concatenate([rows, between]), kind="stable")
        more = (at[:-1] + at[1:])[open_[: len(at) - 1]] / 2
        between = np.sort(np.concatenate([between, more]))
        if len(between) > MAX_STRETCHES:
            break
    raise InputError("no proof was found for the path constraints: the motion is too near to their limits")


def _prove_torques(
    problem: Problem, motion: Path | Trajectory, slack: float
) -> tuple[Float[ndarray, "k"], tuple[tuple[str, float], ...]]:
    """Places between the rows (see `MotionProof.between`) from each of which to the next all torques are
    proved to be within their limits, and upper bounds of the torques."""
    samples = np.zeros(0)
    if problem.payload is None:
        return samples, ()
    timed = isinstance(motion, Trajectory)
    rows = motion.times if timed else np.arange(len(motion.positions), dtype=float)
    for _ in range(MAX_HALVINGS):
        most = torque_bounds(problem, motion, samples)
        open_ = (most > problem.robot.effort * (1 + slack)).any(axis=1)
        if not open_.any():
            return samples, tuple(zip(problem.robot.joint_names, most.max(axis=0).tolist(), strict=True))
        at = np.sort(np.concatenate([rows, samples]))
        if len(at) == 1 or len(at) > MAX_STRETCHES:
            break
        samples = np.sort(np.concatenate([samples, ((at[:-1] + at[1:]) / 2)[open_]]))
    raise InputError("no proof was found for the torques: the motion is too near to their limits")


def _record(problem: Problem) -> dict[str, object] | None:
    from robotdiffuse.problems.files import problem_record

    try:
        return problem_record(problem)
    except InputError:  # a robot that was made in this program and has no file
        return None


def _between(motion: Path | Trajectory, chord: float) -> Float[ndarray, "k"]:
    """Times between the rows such that the cubics leave the straight lines between them by at most
    `chord`."""
    cubics = cubics_of(motion)
    if cubics is None:
        return np.zeros(0)
    off = (cubics.pulls * cubics.steps**2 / 8).max(axis=1)
    parts = np.maximum(np.ceil(np.sqrt(off / chord)), 1).astype(int)
    if parts.sum() > MAX_STRETCHES:
        raise InputError("the motion bends too much between its rows to be certified; give more rows")
    within = [
        t + d * np.arange(1, n) / n for t, d, n in zip(cubics.times, cubics.steps[:, 0], parts, strict=True)
    ]
    return np.concatenate([np.zeros(0), *within])


class _Found(NamedTuple):
    stretches: Stretches
    by_planes: ndarray
    clearance: ndarray
    displacement: ndarray
    planes: list[Plane]


def _prove(prover: Prover, least: dict[str, float]) -> tuple[StretchProof, dict[str, float]]:
    """A proof of all claims, and the clearance that it shows by kind (SCENE or ""); `least` is asked for
    [m]."""
    count, last = len(prover.claims), float(len(prover.q) - 1)
    todo = Stretches(np.arange(count), np.zeros(count), np.full(count, last))
    against_scene = np.array([claim.against == SCENE for claim in prover.claims], bool)
    targets = np.where(against_scene, least.get(SCENE, 0.0), least[""]) + ROUNDING_RESERVE
    in_time = isinstance(prover, MovingProver)
    tools = None if in_time else PlaneFinder(prover)
    done: list[_Found] = []
    total = 0
    while len(todo.claim) or not done:  # robots without bodies have nothing to prove
        n = len(todo.claim)
        found = prover.bounds(todo, np.zeros(n, bool), [])
        clearance, displacement = _down(found.clearance), _up(found.displacement)
        by_planes, planes, target = np.zeros(n, bool), list[Plane](), targets[todo.claim]
        close = (
            (clearance - displacement < target)
            & (clearance < PLANES_BELOW)
            & (displacement < PLANES_DISPLACEMENT)
        )
        if tools is not None and close.any():
            rows = np.flatnonzero(close)
            planes = tools.planes(todo, rows, displacement[rows] + target[rows])
            again = prover.bounds(todo.some(rows), np.ones(len(rows), bool), _renumbered(planes, rows))
            better, less = _down(again.clearance), _up(again.displacement)
            by_planes[rows] = better - less > clearance[rows] - displacement[rows]
            chosen = by_planes[rows]
            clearance[rows[chosen]], displacement[rows[chosen]] = better[chosen], less[chosen]
            _check_parts_are_apart(prover, todo.some(rows[better <= 0]))
        proved = clearance - displacement >= target
        done.append(_proved_part(todo, proved, by_planes, clearance, displacement, planes))
        total += n
        if total > MAX_STRETCHES:
            raise InputError(f"no proof of less than {MAX_STRETCHES:,} stretches was found for the motion")
        todo = _cut(todo, clearance, displacement, target, ~proved)
    return _join(prover, done)


def _check_parts_are_apart(prover: Prover, stretches: Stretches) -> None:
    """Raise InputError if one of these stretches, without separating planes, is of a grazing pair."""
    for k in stretches.claim.tolist():
        claim = prover.claims[k]
        if frozenset((claim.link, claim.against)) in prover.robot.grazing:
            raise InputError(
                f"no proof exists: {claim.link} and {claim.against} are apart only by their exact surfaces, "
                f"and proofs use the convex parts around them, which touch"
            )


def _renumbered(planes: list[Plane], rows: ndarray) -> list[Plane]:
    number = {row: k for k, row in enumerate(rows.tolist())}
    return [plane._replace(stretch=number[plane.stretch]) for plane in planes]


def _proved_part(
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
    """The stretches that are not proved, each split into as many parts as its displacement requires."""
    spare = np.maximum(clearance - target, displacement / MAX_SPLIT)
    # where spheres are too coarse, parts are made short enough for planes
    asked = np.where(clearance < PLANES_BELOW, displacement / PLANES_DISPLACEMENT, 1.2 * displacement / spare)
    parts = np.clip(np.ceil(asked), 2, MAX_SPLIT).astype(int)
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


def _join(prover: Prover, done: list[_Found]) -> tuple[StretchProof, dict[str, float]]:
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
        SCENE: float(_down(left[of_scene]).min(initial=CLEARANCE_CAP)),
        "": float(_down(left[~of_scene]).min(initial=CLEARANCE_CAP)),
    }
    planes.sort()
    proof = StretchProof(prover.claims, stretches, by_planes, clearance, displacement, tuple(planes))
    return proof, least


def _down(values: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    return np.floor(values * 10.0**DECIMALS) / 10.0**DECIMALS


def _up(values: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    return np.ceil(values * 10.0**DECIMALS) / 10.0**DECIMALS
