"""Planning among moving obstacles, and from a start velocity."""

from dataclasses import replace

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.panda import GOAL, PANDA, START
from helpers.refusals import refuses
from robotdiffuse.certificates.checker import check
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.core.deadline import OutOfTimeError, deadline
from robotdiffuse.planning.pipeline.moving_obstacles import GRID_STEP, WAITED, earliest
from robotdiffuse.trajectories.speed_limits import TimingSettings, jerk_limits
from robotdiffuse.trajectories.timing import StopGraph, time_parameterize

CROSSING = rd.MovingObstacle(rd.Sphere([0.95, 0.0, 0.45], 0.12, name="ball"), velocity=[-0.15, 0, 0])
"""Crosses the path when the arm would pass at full speed, then goes on over the base."""
PASSING = rd.MovingObstacle(rd.Box([0.55, -0.5, 0.4], [0.1, 0.1, 0.8], name="cart"), velocity=[0, 0.3, 0])


def problem(*moving: rd.MovingObstacle, **more: object) -> rd.Problem:
    return rd.Problem(PANDA, rd.Scene(), START, GOAL, moving=moving, **more)  # type: ignore[arg-type]


def clearances(motion: rd.Trajectory, obstacle: rd.MovingObstacle) -> list[float]:
    found = list[float]()
    for t in np.arange(0.0, motion.duration, 0.02):
        exact = ExactCollision(PANDA, rd.Scene([obstacle.at(t)]))
        distances = exact.distances(motion.at(t).positions)
        found.append(min(d.distance for d in distances if d.other not in PANDA.link_names))
    return found


@pytest.mark.parametrize(("obstacle", "jerk"), [(CROSSING, None), (PASSING, 300.0)])
def test_motion_is_certified_in_time(obstacle: rd.MovingObstacle, jerk: float | None) -> None:
    task = problem(obstacle)
    planner = rd.load_planner("rrt_connect")
    assert planner.plan(replace(task, moving=()), 10.0, until="first", jerk=jerk).trajectory is not None
    found = planner.plan(task, 10.0, jerk=jerk)
    assert found.status is rd.Status.SOLVED, found.reason
    assert found.trajectory is not None and rd.verify(task, found.trajectory).valid
    assert found.scene_clearance is not None and 0 < found.scene_clearance <= min(clearances(found.trajectory, obstacle)) + 1e-9


def test_a_start_that_is_hit_at_once_is_invalid_and_a_wall_that_comes_cannot_be_passed() -> None:
    at = rd.MovingObstacle(rd.Sphere([0.3, -0.45, 0.45], 0.2, name="ball"), velocity=[0, 0, 0.1])
    found = rd.load_planner("rrt_connect").plan(problem(at))
    assert found.status is rd.Status.INVALID_START and "touches ball" in found.reason
    wall = rd.MovingObstacle(rd.Box([0, 2.0, 0.5], [4, 0.1, 4], name="wall"), velocity=[0, -2.5, 0])
    found = rd.load_planner("rrt_connect").plan(problem(wall), 1.0)
    assert found.status is rd.Status.TIMEOUT and "passes the moving obstacles" in found.reason


def test_progress_counts_from_the_call() -> None:
    """Regression: it counted from the attempt that found the path; the straight line is blocked for good."""
    ball = rd.MovingObstacle(rd.Sphere([0.55, 0, 0.55], 0.12), velocity=[1e-4, 0, 0])
    ends = [[side, 0.3, 0, -1.8, 0, 2.1, 0.8] for side in (-1.0, 1.0)]
    result = rd.plan(rd.Problem(PANDA, rd.Scene(), *ends, moving=[ball]), 60.0, until="first")
    assert result.progress[-1][0] > 0.1 * result.planning_time


def test_the_earliest_schedule_waits_for_a_passing_obstacle() -> None:
    clear = np.ones((3, 10), bool)
    clear[1, 1:4] = False
    args = np.array([0, 2]), np.array([0]), np.array([1]), np.array([0, 3]), np.array([0, 1, 2])
    way, found = earliest(clear, *args)
    assert found and way == [WAITED] * 4 + [0]
    clear[0, 2] = False  # and it comes by the start before
    assert not earliest(clear, *args)[1]
    with deadline(lambda: -1.0), pytest.raises(OutOfTimeError, match="the grid of times"):
        earliest(clear, *args)


UPRIGHT = rd.AxisCone("panda_hand", [0, 0, 1], [0, 0, -1], 0.2)
BESIDE: dict[str, dict[str, object]] = {
    "waypoints": {"waypoints": [(START + GOAL) / 2 - [0, 0.3, 0, 0, 0, 0, 0], START]},
    "constraints": {"constraints": [UPRIGHT]},
    "payload": {"payload": rd.Payload(2.0)},
    "all": {"waypoints": [[-0.6, *START[1:]]], "constraints": [UPRIGHT]},
}


@pytest.mark.parametrize("asked", BESIDE)
def test_other_requests_hold_among_moving_obstacles(asked: str) -> None:
    if asked == "payload":
        pytest.importorskip("pinocchio", reason="the extra `dynamics` (pin) is not installed")
    obstacle = PASSING if asked == "waypoints" else CROSSING
    task = problem(obstacle, **BESIDE[asked])
    found = rd.load_planner("rrt_connect").plan(task, 20.0)
    assert found.trajectory is not None, found.reason
    motion = found.trajectory
    assert rd.verify(task, motion).valid and min(clearances(motion, obstacle)) > 0
    if task.constraints:
        down = min(-PANDA.fk(q, "panda_hand")[2, 2] for q in motion.positions)
        assert down >= np.cos(UPRIGHT.angle + 1e-6)
    resting = np.abs(motion.velocities).max(axis=1) < 1e-9
    for waypoint in task.waypoints:
        there = np.abs(motion.positions - waypoint.positions[0]).max(axis=1) < 1e-6  # type: ignore[union-attr]
        assert (there & resting).any()
    if asked != "payload":  # of which certificates say nothing
        assert check(rd.certify(task, motion), task).valid


def test_a_stop_at_a_waypoint_is_not_gone_through() -> None:
    """The waypoint is on the straight line, so the motion would not stop by itself; a ball is at the waypoint first."""
    middle = (START + GOAL) / 2
    at = PANDA.fk(middle, "panda_hand")[:3, 3]
    task = problem(rd.MovingObstacle(rd.Sphere(at, 0.08, name="ball"), velocity=[0.3, 0, 0.3]), waypoints=[middle])
    found = rd.load_planner("rrt_connect").plan(task, 20.0)
    assert found.solved, found.reason
    assert rd.verify(task, found.trajectory).valid
    assert found.trajectory.duration > rd.load_planner("rrt_connect").plan(replace(task, moving=()), 20.0).trajectory.duration


def test_corners_are_rounded_as_far_as_the_planner_certified() -> None:
    """Without rounding, the motion stops at the corner; with little, it passes more slowly than by default."""
    path = rd.Path(PANDA.joint_names, np.stack([START, [0.0, 0.9, 0, -1.8, 0, 2.1, 0.8], GOAL]))
    shortest = []
    for deviations in (None, np.zeros(3), np.full(3, 0.02)):
        timing = time_parameterize(PANDA, path, lambda _: True, lambda _: True, deviations=deviations)
        graph = StopGraph(PANDA, timing, TimingSettings(), GRID_STEP)
        ends = 0, len(graph.stops) - 1
        shortest.append(min((m.ticks for m in graph.motions if (m.source, m.target) == ends), default=0))
    assert shortest[1] == 0 < shortest[0] < shortest[2]


def test_each_row_of_a_path_through_waypoints_has_its_corner_deviation() -> None:
    """Regression: the deviations were those of the last segment only."""
    tight = rd.Problem(PANDA, rd.Scene([rd.Sphere([0.55, 0.0, 0.5], 0.15)]), START, GOAL)
    mid = rd.load_planner("aorrtc").plan(tight, 10.0)
    task = replace(tight, waypoints=[mid.trajectory.positions[len(mid.trajectory.times) // 3]])
    found = rd.load_planner("aorrtc").plan(task, 10.0)
    assert found.corner_deviations is not None and len(found.corner_deviations) == len(found.path.positions)
    there = np.abs(found.path.positions - task.waypoints[0].positions[0]).max(axis=1) < 1e-6  # type: ignore[union-attr]
    assert there.any() and not np.array(found.corner_deviations)[there].any()


@pytest.mark.parametrize("velocity", [np.eye(7)[0] * 2.0, np.array([-0.5, 0.1, 0.3, -0.4, 0.1, 0, 0.6])])
def test_motions_begin_with_the_start_velocity(velocity: np.ndarray) -> None:
    task = rd.Problem(PANDA, rd.Scene(), START, GOAL, start_velocity=velocity)
    found = rd.load_planner("rrt_connect").plan(task, 60.0)
    assert found.solved, found.reason
    assert np.allclose(found.trajectory.velocities[0], velocity, atol=1e-9)
    assert not found.stops and not found.notes
    assert (np.abs(found.trajectory.at(np.arange(0.0, found.trajectory.duration, 1e-4)).jerks) <= jerk_limits(PANDA)).all()
    assert not found.trajectory.accelerations[0].any()
    assert rd.verify(task, found.trajectory).valid
    assert rd.verify(replace(task, start_velocity=None), found.trajectory).violation.kind in ("rest", "acceleration")


def test_start_velocities_are_within_the_limits_or_rest() -> None:
    def given(velocity: object) -> rd.Problem:
        return rd.Problem(PANDA, rd.Scene(), START, GOAL, start_velocity=velocity)  # type: ignore[arg-type]

    refuses("start_velocity is .*; it must be 7 finite numbers", given, [np.nan] * 7)
    refuses("start_velocity: panda_joint1 is 9; its velocity limit is 2.17", given, [9.0, 0, 0, 0, 0, 0, 0])
    refuses(r"panda_joint1 is 2\.17502; its velocity limit is 2\.175$", given, 1.00001 * PANDA.velocity)
    limit = np.nextafter(PANDA.velocity.astype(np.float32), np.float32(np.inf))
    assert (limit > PANDA.velocity).all()
    for task in (given(limit), given(-limit)):
        assert task.start_velocity is not None and (np.abs(task.start_velocity) <= PANDA.velocity).all()
        assert task.notes and all("clamped from" in note for note in task.notes)
    # 1e-300 rad/s divided by its square's root, which is 0
    assert given([1e-300] * 7).start_velocity is None and given([1e-5] * 7).start_velocity is not None


@pytest.mark.parametrize(("first", "jerk"), [(PANDA.upper[0] - 0.01, None), (START[0], 0.1)])
def test_a_start_velocity_that_cannot_stop_is_invalid(first: float, jerk: float | None) -> None:
    task = rd.Problem(PANDA, rd.Scene(), np.array([first, *START[1:]]), GOAL, start_velocity=np.eye(7)[0] * 2.0)
    found = rd.load_planner("rrt_connect").plan(task, jerk=jerk)
    assert found.status is rd.Status.INVALID_START and "panda_joint1 cannot stop" in found.reason
    refuses(r"velocity_scaling allows 1\.08", rd.load_planner("rrt_connect").plan, task, velocity_scaling=0.5)
