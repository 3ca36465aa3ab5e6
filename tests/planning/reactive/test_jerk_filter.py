"""Jerk limits of motions that are replanned while the arm moves."""

import numpy as np
import pytest

import robotdiffuse as rd
from robotdiffuse.planning.reactive.timed_path import JerkFilter, SpeedProfile, TimedPath
from robotdiffuse.robots.motion_bounds import motion_radii
from robotdiffuse.trajectories.corner_rounding import BlendedPolyline, half_widths

PANDA = rd.load_robot("panda")


@pytest.mark.parametrize("seed", range(10))
def test_limits_hold_at_every_time_however_often_the_arm_brakes(seed: int) -> None:
    """Random paths, jerk limits, steps and periods; each motion goes on exactly as the last one."""
    rng = np.random.default_rng(seed)
    jerk = PANDA.acceleration * 10 ** rng.uniform(0.5, 3.0)
    jerk[rng.random(7) < 0.2] = np.inf
    step = rng.choice([0.001, 0.005, 0.01])
    period = rng.choice([0.02, 0.0137])
    waypoints = np.cumsum(rng.normal(size=(5, 7)) * 0.3, axis=0)
    line = BlendedPolyline(waypoints, half_widths(waypoints, np.full(3, 0.1)))
    filtered = JerkFilter(PANDA, jerk, step, waypoints[0])
    path = TimedPath(PANDA, filtered.acceleration, line, True)
    given = SpeedProfile(np.zeros(2), np.zeros(2))
    dense = path.coarse(path.onwards(0.0, 0.0), 0.002)[1]
    reach = motion_radii(PANDA).max(axis=0)
    since = 0.0
    last = None
    for k in range(400):
        now = k * period
        filtered.advance(path, given, since, now)
        given = given.rest(now - since)
        since = now
        if k % 11 < 8 and given.s[0] < path.end:  # else the arm brakes for a while
            given = path.on_then_rest(float(given.s[0]), float(given.speeds[0]), period)
        motion = filtered.follow(path, given)
        states = motion.at(np.arange(0.0, motion.duration, 1e-4))
        assert (np.abs(states.velocities) <= PANDA.velocity).all()
        assert (np.abs(states.accelerations) <= PANDA.acceleration).all()
        assert (np.abs(states.jerks) <= jerk * (1 + 1e-6)).all()
        # the jerk is constant between rows
        change = states.velocities[1:] - states.velocities[:-1]
        mean = (states.accelerations[1:] + states.accelerations[:-1]) / 2
        assert np.abs(change - 1e-4 * mean).max() < 1e-4 * 1e-2 * PANDA.acceleration.max()
        assert not motion.velocities[-1].any() and not motion.accelerations[-1].any()
        if last is not None:
            then = last.at(min(period, last.duration))
            for what, most in (("positions", 2e-6), ("velocities", 2e-5), ("accelerations", 0.02)):
                assert np.allclose(getattr(motion, what)[0], getattr(then, what), atol=most)
        off = np.abs(motion.positions[:1] - dense) @ reach
        assert off.min() <= filtered.displacement + 0.005
        last = motion
        if filtered.at_rest and given.s[0] >= path.end:
            break
    assert np.array_equal(motion.positions[-1], waypoints[-1])
