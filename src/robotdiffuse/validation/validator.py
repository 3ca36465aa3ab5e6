"""The validator: whether a motion is free of collision, within limits, and leads from the start to the goal.

Freedom from collision between waypoints is certified, not sampled: see collision/motions.py. A trajectory is
validated along the cubics that controllers execute between its rows: see trajectories/cubics.py and
validation/rates.py. The validator does not depend on planners.

Of joint torques and frame speeds, the validator finds the first value that exceeds its limit, or proves that
no value does. A motion consists of pieces, on which positions are straight or cubic and torques are smooth.
Values are computed at both ends of a piece. Bounds on their second derivatives (see robots/dynamics.py) bound
the values in between. If such a bound exceeds the limit, the piece is halved.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.collision.convex_geometry import describe_contact
from robotdiffuse.collision.motions import Contact, ContinuousCollision, contacts
from robotdiffuse.core.errors import (
    MAX_COORDINATE,
    InputError,
    check_type,
    counted,
    distinct,
    shown,
    within,
)
from robotdiffuse.core.kernels import kernel
from robotdiffuse.core.types import (
    Configurations,
    JointRows,
    Path,
    Trajectory,
    Values,
    array_names,
    for_kernels,
)
from robotdiffuse.problems.problem import Problem, check_problem
from robotdiffuse.robots.dynamics import Dynamics, Stretches
from robotdiffuse.robots.robot import check_joints
from robotdiffuse.scenes.scene import MAX_DURATION
from robotdiffuse.trajectories.cubics import Cubics
from robotdiffuse.trajectories.speed_limits import jerk_limits
from robotdiffuse.validation.rates import rate_violations
from robotdiffuse.validation.report import Report, Violation
from robotdiffuse.validation.tolerances import DEFAULT, VerifySettings, first_place_within, goal_error

if TYPE_CHECKING:  # modules for features that few problems have are imported when they are needed
    from robotdiffuse.collision.moving_obstacles import MovingCollision, TimedContact
    from robotdiffuse.problems.compiled_constraints import PathConstraints

RESOLUTION = 1e-3
"""A piece is not halved further once its values are known to this fraction of their limits. If a value may
still exceed its limit then, it counts as exceeding it."""
MAX_OPEN_PIECES = 100_000
"""Maximum number of pieces that are halved at once. If there are more, as in motions with very many turns,
each value that is not proved to be within its limit counts as exceeding it."""
PLACE_RESOLUTION = 1 / 64
"""Resolution of the place where a value first exceeds its limit, as a fraction of a step from row to row."""
States = tuple[JointRows, JointRows, JointRows]
"""Positions, velocities and accelerations."""


class Pieces(NamedTuple):
    """The pieces of a motion, from each row to the next."""

    states: Callable[[Int[ndarray, "n"], Values], States]
    """States at places. A place is the index of a piece, and a share: the fraction of the piece that has
    passed."""
    along: Stretches
    """Bounds on positions and derivatives along each piece; derivatives are with respect to the share."""


class Excess(NamedTuple):
    """The first value that exceeds its limit, or is not proved to be within its limit."""

    place: float
    """Row, plus the share of the piece after it."""
    column: int
    """Index of the joint, or of the frame."""
    value: float
    """The torque of the joint [N m] or [N], or the speed of the frame [m/s]."""
    excess: float
    """Largest amount found by which this joint or frame exceeds its limit plus the allowed slack, in the unit
    of `value`. Inside pieces whose two ends exceed the limit, larger amounts are not searched for."""


def trajectory_pieces(trajectory: Trajectory) -> Pieces:
    """Pieces of a trajectory with increasing times: the cubics through its positions and velocities."""
    if len(trajectory.positions) == 1:
        return static_pieces(trajectory.positions)
    cubics = Cubics(trajectory)
    extremes = cubics.extremes
    h = cubics.steps
    change = np.abs(extremes.end - extremes.start)
    accelerations = np.stack([extremes.acceleration, change, np.zeros_like(change)])
    max_velocities = extremes.velocity
    speed = np.stack([max_velocities, h * accelerations[0], h * change])
    farthest = _farthest(trajectory.positions) + h * max_velocities / 2
    return Pieces(cubics.states, Stretches(farthest, h * speed, speed, accelerations))


def static_pieces(q: Configurations) -> Pieces:
    """Pieces of a path, on straight lines between waypoints, with zero velocity everywhere."""
    q = np.repeat(q, 2, axis=0) if len(q) == 1 else q
    step = np.diff(q, axis=0)
    still = np.zeros((3, *step.shape))

    def states(piece: ndarray, share: ndarray) -> States:
        configurations = q[piece] + share[:, None] * step[piece]
        return configurations, 0 * configurations, 0 * configurations

    by_share = still.copy()  # derivatives of the positions with respect to the share
    by_share[0] = np.abs(step)
    return Pieces(states, Stretches(_farthest(q), by_share, still, still))


def _farthest(q: Configurations) -> JointRows:
    """Largest absolute position of each joint at the ends of each piece."""
    return np.maximum(np.abs(q[:-1]), np.abs(q[1:]))


def first_excess(dynamics: Dynamics, pieces: Pieces, slack: float) -> Excess | None:
    """The first torque that exceeds its limit by more than the fraction `slack`; None if it is proved that no
    torque does."""
    bends = dynamics.second_derivatives(pieces.along)
    return first_beyond(dynamics.limits, dynamics.torques, bends, pieces.states, slack)


def first_beyond(
    limits: Values,
    values: Callable[[ndarray, ndarray, ndarray], ndarray],
    bends: Float[ndarray, "m k"],
    states: Callable[[ndarray, ndarray], States],
    slack: float,
) -> Excess | None:
    """The first value along a motion, such as a torque, that exceeds its limit by more than the fraction
    `slack`; None if it is proved that no value does.

    Args:
        limits: Limits of k values [k].
        values: Computes the k values [n, k] from n positions, velocities and accelerations.
        bends: Bounds on the second derivatives of the values with respect to the share, for each of m pieces.
        states: `Pieces.states`.
        slack: Allowed excess, as a fraction of a limit.
    """
    allowed = limits * (1 + slack)
    count = len(bends)
    piece = np.arange(count)
    low = np.zeros(count)
    high = np.ones(count)

    def magnitudes(piece: ndarray, share: ndarray) -> ndarray:
        return np.abs(values(*states(piece, share)))

    at_low = magnitudes(piece, low)
    at_high = magnitudes(piece, high)
    places: list[ndarray] = [np.zeros(0)]
    beyond: list[ndarray] = [np.zeros((0, len(allowed)))]
    while len(piece):
        # between the ends of [low, high], a value is at most the larger end value plus `bulge`
        bulge = bends[piece] * (high - low)[:, None] ** 2 / 8
        bound = np.maximum(at_low, at_high)
        undecided = bound + bulge > allowed
        low_exceeds = (at_low > allowed).any(axis=1)
        high_exceeds = (at_high > allowed).any(axis=1)
        unsure = np.minimum(bulge, RESOLUTION * limits)
        resolved = bulge <= RESOLUTION * limits if len(piece) <= MAX_OPEN_PIECES else np.ones_like(undecided)
        exceeds = low_exceeds | high_exceeds
        unproved = (undecided & resolved).any(axis=1)
        wrong = np.flatnonzero(exceeds | unproved)
        places.append(piece[wrong] + np.where(exceeds & ~low_exceeds, high, low)[wrong])
        beyond.append((np.where(bound > allowed, bound, bound + unsure) - allowed)[wrong])
        # halve undecided intervals, and intervals with an excess at one end only, to locate the excess
        unlocated = exceeds & (low_exceeds != high_exceeds) & (high - low > PLACE_RESOLUTION)
        halved = undecided.any(axis=1) & (unlocated | ~(exceeds | unproved))
        piece = piece[halved]
        low = low[halved]
        high = high[halved]
        middle = (low + high) / 2
        at_middle = magnitudes(piece, middle)
        at_low = at_low[halved]
        at_high = at_high[halved]
        at_low = np.concatenate([at_low, at_middle])
        at_high = np.concatenate([at_middle, at_high])
        low = np.append(low, middle)
        high = np.append(middle, high)
        piece = np.tile(piece, 2)
    place = np.concatenate(places)
    excess = np.concatenate(beyond)
    if not len(place):
        return None
    i = int(place.argmin())
    j = int(excess[i].argmax())
    return Excess(float(place[i]), j, float(excess[i, j] + allowed[j]), float(excess[:, j].max()))


CHORD_SHARE = 0.1
"""Collision is checked on straight lines, and certified clearances are reduced by how far the cubics leave
these lines. Rows are added until the reduction is at most this fraction of the clearance or, if that is more,
`tightness` * `contact` / 2 of the settings."""
CHORD_MARGIN = 0.9
"""Safety factor on the next `chord` to try (the greatest distance between cubics and lines), so that a single
retry suffices."""


RATE_KINDS = ("rest", "rates", "velocity", "acceleration", "jump")
CONTACT_KINDS = ("scene_collision", "self_collision")


def verify(problem: Problem, motion: Path | Trajectory, settings: VerifySettings = DEFAULT) -> Report:
    """Validate a motion of any planner.

    Args:
        problem: The problem that the motion is to solve.
        motion: A trajectory, which is checked as it will be executed, with its times and rates; or a path. A
            path has no times, so rates and moving obstacles are not checked.
        settings: Tolerances of the validator.

    Returns:
        Whether the motion is valid, the first violation, and certified clearances.

    Raises:
        InputError: If an argument has a wrong type, or the motion has other joints than the robot or wrong
            shapes.

    Examples:
        >>> robot = rd.load_robot("panda")
        >>> problem = rd.Problem(robot, rd.Scene(), "ready", "extended")
        >>> line = np.stack([problem.start, problem.goal.positions[0]])
        >>> rd.verify(problem, rd.Path(robot.joint_names, line)).valid
        True
    """
    check_problem(problem)
    check_type("settings", settings, VerifySettings, "VerifySettings")
    wanted = "a Path, e.g. result.path, or a Trajectory, e.g. result.trajectory"
    check_type("motion", motion, (Path, Trajectory), wanted)
    check_type("motion.joint_names", motion.joint_names, (tuple, list), "a tuple of names")
    for name in array_names(motion):
        values = getattr(motion, name)
        if not isinstance(values, ndarray) or values.dtype.kind not in "iuf":
            raise InputError(f"motion.{name} is {shown(values)}; it must be a NumPy array of numbers")
    validator = verifier(problem, settings)
    return validator.trajectory(motion) if isinstance(motion, Trajectory) else validator.path(motion)


class Verifier:
    """Validates motions for one problem; data of the robot and the scene is prepared once."""

    def __init__(self, problem: Problem, settings: VerifySettings = DEFAULT) -> None:
        self.problem = problem
        self.settings = settings
        self.robot = problem.robot

    def path(self, path: Path) -> Report:
        """See `verify`."""
        self._check_shape("path", path)
        known_violations = list[Violation | None]()
        if self.dynamics is not None and within(path.positions):
            clock = np.arange(len(path.positions), dtype=float)
            known_violations = [self._torques(clock, static_pieces(path.positions), " to hold the payload")]
        return self._report(path.positions, None, known_violations)

    def trajectory(self, trajectory: Trajectory) -> Report:
        """Validate a trajectory with its rates and times, and among moving obstacles.

        All limits must hold along the cubics through the positions and velocities of the rows. Velocities and
        accelerations must agree with the positions. The motion must begin at rest, or with the problem's
        start velocity, and end at rest. Raises InputError if the joints are not those of the robot, or for
        wrong shapes.
        """
        self._check_shape("trajectory", trajectory)
        violation = _unusable(trajectory)
        if violation is not None:
            return Report(False, violation, None, None)
        if not within(trajectory.positions):
            return self._report(trajectory.positions, trajectory.times, [])
        cubics = Cubics(trajectory)
        begins = self.problem.start_velocity
        wrong_rates = rate_violations(self.robot, trajectory, self.settings, begins, cubics)
        at_rest = None
        if self.problem.waypoints:
            at_rest = np.abs(trajectory.velocities).max(axis=1) <= self.settings.rest
        if wrong_rates:
            return self._report(trajectory.positions, trajectory.times, wrong_rates, at_rest)
        violations = [self._limits_between(cubics)]
        if self.dynamics is not None:
            pieces = trajectory_pieces(trajectory)
            violations.append(self._torques(trajectory.times, pieces, ", with the payload"))
        along = None
        if self.constraints is not None:
            violations.append(self._too_fast(cubics))
            along = None if any(violations) else cubics.sampled(self.settings.constraint_chord)[:2]
        report = self._report_on_chords(cubics, violations, at_rest, along)
        if not report.valid:
            return report
        jerks = np.maximum(trajectory.peak_jerks, cubics.extremes.jerk)
        return replace(report, jerk_share=float((jerks / jerk_limits(self.robot)).max()))

    def _report_on_chords(
        self,
        cubics: Cubics,
        found: Sequence[Violation | None],
        at_rest: ndarray | None,
        along: tuple[ndarray, ndarray] | None,
    ) -> Report:
        """The report on straight lines between samples of the cubics.

        The clearances are reduced by a bound on the distance of any point of the arm from its place on the
        lines. Samples are added until the bound is small compared with the clearances, see CHORD_SHARE.

        found: violations that are known. at_rest: for each row, whether the motion rests there. along: as in
        `_report`.
        """
        settings = self.settings
        chord = self.settings.chord
        radii = self._continuous.checks.motion_radii
        while True:
            times, positions, joint_bounds = cubics.sampled(chord)
            still = None if at_rest is None else np.isin(times, cubics.trajectory.times[at_rest])
            report = self._report(positions, times, found, still, along)
            clearance = report.min_clearance
            if clearance is None:
                return report
            reduction = float((radii @ joint_bounds).max(initial=0.0))
            allowed = max(CHORD_SHARE * clearance, settings.tightness * settings.contact / 2)
            if reduction <= allowed:
                scene, itself = np.array([report.scene_clearance, report.self_clearance]) - reduction
                return replace(report, scene_clearance=float(scene), self_clearance=float(itself))
            chord = CHORD_MARGIN * float(joint_bounds.max()) * allowed / reduction

    def collision_free(self, path: Path | Trajectory) -> bool:
        """Whether a path, or the polyline through the rows of a motion, is certified free of collision and
        proved to keep the path constraints. Start, goal and limits are not checked."""
        self._check_shape("path", path)
        if self.constraints is not None and self.constraints.first_violation(path.positions) is not None:
            return False
        return self._continuous.sweep(path.positions).contact is None

    def _check_shape(self, what: str, motion: Path | Trajectory) -> None:
        shape = motion.positions.shape
        check_joints(what, motion.joint_names, self.robot)
        if len(shape) != 2 or shape[1] != self.robot.dof or shape[0] == 0:
            raise InputError(
                f"{what}.positions has shape {shape}; it must be n x {self.robot.dof} with n >= 1"
            )
        if isinstance(motion, Trajectory):
            for name, expected in (("times", shape[:1]), ("velocities", shape), ("accelerations", shape)):
                values = getattr(motion, name)
                if values.shape != expected:
                    rule = f"it must be {expected}, as {what}.positions has shape {shape}"
                    raise InputError(f"{what}.{name} has shape {values.shape}; {rule}")

    def _report(
        self,
        q: ndarray,
        times: ndarray | None,
        found: Sequence[Violation | None],
        at_rest: ndarray | None = None,
        along: tuple[ndarray, ndarray] | None = None,
    ) -> Report:
        """The report on the straight lines between configurations, with the earliest violation.

        q: configurations [n, dof]. times: their times; None for a path. found: violations that are already
        known. at_rest: whether the motion rests at each row; None: it may stop at any row. along: times and
        configurations of a finer path, on which path constraints are proved; None: `times` and `q`.
        """
        wrong = ~(np.abs(q) <= MAX_COORDINATE)
        if wrong.any():
            i, j = np.argwhere(wrong)[0]
            at = float(i if times is None else times[i])
            rule = f"it must be a finite number within ±{MAX_COORDINATE:g}"
            message = f"{self.robot.joint_names[j]} is {q[i, j]:g} at waypoint {i}; {rule}"
            return Report(False, Violation("not_finite", at, message), None, None)
        clock = np.arange(len(q), dtype=float) if times is None else times
        limits = self._limits(q, clock, "waypoint {:g}" if times is None else "{:.3f} s")
        every = (
            self._start(q),
            self._wrapped(q, clock),
            limits,
            *found,
            self._twitch(q, clock),
            self._constrained(q, clock, along),
        )
        found = [violation for violation in every if violation is not None]
        first = min(found, key=attrgetter("time"), default=None)
        last = len(q) - 1 if first is None else int(np.searchsorted(clock, first.time))
        sweep = self._continuous.sweep(q[: last + 1])
        scene = sweep.scene_clearance
        candidates = [first]
        if sweep.contact is not None:
            candidates.append(collision_violation(sweep.contact, clock))
        if times is not None and self.problem.moving:
            moving = self._moving.sweep(times[: last + 1], q[: last + 1])
            scene = min(scene, moving.clearance)
            if moving.contact is not None:
                candidates.append(_moving_contact_violation(moving.contact))
        candidates += [self._waypoints(q, clock, at_rest), self._goal(q[-1], float(clock[-1]))]
        earliest = [v for v in candidates if v is not None]
        violation = min(earliest, key=attrgetter("time"), default=None)
        every_violation = tuple(dict.fromkeys((*found, *earliest)))
        clearances = (scene, sweep.self_clearance) if violation is None else (None, None)
        return Report(violation is None, violation, *clearances, found=every_violation)

    def _start(self, q: ndarray) -> Violation | None:
        difference = np.abs(q[0] - self.problem.start)
        if (difference <= self.settings.start_tolerance).all():
            return None
        j = int(difference.argmax())
        name = self.robot.joint_names[j]
        excess = float(difference[j])
        begins, start = distinct(q[0, j], self.problem.start[j])
        message = f"the motion begins at {name} = {begins}; the problem's start is {start}"
        return Violation("start", 0.0, message, name, None, excess)

    def _wrapped(self, q: ndarray, clock: ndarray) -> Violation | None:
        """A violation if a continuous joint turns by nearly a whole turn in one step, probably because its
        values were wrapped."""
        turns = self.robot.wraps(q)
        if not turns.any():
            return None
        i = int(turns.any(axis=1).argmax())
        j = int(np.abs(turns[i]).argmax())
        name = self.robot.joint_names[j]
        step = float(q[i + 1, j] - q[i, j])
        message = (
            f"{name} turns by {step:.4g} rad from row {i} to row {i + 1}, nearly a whole turn: unwrap values "
            f"that were wrapped to ±pi, or add rows on the way"
        )
        return Violation("jump", float(clock[i]), message, name, None, abs(step))

    def _limits(self, q: ndarray, clock: ndarray, place: str) -> Violation | None:
        excess = self.robot.limit_excess(q)
        beyond = (excess > self.settings.limit_slack).any(axis=1)
        if not beyond.any():
            return None
        i = int(beyond.argmax())
        j = int(excess[i].argmax())
        name = self.robot.joint_names[j]
        at = place.format(clock[i])
        value, low, high = distinct(q[i, j], self.robot.lower[j], self.robot.upper[j])
        message = f"{name} is {value} at {at}; its limits are {low} to {high}"
        return Violation("limits", float(clock[i]), message, name, None, float(excess[i, j]))

    def _constrained(
        self, q: ndarray, clock: ndarray, along: tuple[ndarray, ndarray] | None
    ) -> Violation | None:
        """A violation at the first place where the motion is not proved to keep the path constraints."""
        if self.constraints is None:
            return None
        chord = 0.0 if along is None else self.settings.constraint_chord
        clock, q = (clock, q) if along is None else along
        wrong = self.constraints.first_violation(q, chord)
        if wrong is None:
            return None
        at = _time_at(wrong.at, clock)
        constraint = wrong.constraint
        return Violation("constraint", at, wrong.message, constraint.frame, constraint.kind, wrong.excess)

    def _limits_between(self, cubics: Cubics) -> Violation | None:
        """A violation at the first place between rows where a cubic leaves the joint limits."""
        robot = self.robot
        extremes = cubics.extremes
        beyond = np.maximum(robot.lower - extremes.lower, extremes.upper - robot.upper)
        beyond[robot.continuous] = 0.0
        if not (beyond > self.settings.limit_slack).any():
            return None
        times, turns = cubics.turns()
        return self._limits(turns, times, "{:.3f} s")

    def _too_fast(self, cubics: Cubics) -> Violation | None:
        """A violation at the first place where a frame is not proved to keep its speed limit."""
        assert self.constraints is not None
        limits = self.constraints.speed_limits
        trajectory = cubics.trajectory
        if not len(limits) or not len(cubics.steps):
            return None
        pieces = trajectory_pieces(trajectory)
        speeds = self.constraints.speeds
        bends = self.constraints.third_derivative_bounds(pieces.along.v) / cubics.steps
        beyond = first_beyond(
            limits, lambda q, v, _: speeds(q, v), bends, pieces.states, self.settings.rate_slack
        )
        if beyond is None:
            return None
        at = _time_at(beyond.place, trajectory.times)
        constraint = self.constraints.speed_limited[beyond.column]
        speed, limit = distinct(beyond.value, limits[beyond.column], digits=4)
        message = f"{constraint.frame} moves at {speed} m/s; {constraint.kind} allows {limit} m/s"
        return Violation("speed", at, message, constraint.frame, constraint.kind, beyond.excess)

    def _torques(self, clock: ndarray, pieces: Pieces, what: str) -> Violation | None:
        """A violation at the first place where a joint's torque with the payload is not proved to be within
        its effort limit. what: the end of the message."""
        assert self.dynamics is not None
        beyond = first_excess(self.dynamics, pieces, self.settings.rate_slack)
        if beyond is None:
            return None
        at = _time_at(beyond.place, clock)
        name = self.robot.joint_names[beyond.column]
        message = self.dynamics.torque_message(beyond.column, beyond.value) + what
        return Violation("torque", at, message, name, None, beyond.excess)

    def _twitch(self, q: ndarray, clock: ndarray) -> Violation | None:
        """A violation if the motion has more than `reversals` sharp reversals, counted on rows that are at
        least `reversal_step` apart."""
        settings = self.settings
        if not len(q) > settings.reversals + 2:
            return None
        row_indices = _spaced_rows(for_kernels(q), settings.reversal_step)
        steps = np.diff(q[row_indices], axis=0)
        steps /= np.linalg.norm(steps, axis=1, keepdims=True)
        cosines = (steps[1:] * steps[:-1]).sum(axis=1)
        sharp = np.flatnonzero(cosines < np.cos(settings.reversal_angle))
        if len(sharp) <= settings.reversals:
            return None
        at = float(clock[row_indices[sharp[settings.reversals] + 1]])
        message = (
            f"the motion twitches: {counted(len(sharp), 'sharp reversal')}; at most "
            f"{settings.reversals} are allowed"
        )
        return Violation("twitch", at, message, None, None, float(len(sharp) - settings.reversals))

    def _goal(self, end: ndarray, time: float) -> Violation | None:
        off = goal_error(self.robot, self.problem.goal, end, self.settings)
        if off is None:
            return None
        return Violation("goal", time, f"the motion ends {off.message}", off.subject, None, off.excess)

    def _waypoints(self, q: ndarray, clock: ndarray, at_rest: ndarray | None) -> Violation | None:
        """A violation for the first of the problem's waypoints that the motion misses. The motion must stop
        at a waypoint, or pass within the waypoint's blend, after it has reached the waypoints before."""
        problem = self.problem
        after = 0.0
        for k, (goal, blend) in enumerate(zip(problem.waypoints, problem.blend, strict=True)):
            if blend:
                place = first_place_within(self.robot, goal, q, blend, self.settings, after)
            else:
                stops = np.arange(len(q)) if at_rest is None else np.flatnonzero(at_rest)
                later_stops = stops[stops >= after]
                reaching = (
                    i for i in later_stops if goal_error(self.robot, goal, q[i], self.settings) is None
                )
                place = next(reaching, None)
            if place is None:
                requirement = f"pass within {blend:g} of" if blend else "stop at"
                order = f" after waypoints[{k - 1}]" if k else ""
                message = f"the motion does not {requirement} waypoints[{k}]{order}"
                return Violation("waypoint", float(clock[-1]), message, f"waypoints[{k}]", None, None)
            after = float(place)
        return None

    @cached_property
    def constraints(self) -> "PathConstraints | None":
        """The problem's path constraints, compiled; None if it has none."""
        if not self.problem.constraints:
            return None
        from robotdiffuse.problems.compiled_constraints import PathConstraints

        return PathConstraints(self.problem)

    @cached_property
    def dynamics(self) -> Dynamics | None:
        """The dynamics of the robot with the problem's payload; None without a payload."""
        payload = self.problem.payload
        return None if payload is None else Dynamics(self.robot, payload, self.problem.T_world_base)

    @cached_property
    def _continuous(self) -> ContinuousCollision:
        settings = self.settings
        return ContinuousCollision(self.robot, self.problem.scene, settings.contact, settings.tightness)

    @cached_property
    def _moving(self) -> "MovingCollision":
        from robotdiffuse.collision.moving_obstacles import MovingCollision

        settings = self.settings
        return MovingCollision(self.robot, self.problem.moving, settings.contact, settings.tightness)


@kernel()
def _spaced_rows(q, step):
    """Indices of rows of q [n, dof]: row 0, then each row that is at least `step` from the last returned row
    and differs from it."""
    row_indices = np.zeros(len(q), np.int64)
    count = 1
    for i in range(1, len(q)):
        total = 0.0
        for j in range(q.shape[1]):
            total += (q[i, j] - q[row_indices[count - 1], j]) ** 2
        if total > 0.0 and total >= step * step:
            row_indices[count] = i
            count += 1
    return row_indices[:count]


verifier = lru_cache(maxsize=8)(Verifier)
"""The Verifier of a problem. The last eight are cached, so that data of the robot and the scene is prepared
once for many paths of a problem."""


def _time_at(place: float, clock: ndarray) -> float:
    """The time at a place: the index of a row plus a fraction."""
    return float(np.interp(place, np.arange(len(clock)), clock))


def _unusable(trajectory: Trajectory) -> Violation | None:
    """A violation if values are not finite, or if the times are not those of a motion."""
    times = trajectory.times
    if not all(np.isfinite(rows).all() for rows in (times, trajectory.velocities, trajectory.accelerations)):
        return Violation("not_finite", 0.0, "the trajectory holds values that are not finite")
    backwards = np.flatnonzero(np.diff(times) <= 0)
    if len(backwards):
        i = backwards[0]
        return Violation("time", float(times[i + 1]), f"times do not increase from row {i} to row {i + 1}")
    if times[0] != 0:
        return Violation("time", float(times[0]), f"times begin at {times[0]:.6g} s, not at 0")
    if trajectory.duration <= MAX_DURATION:
        return None
    time, max_time = distinct(trajectory.duration, MAX_DURATION)
    return Violation("time", 0.0, f"the motion takes {time} s; at most {max_time} s can be validated")


def _moving_contact_violation(contact: "TimedContact") -> Violation:
    link, obstacle, time, depth = contact
    message = f"{describe_contact(link, obstacle, depth, False)} at {time:.3f} s"
    return Violation("scene_collision", time, message, link, obstacle, depth)


def collision_violation(contact: Contact, clock: ndarray) -> Violation:
    """The violation for a contact of a motion with rows at the times `clock`."""
    (link, pair), partner, at, depth = contact
    kind = "scene_collision" if pair is None else "self_collision"
    message = describe_contact(link, partner, depth, pair is not None)
    return Violation(kind, _time_at(at, clock), message, link, partner, depth)


def violations(problem: Problem, motion: Path | Trajectory) -> tuple[Violation, ...]:
    """The violations of a motion in the order of their places; empty if it is valid.

    Every contact with static obstacles and between links is listed, at the place where it begins; if a link
    touches several obstacles at once, only the deepest contact. Joint limits are listed once for each joint.
    Of every other kind, contacts with moving obstacles included, only the first violation is listed; but a
    step by nearly a whole turn may be listed twice, as a wrapped value and for its mean velocity. Contacts
    with moving obstacles are searched only up to the first violation that is no contact. Torques and frame
    speeds of a trajectory are checked only if the rates are right. If numbers are not finite, or times are
    not those of a motion, only this is returned.
    """
    report = verify(problem, motion)
    if report.valid:
        return ()
    if report.violation.kind in ("not_finite", "time"):
        return (report.violation,)
    # contacts with static obstacles and links, and joint limits, are left to the complete searches below
    static = {*(shape.name for shape in problem.scene.shapes), *problem.robot.link_names}
    all_violations = [
        w for w in report.found if w.kind != "limits" and not (w.kind in CONTACT_KINDS and w.other in static)
    ]
    q = motion.positions
    clock = np.arange(len(motion.positions), dtype=float)
    cubics = None
    if isinstance(motion, Trajectory):
        cubics = Cubics(motion)
        wrong_rates = any(wrong.kind in RATE_KINDS for wrong in all_violations)
        clock, q = (motion.times, q) if wrong_rates else cubics.sampled(DEFAULT.chord)[:2]
    for contact in contacts(problem.robot, problem.scene, q, DEFAULT.contact):
        all_violations.append(collision_violation(contact, clock))
    # `verify` may use a finer chord, and so find a contact that the search along these lines misses
    listed = {(w.kind, w.subject, w.other) for w in all_violations}
    all_violations += [
        w for w in report.found if w.kind in CONTACT_KINDS and (w.kind, w.subject, w.other) not in listed
    ]
    if cubics is not None:
        times, turns = cubics.turns()
        clock = np.concatenate([clock, times])
        q = np.concatenate([q, turns])
    all_violations += _limit_violations(problem, q, clock)
    return tuple(sorted(all_violations, key=attrgetter("time")))


def _limit_violations(problem: Problem, q: ndarray, clock: ndarray) -> list[Violation]:
    robot = problem.robot
    limit_violations = []
    beyond = robot.limit_excess(q)
    for j in np.flatnonzero((beyond > DEFAULT.limit_slack).any(axis=0)).tolist():
        over = np.flatnonzero(beyond[:, j] > DEFAULT.limit_slack)
        i = int(over[clock[over].argmin()])
        excess = float(beyond[:, j].max())
        name = robot.joint_names[j]
        low = robot.lower[j]
        high = robot.upper[j]
        message = f"{name} leaves its limits, {low:.6g} to {high:.6g}, by up to {excess:.3g}"
        limit_violations.append(Violation("limits", float(clock[i]), message, name, None, excess))
    return limit_violations
