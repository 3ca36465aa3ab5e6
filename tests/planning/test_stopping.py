"""Motions under way end before what appears in their way."""

from dataclasses import replace

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.explorations import FLOOR, HOME
from robotdiffuse.perception.ray_caster import looking_at, ray_cast
from robotdiffuse.planning.exploration.stopping import braked
from robotdiffuse.trajectories.speed_limits import jerk_limits

PANDA = rd.load_robot("panda")
LEFT, RIGHT = (np.array([turn, *HOME[1:]]) for turn in (1.0, -0.9))
EMPTY = rd.Problem(PANDA, rd.Scene([FLOOR]), LEFT, RIGHT)
BALL = rd.Sphere([0.29, -0.13, 0.52], 0.06, name="ball")
"""Where the hand passes."""
LATENCY = 0.1
"""From an image to the motion that follows from it [s]."""


@pytest.fixture(scope="module")
def motion() -> rd.Trajectory:
    found = rd.plan(EMPTY, time_limit=60.0).trajectory
    assert found is not None
    return found


def explorer_with_view(problem: rd.Problem, q: np.ndarray) -> rd.Explorer:
    """An explorer that saw an empty scene when it chose the motion, and the problem's with the arm at a
    configuration on it, from in front."""
    explorer = rd.Explorer(PANDA, (), rd.Scene([FLOOR]), settings=rd.ExplorerSettings(time_limit=1.0))
    T = looking_at(np.array([1.3, -0.8, 1.1]), np.array([0.3, 0.0, 0.4]))
    camera = (300.0, 300.0, 159.5, 119.5), (320, 240), PANDA
    explorer.observe(ray_cast(EMPTY.scene, T, *camera, LEFT))
    explorer.set_goal(RIGHT)
    explorer.next(LEFT)
    explorer.observe(ray_cast(problem.scene, T, *camera, q))
    return explorer


def test_the_arm_stops_before_a_ball_that_appears(motion: rd.Trajectory) -> None:
    true = replace(EMPTY, scene=rd.Scene([FLOOR, BALL]))
    touched = rd.verify(true, rd.Path(PANDA.joint_names, motion.positions)).violation
    assert touched is not None and "ball" in touched.message
    seen_at = 0.2 * motion.duration
    explorer = explorer_with_view(true, motion.at(seen_at).positions)
    stop = explorer.stop(motion, seen_at + LATENCY)
    assert stop is not None and stop.certified and stop.begins == seen_at + LATENCY
    assert "appeared" in stop.reason
    rest = stop.motion.positions[-1]
    way = np.concatenate([motion.positions[motion.times < stop.begins], stop.motion.positions])
    reached = replace(true, goal=rest)
    report = rd.verify(reached, rd.Path(PANDA.joint_names, way))
    assert report.valid, report.violation
    assert np.abs(motion.positions - rest).max(axis=1).min() < 0.02, "it stays on the path"
    assert explorer.next(rest).kind in ("go", "look", "stuck")
    assert explorer.stop(motion, seen_at) is None, "what was seen before the step is in its motion"


def test_a_motion_that_nothing_is_in_the_way_of_goes_on(motion: rd.Trajectory) -> None:
    apart = replace(EMPTY, scene=rd.Scene([FLOOR, rd.Sphere([-0.5, -0.5, 0.5], 0.1, name="ball")]))
    explorer = explorer_with_view(apart, motion.at(0.2).positions)
    assert explorer.stop(motion, 0.3) is None
    for time in (-0.1, motion.duration + 0.1, np.nan):
        with pytest.raises(rd.InputError, match="time is"):
            explorer.stop(motion, time)


def test_too_late_a_stop_is_not_certified(motion: rd.Trajectory) -> None:
    true = replace(EMPTY, scene=rd.Scene([FLOOR, BALL]))
    touched = rd.verify(true, rd.Path(PANDA.joint_names, motion.positions)).violation
    assert touched is not None
    contact = float(motion.times[int(touched.time)])
    explorer = explorer_with_view(true, motion.at(0.2).positions)
    stop = explorer.stop(motion, contact - 0.03)
    assert stop is not None and not stop.certified


def test_certified_stops_are_free_in_the_true_scene(motion: rd.Trajectory) -> None:
    true = replace(EMPTY, scene=rd.Scene([FLOOR, BALL]))
    explorer = explorer_with_view(true, motion.at(0.05).positions)
    said = []
    for time in np.linspace(0.1, 0.5 * motion.duration, 9):
        stop = explorer.stop(motion, float(time))
        assert stop is not None
        said.append(stop.certified)
        way = np.concatenate([motion.positions[motion.times < time], stop.motion.positions])
        valid = rd.verify(replace(true, goal=way[-1]), rd.Path(PANDA.joint_names, way)).valid
        assert valid or not stop.certified
    assert said[0] and not said[-1], "the later, the harder"


@pytest.mark.parametrize("share", np.linspace(0.0, 0.95, 8))
def test_stops_keep_the_limits_and_begin_as_the_motion_was(motion: rd.Trajectory, share: float) -> None:
    time = float(share * motion.duration)
    stop = braked(PANDA, motion, time)
    state = motion.at(time)
    for rows, wanted in (
        (stop.positions, state.positions),
        (stop.velocities, state.velocities),
        (stop.accelerations, state.accelerations),
    ):
        np.testing.assert_allclose(rows[0], wanted, atol=1e-9)
    assert np.abs(stop.velocities[-1]).max() < 1e-9 and np.abs(stop.accelerations[-1]).max() < 1e-9
    assert (np.abs(stop.velocities) <= PANDA.velocity * (1 + 1e-6)).all()
    assert (np.abs(stop.accelerations) <= PANDA.acceleration * (1 + 1e-3)).all()
    jerks = np.diff(stop.accelerations, axis=0) / np.diff(stop.times)[:, None]
    assert (np.abs(jerks) <= jerk_limits(PANDA) * (1 + 2e-3)).all()
    steps = np.diff(stop.times)[:, None]
    means = 0.5 * (stop.velocities[1:] + stop.velocities[:-1])
    means -= steps / 12 * np.diff(stop.accelerations, axis=0)  # Hermite's rule
    np.testing.assert_allclose(np.diff(stop.positions, axis=0) / steps, means, atol=1e-3)
    assert time + stop.duration <= motion.duration + 0.5
