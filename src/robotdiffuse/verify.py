"""The judge: is a motion free of collision, within limits, and from the start to the goal?

Collision between waypoints is settled by a certificate, not by sampling: see collision/motion.py. The rates
of a trajectory are those of its positions over its times, whatever it says of itself: see rates.py. The judge
knows nothing of planners.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float
from numba import njit
from numpy import ndarray

from robotdiffuse.checks import LARGEST, within
from robotdiffuse.collision.hulls import describe_contact
from robotdiffuse.collision.motion import Contact, ContinuousCollision
from robotdiffuse.collision.moving import MovingCollision, TimedContact
from robotdiffuse.errors import InputError
from robotdiffuse.problems.goals import AnyGoal, Goal, JointGoal
from robotdiffuse.problems.path_constraints import PathConstraints
from robotdiffuse.problems.problem import Problem
from robotdiffuse.rates import RateTolerances, between_rows, wrong_rates
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.settings import Bound, Natural, NotNegative, Positive, Settings
from robotdiffuse.transforms import inverse, rotation_angle, rpy_from_rotation
from robotdiffuse.types import Path, Trajectory


@dataclass(frozen=True)
class VerifySettings(Settings, name="verify"):
    """What counts as a violation."""

    contact: Positive = 1e-4
    """Meshes closer than this [m] count as touching; at or above it, clearances are certified, the smaller it
    is, the longer it takes."""
    limit_slack: NotNegative = 1e-6
    """Joint limits may be exceeded by this [rad] or [m]."""
    start_tolerance: NotNegative = 1e-6
    """Largest difference of any joint from the problem's start [rad] or [m]."""
    goal_tolerance: NotNegative = 1e-4
    """Largest difference of any joint from one of the goal configurations [rad] or [m]."""
    goal_distance: NotNegative = 0.01
    """Largest distance from the position of a goal pose [m] (the paper's 1 cm)."""
    goal_angle: NotNegative = float(np.radians(15))
    """Largest angle from the orientation of a goal pose [rad] (the paper's 15 degrees)."""
    goal_slack: NotNegative = 1e-5
    """Tolerances that a pose states may be exceeded by this [m] or [rad]."""
    rest: NotNegative = 1e-6
    """A motion stands still where no joint is faster than this [rad/s] or [m/s]."""
    rate_slack: NotNegative = 0.01
    """Share by which a trajectory may exceed velocity and acceleration limits; also the share of a velocity
    limit by which the velocities that it says may be off, and at which it is at rest."""
    rate_agreement: NotNegative = 0.5
    """Share of the greatest acceleration of the joint by which one that a trajectory says may lie outside of
    the mean ones before and after its row."""
    jump: Positive = 1.5
    """A step of a trajectory longer than this times what the velocity limit allows in its time is a jump."""
    chord: Positive = 1e-3
    """Between rows a trajectory is judged on straight lines, unless the cubic through their positions and
    velocities, as controllers follow it, leaves them by more than this [rad] or [m]: then along the cubic."""
    constraint_chord: Positive = 1e-6
    """Path constraints are judged along that cubic always: on straight lines that leave it by no more than
    this [rad] or [m], which is taken from their tolerances."""
    reversal_angle: NotNegative = float(np.radians(150))
    """A turn in joint space by more than this [rad] is a sharp reversal ..."""
    reversal_step: NotNegative = 0.05
    """... if the straight moves before and after it are both at least this long [rad, joint-space L2]."""
    reversals: Natural = 3
    """More sharp reversals than this are twitching."""
    tightness: Annotated[float, Bound(above=0.0, below=1.0)] = 0.5
    """Each clearance of a `Report` is at least this share of the least one that was measured, in (0, 1)."""


DEFAULT = VerifySettings()
LONGEST = 1e5
"""Motion that is judged [s], about a day."""


@dataclass(frozen=True)
class Violation:
    """The first thing along the motion that is wrong."""

    kind: str
    """not_finite, start, limits, scene_collision, self_collision, constraint, twitch, waypoint or goal; for
    trajectories also time, rest, velocity, acceleration, jump, rates and speed."""
    time: float
    """Where: for a path, waypoint index plus fraction of the segment; for a trajectory, seconds."""
    message: str
    """One line."""
    subject: str | None = None
    """The link that collides or is constrained, or the joint that is out of limits."""
    other: str | None = None
    """The obstacle, the other link or the kind of constraint."""
    excess: float | None = None
    """By how much: the greatest depth until the contact ends [m], the greatest value of a constraint until it
    is kept; beyond the limit, or off the goal, in its unit."""


@dataclass(frozen=True)
class Report:
    """The verdict."""

    valid: bool
    violation: Violation | None
    """None if and only if the motion is valid."""
    scene_clearance: float | None
    """No point of a moving link comes nearer to an obstacle than this [m]: a lower bound over the whole
    motion, at most 1 m. None for an invalid motion."""
    self_clearance: float | None
    """The same to the links that it is checked against."""
    found: tuple[Violation, ...] = ()
    """All that was seen to be wrong, the first of its kind; see `violations` for every contact."""

    @property
    def min_clearance(self) -> float | None:
        """The smaller of both clearances [m]."""
        if self.scene_clearance is None or self.self_clearance is None:
            return None
        return min(self.scene_clearance, self.self_clearance)


def verify(problem: Problem, path: Path, settings: VerifySettings = DEFAULT) -> Report:
    """Judge a path for a problem. It has no times, so obstacles that move are left to `verify_trajectory`.
    Raises InputError if its joints are not those of the robot."""
    return verifier(problem, settings).path(path)


def verify_trajectory(problem: Problem, trajectory: Trajectory, settings: VerifySettings = DEFAULT) -> Report:
    """Judge a trajectory with its rates and times, and among obstacles that move from its first row to its
    last. Its velocities and accelerations must be those of its positions, from rest, or the problem's start
    velocity, to rest; for what is between the rows see `VerifySettings.chord`."""
    return verifier(problem, settings).trajectory(trajectory)


class Verifier:
    """Judges motions for one problem; what the robot and the scene need is prepared once."""

    def __init__(self, problem: Problem, settings: VerifySettings = DEFAULT) -> None:
        self.problem, self.settings, self.robot = problem, settings, problem.robot

    def path(self, path: Path) -> Report:
        """See `verify`."""
        self._check_shape(path.joint_names, path.positions)
        return self._report(path.positions, None, [])

    def trajectory(self, trajectory: Trajectory) -> Report:
        """See `verify_trajectory`."""
        self._check_shape(trajectory.joint_names, trajectory.positions)
        rows = (trajectory.times, trajectory.velocities, trajectory.accelerations)
        for name, values in zip(("times", "velocities", "accelerations"), rows, strict=True):
            if len(values) != len(trajectory.positions):
                raise InputError(
                    f"trajectory.{name} has {len(values)} rows; positions has {len(trajectory.positions)}"
                )
        if not all(np.isfinite(values).all() for values in rows):
            violation = Violation("not_finite", 0.0, "the trajectory holds values that are not finite")
            return Report(False, violation, None, None)
        backwards = np.flatnonzero(np.diff(trajectory.times) <= 0)
        if len(backwards):
            at = float(trajectory.times[backwards[0] + 1])
            message = f"times do not increase from row {backwards[0]} to row {backwards[0] + 1}"
            return Report(False, Violation("time", at, message), None, None)
        if trajectory.duration - trajectory.times[0] > LONGEST:
            message = f"the motion takes {trajectory.duration:.6g} s; at most {LONGEST:g} s can be judged"
            return Report(False, Violation("time", float(trajectory.times[0]), message), None, None)
        if not within(trajectory.positions):
            return self._report(trajectory.positions, trajectory.times, [])
        found = [
            Violation(wrong.kind, wrong.time, wrong.message, wrong.joint, None, wrong.excess)
            for wrong in wrong_rates(
                self.robot, trajectory, self._rate_tolerances, self.problem.start_velocity
            )
        ]
        rows = trajectory.times, trajectory.positions
        times, positions = rows if found else between_rows(trajectory, self.settings.chord)
        still = np.abs(trajectory.velocities).max(axis=1) <= self.settings.rest
        along = None
        if self.constraints is not None:
            found += self._too_fast(trajectory)
            along = between_rows(trajectory, self.settings.constraint_chord) if not found else None
        return self._report(positions, times, found, np.isin(times, trajectory.times[still]), along)

    def collision_free(self, path: Path) -> bool:
        """Whether a path is certified free of collision and keeps path constraints; neither its ends nor
        limits are looked at."""
        self._check_shape(path.joint_names, path.positions)
        if self.constraints is not None and self.constraints.first(path.positions) is not None:
            return False
        return self._continuous.sweep(path.positions).contact is None

    def _check_shape(self, joint_names: tuple[str, ...], positions: ndarray) -> None:
        if tuple(joint_names) != self.robot.joint_names:
            given, right = ", ".join(joint_names), ", ".join(self.robot.joint_names)
            raise InputError(f"path.joint_names is {given}; the robot's planned joints are {right}")
        if positions.ndim != 2 or positions.shape[1] != self.robot.dof or len(positions) == 0:
            raise InputError(
                f"path.positions has shape {positions.shape}; it must be n x {self.robot.dof} with n >= 1"
            )

    def _report(
        self,
        q: ndarray,
        times: ndarray | None,
        found: list[Violation],
        at_rest: ndarray | None = None,
        along: tuple[ndarray, ndarray] | None = None,
    ) -> Report:
        """The verdict on waypoints; `found` are violations known already. The earliest one is reported.

        `at_rest`: at which rows a timed motion stands still. `along`: times and positions of one for path
        constraints.
        """
        bad = np.flatnonzero(~(np.abs(q) <= LARGEST).all(axis=1))
        if len(bad):
            at = float(bad[0] if times is None else times[bad[0]])
            message = f"waypoint {bad[0]} holds values that are not finite, or not within ±{LARGEST:g}"
            return Report(False, Violation("not_finite", at, message), None, None)
        clock = np.arange(len(q), dtype=float) if times is None else times
        limits = self._limits(q, clock, "waypoint {:g}" if times is None else "{:.3f} s")
        every = (self._start(q), limits, *found, self._twitch(q, clock), self._constrained(q, clock, along))
        found = [violation for violation in every if violation is not None]
        first = min(found, key=lambda violation: violation.time, default=None)
        last = len(q) - 1 if first is None else int(np.searchsorted(clock, first.time))
        sweep = self._continuous.sweep(q[: last + 1])
        collision = None
        moving = None
        if times is not None and self.problem.moving:
            moving = self._moving.sweep(times[: last + 1], q[: last + 1])
        if sweep.contact is not None:
            collision = collision_violation(
                sweep.contact, float(np.interp(sweep.contact.at, np.arange(len(clock)), clock))
            )
        ends = (self._waypoints(q, clock, at_rest), self._goal(q[-1], float(clock[-1])))
        hit = None if moving is None or moving.contact is None else _hit(moving.contact)
        every = [v for v in (first, collision, hit, *ends) if v is not None]
        violation = min(every, key=lambda v: v.time, default=None)
        valid = violation is None
        scene, itself = (sweep.scene_clearance, sweep.self_clearance) if valid else (None, None)
        if scene is not None and moving is not None:
            scene = min(scene, moving.clearance)
        return Report(valid, violation, scene, itself, tuple(dict.fromkeys((*found, *every))))

    def _start(self, q: ndarray) -> Violation | None:
        difference = np.abs(q[0] - self.problem.start)
        if (difference <= self.settings.start_tolerance).all():
            return None
        j = int(difference.argmax())
        name, excess = self.robot.joint_names[j], float(difference[j])
        message = (
            f"the motion begins at {name} = {q[0, j]:.6g}; the problem's start is {self.problem.start[j]:.6g}"
        )
        return Violation("start", 0.0, message, name, None, excess)

    def _limits(self, q: ndarray, clock: ndarray, place: str) -> Violation | None:
        excess = np.maximum(self.robot.lower - q, q - self.robot.upper)
        excess[:, self.robot.continuous] = 0.0
        bad = np.flatnonzero((excess > self.settings.limit_slack).any(axis=1))
        if not len(bad):
            return None
        i, j = int(bad[0]), int(excess[bad[0]].argmax())
        name, low, high = self.robot.joint_names[j], self.robot.lower[j], self.robot.upper[j]
        at = place.format(clock[i])
        message = f"{name} is {q[i, j]:.6g} at {at}; its limits are {low:.6g} to {high:.6g}"
        return Violation("limits", float(clock[i]), message, name, None, float(excess[i, j]))

    def _constrained(
        self, q: ndarray, clock: ndarray, along: tuple[ndarray, ndarray] | None
    ) -> Violation | None:
        """Where the motion is first not proved to keep the path constraints."""
        if self.constraints is None:
            return None
        chord = 0.0 if along is None else self.settings.constraint_chord
        clock, q = (clock, q) if along is None else along
        wrong = self.constraints.first(q, chord)
        if wrong is None:
            return None
        at = float(np.interp(wrong.at, np.arange(len(clock)), clock))
        one = wrong.constraint
        return Violation("constraint", at, wrong.message, one.frame, one.kind, wrong.excess)

    def _too_fast(self, trajectory: Trajectory) -> list[Violation]:
        """Where a frame is first faster than its constraint allows."""
        assert self.constraints is not None
        speeds = self.constraints.speeds(trajectory.positions, trajectory.velocities)
        excess = speeds - self.constraints.most_speeds * (1 + self.settings.rate_slack)
        bad = np.flatnonzero((excess > 0).any(axis=1))
        if not len(bad):
            return []
        i, k = int(bad[0]), int(excess[bad[0]].argmax())
        one, at = self.constraints.paced[k], float(trajectory.times[bad[0]])
        most = self.constraints.most_speeds[k]
        message = f"{one.frame} moves at {speeds[i, k]:.4g} m/s; {one.kind} allows {most:.4g} m/s"
        return [Violation("speed", at, message, one.frame, one.kind, float(excess[:, k].max()))]

    def _twitch(self, q: ndarray, clock: ndarray) -> Violation | None:
        """More sharp reversals than allowed, counted on waypoints at least `reversal_step` apart."""
        settings = self.settings
        if not len(q) > settings.reversals + 2:
            return None
        kept = _apart(np.ascontiguousarray(q, np.float64), settings.reversal_step)
        steps = np.diff(q[kept], axis=0)
        steps /= np.linalg.norm(steps, axis=1, keepdims=True)
        cosines = (steps[1:] * steps[:-1]).sum(axis=1)
        sharp = np.flatnonzero(cosines < np.cos(settings.reversal_angle))
        if len(sharp) <= settings.reversals:
            return None
        at = float(clock[kept[sharp[settings.reversals] + 1]])
        message = (
            f"the motion twitches: {len(sharp)} sharp reversals; at most {settings.reversals} are allowed"
        )
        return Violation("twitch", at, message, None, None, float(len(sharp) - settings.reversals))

    def _goal(self, end: ndarray, time: float) -> Violation | None:
        off = goal_error(self.robot, self.problem.goal, end, self.settings)
        if off is None:
            return None
        return Violation("goal", time, f"the motion ends {off.message}", off.subject, None, off.excess)

    def _waypoints(self, q: ndarray, clock: ndarray, at_rest: ndarray | None) -> Violation | None:
        """The first waypoint at which the motion does not stop after those before it."""
        after = 0
        for k, goal in enumerate(self.problem.waypoints):
            rows = range(after, len(q)) if at_rest is None else after + np.flatnonzero(at_rest[after:])
            stop = next((i for i in rows if goal_error(self.robot, goal, q[i], self.settings) is None), None)
            if stop is None:
                message = f"the motion does not stop at waypoints[{k}] after those before it"
                return Violation("waypoint", float(clock[-1]), message, f"waypoints[{k}]", None, None)
            after = int(stop)
        return None

    @cached_property
    def constraints(self) -> PathConstraints | None:
        """The problem's path constraints made ready; None if it has none."""
        return PathConstraints(self.problem) if self.problem.constraints else None

    @property
    def _rate_tolerances(self) -> RateTolerances:
        settings = self.settings
        return RateTolerances(
            settings.rate_slack, settings.rate_agreement, settings.jump, settings.limit_slack
        )

    @cached_property
    def _continuous(self) -> ContinuousCollision:
        settings = self.settings
        return ContinuousCollision(self.robot, self.problem.scene, settings.contact, settings.tightness)

    @cached_property
    def _moving(self) -> MovingCollision:
        settings = self.settings
        return MovingCollision(self.robot, self.problem.moving, settings.contact, settings.tightness)


class GoalError(NamedTuple):
    """How far a configuration is off a goal."""

    message: str
    subject: str | None
    excess: float


def goal_error(
    robot: Robot, goal: Goal, q: Float[ndarray, "dof"], settings: VerifySettings = DEFAULT
) -> GoalError | None:
    """How far a configuration is off a goal, of several the nearest by its own measure; None at the goal."""
    if isinstance(goal, AnyGoal):
        errors = [goal_error(robot, one, q, settings) for one in goal.goals]
        off = [error for error in errors if error is not None]
        return min(off, key=lambda error: error.excess) if len(off) == len(errors) else None
    if isinstance(goal, JointGoal):
        differences = goal.positions - q
        differences -= robot.turns(differences)
        off = float(np.abs(differences).max(axis=1).min(initial=np.inf))
        if off <= settings.goal_tolerance:
            return None
        return GoalError(f"{off:.3g} from the nearest goal configuration (largest joint error)", None, off)
    T_goal_end = inverse(goal.T_base_frame) @ link_pose(robot, q, goal.frame)
    distance, angle = float(np.linalg.norm(T_goal_end[:3, 3])), rotation_angle(T_goal_end[:3, :3])
    xyz, rpy = goal.xyz_tolerance, goal.rpy_tolerance
    slack = settings.goal_slack
    there = distance <= settings.goal_distance if xyz is None else _within(T_goal_end[:3, 3], xyz, slack)
    turned = angle <= settings.goal_angle if rpy is None else _turned(T_goal_end[:3, :3], rpy, slack)
    if there and turned:
        return None
    beyond = "" if xyz is None and rpy is None else ", which is beyond its tolerances"
    message = (
        f"with {goal.frame} {distance * 100:.2f} cm and {np.degrees(angle):.1f} degrees off the goal "
        f"pose{beyond}"
    )
    return GoalError(message, goal.frame, distance)


def _within(values: ndarray, tolerance: ndarray, slack: float) -> bool:
    return bool((np.abs(values) <= tolerance + slack).all())


def _turned(rotation: ndarray, tolerance: ndarray, slack: float) -> bool:
    """Whether roll, pitch and yaw are within the tolerance, by either of the two ways to give a rotation."""
    roll, pitch, yaw = rpy_from_rotation(rotation)
    other = np.array([roll + np.pi, np.pi - pitch, yaw + np.pi])
    ways = np.array([roll, pitch, yaw]), (other + np.pi) % (2 * np.pi) - np.pi
    return any(_within(way, tolerance, slack) for way in ways)


@njit(cache=True)
def _apart(q, step):
    """Indices of rows of q[n, dof] that are each at least `step` from the one before, with the first."""
    kept, count = np.zeros(len(q), np.int64), 1
    for i in range(1, len(q)):
        total = 0.0
        for j in range(q.shape[1]):
            total += (q[i, j] - q[kept[count - 1], j]) ** 2
        if total >= step * step:
            kept[count] = i
            count += 1
    return kept[:count]


@lru_cache(maxsize=8)
def verifier(problem: Problem, settings: VerifySettings = DEFAULT) -> Verifier:
    """The Verifier of a problem; the last few are kept, so that many paths of one problem are judged fast."""
    return Verifier(problem, settings)


def _hit(contact: TimedContact) -> Violation:
    link, other, time = contact.link, contact.obstacle, contact.time
    message = f"{describe_contact(link, other, contact.depth, False)} at {time:.3f} s"
    return Violation("scene_collision", time, message, link, other, contact.depth)


def collision_violation(contact: Contact, time: float) -> Violation:
    """A contact as a violation at a time."""
    (link, pair), other = contact.check, contact.other
    kind = "scene_collision" if pair is None else "self_collision"
    message = describe_contact(link, other, contact.depth, pair is not None)
    return Violation(kind, time, message, link, other, contact.depth)
