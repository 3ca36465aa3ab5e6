"""Rates of a trajectory: whether its velocities and accelerations are within the limits, and whether they
agree with its positions and times.

Limits must hold all along the cubics through the rows' positions and velocities, which controllers execute
(see trajectories/cubics.py). The rows' own accelerations must keep the limits too, but do not affect the
cubics. A trajectory whose cubics exceed the limits needs rows at shorter intervals. The arm is assumed to
rest before the first row (or to move at the problem's start velocity) and after the last row.

Rates agree with the positions if some motion within the limits has these rates and positions. If a joint's
velocity changes from v0 to v1 in a step of h seconds with accelerations up to A, it moves by h (v0 + v1) / 2
± (A h² - (v1 - v0)² / A) / 4. The extremes are full acceleration followed by full braking, and the
reverse. Here, A is twice the greatest acceleration that the rows state or that follows from their positions
or velocities, but at most the limit with its tolerance. The acceleration of a row must be in or near the
interval between those that the cubics before and after it have there.

Positions have a limited resolution, which hides any velocity over a step of nanoseconds. If rows are closer
than a millisecond, the tests are therefore repeated between rows that are further apart.
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
from robotdiffuse.validation.tolerances import VerifySettings

AVERAGING_WINDOWS = (1e-3, 4e-3, 16e-3)
"""Lengths of time over which mean accelerations are tested if any rows are closer than the first length [s].
The resolution of positions hides mean accelerations over shorter times."""
MIN_TIME = 1e-12
"""Smallest time by which a change is divided [s], so that rates are finite."""


def rate_violations(
    robot: Robot,
    trajectory: Trajectory,
    settings: VerifySettings,
    start_velocity: JointValues | None = None,
    cubics: Cubics | None = None,
) -> list[Violation]:
    """The first violation of each kind in the rates of a trajectory. Its rows must be finite and its times
    must increase.

    The motion must begin with `start_velocity` [dof] (None: at rest) and end at rest. A limit of 0 means that
    the robot states none; the rates must then only agree with the positions. cubics: the trajectory's cubics,
    if they have been computed.
    """
    first_violations = dict[str, Violation]()
    with np.errstate(all="ignore"):
        initial_velocity = np.zeros(robot.dof) if start_velocity is None else start_velocity
        for check in _checks(robot, cubics or Cubics(trajectory), settings, initial_velocity):
            wrong = ~(check.deviation <= check.allowed)
            if not wrong.any():
                continue
            i = int(wrong.any(axis=1).argmax())
            beyond = np.where(wrong, np.nan_to_num(check.deviation - check.allowed, nan=np.inf), 0.0)
            j = int(beyond[i].argmax())
            time = float(trajectory.times[i])
            if check.kind not in first_violations or time < first_violations[check.kind].time:
                name = robot.joint_names[j]
                signed = check.kind in ("rates", "rest")
                rate = float(check.rates[i, j]) if signed else abs(float(check.rates[i, j]))
                message = f"{name} at {time:.3f} s: its {check.what} is {rate:.6g}, {check.expected(i, j)}"
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
    deviation: JointRows
    """Deviation of the rates from the expected value; for limits, the absolute rates."""
    allowed: Float[ndarray, "#n dof"]
    """Allowed deviation."""
    expected: Callable[[int, int], str]
    """The end of a message: the expected value, by row and joint."""


def _checks(
    robot: Robot, cubics: Cubics, settings: VerifySettings, initial_velocity: JointValues
) -> Iterator[_Check]:
    """All tests of the rates; `initial_velocity` is the velocity before the motion."""
    trajectory = cubics.trajectory
    q = trajectory.positions
    v = trajectory.velocities
    a = trajectory.accelerations
    step = cubics.steps
    mean = cubics.extremes.mean
    change = np.diff(v, axis=0) / cubics.steps
    mean_error = 2 * settings.limit_slack / step
    """Uncertainty of the mean velocity of each step, from the resolution of positions."""
    limit_factor = 1 + settings.rate_slack
    """Factor on limits, for the tolerance."""
    rest_tolerance = settings.rate_slack * np.where(robot.velocity > 0, robot.velocity, _peak(v, mean))
    """Velocity that counts as zero, for each joint."""

    def limited(kind: str, what: str, rates: ndarray, error: ndarray | float = 0.0) -> _Check:
        """Whether rates of an uncertainty `error` keep the limits."""
        limit = robot.acceleration if kind == "acceleration" else robot.velocity
        factor = settings.jump if kind == "jump" else limit_factor
        allowed = np.where(limit > 0, factor * limit + error, np.inf)
        return _Check(kind, what, rates, np.abs(rates), allowed, lambda _, j: f"its limit {limit[j]:.6g}")

    at_ends = np.zeros_like(v)
    at_ends[0] = np.abs(v[0] - initial_velocity)
    at_ends[-1] = np.maximum(at_ends[-1], np.abs(v[-1]))  # a single row is the start and the end

    def rule(_: int, j: int) -> str:
        if not initial_velocity.any():
            return "but motions begin and end at rest"
        return f"but the motion is to begin at the start_velocity {initial_velocity[j]:.6g} and end at rest"

    yield _Check("rest", "velocity", v, at_ends, rest_tolerance, rule)

    yield limited("jump", "mean velocity from here to the next row", mean, mean_error)
    # An error e of the mean velocity of a step of h seconds changes the cubic's velocities by up to 3/2 e,
    # and its accelerations by up to 6 e / h (see trajectories/cubics.py).
    rate_name = "greatest velocity of the cubic to the next row"
    yield limited("velocity", rate_name, cubics.extremes.velocity, 1.5 * mean_error)
    yield limited("velocity", "velocity", v)

    # Second differences of positions. At each end, a step as long as its neighbor is added. The mean
    # velocities of the added step and its neighbor average to `initial_velocity` (before the first row) or 0
    # (after the last).
    means = _padded(2 * initial_velocity - mean[:1], mean, -mean[-1:])
    durations = _padded(step[:1], step, step[-1:])
    uncertainty = _padded(mean_error[:1], mean_error, mean_error[-1:])
    spacing = (durations[1:] + durations[:-1]) / 2
    second = (means[1:] - means[:-1]) / spacing
    uncertainty = (uncertainty[1:] + uncertainty[:-1]) / spacing
    cubic_error = 6 * mean_error / step
    yield limited("acceleration", "mean acceleration by its positions", second, uncertainty)
    rate_name = "greatest acceleration of the cubic to the next row"
    yield limited("acceleration", rate_name, cubics.extremes.acceleration, cubic_error)
    yield limited("acceleration", "mean acceleration by its velocities", change)
    yield limited("acceleration", "acceleration", a)

    # The greatest acceleration between rows is assumed to be at most twice the greatest measured one.
    limits = robot.acceleration
    measured = np.maximum(_peak(a, second, change), settings.rate_slack * robot.acceleration)
    strongest = np.where(limits > 0, np.minimum(limit_factor * limits, 2 * measured), 2 * measured)
    # Let the velocity change by d h in a step of h seconds. With accelerations up to A, the mean velocity of
    # the step differs from the mean of the velocities at its two ends by at most (A - d² / A) h / 4.
    spent = np.divide(change**2, strongest, out=np.zeros_like(change), where=strongest > 0)
    possible = np.maximum(strongest - spent, 0.0) * step / 4 + rest_tolerance
    """Allowed difference between mean velocities and the means of the rows' velocities."""
    difference = np.abs(mean - (v[1:] + v[:-1]) / 2)
    allowed = possible + mean_error
    yield _Check(
        "rates",
        "mean velocity from here to the next row",
        mean,
        difference,
        allowed,
        lambda i, j: f"but the velocities of these rows are {v[i, j]:.6g} and {v[i + 1, j]:.6g}",
    )
    if len(a) > 1 and (difference <= allowed).all():  # otherwise velocities, and so the cubics, are wrong
        start = cubics.extremes.start
        end = cubics.extremes.end
        before = _padded(start[:1], end)
        after = _padded(start, end[-1:])
        low = np.minimum(before, after)
        high = np.maximum(before, after)
        outside = np.maximum(low - a, a - high)
        if initial_velocity.any():
            outside[0] = 0.0  # the unknown motion before the start may have had any acceleration
        agreement = settings.rate_agreement * np.where(limits > 0, np.minimum(limits, measured), measured)
        yield _Check(
            "rates",
            "acceleration",
            a,
            outside,
            agreement
            + np.maximum(_padded(cubic_error[:1], cubic_error), _padded(cubic_error, cubic_error[-1:])),
            lambda i, j: f"but the cubics beside it have {low[i, j]:.6g} to {high[i, j]:.6g}",
        )

    if step.min(initial=np.inf) >= AVERAGING_WINDOWS[0]:
        return
    # tests over longer times: to each row from the one that `_worst_earlier_row` gives
    times = trajectory.times
    resolution = settings.limit_slack
    rate_name = "mean velocity from an earlier row to here"
    farthest = (times - times[0])[:, None] * limit_factor * robot.velocity
    since, span = _worst_earlier_row(times, q, farthest)
    moved = _change_since(q, since) / span
    yield limited("velocity", rate_name, moved, 2 * resolution / span)

    stated_positions = _cumulative(step * (v[1:] + v[:-1]) / 2)
    allowed = _cumulative(step * possible)
    since, span = _worst_earlier_row(times, q - stated_positions, allowed)
    moved = _change_since(q, since) / span
    stated = _change_since(stated_positions, since) / span
    yield _Check(
        "rates",
        rate_name,
        moved,
        np.abs(moved - stated),
        (_change_since(allowed, since) + 2 * resolution) / span,
        lambda i, j: f"but its velocities give {stated[i, j]:.6g}",
    )

    for window in AVERAGING_WINDOWS:
        second, uncertainty = _second_differences(
            trajectory, initial_velocity, window, resolution, rest_tolerance
        )
        description = f"mean acceleration by its positions over {1e3 * window:g} ms and more"
        yield limited("acceleration", description, second, uncertainty)


def _cumulative(steps: JointRows) -> JointRows:
    """For each row, the sum of all steps before it; 0 for the first row."""
    return _padded(np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0))


def _worst_earlier_row(
    times: Values, values: JointRows, allowed: JointRows
) -> tuple[Int[ndarray, "n dof"], JointRows]:
    """For each row and joint, the earlier row with the largest excess, and the time since that row [s].

    The excess is the absolute change of `values` since the earlier row, minus the growth of `allowed`. For
    the first row, the row itself is returned.
    """
    rows = np.arange(len(values))[:, None]
    beyond = np.full(values.shape, -np.inf)
    since = np.broadcast_to(rows, values.shape)
    for signed in (values, -values):
        excess = signed - allowed
        min_excess = np.minimum.accumulate(excess, axis=0)
        at = np.maximum.accumulate(np.where(excess <= min_excess, rows, 0), axis=0)
        # shifted by one row to exclude the row itself
        min_excess = _padded(excess[:1], min_excess[:-1])
        at = _padded(since[:1], at[:-1])
        since = np.where(excess - min_excess > beyond, at, since)
        beyond = np.maximum(beyond, excess - min_excess)
    return since, np.maximum(times[:, None] - times[since], MIN_TIME)


def _change_since(rows: JointRows, since: Int[ndarray, "n dof"]) -> JointRows:
    """The change of each joint's value since its earlier row `since`."""
    return rows - np.take_along_axis(rows, since, axis=0)


def _second_differences(
    trajectory: Trajectory,
    initial_velocity: JointValues,
    window: float,
    resolution: float,
    rest_tolerance: JointValues,
) -> tuple[JointRows, JointRows]:
    """Mean accelerations about each row and their uncertainty, from the positions at the row and at the
    nearest rows at least `window` [s] before and after it. Before the motion, the arm moves with the velocity
    `initial_velocity`; after it, the arm rests."""
    times = trajectory.times
    q = trajectory.positions
    clock = _padded(times[:1] - window, times, times[-1:] + window)
    rows = _padded(q[:1] - window * initial_velocity, q, q[-1:])
    low = np.searchsorted(clock, times - window, side="right") - 1
    high = np.searchsorted(clock, times + window)
    before = (times - clock[low])[:, None]
    after = (clock[high] - times)[:, None]
    spacing = (before + after) / 2
    outside = (low == 0).astype(float) + (high == len(clock) - 1)
    uncertainty = 2 * resolution * (1 / before + 1 / after) + outside[:, None] * rest_tolerance
    return ((rows[high] - q) / after - (q - rows[low]) / before) / spacing, uncertainty / spacing


def _padded(*rows: ndarray) -> ndarray:
    return np.concatenate(rows)


def _peak(*rates: ndarray) -> JointValues:
    return np.abs(np.concatenate(rates)).max(axis=0, initial=0.0)
