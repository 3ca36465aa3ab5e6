"""Rates of a trajectory: what its positions over its times amount to, and whether it says so itself.

Of a motion from rest to rest whose acceleration never exceeds A, the mean velocity of each step is within its
velocity limit, and each second difference quotient, the arm standing before the first and after the last
row, is a mean of its accelerations and thus at most A. Velocities v0 and v1 at both ends of a step of h
seconds leave its length within h (v0 + v1) / 2 ± (A h² - (v1 - v0)² / A) / 4, the extremes being full
acceleration and then full braking. So no limit refuses what an arm can do within it. Whether rates agree is
asked with twice the greatest acceleration that the motion has or says in place of A, where that is less.

Positions are known to a resolution only, which over a step of nanoseconds hides any velocity. So where rows
are closer than a millisecond, all this is asked from each row to each later one too, with the resolution of
these two alone.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.types import Trajectory
from robotdiffuse.robots.robot import Robot

WINDOWS = (1e-3, 4e-3, 16e-3)
"""Where rows are closer than the first of these [s], mean accelerations are asked for over times of at least
each; over shorter ones, the resolution of positions hides any."""
SHORTEST = 1e-12
"""Shorter times count as this one [s], so that rates over them are finite."""


@dataclass(frozen=True)
class RateTolerances:
    slack: float
    """Share by which limits may be exceeded, and share of a velocity limit that counts as none."""
    agreement: float
    """Share of a joint's greatest acceleration by which one may lie outside of the means beside its row."""
    jump: float
    """Times the velocity limit from which a step is a jump."""
    resolution: float
    """Positions are taken as known to this [rad] or [m]."""


@dataclass(frozen=True)
class WrongRate:
    """The first of its kind."""

    kind: str
    """rest, jump, velocity, acceleration or rates."""
    time: float
    """[s]"""
    joint: str
    message: str
    excess: float
    """Beyond what is allowed, in the rate's unit."""


def wrong_rates(
    robot: Robot,
    trajectory: Trajectory,
    tolerances: RateTolerances,
    start_velocity: Float[ndarray, "dof"] | None = None,
) -> list[WrongRate]:
    """What is wrong with the rates of finite rows at increasing times; the first of each kind. The motion is
    to begin at rest, or at `start_velocity`.

    A limit of 0 stands for one that the robot does not give: there the rates need only agree.
    """
    found: dict[str, WrongRate] = {}
    with np.errstate(over="ignore", invalid="ignore"):
        begins = np.zeros(robot.dof) if start_velocity is None else start_velocity
        checks = list(_checks(robot, trajectory, tolerances, begins))
    for check in checks:
        right = check.off <= check.allowed
        if right.all():
            continue
        wrong = ~right
        i = int(np.flatnonzero(wrong.any(axis=1))[0])
        beyond = np.where(wrong, np.nan_to_num(check.off - check.allowed, nan=np.inf), 0.0)
        j, time = int(beyond[i].argmax()), float(trajectory.times[i])
        if check.kind not in found or time < found[check.kind].time:
            name, rate = robot.joint_names[j], abs(float(check.rates[i, j]))
            message = f"{name} at {time:.3f} s: its {check.what} is {rate:.6g}, {check.right(i, j)}"
            found[check.kind] = WrongRate(check.kind, time, name, message, float(beyond[i, j]))
    return list(found.values())


def between_rows(trajectory: Trajectory, chord: float) -> tuple[Float[ndarray, "m"], Float[ndarray, "m dof"]]:
    """Times and positions of a trajectory, with further rows on the cubics through its rows' positions and
    velocities, so that straight lines between rows leave those by no more than `chord` [rad] or [m]."""
    times, q, v = trajectory.times, trajectory.positions, trajectory.velocities
    step = np.diff(times)[:, None]
    mean = (q[1:] - q[:-1]) / step
    first, last = v[:-1] - mean, v[1:] - mean
    # A cubic's second derivative is greatest at an end, and its chord is off by an eighth of it.
    bend = step * np.maximum(np.abs(4 * first + 2 * last), np.abs(2 * first + 4 * last)) / 8
    counts = np.ceil(np.sqrt(bend.max(axis=1, initial=0.0) / chord)).astype(int)
    if (counts <= 1).all():
        return times, q
    counts = np.maximum(counts, 1)
    row = np.repeat(np.arange(len(counts)), counts)
    u = np.concatenate([np.arange(n) / n for n in counts])[:, None]
    h = step[row]
    off = h * (u * (1 - u) ** 2 * first[row] - u**2 * (1 - u) * last[row])
    between = q[row] + u * h * mean[row] + off
    return np.append(times[row] + (u * h)[:, 0], times[-1]), np.concatenate([between, q[-1:]])


class _Check(NamedTuple):
    """Rows are those of the trajectory, from its first."""

    kind: str
    what: str
    rates: Float[ndarray, "n dof"]
    off: Float[ndarray, "n dof"]
    """How far the rates are off, ..."""
    allowed: Float[ndarray, "#n dof"]
    """... and how far they may be."""
    right: Callable[[int, int], str]
    """What would be right, by row and joint."""


def _checks(
    robot: Robot, trajectory: Trajectory, tolerances: RateTolerances, begins: Float[ndarray, "dof"]
) -> Iterator[_Check]:
    q, v, a = trajectory.positions, trajectory.velocities, trajectory.accelerations
    step = np.diff(trajectory.times)[:, None]
    mean, change = (q[1:] - q[:-1]) / step, (v[1:] - v[:-1]) / step
    blur = 2 * tolerances.resolution / step
    """Of the mean velocities, as positions are not known better."""
    share = 1 + tolerances.slack
    nothing = tolerances.slack * _known(robot.velocity, v, mean)

    def limited(kind: str, what: str, rates: ndarray, limit: ndarray, allowed: ndarray) -> _Check:
        known = allowed if (limit > 0).all() else np.where(limit > 0, allowed, np.inf)
        return _Check(kind, what, rates, np.abs(rates), known, lambda _, j: f"its limit {limit[j]:.6g}")

    at_ends = np.zeros_like(v)
    at_ends[0], at_ends[-1] = np.abs(v[0] - begins), np.abs(v[-1])
    rule = "but motions begin and end at rest"
    if begins.any():
        rule = "but the motion is to begin at the problem's start_velocity and end at rest"
    yield _Check("rest", "velocity", v, at_ends, nothing, lambda *_: rule)

    most, onwards = robot.velocity, "mean velocity from here to the next row"
    yield limited("jump", onwards, mean, most, tolerances.jump * most + blur)
    yield limited("velocity", onwards, mean, most, share * most + blur)
    yield limited("velocity", "velocity", v, most, share * most)

    around, length = _padded(2 * begins - mean[:1], mean, -mean[-1:]), _padded(step[:1], step, step[-1:])
    unsure = _padded(blur[:1], blur, blur[-1:])
    apart = (length[1:] + length[:-1]) / 2
    second, unsure = (around[1:] - around[:-1]) / apart, (unsure[1:] + unsure[:-1]) / apart
    most = robot.acceleration
    yield limited("acceleration", "mean acceleration by its positions", second, most, share * most + unsure)
    yield limited("acceleration", "mean acceleration by its velocities", change, most, share * most)
    yield limited("acceleration", "acceleration", a, most, share * most)

    # Rows may miss the peaks of what accelerates the motion, but not by half.
    own = np.maximum(_greatest(a, second, change), tolerances.slack * robot.acceleration)
    strongest = np.where(most > 0, np.minimum(share * most, 2 * own), 2 * own)
    spent = np.divide(change**2, strongest, out=np.zeros_like(change), where=strongest > 0)
    possible = np.maximum(strongest - spent, 0.0) * step / 4 + nothing
    """Between mean velocities and those that the rows say."""
    yield _Check(
        "rates",
        onwards,
        mean,
        np.abs(mean - (v[1:] + v[:-1]) / 2),
        possible + blur,
        lambda i, j: f"the velocities that these rows say are {v[i, j]:.6g} and {v[i + 1, j]:.6g}",
    )
    beside = _padded(change[:1], change, change[-1:])
    low, high = np.minimum(beside[1:], beside[:-1]), np.maximum(beside[1:], beside[:-1])
    outside = np.maximum(low - a, a - high)
    if begins.any():
        outside[0] = 0.0  # nothing is known of the motion before, which may have ended in any acceleration
    yield _Check(
        "rates",
        "acceleration",
        a,
        outside,
        tolerances.agreement * np.where(most > 0, np.minimum(most, own), own),
        lambda i, j: f"by its velocities between {low[i, j]:.6g} and {high[i, j]:.6g}",
    )

    if step.min(initial=np.inf) >= WINDOWS[0]:
        return
    times, resolution = trajectory.times, tolerances.resolution
    onwards = "mean velocity from an earlier row to here"
    most = robot.velocity
    first, span = _since(times, q, (times - times[0])[:, None] * share * most)
    moved = _changes(q, first) / span
    yield limited("velocity", onwards, moved, most, share * most + 2 * resolution / span)

    said, room = _summed(step * (v[1:] + v[:-1]) / 2), _summed(step * possible)
    first, span = _since(times, q - said, room)
    moved, told = _changes(q, first) / span, _changes(said, first) / span
    yield _Check(
        "rates",
        onwards,
        moved,
        np.abs(moved - told),
        (_changes(room, first) + 2 * resolution) / span,
        lambda i, j: f"the one that its velocities amount to is {told[i, j]:.6g}",
    )

    most = robot.acceleration
    for window in WINDOWS:
        second, unsure = _second_differences(trajectory, begins, window, resolution, nothing)
        what = f"mean acceleration by its positions over {1e3 * window:g} ms and more"
        yield limited("acceleration", what, second, most, share * most + unsure)


def _summed(steps: Float[ndarray, "m dof"]) -> Float[ndarray, "n dof"]:
    """By row."""
    return np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])


def _since(
    times: Float[ndarray, "n"], way: Float[ndarray, "n dof"], allowed: Float[ndarray, "n dof"]
) -> tuple[Int[ndarray, "n dof"], Float[ndarray, "n dof"]]:
    """For each row the earlier one since which a joint's way has changed most beyond what `allowed` has grown
    by, in either direction, and the time since then [s]; itself where there is none."""
    rows, beyond = np.arange(len(way))[:, None], np.full(way.shape, -np.inf)
    first = np.broadcast_to(rows, way.shape)
    for signed in (way, -way):
        room = signed - allowed
        least = np.minimum.accumulate(room, axis=0)
        at = np.maximum.accumulate(np.where(room <= least, rows, 0), axis=0)
        # not the row itself
        least, at = np.concatenate([room[:1], least[:-1]]), np.concatenate([first[:1], at[:-1]])
        first = np.where(room - least > beyond, at, first)
        beyond = np.maximum(beyond, room - least)
    return first, np.maximum(times[:, None] - times[first], SHORTEST)


def _changes(rows: Float[ndarray, "n dof"], first: Int[ndarray, "n dof"]) -> Float[ndarray, "n dof"]:
    return rows - np.take_along_axis(rows, first, axis=0)


def _second_differences(
    trajectory: Trajectory,
    begins: Float[ndarray, "dof"],
    window: float,
    resolution: float,
    nothing: Float[ndarray, "dof"],
) -> tuple[Float[ndarray, "n dof"], Float[ndarray, "n dof"]]:
    """Mean accelerations by positions, about each row, from and to the first rows at least `window` [s] away,
    and how unsure they are; before and after the motion the arm moves as it begins, and stands."""
    times, q = trajectory.times, trajectory.positions
    clock = np.concatenate([times[:1] - window, times, times[-1:] + window])
    rows = _padded(q[:1] - window * begins, q, q[-1:])
    low = np.searchsorted(clock, times - window, side="right") - 1
    high = np.searchsorted(clock, times + window)
    before, after = (times - clock[low])[:, None], (clock[high] - times)[:, None]
    apart = (before + after) / 2
    outside = (low == 0).astype(float) + (high == len(clock) - 1)
    unsure = 2 * resolution * (1 / before + 1 / after) + outside[:, None] * nothing
    return ((rows[high] - q) / after - (q - rows[low]) / before) / apart, unsure / apart


def _padded(before: ndarray, rows: ndarray, after: ndarray) -> ndarray:
    return np.concatenate([before, rows, after])


def _known(limit: Float[ndarray, "dof"], *rates: ndarray) -> Float[ndarray, "dof"]:
    """The limits; the greatest of the rates where there is none."""
    return np.where(limit > 0, limit, _greatest(*rates))


def _greatest(*rates: ndarray) -> Float[ndarray, "dof"]:
    return np.abs(np.concatenate(rates)).max(axis=0, initial=0.0)
