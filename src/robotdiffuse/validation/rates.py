"""Rates of a trajectory: those that follow from its positions and times, and whether its own rates agree.

Limits hold all along the cubics through the rows' positions and velocities, which controllers execute (see
trajectories/cubics.py), whatever accelerations are written. A motion that is within the limits between its
rows, but whose cubics are not, needs closer rows. The arm is taken to stand still before the first and after
the last row.

Rates agree if they are those of some motion within the limits. With velocities v0 and v1 at both ends of a
step of h seconds, and accelerations up to A, the length of the step is within
h (v0 + v1) / 2 ± (A h² - (v1 - v0)² / A) / 4; the extremes are full acceleration followed by full braking and
vice versa. The test of agreement takes for A twice the greatest acceleration in the motion, computed or
written, if that is less. Written accelerations must be near those of the cubics beside their row.

Positions are known only to a resolution, which over a step of nanoseconds hides any velocity. Where rows are
closer than a millisecond, the tests are therefore repeated from each row to later ones, with the resolution
of these two rows alone.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.types import JointRows, JointValues, Trajectory, Values
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories.cubics import Cubics
from robotdiffuse.validation.report import Violation
from robotdiffuse.validation.tolerances import DEFAULT, VerifySettings

AVERAGING_WINDOWS = (1e-3, 4e-3, 16e-3)
"""Where rows are closer than the first of these [s], mean accelerations are tested over windows of at least
each length; over shorter ones, the resolution of positions would hide them."""
MIN_TIME = 1e-12
"""Shorter times are taken as this [s], so that rates over them are finite."""


def rate_violations(
    robot: Robot,
    trajectory: Trajectory,
    settings: VerifySettings = DEFAULT,
    start_velocity: JointValues | None = None,
    cubics: Cubics | None = None,
) -> list[Violation]:
    """The first violation of each kind in the rates of a trajectory, whose rows are finite and times
    increase; `cubics` are its cubics, if they are known.

    The motion must begin at `start_velocity` [dof], by default at rest, and end at rest. A limit of 0 means
    that the robot gives none: then the rates must only agree with each other.
    """
    first_violations: dict[str, Violation] = {}
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        begins = np.zeros(robot.dof) if start_velocity is None else start_velocity
        for check in _checks(robot, cubics or Cubics(trajectory), settings, begins):
            right = check.off <= check.allowed
            if right.all():
                continue
            wrong = ~right
            i = int(np.flatnonzero(wrong.any(axis=1))[0])
            beyond = np.where(wrong, np.nan_to_num(check.off - check.allowed, nan=np.inf), 0.0)
            j = int(beyond[i].argmax())
            time = float(trajectory.times[i])
            if check.kind not in first_violations or time < first_violations[check.kind].time:
                name = robot.joint_names[j]
                rate = abs(float(check.rates[i, j]))
                message = f"{name} at {time:.3f} s: its {check.what} is {rate:.6g}, {check.right(i, j)}"
                first_violations[check.kind] = Violation(
                    check.kind, time, message, name, None, float(beyond[i, j])
                )
    return list(first_violations.values())


class _Check(NamedTuple):
    """One test of the rates; row i belongs to row i of the trajectory."""

    kind: str
    what: str
    """The rate in words."""
    rates: JointRows
    off: JointRows
    """Deviation of the rates."""
    allowed: Float[ndarray, "#n dof"]
    """Allowed deviation."""
    right: Callable[[int, int], str]
    """The expected value in words, by row and joint."""


def _checks(robot: Robot, cubics: Cubics, settings: VerifySettings, begins: JointValues) -> Iterator[_Check]:
    trajectory = cubics.trajectory
    q = trajectory.positions
    v = trajectory.velocities
    a = trajectory.accelerations
    step = cubics.steps
    mean = cubics.extremes.mean
    change = np.diff(v, axis=0) / cubics.steps
    blur = 2 * settings.limit_slack / step
    """Uncertainty of the mean velocities, from the resolution of positions."""
    share = 1 + settings.rate_slack
    nothing = settings.rate_slack * np.where(robot.velocity > 0, robot.velocity, _peak(v, mean))

    def limited(kind: str, what: str, rates: ndarray, limit: ndarray, allowed: ndarray) -> _Check:
        allowed_rates = allowed if (limit > 0).all() else np.where(limit > 0, allowed, np.inf)
        return _Check(
            kind, what, rates, np.abs(rates), allowed_rates, lambda _, j: f"its limit {limit[j]:.6g}"
        )

    at_ends = np.zeros_like(v)
    at_ends[0], at_ends[-1] = np.abs(v[0] - begins), np.abs(v[-1])
    rule = "but motions begin and end at rest"
    if begins.any():
        rule = "but the motion is to begin at the problem's start_velocity and end at rest"
    yield _Check("rest", "velocity", v, at_ends, nothing, lambda *_: rule)

    limits = robot.velocity
    onwards = "mean velocity from here to the next row"
    yield limited("jump", onwards, mean, limits, settings.jump * limits + blur)
    # Velocities of cubics contain up to 3/2 of the mean velocity, accelerations 6 of it over the step.
    onwards = "velocity by its positions from here to the next row"
    yield limited("velocity", onwards, cubics.extremes.velocity, limits, share * limits + 1.5 * blur)
    yield limited("velocity", "velocity", v, limits, share * limits)

    around = _padded(2 * begins - mean[:1], mean, -mean[-1:])
    length = _padded(step[:1], step, step[-1:])
    unsure = _padded(blur[:1], blur, blur[-1:])
    spacing = (length[1:] + length[:-1]) / 2
    second = (around[1:] - around[:-1]) / spacing
    unsure = (unsure[1:] + unsure[:-1]) / spacing
    limits = robot.acceleration
    peaks = cubics.extremes.acceleration
    bent = 6 * blur / step
    yield limited(
        "acceleration", "mean acceleration by its positions", second, limits, share * limits + unsure
    )
    yield limited("acceleration", "acceleration by its positions", peaks, limits, share * limits + bent)
    yield limited("acceleration", "mean acceleration by its velocities", change, limits, share * limits)
    yield limited("acceleration", "acceleration", a, limits, share * limits)

    # Rows may miss the peaks of the acceleration, but not by half.
    measured = np.maximum(_peak(a, second, change), settings.rate_slack * robot.acceleration)
    strongest = np.where(limits > 0, np.minimum(share * limits, 2 * measured), 2 * measured)
    spent = np.divide(change**2, strongest, out=np.zeros_like(change), where=strongest > 0)
    possible = np.maximum(strongest - spent, 0.0) * step / 4 + nothing
    """Allowed difference between mean velocities and the means of the rows' velocities."""
    off = np.abs(mean - (v[1:] + v[:-1]) / 2)
    allowed = possible + blur
    yield _Check(
        "rates",
        "mean velocity from here to the next row",
        mean,
        off,
        allowed,
        lambda i, j: f"but the velocities of these rows are {v[i, j]:.6g} and {v[i + 1, j]:.6g}",
    )
    if len(a) > 1 and (off <= allowed).all():  # else the cubics are not those of the positions
        start = cubics.extremes.start
        end = cubics.extremes.end
        before = _padded(start[:1], end)
        after = _padded(start, end[-1:])
        low = np.minimum(before, after)
        high = np.maximum(before, after)
        outside = np.maximum(low - a, a - high)
        if begins.any():
            outside[0] = 0.0  # the motion before is unknown and may have ended in any acceleration
        near = settings.rate_agreement * np.where(limits > 0, np.minimum(limits, measured), measured)
        yield _Check(
            "rates",
            "acceleration",
            a,
            outside,
            near + np.maximum(_padded(bent[:1], bent), _padded(bent, bent[-1:])),
            lambda i, j: f"but the cubics beside it have {low[i, j]:.6g} to {high[i, j]:.6g}",
        )

    if step.min(initial=np.inf) >= AVERAGING_WINDOWS[0]:
        return
    times = trajectory.times
    resolution = settings.limit_slack
    onwards = "mean velocity from an earlier row to here"
    limits = robot.velocity
    first, span = _worst_earlier_row(times, q, (times - times[0])[:, None] * share * limits)
    moved = _change_since(q, first) / span
    yield limited("velocity", onwards, moved, limits, share * limits + 2 * resolution / span)

    stated_positions = _cumulative(step * (v[1:] + v[:-1]) / 2)
    allowed = _cumulative(step * possible)
    first, span = _worst_earlier_row(times, q - stated_positions, allowed)
    moved = _change_since(q, first) / span
    stated = _change_since(stated_positions, first) / span
    yield _Check(
        "rates",
        onwards,
        moved,
        np.abs(moved - stated),
        (_change_since(allowed, first) + 2 * resolution) / span,
        lambda i, j: f"but its velocities give {stated[i, j]:.6g}",
    )

    limits = robot.acceleration
    for window in AVERAGING_WINDOWS:
        second, unsure = _second_differences(trajectory, begins, window, resolution, nothing)
        description = f"mean acceleration by its positions over {1e3 * window:g} ms and more"
        yield limited("acceleration", description, second, limits, share * limits + unsure)


def _cumulative(steps: JointRows) -> JointRows:
    """Sums of all steps before each row."""
    return _padded(np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0))


def _worst_earlier_row(
    times: Values, way: JointRows, allowed: JointRows
) -> tuple[Int[ndarray, "n dof"], JointRows]:
    """For each row and joint the earlier row with the largest excess, and the time since then [s].

    The excess is the change of `way` since that row, in either direction, minus the growth of `allowed`. The
    first row refers to itself.
    """
    rows = np.arange(len(way))[:, None]
    beyond = np.full(way.shape, -np.inf)
    first = np.broadcast_to(rows, way.shape)
    for signed in (way, -way):
        room = signed - allowed
        min_room = np.minimum.accumulate(room, axis=0)
        at = np.maximum.accumulate(np.where(room <= min_room, rows, 0), axis=0)
        # shifted by one row to exclude the row itself
        min_room = _padded(room[:1], min_room[:-1])
        at = _padded(first[:1], at[:-1])
        first = np.where(room - min_room > beyond, at, first)
        beyond = np.maximum(beyond, room - min_room)
    return first, np.maximum(times[:, None] - times[first], MIN_TIME)


def _change_since(rows: JointRows, first: Int[ndarray, "n dof"]) -> JointRows:
    return rows - np.take_along_axis(rows, first, axis=0)


def _second_differences(
    trajectory: Trajectory,
    begins: JointValues,
    window: float,
    resolution: float,
    nothing: JointValues,
) -> tuple[JointRows, JointRows]:
    """Mean accelerations about each row, from positions at the nearest rows at least `window` [s] away, and
    their uncertainty. Before the motion the arm moves at its start velocity, and afterwards it stands
    still."""
    times = trajectory.times
    q = trajectory.positions
    clock = _padded(times[:1] - window, times, times[-1:] + window)
    rows = _padded(q[:1] - window * begins, q, q[-1:])
    low = np.searchsorted(clock, times - window, side="right") - 1
    high = np.searchsorted(clock, times + window)
    before = (times - clock[low])[:, None]
    after = (clock[high] - times)[:, None]
    spacing = (before + after) / 2
    outside = (low == 0).astype(float) + (high == len(clock) - 1)
    unsure = 2 * resolution * (1 / before + 1 / after) + outside[:, None] * nothing
    return ((rows[high] - q) / after - (q - rows[low]) / before) / spacing, unsure / spacing


def _padded(*rows: ndarray) -> ndarray:
    return np.concatenate(rows)


def _peak(*rates: ndarray) -> JointValues:
    return np.abs(np.concatenate(rates)).max(axis=0, initial=0.0)
