"""Preparing a large scene counts against the time limit, and messages name the step that did not fit."""

from dataclasses import replace

import numpy as np
import pytest

import robotdiffuse as rd
from robotdiffuse.collision import exact_meshes, kernel_arrays
from robotdiffuse.core.deadline import LONG, OutOfTimeError, check_time, check_timing, deadline
from robotdiffuse.planning.search.rrt import RRTConnect
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.trajectories import speed_limits

PANDA = rd.load_robot("panda")
LEFT = np.array([0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
RIGHT = np.array([-0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])


def wall(sides: int = 20) -> rd.Mesh:
    """A wall across the straight path, of two triangles for each square."""
    x, z = np.meshgrid(np.linspace(0.3, 0.6, sides), np.linspace(0.0, 0.5, sides))
    vertices = np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], axis=1)
    at = (np.arange(sides - 1)[:, None] * sides + np.arange(sides - 1)).ravel()
    faces = np.concatenate(
        [np.stack([at, at + 1, at + sides], 1), np.stack([at + 1, at + sides + 1, at + sides], 1)]
    )
    return rd.Mesh(vertices, faces, name="wall")


def problem(*shapes: rd.Mesh | rd.PointCloud) -> rd.Problem:
    return rd.Problem(PANDA, rd.Scene(list(shapes)), LEFT, RIGHT)


def test_steps_are_begun_while_there_is_time_and_long_ones_if_it_is_enough() -> None:
    check_time("anything", 1e9)
    with deadline(lambda: 1.0):
        check_time("a short step")
        check_time("a long step", 0.9)
        with pytest.raises(OutOfTimeError, match=r"a longer step, which takes about 1\.1 s"):
            check_time("a longer step", 1.1)
    with deadline(lambda: 1e-3):
        check_time("a short step", 0.1)
    with deadline(lambda: -1e-3), pytest.raises(OutOfTimeError, match=r"^a short step$"):
        check_time("a short step")
    check_time("anything", 1e9)


def test_timing_is_begun_a_little_late_too() -> None:
    with deadline(lambda: -0.5 * LONG):
        check_timing("a step")
        with pytest.raises(OutOfTimeError, match=r"rows, which takes about 0\.3 s"):
            check_timing("rows", 1.5 * LONG)
    with deadline(lambda: -1.5 * LONG), pytest.raises(OutOfTimeError, match=r"^a step$"):
        check_timing("a step")


@pytest.mark.parametrize("more", [{}, {"jerk": 100.0}, {"velocity_scaling": 0.01}])
def test_a_motion_whose_timing_takes_too_long_is_a_time_out(
    more: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(speed_limits, "SECONDS_PER_ROW", 1e3)
    result = RRTConnect().plan(problem(), 20.0, **more)
    assert result.status is rd.Status.TIMEOUT
    assert "time limit of 20 s is too short for timing: there was no time for the" in result.reason
    assert "rows of a motion of" in result.reason


def test_a_motion_too_long_to_be_validated_ends_the_search() -> None:
    """It went on until its time ran out, and did not say why."""
    joints = tuple(replace(joint, velocity=1e-6) for joint in PANDA.joints)
    slow = rd.Problem(replace(PANDA, joints=joints), rd.Scene(), LEFT, RIGHT)
    result = RRTConnect().plan(slow, 600.0)
    assert result.status is rd.Status.NO_PATH
    assert "the motion takes 1.8" in result.reason


def test_a_grid_of_too_many_points_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_arrays, "GRID_SECONDS_PER_POINT", 1e3)
    result = RRTConnect().plan(problem(wall()), time_limit=20.0)
    assert result.status is rd.Status.TIMEOUT
    assert "time limit of 20 s is too short to prepare the scene" in result.reason
    assert "the grid of" in result.reason


def test_meshes_end_with_the_time() -> None:
    meshes = [wall(sides) for sides in (3, 4, 5)]
    with deadline(iter([1.0, 1.0, -1.0]).__next__), pytest.raises(OutOfTimeError, match="1 of 3 meshes"):
        kernel_arrays.compile_scene_for(PANDA, rd.Scene(meshes))


@pytest.mark.parametrize("cloud", [False, True])
def test_a_tree_of_the_validator_that_takes_too_long_is_refused(
    cloud: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The start collides, so the exact meshes are asked where."""
    tip = link_pose(PANDA, LEFT, PANDA.tip)[:3, 3]
    vertices = wall().vertices - wall().vertices.mean(axis=0) + tip
    asked = problem(rd.PointCloud(vertices, 0.01) if cloud else rd.Mesh(vertices, wall().faces))
    monkeypatch.setattr(exact_meshes, "TREE_SECONDS_PER_ELEMENT", 1e3)
    refused = RRTConnect().plan(asked, time_limit=20.0)
    assert refused.status is rd.Status.TIMEOUT
    assert "the validator's tree over the" in refused.reason
    monkeypatch.undo()
    assert RRTConnect().plan(asked, time_limit=20.0).status is rd.Status.INVALID_START
