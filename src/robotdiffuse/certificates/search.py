"""The search for a proof, which the checker can re-check without a search.

For each claim (see `bounds.py`), the motion is split into stretches until the checker's own bounds prove
every stretch. If the covering spheres are too coarse, separating planes of convex bodies are used, which are
perpendicular to the line between the bodies' nearest points. Coal finds these points.
"""

# Coal's Python module has no type information.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import coal
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.certificates.bounds import (
    CLEARANCE_CAP,
    SCENE,
    MovingProver,
    Part,
    Plane,
    Prover,
    Rounded,
    Stretches,
    Surface,
    gaps,
)
from robotdiffuse.certificates.certificate import Certificate
from robotdiffuse.certificates.kinematics import cubics_of, places_of
from robotdiffuse.certificates.proof import (
    DECIMALS,
    StretchProof,
    Tolerances,
    hash_of,
    joined,
    request_parts,
    robot_parts,
    scene_parts,
)
from robotdiffuse.certificates.requirements import (
    UNTIMED,
    configurations,
    constraint_bounds,
    cubic_jerks,
    deviations,
    torque_bounds,
)
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import transform
from robotdiffuse.core.types import Path, Pose, Trajectory, Values, array_names
from robotdiffuse.problems.files import problem_record
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.coal_geometry import coal_convex, coal_pose, coal_rounded
from robotdiffuse.robots.motion_bounds import motion_radii
from robotdiffuse.validation.validator import DEFAULT, VerifySettings, verify

MAX_PLANES = 64
"""Largest number of planes between a part and a surface; a concave surface needs several."""
NORMAL_DECIMALS = 10
"""Number of decimals of normals in files; the length of a normal must be 1 within 1e-9."""

Normal = tuple[float, float, float]


class _Body(NamedTuple):
    geometry: coal.CollisionGeometry
    T: Pose
    """Pose of the body in the frame of its link, or in the base frame."""


def _planes(
    prover: Prover, hulls: dict[str, list[_Body]], stretches: Stretches, needed: Values
) -> Iterator[Plane]:
    """Separating planes for the stretches of a prover.

    hulls: the parts of each link. needed: for each of the stretches, the clearance that it needs [m]. Bodies
    farther than this from the part's ball get no plane, nor do bodies that touch.
    """
    poses = prover.linkage.place(prover.at((stretches.start + stretches.stop) / 2)).T
    for k, claim_index in enumerate(stretches.claim):
        claim = prover.claims[claim_index]
        T_base_link = dict(zip(prover.linkage.links, poses[k], strict=True))
        for p, (part, bodies, ball_gaps) in enumerate(prover.pairs(claim, poses[k])):
            first = hulls[claim.link][p]
            first = first._replace(T=T_base_link[claim.link] @ first.T)
            for o in np.flatnonzero(ball_gaps < needed[k]).tolist():
                body = bodies[o]
                if isinstance(body, Surface):
                    normals = _around(first, part, body, float(needed[k]))
                else:
                    if isinstance(body, Rounded):
                        second = _Body(coal_rounded(*body[2:]), transform(body.center, body.R))
                    else:
                        second = hulls[claim.against][o]
                        second = second._replace(T=T_base_link[claim.against] @ second.T)
                    normals = filter(None, [_normal(first, second)])
                yield from (Plane(k, p, o, normal) for normal in normals)


def _around(first: _Body, part: Part, surface: Surface, needed: float) -> Iterator[Normal]:
    """Normals of planes that separate the elements of a surface from a part, by `needed` [m] where possible;
    elements with corners nearest to the part's center come first. Ends early if one touches the part."""
    shown_gaps = np.full(len(surface.corners), -np.inf)
    order = np.argsort(np.linalg.norm(surface.corners - part.center, axis=-1).min(axis=1))
    tried_elements = np.zeros(len(order), bool)
    for _ in range(MAX_PLANES):
        open_elements = order[(shown_gaps[order] < needed) & ~tried_elements[order]]
        if not len(open_elements):
            return
        element = int(open_elements[0])
        tried_elements[element] = True
        corners = surface.corners[element]
        if len(corners) == 3:
            second = _Body(coal_convex(corners, np.array([[0, 1, 2], [0, 2, 1]])), np.eye(4))
        else:
            second = _Body(coal.Sphere(surface.radius), transform(corners[0]))
        normal = _normal(first, second)
        if normal is None:
            return
        shown_gaps = np.maximum(shown_gaps, gaps(part, surface, np.array([normal]))[:, 0])
        yield normal


def _normal(first: _Body, second: _Body) -> Normal | None:
    """Unit vector from the second body to the first, between their nearest points; None if they touch."""
    request = coal.DistanceRequest()
    result = coal.DistanceResult()
    coal.distance(first.geometry, coal_pose(first.T), second.geometry, coal_pose(second.T), request, result)
    between = np.asarray(result.getNearestPoint1()) - np.asarray(result.getNearestPoint2())
    distance = float(np.linalg.norm(between))
    if not result.min_distance > 0 or distance < 1e-9:
        return None
    x, y, z = np.round(between / distance, NORMAL_DECIMALS).tolist()
    return x, y, z


def _hull(part: Part) -> _Body:
    if len(part.vertices) == 1:
        return _Body(coal.Sphere(part.rounding), transform(part.vertices[0]))
    return _Body(coal_convex(part.vertices, part.faces), np.eye(4))


CLEARANCE_SHARE = 0.5
"""Clearance that is proved, as a fraction of the clearance that the validator certifies. A larger fraction
needs more stretches."""
CHORD_SHARE = 0.05
"""Largest displacement of any point by replacing cubics with straight lines, as a fraction of the
clearance."""
MAX_SPLIT = 8
"""Largest number of parts into which a stretch is split at once."""
PLANES_BELOW = 0.02
"""Planes are tried if the clearance of the spheres is below this [m]. The spheres of moving links stick out
of the meshes by somewhat less."""
PLANES_DISPLACEMENT = 0.1
"""Largest displacement of stretches for which planes are tried [m]."""
ROUNDING_RESERVE = 2e-6
"""Margin added to each target clearance, so that rounded bounds still prove the clearance [m]."""
MAX_STRETCHES = 200_000
"""Largest number of stretches that are tried, and of configurations between the rows of a motion."""
PLACE_DECIMALS = 7
"""Number of decimals of the ends of stretches."""
MAX_HALVINGS = 20
"""Largest number of times that the step between two rows is halved to prove path constraints or torques."""


class NotValidError(InputError):
    """The validator refuses the motion, so it cannot be certified."""


def certify(problem: Problem, motion: Path | Trajectory, settings: VerifySettings = DEFAULT) -> Certificate:
    """Prove that a motion is valid, in a form that a small independent checker can check without a search.

    Args:
        problem: The problem that the motion solves.
        motion: A path, or a trajectory.
        settings: Tolerances of the validator.

    Returns:
        The motion and its proof; `Certificate.check` checks it.

    Raises:
        NotValidError: If the validator refuses the motion; a subclass of InputError that names the violation.
        InputError: For obstacles and requirements that certificates do not support, and if no proof of
            reasonable size is found.

    Examples:
        >>> problem = rd.Problem(rd.load_robot("panda"), rd.Scene(), "ready", "extended")
        >>> result = rd.plan(problem, until="first")
        >>> rd.certify(problem, result.trajectory).check(problem).valid
        True
    """
    report = verify(problem, motion, settings)
    if problem.moving and isinstance(motion, Path):
        raise InputError(UNTIMED)
    if report.violation is not None:
        raise NotValidError(f"the motion is not valid: {report.violation.line}")
    # files hold float64; bounds of float32 rows, such as PyTorch's, would differ from the bounds checked
    arrays = {name: np.asarray(getattr(motion, name), np.float64) for name in array_names(motion)}
    motion = replace(motion, **arrays)
    required = {
        SCENE: CLEARANCE_SHARE * (report.scene_clearance or 0.0),
        "": CLEARANCE_SHARE * (report.self_clearance or 0.0),
    }
    tolerances = Tolerances(**{name: getattr(settings, name) for name in Tolerances.__dataclass_fields__})
    if problem.constraints:
        tolerances = replace(tolerances, chord=settings.constraint_chord)
    clearances = [c for c in (report.scene_clearance, report.self_clearance) if c]
    robot = problem.robot
    reach = float(motion_radii(robot).max(axis=0, initial=0.0).sum())
    chord = min(tolerances.chord, CHORD_SHARE * min(clearances, default=np.inf) / max(reach, 1e-3))
    between = _between(motion, chord)
    bounds = torques = ()
    samples = np.zeros(0)
    if problem.constraints:
        between, bounds = _refined(
            motion,
            between,
            lambda places: constraint_bounds(problem, configurations(motion, places), tolerances.chord),
            "path constraints",
        )
    if problem.payload is not None:
        allowed = robot.effort * (1 + tolerances.rate_slack)
        samples, torques = _refined(
            motion,
            samples,
            lambda places: (robot.joint_names, torque_bounds(problem, motion, places), allowed),
            "torques",
        )
    q = configurations(motion, between)
    off = deviations(motion, between)
    proof, margins = _prove(Prover(robot, problem.scene, q, off), required)
    moving = None
    if problem.moving and isinstance(motion, Trajectory):
        times = places_of(motion, between)
        moving, moving_margins = _prove(MovingProver(robot, problem.moving, q, times, off), {"": 0.0})
        # moving_margins[SCENE] is that of a moving obstacle with the name "scene", if there is one
        margins[SCENE] = min(margins[SCENE], *moving_margins.values())
    record = None
    with suppress(InputError):  # the robot may have been made or changed in this program, and have no file
        # without T_world_base, numbers are not rounded; only a payload's weight depends on this pose
        record = problem_record(problem if problem.payload else replace(problem, T_world_base=None))
    jerks = cubic_jerks(robot, motion)
    return Certificate(
        robot.name,
        robot_parts(robot),
        scene_parts(problem.scene),
        hash_of(motion),
        tolerances,
        motion,
        between,
        margins[SCENE],
        margins[""],
        proof,
        record,
        request_parts(problem),
        moving,
        bounds,
        samples,
        torques,
        () if jerks is None else tuple(zip(motion.joint_names, jerks.tolist(), strict=True)),
    )


def _refined(
    motion: Path | Trajectory,
    places: Values,
    bounds_of: Callable[[Values], tuple[Sequence[str], Float[ndarray, "n b"], Any]],
    what: str,
) -> tuple[Values, tuple[tuple[str, float], ...]]:
    """Places between the rows (see `MotionProof.between`), added until all bounds are within their limits
    between neighboring places; and the name and largest value of each bound.

    bounds_of: computes names, bounds from each place to the next [n, b], and limits. what: for the message.
    Raises InputError if this needs too many places.
    """
    for _ in range(MAX_HALVINGS):
        names, bounds, limits = bounds_of(places)
        open_ = (bounds > limits).any(axis=1)
        if not open_.any():
            return places, tuple(zip(names, bounds.max(axis=0).tolist(), strict=True))
        at = places_of(motion, places)
        if len(at) == 1 or len(at) > MAX_STRETCHES:
            break
        places = np.sort(np.concatenate([places, ((at[:-1] + at[1:]) / 2)[open_]]))
    raise InputError(f"no proof was found for the {what}: the motion is too near to their limits")


def _between(motion: Path | Trajectory, chord: float) -> Values:
    """Places between the rows (see `MotionProof.between`) at which configurations are added, so that no joint
    leaves the straight lines between configurations by more than `chord` [rad] or [m]."""
    cubics = cubics_of(motion)
    off = (cubics.peak_accelerations * cubics.steps**2 / 8).max(axis=1)
    parts = np.maximum(np.ceil(np.sqrt(off / chord)), 1).astype(int)
    if parts.sum() > MAX_STRETCHES:
        raise InputError("the motion bends too much between its rows to be certified; give more rows")
    within = [
        t + d * np.arange(1, n) / n for t, d, n in zip(cubics.times, cubics.steps[:, 0], parts, strict=True)
    ]
    return np.concatenate([np.zeros(0), *within])


def _prove(prover: Prover, least: dict[str, float]) -> tuple[StretchProof, dict[str, float]]:
    """A proof of all claims, and the clearance that it proves for each kind of claim: SCENE for the scene, ""
    for pairs of links or moving obstacles. least: the clearance to prove for each kind [m]."""
    count = len(prover.claims)
    last = float(len(prover.q) - 1)
    todo = Stretches(np.arange(count), np.zeros(count), np.full(count, last))
    against_scene = np.array([claim.against == SCENE for claim in prover.claims], bool)
    targets = np.where(against_scene, least.get(SCENE, 0.0), least[""]) + ROUNDING_RESERVE
    moving = isinstance(prover, MovingProver)
    hulls = {} if moving else {link: list(map(_hull, parts)) for link, parts in prover.parts.items()}
    proofs = list[StretchProof]()
    total = 0
    while len(todo.claim) or not proofs:  # once, even without claims
        n = len(todo.claim)
        bounds = prover.bounds(todo, np.zeros(n, bool), [])
        clearance = _down(bounds.clearance)
        displacement = _up(bounds.displacement)
        by_planes = np.zeros(n, bool)
        planes = list[Plane]()
        target = targets[todo.claim]
        close = (
            (clearance - displacement < target)
            & (clearance < PLANES_BELOW)
            & (displacement < PLANES_DISPLACEMENT)
        )
        if hulls and close.any():
            rows = np.flatnonzero(close)
            near = todo.some(rows)
            planes = [*_planes(prover, hulls, near, displacement[rows] + target[rows])]
            tighter = prover.bounds(near, np.ones(len(rows), bool), planes)
            plane_clearance = _down(tighter.clearance)
            plane_displacement = _up(tighter.displacement)
            chosen = plane_clearance - plane_displacement > clearance[rows] - displacement[rows]
            by_planes[rows] = chosen
            clearance[rows[chosen]] = plane_clearance[chosen]
            displacement[rows[chosen]] = plane_displacement[chosen]
            planes = [plane._replace(stretch=int(rows[plane.stretch])) for plane in planes]
            _check_parts_are_apart(prover, near.some(plane_clearance <= 0))
        proved = clearance - displacement >= target
        proved_index = np.cumsum(proved) - 1
        kept_planes = tuple(
            plane._replace(stretch=int(proved_index[plane.stretch]))
            for plane in planes
            if proved[plane.stretch] and by_planes[plane.stretch]
        )
        columns = by_planes[proved], clearance[proved], displacement[proved]
        proofs.append(StretchProof(prover.claims, todo.some(proved), *columns, kept_planes))
        total += n
        if total > MAX_STRETCHES:
            raise InputError(f"no proof was found for the motion in {MAX_STRETCHES:,} stretches")
        todo = _cut(todo, clearance, displacement, target, ~proved)
    proof = _sorted(joined(prover.claims, proofs))
    margins = proof.clearance - proof.displacement
    of_scene = against_scene[proof.stretches.claim]
    return proof, {
        SCENE: float(_down(margins[of_scene]).min(initial=CLEARANCE_CAP)),
        "": float(_down(margins[~of_scene]).min(initial=CLEARANCE_CAP)),
    }


def _check_parts_are_apart(prover: Prover, stretches: Stretches) -> None:
    """Raise InputError if one of these stretches is for grazing links (`Robot.grazing`): their convex parts
    touch, so that no separating planes exist."""
    for k in stretches.claim.tolist():
        claim = prover.claims[k]
        if frozenset((claim.link, claim.against)) in prover.robot.grazing:
            raise InputError(
                f"no proof exists: the exact surfaces of {claim.link} and {claim.against} are apart, but "
                f"proofs use the convex parts around them, which touch"
            )


def _cut(
    todo: Stretches, clearance: ndarray, displacement: ndarray, target: ndarray, which: ndarray
) -> Stretches:
    """The stretches marked by `which`, each split into as many parts as its displacement requires."""
    spare = np.maximum(clearance - target, displacement / MAX_SPLIT)
    # if the spheres are too coarse, the parts are made short enough for planes
    split_factor = np.where(
        clearance < PLANES_BELOW, displacement / PLANES_DISPLACEMENT, 1.2 * displacement / spare
    )
    parts = np.clip(np.ceil(split_factor), 2, MAX_SPLIT).astype(int)
    rows = []
    for i in np.flatnonzero(which).tolist():
        low = float(todo.start[i])
        high = float(todo.stop[i])
        n = int(parts[i])
        edges = np.round(low + (high - low) * np.arange(n + 1) / n, PLACE_DECIMALS)
        edges[0] = low
        edges[-1] = high
        if not (np.diff(edges) > 0).all():
            raise InputError("no proof was found for the motion: it is too near to contact")
        rows += [(todo.claim[i], *ends) for ends in pairwise(edges.tolist())]
    claim, start, stop = np.array(rows).reshape(-1, 3).T
    return Stretches(claim.astype(int), start, stop)


def _sorted(proof: StretchProof) -> StretchProof:
    order = np.lexsort((proof.stretches.start, proof.stretches.claim))
    place = np.argsort(order)
    planes = sorted(plane._replace(stretch=int(place[plane.stretch])) for plane in proof.planes)
    columns = proof.by_planes[order], proof.clearance[order], proof.displacement[order]
    return StretchProof(proof.claims, proof.stretches.some(order), *columns, tuple(planes))


def _down(values: Values) -> Values:
    return np.floor(values * 10.0**DECIMALS) / 10.0**DECIMALS


def _up(values: Values) -> Values:
    return -_down(-values)
