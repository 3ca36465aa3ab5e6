"""The replanner: every motion ends at rest before an obstacle can reach the arm."""

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import count as counted, pairwise
from threading import Lock
from typing import Any

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.panda import GOAL, PANDA, START
from helpers.refusals import refuses
from robotdiffuse.collision.moving_obstacles import MovingCollision
from robotdiffuse.drawables import drawables
from robotdiffuse.planning.reactive.replanner import JerkFilter, SpeedProfile, TimedPath
from robotdiffuse.robots.motion_bounds import motion_radii
from robotdiffuse.trajectories.speed_limits import jerk_limits
from robotdiffuse.trajectories.timing_kernel import line_with_widths, rounded_line

SPEED = 0.4
PERIOD = 0.02
FLOOR = rd.Box([0, 0, -0.06], [2, 2, 0.1], name="floor")


def balls(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    through = np.column_stack([rng.uniform(0.4, 0.7, count), rng.uniform(-0.3, 0.3, count), [0.5] * count])
    ways = np.column_stack([rng.choice([-1.0, 1.0], count), rng.normal(size=(count, 2)) * [0.3, 0.2]])
    ways = ways[:, [1, 0, 2]]
    velocities = SPEED * rng.uniform(0.5, 0.95, (count, 1)) * ways / np.linalg.norm(ways, axis=1)[:, None]
    return through - rng.uniform(1.5, 2.5, (count, 1)) * velocities, velocities


def loop(places: np.ndarray) -> rd.Replanner:
    moving = [rd.MovingObstacle(rd.Sphere(place, 0.1), max_speed=SPEED) for place in places]
    return rd.Replanner(rd.Problem(PANDA, rd.Scene([FLOOR]), START, GOAL, moving=moving))


@pytest.mark.parametrize(("count", "seed"), [(1, 0), (3, 2)])
def test_every_command_is_a_certified_stop(count: int, seed: int) -> None:
    places, velocities = balls(count, seed)
    replanner = loop(places)
    names = [one.name for one in replanner.problem.moving]
    jerk = jerk_limits(PANDA)
    before = None
    renewed = 0
    for k in range(600):
        now = k * PERIOD
        seen = places + now * velocities
        command = replanner.step(dict(zip(names, seen, strict=True)), now)
        motion = command.motion
        assert command.begins == pytest.approx(now + PERIOD)
        assert np.abs(motion.velocities[-1]).max() == 0
        assert (np.abs(motion.at(np.arange(0.0, motion.duration, 1e-3)).jerks) <= jerk).all()
        if before is not None:  # it goes on as the last one is then
            then = before.motion.at(min(command.begins - before.begins, before.motion.duration))
            for what in ("positions", "velocities", "accelerations"):
                assert np.allclose(getattr(motion, what)[0], getattr(then, what), atol=1e-9)
        if command.renewed:
            renewed += 1
            anywhere = [rd.MovingObstacle(rd.Sphere(place, 0.1), max_speed=SPEED) for place in seen]
            assert MovingCollision(PANDA, anywhere, 1e-4, 0.5).sweep(motion.times + PERIOD, motion.positions).contact is None
            ends = motion.positions[0], motion.positions[-1]
            still = rd.Problem(PANDA, rd.Scene([FLOOR]), *ends, start_velocity=motion.velocities[0])
            violation = rd.verify(still, motion).violation
            assert violation is None, violation
        before = command
        if command.arrived:
            break
    assert command.arrived and renewed > 10
    assert np.allclose(motion.positions[-1], GOAL, atol=1e-9)


def test_same_observations_give_the_same_motions() -> None:
    places, velocities = balls(3, 1)
    loops = loop(places), loop(places)
    names = [one.name for one in loops[0].problem.moving]
    for k in range(60):
        seen = dict(zip(names, places + k * PERIOD * velocities, strict=True))
        one, other = (each.step(seen, k * PERIOD) for each in loops)
        assert np.array_equal(one.motion.positions, other.motion.positions)


def test_a_late_step_finds_the_arm_where_the_last_command_left_it() -> None:
    replanner = loop(np.array([[0.5, 3.0, 0.5]]))
    command = replanner.step({}, 0.0)
    for k in range(1, 15):
        command = replanner.step({}, k * PERIOD)
    assert np.abs(command.motion.velocities[0]).max() > 0.5
    assert np.allclose(replanner.step({}, 15 * PERIOD + 3.0).motion.positions[0], command.motion.positions[-1], atol=1e-9)


def test_steps_of_two_threads_follow_each_other() -> None:
    replanner = loop(np.array([[0.5, 1.5, 0.5]]))
    clock = counted(1)
    commands = list[Any]()
    refused = list[str]()
    reading = Lock()

    def steps(_: int) -> None:
        for _ in range(60):
            with reading:
                now = next(clock) * PERIOD
            try:
                commands.append(replanner.step({}, now))
            except rd.InputError as error:
                refused.append(str(error))

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(2) as threads:
            list(threads.map(steps, range(2)))
    finally:
        sys.setswitchinterval(interval)
    commands.sort(key=lambda command: command.begins)
    assert len(commands) + len(refused) == 120
    assert all("must grow from step to step" in message for message in refused)
    for before, after in pairwise(commands):
        then = before.motion.at(min(after.begins - before.begins, before.motion.duration))
        assert np.allclose(after.motion.positions[0], then.positions, atol=1e-9)


def test_unseen_obstacles_grow_with_time() -> None:
    replanner = loop(np.array([[0.5, 1.6, 0.5]]))
    replanner.step({"sphere": [0.5, 1.6, 0.5]}, 0.0)
    assert not replanner.step({}, 10.0).renewed


def test_an_obstacle_that_is_not_seen_does_not_make_others_grow() -> None:
    """Regression: all grew since the one that was seen longest ago, and the arm stood still for ever."""
    moving = [rd.MovingObstacle(rd.Sphere([0.5, 1.6, 0.5], 0.1), max_speed=SPEED)]
    moving.append(rd.MovingObstacle(rd.Box([3, 3, 0.5], [0.2] * 3, name="door"), max_speed=0.0))
    replanner = rd.Replanner(rd.Problem(PANDA, rd.Scene([FLOOR]), START, GOAL, moving=moving))
    replanner.step({"door": [3, 3, 0.5]}, 0.0)
    assert replanner.step({"sphere": [0.5, 1.6, 0.5]}, 10.0).renewed


def test_a_still_sphere_may_be_turned_and_a_box_may_turn_on_its_track_from_before_time_0() -> None:
    """Regressions: both were refused as too fast; the pose at time 0 was the first of the track."""
    replanner = loop(np.array([[0.5, 1.6, 0.5]]))
    times = np.linspace(-2, 2, 41)
    box = rd.Box([3.0 - 2.0, 3, 0.5], [0.4] * 3, name="cart")
    poses = [rd.pose([3 + t, 3, 0.5], rpy=[0, 0, t + 2]) for t in times]
    cart = rd.MovingObstacle(box, times=times, poses=poses)
    with_cart = rd.Replanner(rd.Problem(PANDA, rd.Scene(), START, GOAL, moving=[cart]))
    for k in range(50):
        replanner.step({"sphere": rd.pose([0.5, 1.6, 0.5], rpy=[0, 0, 0.8])}, k * PERIOD)
        with_cart.step({"cart": cart.pose(k * PERIOD)}, k * PERIOD)
    (drawn,) = drawables(rd.Scene(), [cart])
    assert np.allclose(drawn.surface_at(1.0).vertices.mean(axis=0), cart.pose(1.0)[:3, 3])


def test_a_short_last_part_of_a_path_has_a_grid() -> None:
    """Regression: grid points coincided within 3e-8 rad after the last corner (ZeroDivisionError)."""
    q = np.zeros((3, 7))
    q[1:, 0] = 4.5
    q[2, 1] = 0.04375
    path = TimedPath(PANDA, PANDA.acceleration, line_with_widths(q, np.array([0.04375 - 3e-8])), True)
    assert np.isfinite(path.advance_then_brake(0.0, 0.0).duration)


def test_the_arm_waits_for_an_obstacle_at_the_goal() -> None:
    place = PANDA.fk(GOAL)[:3, 3]
    replanner = loop(place[None])
    for k in range(100):
        command = replanner.step({"sphere": place}, k * PERIOD)
    assert not command.arrived
    for k in range(100, 700):
        command = replanner.step({"sphere": place + 0.3 * PERIOD * (k - 99) * np.eye(3)[1]}, k * PERIOD)
        if command.arrived:
            break
    assert command.arrived


def test_invalid_steps_are_refused() -> None:
    replanner = loop(np.array([[0.5, 1.6, 0.5]]))
    replanner.step({"sphere": [0.5, 1.6, 0.5]}, 0.0)
    for observation, now, message in (
        ({"sphere": [0.5, 1.6, 0.5]}, 0.0, "now is 0 s, but the last step was at 0 s; it must grow"),
        ({"sphere": [0.5, 1.6, 0.5]}, np.nan, "now is nan; it must be a finite number of seconds"),
        ({"ball": [0.5, 1.6, 0.5]}, 0.1, "unknown obstacle in observation: 'ball'"),
        ({"sphere": [0.5, np.nan, 0.5]}, 0.1, r"observation\['sphere'\] is"),
        ({"sphere": [0.5, 1.0, 0.5]}, 0.1, r"observation\['sphere'\]: a point of it can have moved 0.6 m in 0.1 s"),
    ):
        refuses(message, replanner.step, observation, now)


def test_replanners_that_cannot_begin() -> None:
    moving = [rd.MovingObstacle(rd.Sphere([3, 0, 0], 0.1), max_speed=0.1)]
    problem = rd.Problem(PANDA, rd.Scene([FLOOR]), START, GOAL, moving=moving)
    for fields, message in (
        ({"moving": []}, r"problem\.moving is empty"),
        ({"start": [0, 1.5, 0, -0.5, 0, 2.1, 0.8]}, "the replanner cannot begin: the start is in collision"),
        ({"waypoints": [GOAL]}, r"does not support problem\.waypoints"),
        ({"constraints": [rd.AxisCone("panda_hand", [0, 0, 1], [0, 0, -1], 0.2)]}, r"does not support problem\.constraints"),
        ({"payload": rd.Payload(0.5, link="panda_hand")}, r"does not support problem\.payload"),
    ):
        refuses(message, rd.Replanner, replace(problem, **fields))


def test_a_wound_up_arm_is_where_it_rests() -> None:
    """Regression: if a continuous joint began beyond half a turn, no goal was ever reached."""
    gen3 = rd.load_robot("gen3")
    q, goal = ([wound, 0.3, 0.0, -1.2, 0.0, 0.9, 0.0] for wound in (2 * np.pi, 2 * np.pi + 0.2))
    ball = rd.MovingObstacle(rd.Sphere([0.0, -3.0, 0.5], 0.1), max_speed=SPEED)
    replanner = rd.Replanner(rd.Problem(gen3, rd.Scene(), q, goal, moving=[ball]))
    replanner.set_goal(q)
    assert replanner.step({"sphere": [0.0, -3.0, 0.5]}, 0.0).arrived


@pytest.mark.parametrize("goal", ["start", "pose", "here"])
def test_a_new_goal_is_reached_from_where_the_motion_ends(goal: str) -> None:
    replanner = loop(np.array([[0.0, -3.0, 0.5]]))
    seen = {"sphere": [0.0, -3.0, 0.5]}
    command = None
    pose = rd.PoseGoal("panda_hand", PANDA.fk(START))
    for k in range(600):
        command = replanner.step(seen, k * PERIOD)
        if k == 15:
            assert not command.arrived and np.abs(command.motion.velocities).max() > 0.1
            rest = command.motion.positions[-1]
            replanner.set_goal({"start": START, "pose": pose, "here": rest}[goal])
        if command.arrived:
            break
    assert command is not None and command.arrived and k > 15
    assert np.allclose(PANDA.fk(command.motion.positions[-1]), PANDA.fk(rest if goal == "here" else START), atol=1e-4)


def test_a_goal_in_collision_leaves_the_old_one() -> None:
    replanner = loop(np.array([[0.0, -3.0, 0.5]]))
    refuses("cannot take this goal: the goal is in collision", replanner.set_goal, [0, 1.5, 0, -0.5, 0, 2.1, 0.8])
    assert np.allclose(replanner.problem.goal.positions, GOAL)  # type: ignore[union-attr]


@pytest.mark.parametrize("seed", range(2))
def test_limits_hold_at_every_time_however_often_the_arm_brakes(seed: int) -> None:
    """Random paths, jerk limits, steps and periods; each motion continues the last one without a jump."""
    rng = np.random.default_rng(seed)
    jerk = PANDA.acceleration * 10 ** rng.uniform(0.5, 3.0)
    jerk[rng.random(7) < 0.2] = np.inf
    step = rng.choice([0.001, 0.005, 0.01])
    period = rng.choice([0.02, 0.0137])
    waypoints = np.cumsum(rng.normal(size=(5, 7)) * 0.3, axis=0)
    filtered = JerkFilter(PANDA, jerk, step, waypoints[0])
    path = TimedPath(PANDA, filtered.acceleration, rounded_line(waypoints, np.full(3, 0.1)), True)
    given = SpeedProfile(np.zeros(2), np.zeros(2))
    dense = path.positions(path.advance_then_brake(0.0, 0.0), np.arange(0.0, 20.0, 0.002))
    reach = motion_radii(PANDA).max(axis=0)
    since = 0.0
    last = None
    for k in range(400):
        now = k * period
        filtered.advance(path, given, since, now)
        given = given.after(now - since)
        since = now
        if k % 11 < 8 and given.s[0] < path.end:  # else the arm brakes for a while
            given = path.advance_then_brake(float(given.s[0]), float(given.speeds[0]), period)
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


def test_arms_move_off_from_near_the_end_of_a_path_rest_after_it_and_stay_at_a_goal() -> None:
    """Regressions: an arm at rest 0.03 rad before its goal stayed there, a late step asked for 138 TiB, one at a goal swung."""
    line = rounded_line(np.stack([START, GOAL]), np.zeros(0))
    path = TimedPath(PANDA, JerkFilter(PANDA, jerk_limits(PANDA), 0.001, START).acceleration, line, True)
    motion = path.advance_then_brake(path.end - 0.02, 0.0)
    assert motion.s[-1] >= path.end and 0 < motion.duration < 1
    ended = SpeedProfile(np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 0.0]))
    assert ended.after(ended.duration - 1e-13).speeds.tolist() == [0.0]
    far = [rd.MovingObstacle(rd.Sphere([3, 3, 3], 0.1), max_speed=SPEED)]
    command = rd.Replanner(rd.Problem(PANDA, rd.Scene([FLOOR]), START, START, moving=far)).step({}, 0.0)
    assert command.arrived and (command.motion.positions == START).all()
