"""Speeds along a timed path: limits hold from any place, however often the motion is replanned."""

import numpy as np
import pytest

import robotdiffuse as rd
from robotdiffuse.planning.reactive.timed_path import SpeedProfile, TimedPath
from robotdiffuse.trajectories.corner_rounding import BlendedPolyline, half_widths

PANDA = rd.load_robot("panda")
LIMITS = 0.96 * PANDA.acceleration


@pytest.mark.parametrize("seed", range(4))
def test_steps_keep_limits_and_end_at_rest(seed: int) -> None:
    rng = np.random.default_rng(seed)
    waypoints = np.cumsum(rng.normal(size=(6, 7)) * 0.4, axis=0)
    line = BlendedPolyline(waypoints, half_widths(waypoints, np.full(4, 0.1)))
    course = TimedPath(PANDA, LIMITS, line, True)
    left = SpeedProfile(np.zeros(2), np.zeros(2))
    for k in range(400):
        s = float(left.s[0])
        speed = float(left.speeds[0])
        if s >= course.end:
            break
        if k % 7 < 5:  # else the arm brakes for a while
            left = course.on_then_rest(s, speed, 0.02)
            assert left.speeds[0] == pytest.approx(speed, abs=1e-9)
        assert left.speeds[-1] == 0
        times, q = course.coarse(left, 0.002)
        velocities = np.diff(q, axis=0) / 0.002
        assert (np.abs(velocities) <= PANDA.velocity).all()
        assert (np.abs(np.diff(velocities, axis=0) / 0.002) <= PANDA.acceleration).all()
        assert np.array_equal(q[-1], q[-2]) and times[-2] >= left.duration - 1e-9
        assert left.duration < 1.0, "stops that take that long are none"
        left = left.rest(0.02)
    assert left.s[0] >= course.end


def test_fastest_motion_to_the_end_is_that_of_the_timing() -> None:
    """They differ by the margin that the timed path leaves to the limits, about 4 % of accelerations."""
    from robotdiffuse.trajectories.speed_limits import TimingSettings, time_line

    waypoints = np.array([np.zeros(7), np.full(7, 0.8), np.linspace(0, 1, 7)])
    line = BlendedPolyline(waypoints, half_widths(waypoints, np.array([0.1])))
    fastest = time_line(PANDA, line, TimingSettings())[0][-1]
    assert TimedPath(PANDA, LIMITS, line, True).onwards(0.0, 0.0).duration == pytest.approx(fastest, rel=0.05)
