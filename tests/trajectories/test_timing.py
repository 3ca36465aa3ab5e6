"""Timing: limits hold, motions begin and end at rest, and stay on the path or its checked rounded corners; times of lines."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import toppra
from hypothesis import example, given, strategies as st

import robotdiffuse as rd
from helpers.refusals import refuses
from robotdiffuse.planning.reactive.replanner import TimedPath
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.trajectories import speed_limits, timing_kernel
from robotdiffuse.trajectories.speed_limits import MIN_JERK, TimingSettings, symmetric_bounds, timing_grid
from robotdiffuse.trajectories.straight_line import straight_line_time
from robotdiffuse.trajectories.timing import SAME_WAYPOINT_DISTANCE, time_parameterize
from robotdiffuse.trajectories.timing_kernel import BLEND_DEVIATION, RoundedLine, rounded_line
from robotdiffuse.validation.rates import rate_violations
from robotdiffuse.validation.validator import VerifySettings

VELOCITY = (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61)
ACCELERATION = (15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0)
NO_JERK_LIMIT = TimingSettings(jerk=np.inf, sample_time=1e-4)


def arm(velocity: tuple[float, ...] = VELOCITY, acceleration: tuple[float, ...] = ACCELERATION) -> rd.Robot:
    """A chain of revolute joints, of which timing uses only the limits."""
    joints = tuple(
        Joint(f"j{i}", "revolute", f"l{i}", f"l{i + 1}", np.eye(4), np.array([0.0, 0.0, 1.0]), -3.0, 3.0, v, a)
        for i, (v, a) in enumerate(zip(velocity, acceleration, strict=True))
    )
    return rd.Robot("arm", "l0", f"l{len(joints)}", joints)


def always(_: object) -> bool:
    return True


def never(_: object) -> bool:
    return False


ARM = arm()
DEFAULT = TimingSettings()


def timed(
    q: object,
    valid: Callable[[Any], bool] = always,
    free: Callable[[Any], bool] | None = None,
    settings: TimingSettings = DEFAULT,
    robot: rd.Robot = ARM,
    **more: Any,
) -> rd.Trajectory:
    path = rd.Path(robot.joint_names, np.asarray(q, float))
    return time_parameterize(robot, path, valid, free or valid, settings, **more).trajectory


def distance_to_polyline(points: np.ndarray, waypoints: np.ndarray) -> np.ndarray:
    best = np.full(len(points), np.inf)
    for a, b in pairwise(waypoints):
        ab = b - a
        t = np.clip((points - a) @ ab / max(ab @ ab, 1e-300), 0, 1)
        best = np.minimum(best, np.linalg.norm(points - a - t[:, None] * ab, axis=1))
    return best


def rates_agree(t: rd.Trajectory, robot: rd.Robot = ARM) -> bool:
    return rate_violations(robot, t, VerifySettings()) == []


def check(q: np.ndarray, t: rd.Trajectory, settings: TimingSettings, robot: rd.Robot = ARM) -> None:
    assert t.times[0] == 0 and (np.diff(t.times) > 0).all() and np.diff(t.times).max() <= 1.1 * settings.sample_time + 1e-9
    assert np.array_equal(t.positions[0], q[0]) and np.array_equal(t.positions[-1], q[-1]) and not t.velocities[[0, -1]].any()
    assert (np.abs(t.velocities) <= 1.01 * settings.velocity_scale * robot.velocity).all()
    assert (np.abs(t.accelerations) <= 1.01 * settings.acceleration_scale * robot.acceleration).all()
    # where a corner is narrow, smoothing for a limit of jerk leaves it by up to 0.03 rad more
    more = 2 * SAME_WAYPOINT_DISTANCE if settings.jerk == np.inf else 0.05
    assert distance_to_polyline(t.positions, q).max() <= settings.corner_deviation + more


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(2, 40),
    scale=st.floats(-6, 0.3),
    settings=st.builds(
        TimingSettings,
        velocity_scale=st.floats(0.05, 1),
        acceleration_scale=st.floats(0.05, 1),
        corner_deviation=st.sampled_from([0.0, 1e-4, 0.01, 0.1, 1.0]),
        jerk=st.sampled_from([None, np.inf]),
    ),
    kind=st.sampled_from(["random", "there and back", "nearly straight", "repeated", "one joint", "steps of all sizes"]),
)
@example(  # the path velocity of a rounded reversal peaks between grid points: it was 1.8 % too fast there
    seed=0, count=3, scale=0.0, settings=TimingSettings(velocity_scale=0.0625, corner_deviation=1.0), kind="there and back"
)
def test_limits_rest_and_geometry(seed: int, count: int, scale: float, settings: TimingSettings, kind: str) -> None:
    rng = np.random.default_rng(seed)
    q = 10**scale * rng.uniform(-1, 1, (count, 7))
    if kind == "there and back":
        q = q[np.arange(count) % 2]
    elif kind == "nearly straight":
        q = np.linspace(0, 1, count)[:, None] * q[0] + 1e-7 * q
    elif kind == "repeated":
        q = np.repeat(q, 3, axis=0)
    elif kind == "one joint":
        q[:, :6] = 0
    elif kind == "steps of all sizes":  # toppra failed on steps below 1e-6 among long ones
        q = q[0] + 10 ** rng.uniform(-9, 0, (count, 1)) * q
    check(q, timed(q, (lambda _: rng.random() < 0.5) if seed % 2 else always, settings=settings), settings)


def test_one_joint_against_the_closed_form_and_a_path_of_length_zero() -> None:
    """Bang-bang: 2 sqrt(d / a) below the velocity limit, d / v + v / a above it."""
    robot = arm((2.0,), (8.0,))
    for d, expected in ((0.125, 2 * np.sqrt(0.125 / 8)), (3.0, 3.0 / 2 + 2.0 / 8)):
        assert timed([[0.0], [d]], settings=NO_JERK_LIMIT, robot=robot).duration == pytest.approx(expected, rel=0.01)
    for rows in (1, 2, 5):
        t = timed(np.full((rows, 7), 0.3))
        assert t.times[0] == 0 and t.duration <= 4 * TimingSettings().sample_time
        assert (t.positions == 0.3).all() and not t.velocities.any() and not t.accelerations.any()


@pytest.mark.parametrize("distance", [1e-9, 9e-7])
@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_motions_that_count_as_one_waypoint_keep_all_limits(distance: float, scale: float) -> None:
    """Regression: such a motion took one time step, with up to 19,000 times the jerk limit that was asked for."""
    q = np.zeros((2, 7))
    q[1] = -distance / 7, *[distance / 7] * 6
    t = timed(q, settings=TimingSettings(velocity_scale=scale, acceleration_scale=scale, jerk=MIN_JERK))
    assert np.array_equal(t.positions[[0, -1]], q) and not t.velocities[[0, -1]].any()
    assert (t.peak_jerks <= MIN_JERK).all()
    start, end = t.cubic_accelerations
    assert np.allclose(start, t.accelerations[:-1], atol=1e-12) and np.allclose(end, t.accelerations[1:], atol=1e-12)
    assert (np.abs(t.accelerations) <= scale * np.array(ACCELERATION)).all()
    assert (np.abs(t.velocities) <= scale * np.array(VELOCITY)).all()


def test_corner_is_rounded_when_valid_and_stopped_at_when_not() -> None:
    q = np.tri(3, 7, -1)
    stopped = timed(q, never)
    assert timed(q).duration < 0.9 * stopped.duration
    nearest = np.linalg.norm(stopped.positions - q[1], axis=1).argmin()
    assert np.array_equal(stopped.positions[nearest], q[1]) and np.abs(stopped.velocities[nearest]).max() < 1e-9
    assert distance_to_polyline(stopped.positions, q).max() < 1e-12


@pytest.mark.parametrize("size", [1e-5, 1e-3, 0.02])
def test_rows_of_the_shortest_pieces_agree(size: float) -> None:
    """Regression: between two close stops, rows at sample times missed the acceleration."""
    q = np.tri(4, 7, -1)
    q[2:, 1] = size
    assert rates_agree(timed(q)) and rates_agree(timed(q, never))


def test_only_the_corner_that_fails_is_tightened() -> None:
    """An obstacle is inside the first corner only, so the second corner keeps its rounding."""
    q = np.tri(4, 7, -1)

    def cuts(positions: np.ndarray, k: int) -> float:
        return float(np.linalg.norm(positions - q[k], axis=1).min())

    def valid(piece: rd.Path | rd.Trajectory) -> bool:
        near = np.linalg.norm(piece.positions - q[1], axis=1) < 0.4
        return not near.any() or distance_to_polyline(piece.positions[near], q).max() < 0.03

    t = timed(q, valid)
    assert valid(t) and cuts(t.positions, 1) < 0.05 and cuts(t.positions, 2) > 0.09


def test_blend_reaches_the_deviation_and_is_twice_differentiable() -> None:
    waypoints = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]])
    line = rounded_line(waypoints, np.array([0.05]))
    assert np.linalg.norm(line(np.array([1.0]), 0) - waypoints[1]) == pytest.approx(0.05)
    assert line.half_widths[0] * BLEND_DEVIATION * np.sqrt(2) == pytest.approx(0.05)
    s = np.linspace(0, line.length, 20001)
    for order in (0, 1):
        assert np.abs(np.gradient(line(s, order), s, axis=0)[1:-1] - line(s, order + 1)[1:-1]).max() < 2e-3


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(2, 8),
    jerk=st.floats(20.0, 5000.0),
    sample_time=st.sampled_from([0.002, 0.004, 0.01]),
    stops=st.booleans(),
)
def test_a_limit_of_jerk_is_kept_with_the_others(seed: int, count: int, jerk: float, sample_time: float, stops: bool) -> None:
    q = np.cumsum(np.random.default_rng(seed).normal(0, 0.3, (count, 7)), axis=0)
    t = timed(q, never if stops else always, settings=TimingSettings(jerk=jerk, sample_time=sample_time))
    steps = np.diff(t.times)[:, None]
    assert steps.min() > 0 and steps.max() <= sample_time + 1e-9
    assert np.abs(np.diff(t.accelerations, axis=0) / steps).max() <= jerk * (1 + 1e-6)
    assert (np.abs(t.velocities) <= ARM.velocity * (1 + 1e-9)).all()
    assert (np.abs(t.accelerations) <= ARM.acceleration * (1 + 1e-9)).all()
    assert np.array_equal(t.positions[0], q[0]) and np.array_equal(t.positions[-1], q[-1])
    assert not t.velocities[[0, -1]].any() and np.abs(t.accelerations[[0, -1]]).max() < 1e-9
    # the jerk is constant between rows, so that limits hold at every time
    p, v, a = t.positions, t.velocities, t.accelerations
    assert np.abs(v[:-1] + steps / 2 * (a[1:] + a[:-1]) - v[1:]).max() < 1e-9
    assert np.abs(p[:-1] + steps * v[:-1] + steps**2 / 6 * (2 * a[:-1] + a[1:]) - p[1:]).max() < 1e-9
    if stops:
        assert distance_to_polyline(t.positions, q).max() < 1e-8


@given(
    seed=st.integers(0, 2**32 - 1),
    jerk=st.floats(3.0, 1e4) | st.just(np.inf),
    scale=st.floats(0.1, 1.0),
    ratio=st.floats(0.01, 0.99),
)
def test_motions_from_a_start_velocity_keep_all_limits(seed: int, jerk: float, scale: float, ratio: float) -> None:
    """Checks velocities, accelerations and jerks every ms, first along a straight line and then around a corner."""
    robot = arm()
    rng = np.random.default_rng(seed)
    settings = TimingSettings(jerk=jerk, velocity_scale=scale, acceleration_scale=scale)
    direction = rng.normal(size=7)
    direction /= np.linalg.norm(direction)
    velocity = ratio * scale * float((robot.velocity / np.abs(direction)).min()) * direction
    stop = speed_limits.stopping_distance(robot, settings, velocity) * direction
    for q in (np.stack([0 * stop, stop]), np.stack([0 * stop, stop, stop + 0.5 * rng.normal(size=7)])):
        t = timed(q, settings=settings, start_speed=float(np.linalg.norm(velocity)))
        assert np.array_equal(t.positions[0], q[0]) and np.array_equal(t.positions[-1], q[-1])
        assert np.allclose(t.velocities[0], velocity, rtol=1e-12) and not t.accelerations[0].any()
        assert not t.velocities[-1].any() and not t.accelerations[-1].any() and len(t.stops) == 0
        states = t.at(np.arange(0.0, t.duration, 1e-3))
        assert (np.abs(states.velocities) <= scale * robot.velocity * (1 + 2e-6)).all()
        assert (np.abs(states.accelerations) <= scale * robot.acceleration * (1 + 2e-6)).all()
        assert (np.abs(states.jerks) <= jerk * (1 + 1e-6)).all()


def test_a_limit_of_jerk_costs_what_it_must() -> None:
    """One joint needs (32 d / j)^(1/3). Regression: accelerations of seven fixed fractions of the limits took 20 times that."""
    free, slight, *gentle = (
        timed([[0.0], [1.0]], settings=TimingSettings(jerk=jerk), robot=arm((20.0,), (80.0,))).duration
        for jerk in (np.inf, 1e5, 50.0, MIN_JERK)
    )
    least = (32 / np.array([50.0, MIN_JERK])) ** (1 / 3)
    assert (least <= gentle).all() and (1.4 * least > gentle).all()
    assert slight == pytest.approx(free, abs=0.004)


def toppra_speeds(line: RoundedLine, grid: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> np.ndarray | None:
    """toppra's fastest speeds at the grid points of a line; None if it finds none."""

    class Geometry(toppra.interpolator.AbstractGeometricPath):
        @property
        def dof(self) -> int:
            return len(velocity)

        @property
        def path_interval(self) -> np.ndarray:
            return np.array([0.0, line.length])

        def __call__(self, path_positions: np.ndarray | float, order: int = 0) -> np.ndarray:
            return line(np.atleast_1d(np.asarray(path_positions, dtype=np.float64)), order)

    kinds = toppra.constraint
    most = kinds.JointAccelerationConstraint(acceleration, discretization_scheme=kinds.DiscretizationType.Interpolation)
    constraints = [kinds.JointVelocityConstraint(velocity), most]
    algorithm = toppra.algorithm.TOPPRA(constraints, Geometry(), gridpoints=grid, solver_wrapper="seidel")
    return algorithm.compute_parameterization(0.0, 0.0)[1]


def toppra_duration(robot: rd.Robot, line: RoundedLine, settings: TimingSettings) -> float:
    """Duration [s] of the motion along a line with toppra's speeds, reduced in the same way as ours."""
    grid = timing_grid(line, settings)
    speeds = toppra_speeds(line, grid, robot.velocity, robot.acceleration)
    assert speeds is not None
    slower = timing_kernel.slowdown(line, grid, speeds, robot.velocity, robot.acceleration)
    return slower * float((2 * np.diff(grid) / (speeds[1:] + speeds[:-1])).sum())


@given(seed=st.integers(0, 2**32 - 1), deviation=st.sampled_from([0.0, 0.02, 0.1]))
def test_durations_are_those_of_toppra(seed: int, deviation: float) -> None:
    rng = np.random.default_rng(seed)
    robot = arm()
    q = np.cumsum(rng.normal(0, 0.4, (rng.integers(2, 8), 7)), axis=0)
    settings = replace(NO_JERK_LIMIT, corner_deviation=deviation)
    ours = timed(q, settings=settings).duration
    parts = [q] if deviation else [q[i : i + 2] for i in range(len(q) - 1)]
    lines = [rounded_line(w, np.full(len(w) - 2, deviation)) for w in parts]
    theirs = sum(toppra_duration(robot, line, settings) for line in lines)
    assert ours == pytest.approx(theirs + len(lines) * 2 * settings.sample_time, rel=1e-3)


@given(seed=st.integers(0, 2**32 - 1), narrow=st.sampled_from([0.0, 1e-4]))
def test_the_estimated_time_is_near_the_exact_one(seed: int, narrow: float) -> None:
    """Regression: the estimate was 7 % too short where a rounded corner began just after the start."""
    rng = np.random.default_rng(seed)
    q = np.cumsum(rng.normal(0, 0.4, (rng.integers(3, 8), 7)), axis=0)
    line = rounded_line(q, 10 ** rng.uniform(-2, 0, len(q) - 2))
    line.half_widths[0] *= 1 - narrow
    velocity = rng.uniform(1, 3, 7)
    acceleration = rng.uniform(5, 20, 7)
    exact = speed_limits.least_time(line, velocity, acceleration, TimingSettings(corner_intervals=16, line_intervals=128))
    assert 0.97 < timing_kernel.estimated_time(line, velocity, acceleration) / exact < 1.1


def test_a_slow_torso_has_a_timing() -> None:
    """Regression: where the torso turns back, a speed was so high that only a stop could follow, and no timing was found."""
    fetch = (0.1, 1.25, 1.45, 1.57, 1.52, 1.57, 2.26, 2.26)
    robot = arm(fetch, tuple(4 * v for v in fetch))
    for seed in (1868, 2571, 2972):
        q = np.cumsum(np.random.default_rng(seed).normal(0, 0.4, (7, 8)), axis=0) * [0.3, *[1] * 7]
        check(q, timed(q, robot=robot), TimingSettings(), robot)


@given(
    seed=st.integers(0, 2**32 - 1),
    dof=st.integers(3, 14),
    count=st.integers(2, 10),
    scale=st.floats(-3, 0.3),
    decades=st.floats(0, 4),
    kind=st.sampled_from(["random", "there and back", "few joints", "steps of all sizes"]),
)
@example(seed=930, dof=8, count=7, scale=0.0, decades=4.0, kind="random")
def test_every_path_has_a_timing(seed: int, dof: int, count: int, scale: float, decades: float, kind: str) -> None:
    """Within the limits, above 0 except at both ends, and not below toppra's, except where those fall to nearly 0."""
    rng = np.random.default_rng(seed)
    velocity, acceleration = 10 ** rng.uniform(-decades / 2, decades / 2, (2, dof))
    q = np.cumsum(10**scale * rng.normal(0, 1, (count, dof)), axis=0)
    if kind == "there and back":
        q = q[np.arange(count) % 2]
    elif kind == "few joints":
        q[:, 2:] = q[:1, 2:]
    elif kind == "steps of all sizes":
        q = np.cumsum(10 ** rng.uniform(-4, 0, (count, 1)) * rng.normal(0, 1, (count, dof)), axis=0)
    line = rounded_line(q, 10 ** rng.uniform(-4, 0, count - 2))
    grid = timing_grid(line, TimingSettings())
    first, second = line(grid, 1), line(grid, 2)
    found = timing_kernel.fastest_speeds(first, second, grid, velocity, *symmetric_bounds(acceleration, len(grid)))
    assert (found[1:-1] > 0).all() and np.isfinite(found).all()
    assert (np.abs(first) * found[:, None] <= velocity * (1 + 1e-9)).all()
    pull = (np.diff(found**2) / (2 * np.diff(grid)))[:, None]
    for end in (slice(0, -1), slice(1, None)):
        rates = first[end] * pull + second[end] * found[end, None] ** 2
        assert (np.abs(rates) <= acceleration * (1 + 1e-4)).all()
    theirs = toppra_speeds(line, grid, velocity, acceleration)
    if theirs is not None and np.isfinite(theirs).all() and (theirs[1:-1] > 0.01 * theirs.max()).all():
        ours, least = ((2 * np.diff(grid) / (speeds[1:] + speeds[:-1])).sum() for speeds in (found, theirs))
        assert ours == pytest.approx(least, rel=1e-3)
    t = timed(q, robot=arm(tuple(velocity), tuple(acceleration)))
    assert (np.abs(t.velocities) <= 1.01 * velocity).all() and (np.abs(t.accelerations) <= 1.01 * acceleration).all()


@pytest.mark.parametrize("value", [1e-300, 1e-12, 1e-6, float("nan")])
@pytest.mark.parametrize("field", ["velocity_scale", "acceleration_scale", "jerk"])
def test_settings_that_make_a_motion_endless_are_refused(field: str, value: float) -> None:
    right = "at least 0.01" if field == "jerk" else "between 0.001 and 1"
    refuses(rf"timing\.{field} is {value}; it must be {right}", TimingSettings, **{field: value})


@pytest.mark.parametrize("limit", [0.0, 1e-300, 1e-7, float("nan")])
def test_limits_that_make_a_motion_endless_are_refused(limit: float) -> None:
    for robot in (arm((1.0, limit), (1.0, 1.0)), arm((1.0, 1.0), (1.0, limit))):
        refuses(rf"limit of j1 is {limit}; it must be at least 1e-06", timed, [[0.0, 0.0], [1.0, 1.0]], robot=robot)


@pytest.mark.parametrize("jerk", [None, 10.0])
def test_rows_of_a_motion_without_end_are_counted(jerk: float | None) -> None:
    """Regression: a joint limited to 1e-6 rad/s had 1e8 rows, which ended in a MemoryError."""
    robot = arm((1e-6,), (1.0,))
    t = timed([[0.0], [1.0]], settings=TimingSettings(jerk=jerk), robot=robot)
    assert t.duration == pytest.approx(1e6, rel=0.05) and len(t.times) <= speed_limits.MAX_ROWS + 3
    assert rates_agree(t, robot)


@pytest.mark.parametrize("jerk", [2e3, 7.5e3, 1e5, 1e300])
def test_rows_tell_the_acceleration_under_a_high_limit_of_jerk(jerk: float) -> None:
    """Regression: the peak of the acceleration was between two rows, whose velocities and positions then disagreed."""
    q = np.cumsum(np.random.default_rng(0).normal(0, 0.5, (5, 7)), axis=0)
    assert rates_agree(timed(q, settings=TimingSettings(jerk=jerk)))


def test_a_dense_path_is_driven_without_stops() -> None:
    """Regression: 46 of 46 waypoints of a sampled path were stops, since its rows did not show its accelerations."""
    rng = np.random.default_rng(3)
    along = np.linspace(0, 1, 48)[:, None]
    q = along * rng.normal(0, 1, 7) + np.sin(np.pi * along) * rng.normal(0, 0.4, 7)
    q += rng.normal(0, 2e-3, (48, 7))
    t = timed(q, rates_agree, always)
    assert rates_agree(t) and len(t.stops) == 0 and t.duration < 0.5 * timed(q, never).duration


def test_a_corner_in_a_narrow_passage_is_no_stop() -> None:
    """Regression: a corner that was not free after two reductions of its rounding became a stop."""
    q = np.tri(3, 7, -1)

    def free(piece: rd.Path | rd.Trajectory) -> bool:
        return bool(distance_to_polyline(piece.positions, q).max() < 1e-3)

    t = timed(q, free)
    assert free(t) and len(t.stops) == 0


@pytest.mark.parametrize("accepted", [6, 7, 8])
def test_lower_accelerations_that_did_not_help_are_given_up(accepted: int) -> None:
    """Regression: the lower accelerations were kept as corners were tightened: 2.8 times as long as with stops."""
    calls = []

    def valid(_motion: rd.Trajectory) -> bool:
        calls.append(1)
        return len(calls) == accepted

    q = [[0.0] * 7, [0.5] * 7, [0.5, 1.0, *[0.5] * 5], [1.0] * 7]
    rounded = timed(q, valid, always)
    assert len(calls) == accepted and rounded.duration < timed(q, never, always).duration


def test_joints_without_a_jerk_limit_have_the_stated_default() -> None:
    assert speed_limits.jerk_limits(ARM, TimingSettings()).tolist() == [10 * a for a in ACCELERATION]
    t = timed(np.tri(3, 7, -1))
    jerk = np.diff(t.accelerations, axis=0) / np.diff(t.times)[:, None]
    assert (np.abs(jerk) <= 10 * np.array(ACCELERATION) * (1 + 1e-9)).all()


def test_a_corner_that_its_neighbor_leaves_more_room_is_checked_again() -> None:
    """Regression: the second corner grew without a check when its wide neighbor shrank, and came too near an obstacle."""
    q = np.tri(4, 7, -1)

    def keeps(corner: np.ndarray) -> bool:
        near = corner[np.linalg.norm(corner - q[1], axis=1) < 0.3]
        return distance_to_polyline(corner, q).max() < 0.12 and distance_to_polyline(near, q).max(initial=0) < 0.01

    assert keeps(timed(q, keeps=keeps).positions)


def test_a_timed_path_is_as_fast_as_its_timing() -> None:
    """Except for the margin that it leaves to the limits, about 4 % of accelerations."""
    robot = rd.load_robot("panda")
    line = rounded_line(np.array([np.zeros(7), np.full(7, 0.8), np.linspace(0, 1, 7)]), np.array([0.1]))
    fastest = speed_limits.time_line(robot, line, TimingSettings())[0][-1]
    found = TimedPath(robot, 0.96 * robot.acceleration, line, True).advance_then_brake(0.0, 0.0).duration
    assert found == pytest.approx(fastest, rel=0.05)


START = np.zeros(2)
FAR, NEAR = np.array([3.0, 1.0]), np.array([0.1, -0.05])


def test_the_time_of_a_line_by_hand():
    one = np.ones(2)
    assert np.allclose(straight_line_time(START, np.stack([FAR, NEAR, START]), one, one), [3.0 + 1.0, 2 * np.sqrt(0.1), 0.0])
    # the slowest joint at each limit decides: times 1 / v, 1 / a of the share of the way
    assert np.isclose(straight_line_time(START, FAR, np.array([6.0, 0.5]), np.array([3.0, 1.0])), 2.0 + 0.5)
    refuses("acceleration", straight_line_time, START, FAR, one, np.zeros(2))


def test_along_a_line_as_toppra_times_it():
    robot = arm((1.0, 0.7), (2.0, 3.0))
    for goal in (FAR, NEAR):
        duration = toppra_duration(robot, rounded_line(np.stack([START, goal]), np.zeros(0)), DEFAULT)
        assert straight_line_time(START, goal, robot.velocity, robot.acceleration) == pytest.approx(duration, rel=5e-3)
