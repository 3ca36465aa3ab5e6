"""Motions from a start velocity."""

from dataclasses import replace

import numpy as np
import pytest

import robotdiffuse as rd
from robotdiffuse.trajectories.speed_limits import jerk_limits
from robotdiffuse.validation.validator import verify_trajectory

PANDA = rd.load_robot("panda")
START, END = np.array([-1.0, 0.3, 0, -1.8, 0, 2.1, 0.8]), np.array([1.0, 0.3, 0, -1.8, 0, 2.1, 0.8])
VELOCITIES = [np.eye(7)[0] * 2.0, np.array([0.5, 0.1, 0.3, -0.4, 0.1, 0, 0.6]), -np.eye(7)[0]]


@pytest.mark.parametrize("velocity", VELOCITIES)
def test_motions_begin_with_the_start_velocity(velocity: np.ndarray) -> None:
    task = rd.Problem(PANDA, rd.Scene(), START, END, start_velocity=velocity)
    found = rd.load_planner("rrt_connect").plan(task, 60.0)
    assert found.status is rd.Status.SOLVED, found.reason
    assert found.trajectory is not None
    assert np.allclose(found.trajectory.velocities[0], velocity, atol=1e-9)
    assert (np.abs(found.trajectory.velocities) <= PANDA.velocity * (1 + 1e-6)).all()
    assert (np.abs(found.trajectory.accelerations) <= PANDA.acceleration * (1 + 1e-3)).all()
    assert not found.stops and not found.notes
    states = found.trajectory.at(np.arange(0.0, found.trajectory.duration, 1e-4))
    assert (np.abs(states.jerks) <= jerk_limits(PANDA)).all()
    assert not found.trajectory.accelerations[0].any()
    assert verify_trajectory(task, found.trajectory).valid
    at_rest = verify_trajectory(replace(task, start_velocity=None), found.trajectory).violation
    assert at_rest is not None
    assert at_rest.kind in ("rest", "acceleration")


@pytest.mark.parametrize(
    ("velocity", "message"),
    [
        ([0.1] * 6, "start_velocity is .*; it must be 7 finite numbers"),
        ([np.nan] * 7, "start_velocity is .*; it must be 7 finite numbers"),
        ([9.0, 0, 0, 0, 0, 0, 0], "start_velocity: panda_joint1 is 9; its velocity limit is 2.17"),
    ],
)
def test_invalid_start_velocities_are_refused(velocity: list[float], message: str) -> None:
    with pytest.raises(rd.InputError, match=message):
        rd.Problem(PANDA, rd.Scene(), START, END, start_velocity=velocity)


def test_a_start_velocity_in_float32_at_the_limit_is_clamped() -> None:
    limit = np.nextafter(PANDA.velocity.astype(np.float32), np.float32(np.inf))
    assert (limit > PANDA.velocity).all()
    for sign in (1, -1):
        task = rd.Problem(PANDA, rd.Scene(), START, END, start_velocity=sign * limit)
        assert task.start_velocity is not None and task.notes
        assert (np.abs(task.start_velocity) <= PANDA.velocity).all()
        assert all("clamped from" in note for note in task.notes)


def test_a_message_has_the_digits_that_tell_a_velocity_from_its_limit() -> None:
    velocity = 1.00001 * PANDA.velocity
    with pytest.raises(rd.InputError, match=r"panda_joint1 is 2\.17502; its velocity limit is 2\.175$"):
        rd.Problem(PANDA, rd.Scene(), START, END, start_velocity=velocity)


def test_start_velocity_into_a_limit() -> None:
    start = START.copy()
    start[0] = PANDA.upper[0] - 0.01
    task = rd.Problem(PANDA, rd.Scene(), start, END, start_velocity=np.eye(7)[0] * 2.0)
    found = rd.load_planner("rrt_connect").plan(task)
    assert found.status is rd.Status.INVALID_START
    assert "panda_joint1 cannot stop" in found.reason


def test_start_velocity_beyond_what_scaling_leaves() -> None:
    task = rd.Problem(PANDA, rd.Scene(), START, END, start_velocity=np.eye(7)[0] * 2.0)
    with pytest.raises(rd.InputError, match=r"velocity_scaling leaves it 1\.08"):
        rd.load_planner("rrt_connect").plan(task, velocity_scaling=0.5)


def test_a_start_velocity_too_high_to_stop_from_with_little_jerk() -> None:
    task = rd.Problem(PANDA, rd.Scene(), START, END, start_velocity=np.eye(7)[0] * 2.0)
    found = rd.load_planner("rrt_connect").plan(task, jerk=0.1)
    assert found.status is rd.Status.INVALID_START
    assert "panda_joint1 cannot stop" in found.reason


def test_start_velocities_of_nearly_nothing_are_rest() -> None:
    """1e-300 rad/s divided by its square's root, which is 0."""
    assert rd.Problem(PANDA, rd.Scene(), START, END, start_velocity=[1e-300] * 7).start_velocity is None
    assert rd.Problem(PANDA, rd.Scene(), START, END, start_velocity=[1e-5] * 7).start_velocity is not None
