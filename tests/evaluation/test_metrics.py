"""Metrics on motions with known values, each criterion of success, statistics, and ComScore."""

from math import comb

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.integrate import quad

import robotdiffuse as rd
from helpers.example_robots import planar_arm
from helpers.panda import HOME, PANDA
from robotdiffuse.core.transforms import rotation_about, transform
from robotdiffuse.evaluation import bench_comparisons, metrics
from robotdiffuse.evaluation.paper import PAPER_TABLE_1
from robotdiffuse.validation.validator import VerifySettings

ARM = planar_arm(0.5, 0.4)
MINIMUM_JERK = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
END = np.array([0.6, -0.4, 0.3, -2.0, 0.2, 1.8, 0.5])


def minimum_jerk(duration: float, start: np.ndarray, end: np.ndarray, rows: int = 501) -> rd.Trajectory:
    s = np.linspace(0, 1, rows)
    way = np.asarray(end) - start
    p, v, a = (MINIMUM_JERK.deriv(k)(s)[:, None] * way / duration**k for k in range(3))
    return rd.Trajectory(tuple(f"j{i}" for i in range(len(way))), s * duration, start + p, v, a)


@pytest.mark.parametrize(
    ("rows", "joint", "link", "tip", "turned"),
    [
        # the arcs between waypoints count, not the chord; the tip is fixed to l2 and does not count as a link
        ([[0, 0], [1.5, 0]], 1.5, 1.5 * 0.5, 1.5 * 0.9, 0),
        ([[0, 0], [0, 0.7], [0, 0]], 1.4, 0, 1.4 * 0.4, np.pi),  # l2 turns about its own origin
        ([[0, 0], [0, 0.6], [0, 0.6], [0.6, 0.6], [0.6, 0]], 1.8, 0.3, None, np.pi),
        ([[0, 0], [1, 1e-7], [2, 0]], 2, 1.0, None, 2e-7),
    ],
)
def test_lengths_of_an_arm_of_two_links(rows, joint, link, tip, turned):
    motion = minimum_jerk(2.0, np.zeros(2), np.array([1.5, 0.0]))
    found = metrics.measured(ARM, rd.Path(motion.joint_names, np.array(rows, float)), motion)
    assert found["joint_length"] == pytest.approx(joint)
    assert found["link_length"] == pytest.approx(link, rel=1e-4, abs=1e-12)
    assert tip is None or found["tip_length"] == pytest.approx(tip, rel=1e-4)
    assert found["turning"] == pytest.approx(turned, rel=1e-6)
    assert found["duration"] == 2.0
    # the tip's speed is 0.9 m times the joint's
    assert found["sparc_tip"] == pytest.approx(found["sparc_joint"], rel=1e-9)


def test_bending_of_a_sine_by_hand() -> None:
    """q = (u, a sin(pi k u)), in units of the path's length; since the amplitude is small, the speed is nearly constant."""
    u = np.linspace(0, 1, 4001)
    a, k = 0.003, 3
    q = np.stack([u, a * np.sin(np.pi * k * u)], axis=1)
    assert metrics.bending(q) == pytest.approx((a * (np.pi * k) ** 2) ** 2 / 2, rel=0.01)
    assert metrics.bending(5 * q) == pytest.approx(metrics.bending(q))
    assert metrics.bending(q[[0, -1]]) == pytest.approx(0, abs=1e-9)


@given(st.floats(0.3, 8), st.floats(0.05, 6))
def test_dimensionless_jerk_of_minimum_jerk_is_720(duration: float, amplitude: float) -> None:
    """For any duration T and amplitude A: the integral of the squared jerk is 720 A^2 / T^5."""
    motion = minimum_jerk(duration, np.zeros(2), np.array([0.6, 0.8]) * amplitude)
    assert metrics.log_dimensionless_jerk(motion) == pytest.approx(np.log(720), abs=0.01)


def test_jerk_of_jumps_of_the_acceleration_by_hand() -> None:
    """Full acceleration, then full braking: three jumps of a, 2a and a, each spread over a row of 10 ms."""
    t = np.linspace(0, 2, 201)
    a = 1.5
    acceleration = np.where(t < 1, a, -a)
    velocity = np.where(t < 1, a * t, a * (2 - t))
    position = np.where(t < 1, a * t**2 / 2, a - a * (2 - t) ** 2 / 2)
    motion = rd.Trajectory(("j0",), t, position[:, None], velocity[:, None], acceleration[:, None])
    integral = (1 + 4 + 1) * a**2 / 0.01
    assert metrics.log_dimensionless_jerk(motion) == pytest.approx(np.log(2**5 / a**2 * integral), abs=1e-9)


@pytest.mark.parametrize("width", [0.1, 0.35, 1.0])
def test_spectral_arc_length_of_a_gaussian(width: float) -> None:
    """Its amplitude is exp(-(2 pi f width)^2 / 2), 0.05 at x = 1 with x = f / last."""
    speed = np.exp(-((np.arange(-6 * width, 6 * width, 0.01) / width) ** 2) / 2)
    c = np.log(20)
    expected = -quad(lambda x: np.hypot(1, 2 * c * x * np.exp(-c * x**2)), 0, 1)[0]
    assert metrics.spectral_arc_length(speed, 0.01) == pytest.approx(expected, abs=0.01)


def test_interrupted_and_shaking_motions_are_less_smooth() -> None:
    straight = minimum_jerk(2.0, np.zeros(2), np.array([1.0, 0.5]))
    half = minimum_jerk(1.0, np.zeros(2), np.array([0.5, 0.25]))
    parts = (half.times, 1.0), (half.positions, half.positions[-1]), (half.velocities, 0), (half.accelerations, 0)
    stopping = rd.Trajectory(half.joint_names, *(np.concatenate([of, of[1:] + more]) for of, more in parts))
    smooth, stops = (metrics.measured(ARM, rd.Path(m.joint_names, m.positions[[0, -1]]), m) for m in (straight, stopping))
    assert stops["sparc_joint"] < smooth["sparc_joint"] - 0.1
    assert stops["sparc_tip"] < smooth["sparc_tip"] - 0.1
    # Two motions of half the length in half the time: 2 * (1/2)^2 * 2^5.
    assert stops["jerk"] == pytest.approx(np.log(16 * 720), abs=0.01)


@pytest.mark.parametrize("rows", [np.zeros((1, 2)), np.zeros((2, 2)), np.ones((5, 2))])
def test_a_motion_that_stands_still_has_figures(rows: np.ndarray) -> None:
    motion = rd.Trajectory(("j0", "j1"), np.linspace(0, 0.01 * (len(rows) - 1), len(rows)), rows, 0 * rows, 0 * rows)
    found = metrics.measured(ARM, rd.Path(motion.joint_names, rows), motion)
    assert found.pop("duration") == motion.duration
    assert set(found) >= {"joint_length", "link_length", "turning", "bending", "jerk", "sparc_tip"}
    assert set(found.values()) == {0.0}


def test_clearance_to_the_scene_and_to_itself_apart() -> None:
    rows = np.stack([HOME, HOME + 0.01])
    ball = rd.Sphere(PANDA.fk(HOME, "panda_link4")[:3, 3] + np.array([0, 0, 0.4]), 0.1)
    path = rd.Path(PANDA.joint_names, rows)
    verdict = rd.verify(rd.Problem(PANDA, rd.Scene([ball]), HOME, rows[1]), path)
    found = metrics.measured(PANDA, path, None, verdict)
    apart = found["scene_clearance"], found["self_clearance"]
    assert apart == pytest.approx((verdict.scene_clearance, verdict.self_clearance), rel=1e-6)
    assert found["min_clearance"] == min(apart) and 0.05 < apart[0] < 0.3
    assert "scene_clearance" not in metrics.measured(PANDA, path)


@pytest.mark.parametrize(("shift", "angle", "kind"), [(0.009, 0, ""), (0.011, 0, "goal"), (0, 14, ""), (0, 16, "goal")])
def test_one_centimeter_and_fifteen_degrees_are_settings(shift: float, angle: float, kind: str) -> None:
    axis = np.array([0.6, 0.0, 0.8])
    T = PANDA.fk(END, "panda_hand")
    T = transform(T[:3, 3] + shift * axis, rotation_about(axis, np.radians(angle)) @ T[:3, :3])
    problem = rd.Problem(PANDA, rd.Scene(), HOME, rd.PoseGoal("panda_hand", T))
    path = rd.Path(PANDA.joint_names, np.stack([HOME, END]))
    loose = VerifySettings(goal_distance=0.012, goal_angle=float(np.radians(17)))
    strict = VerifySettings(goal_distance=0.008, goal_angle=float(np.radians(13)))
    for settings, expected in ((VerifySettings(), kind), (loose, ""), (strict, "goal")):
        violation = rd.verify(problem, path, settings).violation
        assert ("" if violation is None else violation.kind) == expected


def test_intervals_are_wilsons_and_have_the_normal_width() -> None:
    """R. G. Newcombe 1998, table 1, method 3."""
    table = (81, 263, 0.2553, 0.3662), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718), (0, 0, 0.0, 1.0)
    for successes, n, low, high in table:
        assert bench_comparisons.wilson_interval(successes, n) == pytest.approx((low, high), abs=5e-5)
    values = np.random.default_rng(1).normal(3.0, 2.0, 400)
    low, high = bench_comparisons.bootstrap_interval(values)
    half = 1.96 * values.std() / 20
    assert (low, high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.02)
    assert bench_comparisons.bootstrap_interval(values) == (low, high)


def test_paired_success_is_the_exact_test_of_mcnemar() -> None:
    a, b = np.full((2, 100), np.nan)
    a[:80] = b[:80] = 2.0
    b[80:85] = a[85:97] = 2.0
    found = bench_comparisons.compare(a, b)
    assert (found.a_only, found.b_only, found.both, found.neither) == (12, 5, 80, 3)
    assert found.p_success == pytest.approx(2 * sum(comb(17, k) for k in range(6)) / 2**17)
    assert (found.ratio, found.ratio_interval, found.p_length) == (1.0, (1.0, 1.0), 1.0)


def test_paired_lengths_are_the_signed_ranks_of_wilcoxon() -> None:
    """C. Darwin's maize data: rank sums 24 and 96; 1,352 of the 2^15 sign patterns are at least as extreme."""
    differences = np.array([6, 8, 14, 16, 23, 24, 28, 29, 41, -48, 49, 56, 60, -67, 75])
    lengths = np.random.default_rng(0).uniform(1, 9, 15)
    found = bench_comparisons.compare(lengths * np.exp(differences / 1000), lengths)
    assert found.p_length == pytest.approx(0.041259765625)
    assert found.ratio == pytest.approx(np.exp(0.024))
    assert found.ratio is not None and found.ratio_interval is not None
    assert np.exp(0.006) <= found.ratio_interval[0] < found.ratio < found.ratio_interval[1] <= np.exp(0.056)
    back = bench_comparisons.compare(lengths, lengths * np.exp(differences / 1000))
    assert back.p_length == found.p_length
    assert back.ratio == pytest.approx(np.exp(-0.024))
    assert bench_comparisons.compare(np.full(6, 1.1), np.full(6, 1.0)).p_length == pytest.approx(2 / 2**6)


def test_paired_without_common_solutions() -> None:
    found = bench_comparisons.compare(np.array([1.0, np.nan, np.nan]), np.array([np.nan, 1.0, np.nan]))
    assert (found.a_only, found.b_only, found.both, found.neither) == (1, 1, 0, 1)
    assert (found.p_success, found.ratio, found.ratio_interval, found.p_length) == (1.0, None, None, 1.0)
    none = bench_comparisons.compare(np.zeros(0), np.zeros(0))
    assert (none.neither, none.p_success, none.ratio) == (0, 1.0, None)
    still = bench_comparisons.compare(np.zeros(3), np.zeros(3))  # start and goal are the same
    assert (still.ratio, still.p_length) == (1.0, 1.0)


def test_comscore_of_the_papers_table() -> None:
    scores = bench_comparisons.comscores([row.indicators for row in PAPER_TABLE_1])
    by_hand = [
        (0 + 1 + (18.492 - 15.037) / 4.35 + 0) / 4,
        (11.2 / 14.1 + 0 + 0 + 0) / 4,
        (1 + 2.7 / 14.3 + 2.054 / 4.35 + 0) / 4,
        (6.4 / 14.1 + 1.9 / 14.3 + 1 + 1) / 4,
        (11.6 / 14.1 + 4.5 / 14.3 + 4.274 / 4.35 + 585 / 591) / 4,
    ]
    np.testing.assert_allclose(scores, by_hand, rtol=1e-12)
    assert list(np.argsort(scores)) == [1, 2, 0, 3, 4]


def test_where_all_are_equal_all_are_best() -> None:
    same = bench_comparisons.Indicators(90.0, 0.0, 5.0, 1.0)
    np.testing.assert_array_equal(bench_comparisons.comscores([same, same]), [1.0, 1.0])
    np.testing.assert_array_equal(bench_comparisons.comscores([same, same._replace(length=6.0)]), [1.0, 0.75])
    assert bench_comparisons.comscores([]).shape == (0,)
    # unknown figures count as the worst
    nothing = bench_comparisons.Indicators(0.0, 0.0, np.nan, 10.0)
    rows = [bench_comparisons.Indicators(90.0, 2.0, 5.0, 1.0), bench_comparisons.Indicators(95.0, 1.0, 7.0, 3.0), nothing]
    np.testing.assert_allclose(bench_comparisons.normalized(rows), [[90 / 95, 0, 1, 1], [1, 0.5, 0, 7 / 9], [0, 1, 0, 0]])
    np.testing.assert_array_equal(bench_comparisons.normalized([nothing, nothing])[:, 2], [0, 0])
