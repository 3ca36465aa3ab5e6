import numpy as np
import pytest

from helpers.box_arm import box_arm
from helpers.refusals import refuses
from robotdiffuse import Problem, Scene, Trajectory, load_planner, verify
from robotdiffuse.core.types import ROWS
from robotdiffuse.validation.rates import rate_violations
from robotdiffuse.validation.validator import VerifySettings


def cubic(steps: int = 7) -> Trajectory:
    """A minimum-acceleration motion, whose positions are one cubic, with rows at uneven times."""
    t = np.linspace(0.0, 1.0, steps) ** 1.3 * 2.0
    u = (t / 2.0)[:, None]
    far = np.array([[1.0, -0.5, 0.2]])
    return Trajectory(("a", "b", "c"), t, u**2 * (3 - 2 * u) * far, 3 * u * (1 - u) * far, (1.5 - 3 * u) * far)


def smooth(legs: int = 1, rate: float = 40.0) -> Trajectory:
    """Minimum-jerk motions of 1 s each, with a wait of 0.5 s between them."""
    u = np.linspace(0.0, 1.0, int(rate) + 1)[:, None]
    far = np.array([[0.9, -0.5, 0.2]])
    q = (10 * u**3 - 15 * u**4 + 6 * u**5) * far
    v = 30 * u**2 * (1 - u) ** 2 * far
    a = 60 * u * (1 - u) * (1 - 2 * u) * far
    shift = [(1.5 * k + u[:, 0], q + k * far) for k in range(legs)]
    times = np.concatenate([s[0] for s in shift])
    positions = np.concatenate([s[1] for s in shift])
    return Trajectory(("a", "b", "c"), times, positions, np.tile(v, (legs, 1)), np.tile(a, (legs, 1)))


def pulse(step: float = 0.004, count: int = 6) -> Trajectory:
    """An accelerating and a braking pulse, each of `count` steps up and down at constant jerk: a few rows at 125 Hz."""
    half = np.concatenate([np.arange(count), np.arange(count, 0, -1)])
    a = 2.0 * np.concatenate([half, -half, [0]])[:, None] * np.array([[1.0, 0.5, -1.0]]) / count
    v = np.concatenate([np.zeros((1, 3)), np.cumsum((a[1:] + a[:-1]) / 2 * step, axis=0)])
    moved = step * (v[1:] + v[:-1]) / 2 - step**2 * (a[1:] - a[:-1]) / 12
    q = np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])
    return Trajectory(("a", "b", "c"), step * np.arange(len(a)), q, v, a)


def test_a_cubic_is_exact_at_any_time():
    rough = cubic()
    fine = cubic(101)
    state = rough.at(fine.times)
    for got, right in zip(state, (fine.positions, fine.velocities, fine.accelerations), strict=False):
        assert np.allclose(got, right, atol=1e-12)
    assert np.allclose(state.jerks, -1.5 * np.array([1.0, -0.5, 0.2]))
    one = rough.at(0.7)
    assert one.jerks.shape == one.positions.shape == (3,)
    assert np.allclose(one.positions, rough.at(np.array([0.7])).positions[0])


def test_times_outside_and_rates_that_are_not_positive_are_refused():
    for time in (-0.1, 2.1, np.nan, np.array([0.5, 3.0])):
        refuses(r"it must be in \[0, 2\]", cubic().at, time)
    for rate in (0, -5, np.inf, np.nan, 1e12):
        refuses("rate is", cubic().resample, rate)


def test_the_largest_jerk_is_that_between_rows_unless_the_ends_jump_and_a_wait_is_one_stop():
    # 60 at both ends of a minimum-jerk motion, whose accelerations are 0 there
    assert np.allclose(smooth(rate=400.0).peak_jerks, 60 * np.array([0.9, 0.5, 0.2]), rtol=0.01)
    assert np.isinf(cubic().peak_jerks).all()
    assert len(smooth().stops) == 0
    assert np.allclose(smooth(3).stops, [1.25, 2.75])


@pytest.mark.parametrize("rate", [125, 250, 500, 1000, 3.3, 0.1])
def test_resampled_times_also_in_files(rate, tmp_path):
    motion = cubic()
    rows = motion.resample(rate)
    motion.save(tmp_path / "motion.csv", rate=rate)
    assert np.allclose(np.loadtxt(tmp_path / "motion.csv", delimiter=",", skiprows=1)[:, 0], rows.times)
    assert np.allclose(rows.times[:-1] * rate, np.arange(len(rows.times) - 1))
    assert rows.duration == motion.duration and (np.diff(rows.times) > 1e-9).all()
    assert (rows.positions[-1] == motion.positions[-1]).all() and (rows.velocities[-1] == 0).all()


@pytest.mark.parametrize("rate", [125, 250, 500, 1000])
def test_resampled_rates_still_keep_limits(rate):
    tolerances = VerifySettings(rate_agreement=0.25)
    for motion in (smooth(), smooth(2), pulse()):
        assert rate_violations(box_arm(), motion, tolerances) == []
        assert rate_violations(box_arm(), motion.resample(rate), tolerances) == []


@pytest.mark.parametrize("rate", [30, 125, 1000])
@pytest.mark.parametrize("size", [1e-6, 1e-5, 1e-4, 3e-4, 1e-2])
def test_short_motions_stay_valid_when_resampled(size, rate):
    """The accelerations of these motions swing within a row or two, and are 0 at both ends."""
    start = np.array([0.1, 0.2, 0.3])
    problem = Problem(box_arm(), Scene(), start, start + size * np.array([1.0, 0.7, -1.0]))
    motion = load_planner("straight_line").plan(problem).trajectory
    assert verify(problem, motion).valid
    report = verify(problem, motion.resample(rate))
    assert report.valid, report.violation


def test_a_trajectory_of_one_row_rests_there():
    """Regression: positions were NaN, and resampling gave two rows at the same time."""
    motion = cubic()
    one = Trajectory(motion.joint_names, *(getattr(motion, name)[:1] for name in ("times", *ROWS)))
    state = one.at(np.zeros(2))
    assert (state.positions == motion.positions[:1]).all() and not state.jerks.any()
    assert one.at(0.0).positions.shape == (3,)
    assert len(one.resample(500).times) == 1
