"""The validator: motions that it must reject, motions that it must accept, and its certified clearances."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, strategies as st

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.panda import PANDA
from helpers.refusals import refuses
from helpers.sphere_oracles import random_shape
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.scenes.shapes import Shape
from robotdiffuse.trajectories.cubics import Cubics
from robotdiffuse.trajectories.speed_limits import TimingSettings
from robotdiffuse.trajectories.timing import time_parameterize
from robotdiffuse.validation.rates import rate_violations
from robotdiffuse.validation.report import Report, Violation
from robotdiffuse.validation.validator import VerifySettings, verifier, violations

RATES = VerifySettings()


def vector(*values: float) -> np.ndarray:
    return np.array(values, float)


def validator(rows: np.ndarray, *shapes: Shape, robot: rd.Robot | None = None, **settings: float) -> Report:
    """The report on a path for the problem from its first to its last waypoint."""
    robot = robot or box_arm()
    problem = rd.Problem(robot, rd.Scene(shapes), rows[0], rd.JointGoal(rows[-1:]))
    return rd.verify(problem, rd.Path(robot.joint_names, rows), VerifySettings(**settings))  # type: ignore[arg-type]


def refused(report: Report, kind: str) -> Violation:
    assert not report.valid and report.min_clearance is None and report.violation is not None
    assert report.violation.kind == kind, report.violation
    assert "\n" not in report.violation.message
    return report.violation


def dense(rows: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Configurations at most `step` apart in any joint along a path, and their indices with fractions."""
    counts = np.maximum(np.ceil(np.abs(np.diff(rows, axis=0)).max(axis=1) / step).astype(int), 1)
    where = np.concatenate([*(i + np.arange(n) / n for i, n in enumerate(counts)), [len(rows) - 1.0]])
    return np.stack([np.interp(where, np.arange(len(rows)), column) for column in rows.T], axis=1), where


SWING = np.array([[-0.6, 0.2, 0.3], [0.6, 0.2, 0.3]])


def test_a_free_motion_is_accepted_with_a_certified_clearance() -> None:
    shapes = (rd.Sphere(vector(1.3, 0.3, 0), 0.1), rd.Sphere(vector(0, -1, 0), 0.2))
    report = validator(SWING, *shapes)
    assert report.valid and report.violation is None
    exact = ExactCollision(box_arm(), rd.Scene(shapes))
    every = np.array([[d.distance for d in exact.distances(q)] for q in dense(SWING, 0.01)[0]])
    for found, least in ((report.scene_clearance, every[:, :3].min()), (report.self_clearance, every[:, 3:].min())):
        assert found is not None
        # Spheres stick out of the boxes by 2 cm, towards each other by 4; the certificate may give away half.
        assert 0.5 * (least - 0.04) <= found <= least
    assert report.min_clearance == report.scene_clearance


def test_an_empty_scene_and_a_motion_of_one_waypoint() -> None:
    report = validator(np.zeros((1, 3)))
    assert report.valid and report.min_clearance is not None and 0.2 < report.min_clearance < 0.4
    assert report.scene_clearance == pytest.approx(1.0, abs=1e-4) and report.self_clearance == report.min_clearance
    refused(validator(vector(1, 2.6, 2.6)[None]), "self_collision")
    assert validator(np.zeros((3, 3))).valid


@given(st.floats(0.02, 0.98), st.floats(0.25, 1.1), st.floats(0.0005, 0.01), st.integers(0, 3), st.booleans())
def test_thin_walls_on_the_way_are_found(share: float, reach: float, thickness: float, extra: int, spheres: bool) -> None:
    """A straight arm swings through a wall that coarse sampling may miss."""
    angle = -1 + 2 * share
    turn = vector(np.cos(angle / 2), 0, 0, np.sin(angle / 2))
    wall = rd.Box(reach * vector(np.cos(angle), np.sin(angle), 0), vector(0.2, thickness, 0.5), turn)
    rows = np.zeros((2 + extra, 3))
    rows[:, 0] = np.linspace(-1, 1, len(rows))
    if np.abs(angle - rows[[0, -1], 0]).min() < np.arctan2(0.03 + thickness / 2, reach - 0.1):
        return
    found = refused(validator(rows, wall, robot=box_arm(spheres)), "scene_collision")
    assert found.other == "box"
    q, at = dense(rows, 1e-3)
    first = at[ExactCollision(box_arm(), rd.Scene([wall])).collides(q)].min()
    assert first - 0.02 < found.time < first + 0.002


def scattered(rng: np.random.Generator) -> list[Shape]:
    """Up to four shapes at random places in the plane of the arm."""
    shapes = [random_shape(kind, rng) for kind in rng.choice(["sphere", "box", "cylinder"], rng.integers(0, 4))]
    at = vector(*rng.uniform(-1.2, 1.2, 2), 0) + rng.normal(size=(30, 3)) * 0.1
    flat: list[Shape] = [replace(one, center=one.center * [1.2, 1.2, 0.1]) for one in shapes]  # type: ignore
    return [*flat, rd.PointCloud(at, 0.01)] if rng.random() < 0.5 else flat


@given(st.integers(0, 2**31), st.integers(2, 5))
def test_the_certificate_agrees_with_dense_sampling(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    shapes = scattered(rng)
    rows = rng.uniform(-2, 2, (1, 3)) + rng.uniform(-0.8, 0.8, (count, 3))
    report = validator(rows, *shapes)
    exact = ExactCollision(box_arm(), rd.Scene(shapes))
    q, at = dense(rows, 2e-3)
    hits = exact.collides(q)
    if report.valid:
        assert not hits.any() and report.min_clearance is not None
        assert 0 < report.min_clearance <= min(d.distance for row in q[::50] for d in exact.distances(row))
        return
    found = report.violation
    assert found is not None and found.excess is not None
    if not hits.any():  # a touch between the samples: no deeper than they are apart
        assert found.excess < 2e-3 * 3 * 1.2
        return
    # The first contact is located to 1 mm of motion, and counts from a gap of 0.1 mm on.
    here = np.stack([np.interp(found.time, np.arange(count), column) for column in rows.T])
    distances = [d for d in exact.distances(here) if d.link == found.subject]
    assert min(d.distance for d in distances) <= 1.001e-4 and not hits[at < found.time - 0.02].any()
    assert found.time <= at[hits].min() + 1e-6 + 0.01


def test_the_first_of_two_collisions_is_reported() -> None:
    early, late = (rd.Sphere(1.1 * vector(np.cos(a), np.sin(a), 0), 0.05, name) for a, name in ((0.1, "b"), (0.5, "a")))
    rows = np.array([[-0.6, 0, 0], [0.2, 0, 0], [1.0, 0, 0]])
    forward = validator(rows, early, late)
    assert refused(forward, "scene_collision").other == "b"
    assert refused(validator(rows[::-1].copy(), early, late), "scene_collision").other == "a"
    found = refused(forward, "scene_collision")
    assert found.subject == "l3"
    # The contact begins where the arm's edge meets the sphere and is deepest in its middle.
    assert found.time == pytest.approx((0.6 + 0.1 - np.arcsin(0.08 / 1.1)) / 0.8, abs=0.003)
    assert found.excess == pytest.approx(0.08, abs=0.006)
    assert found.message.startswith("l3 is 7.") or found.message.startswith("l3 is 8.0 cm inside b")


def test_a_contact_with_two_obstacles_at_once_has_a_depth() -> None:
    """The arm starts inside two obstacles: the deeper contact is reported, in either order of the obstacles."""
    deep = rd.Sphere(vector(1.1, 0.02, 0), 0.1, "deep")
    shallow = rd.Sphere(vector(1.15, 0.12, 0), 0.1, "shallow")
    for shapes in ((deep, shallow), (shallow, deep)):
        found = refused(validator(np.array([[0, 0, 0], [-0.5, 0, 0]]), *shapes), "scene_collision")
        assert (found.time, found.subject, found.other) == (0, "l3", "deep") and found.excess == pytest.approx(0.11, abs=0.003)


def test_self_collision_between_waypoints() -> None:
    rows = np.array([[0, 2.7, 1.0], [0, 2.7, 2.7]])
    found = refused(validator(rows), "self_collision")
    assert {found.subject, found.other} == {"l1", "l3"} and 0 < found.time < 1
    allowed = frozenset({*box_arm().allowed_collisions, frozenset(("l1", "l3"))})
    assert validator(rows, robot=replace(box_arm(), allowed_collisions=allowed)).valid


def test_meshes_decide_where_spheres_are_too_coarse() -> None:
    shelf = rd.Box(vector(0.6, 0, -0.032 - 0.05), vector(1.5, 1.5, 0.1))
    sides = trimesh.creation.box(shelf.size)
    for shape in (shelf, rd.Mesh(np.asarray(sides.vertices), np.asarray(sides.faces), shelf.center)):
        report = validator(SWING, shape)
        assert report.min_clearance is not None and 0.001 <= report.min_clearance <= 0.002
    touching = rd.Box(vector(0.6, 0, -0.03005 - 0.05), vector(1.5, 1.5, 0.1))
    assert refused(validator(SWING, touching), "scene_collision").time == 0
    assert validator(SWING[:1], touching, contact=1e-5).valid


def problem_and_path(rows: np.ndarray) -> tuple[rd.Problem, rd.Path]:
    robot = box_arm()
    return rd.Problem(robot, rd.Scene(), SWING[0], rd.JointGoal(SWING[1:])), rd.Path(robot.joint_names, rows)


def test_limits_start_and_goal() -> None:
    found = refused(rd.verify(*problem_and_path(np.array([SWING[0], [0, 2.8 + 1e-3, 0], [0, 2.9, 0], SWING[1]]))), "limits")
    assert (found.subject, found.time) == ("j1", 1.0) and found.excess == pytest.approx(1e-3)
    assert rd.verify(*problem_and_path(np.array([SWING[0], [0, 2.8 + 1e-7, 0.5], SWING[1]]))).valid
    assert refused(rd.verify(*problem_and_path(SWING + vector(1e-4, 0, 0))), "start").time == 0
    found = refused(rd.verify(*problem_and_path(SWING + np.array([[0, 0, 0], [0, 2e-4, 0]]))), "goal")
    assert found.time == 1 and found.excess == pytest.approx(2e-4)
    assert rd.verify(*problem_and_path(SWING + np.array([[0, 0, 0], [0, 5e-5, 0]]))).valid
    problem, path = problem_and_path(SWING)
    assert rd.verify(replace(problem, goal=rd.JointGoal(np.stack([SWING[0], SWING[1], -SWING[1]]))), path).valid
    assert refused(rd.verify(*problem_and_path(SWING + np.array([[0, 0, 0], [0, 0, np.nan]]))), "not_finite").time == 1


def test_the_earliest_of_different_violations_is_reported_unless_collision_alone_is_asked_for() -> None:
    rows = np.array([[-0.6, 0, 0], [0.6, 0, 0], [0.6, 2.9, 0]])
    path = rd.Path(box_arm().joint_names, rows)
    for shapes, kind in (([rd.Sphere(vector(1.2, 0, 0), 0.05)], "scene_collision"), ([], "limits")):
        problem = rd.Problem(box_arm(), rd.Scene(shapes), rows[0], rd.JointGoal(rows[:1]))
        refused(rd.verify(problem, path), kind)
        assert verifier(replace(problem, start=rows[1]), VerifySettings()).collision_free(path) == (kind == "limits")


@pytest.mark.parametrize("spacing", [0.3, 0.02])
def test_twitching(spacing: float) -> None:
    """Back and forth along one line, in long steps or densely sampled."""
    there = np.linspace(0, 0.3, round(0.3 / spacing), endpoint=False)
    along = np.concatenate([there, 0.3 - there, there, 0.3 - there, there, [0.3]])
    rows = np.column_stack([along, np.zeros((len(along), 2))])
    assert "4 sharp reversals" in refused(validator(rows), "twitch").message
    assert validator(rows, reversals=4).valid and validator(rows, reversal_step=0.5).valid
    assert validator(rows * 0.1).valid


def trajectory(duration: float) -> rd.Trajectory:
    """A smooth swing from rest to rest with this duration."""
    s = np.linspace(0, 1, 101)
    span = SWING[1] - SWING[0]
    way, speed, push = (share[:, None] * span for share in (3 * s**2 - 2 * s**3, 6 * s - 6 * s**2, 6 - 12 * s))
    return rd.Trajectory(box_arm().joint_names, s * duration, SWING[0] + way, speed / duration, push / duration**2)


def strong(acceleration: float) -> rd.Robot:
    return replace(box_arm(), joints=tuple(replace(j, acceleration=acceleration) for j in box_arm().joints))


def verified(motion: rd.Trajectory, *shapes: Shape, robot: rd.Robot | None = None) -> Report:
    robot = robot or box_arm()
    return rd.verify(rd.Problem(robot, rd.Scene(shapes), motion.positions[0], rd.JointGoal(motion.positions[-1:])), motion)


def wrong_rates(motion: rd.Trajectory, robot: rd.Robot | None = None) -> dict[str, str]:
    """The messages of violations of velocities and accelerations, by kind. The validator must refuse the motion."""
    assert not verified(motion, robot=robot).valid
    return {wrong.kind: wrong.message for wrong in rate_violations(robot or box_arm(), motion, RATES)}


def test_trajectories() -> None:
    """Regression: `rd.verify` took a trajectory for a path and called it valid at any speed."""
    assert verified(trajectory(2.0)).valid
    refused(verified(trajectory(0.5)), "acceleration")
    # The peak speed is 1.5 * 1.2 / duration, the peak acceleration 6 * 1.2 / duration^2.
    assert refused(verified(trajectory(0.94)), "acceleration").time == 0
    found = refused(verified(trajectory(0.8), robot=strong(20.0)), "velocity")
    assert found.subject == "j0" and found.excess == pytest.approx(1.5 * 1.2 / 0.8 - 2.0, abs=0.25)
    late = rd.Sphere(1.1 * vector(np.cos(0.8), np.sin(0.8), 0), 0.05)
    assert 1.0 < refused(verified(trajectory(2.0), late), "scene_collision").time < 2.0


def test_trajectories_that_jump_or_run_backwards() -> None:
    good = trajectory(2.0)
    positions = good.positions.copy()
    positions[50:60, 1] += 0.3
    found = refused(verified(replace(good, positions=positions)), "jump")
    assert found.subject == "j1" and found.time == pytest.approx(0.98)
    times = good.times.copy()
    times[7] = times[6]
    assert "from row 6 to row 7" in refused(verified(replace(good, times=times)), "time").message
    assert "times begin at 5 s, not" in refused(verified(replace(good, times=good.times + 5)), "time").message
    refused(verified(replace(good, velocities=np.full_like(good.velocities, np.inf))), "not_finite")
    refused(verified(trajectory(3e9)), "time")


def test_motions_of_another_shape_or_other_joints_raise() -> None:
    for rows in (np.zeros((0, 3)), np.zeros((2, 4))):
        refuses(r"path.positions has shape .* it must be n x 3 with n >= 1", rd.verify, *problem_and_path(rows))
    problem, path = problem_and_path(SWING)
    refuses(r"path.joint_names is j2, j1, j0; .* are j0, j1, j2", rd.verify, problem, rd.Path(path.joint_names[::-1], SWING))
    for name, cut in (
        ("times", lambda times: times[0]),
        ("velocities", lambda rates: rates[1:]),
        ("velocities", lambda rates: rates[:, 0]),
        ("accelerations", lambda rates: rates[:, :1]),
        ("positions", lambda q: q[:, :2]),
    ):
        good = trajectory(2.0)
        object.__setattr__(good, name, np.asarray(cut(getattr(good, name))))
        refuses(rf"trajectory\.{name} has shape .*; it must be", rd.verify, problem, good)


@pytest.mark.parametrize(("factor", "jumps"), [(1.0, False), (1.02, False), (1.49, False), (1.6, True)])
def test_times_compressed_under_rates_of_zero(factor: float, jumps: bool) -> None:
    """Velocities and accelerations too small for the positions are computed anew; by its own, this motion stops at each row."""
    good = trajectory(1.5 * 1.2 / 2.0 * 1.0001)  # as fast as the limit of 2 rad/s allows
    assert verified(good, robot=strong(1e3)).valid
    still = np.zeros_like(good.velocities)
    quick = replace(good, times=good.times / factor, velocities=still, accelerations=still)
    assert wrong_rates(quick, strong(1e3)).keys() == {"velocity", "acceleration", "rates", *(["jump"] if jumps else [])}


def test_rates_that_are_not_those_of_the_positions() -> None:
    good = trajectory(1.0)
    for factor in (-1, 0):
        found = wrong_rates(replace(good, velocities=factor * good.velocities))
        assert found.keys() == {"rates", "velocity", "acceleration"} and "veloc" in found["rates"]
        found = wrong_rates(replace(good, accelerations=factor * good.accelerations))
        assert found.keys() == {"rates"} and "accel" in found["rates"]
    # the rate in a message has its sign
    ways = (good.positions, good.positions[::-1])
    messages = [wrong_rates(replace(good, positions=q, velocities=0 * q, accelerations=0 * q))["rates"] for q in ways]
    there, back = (float(message.split(" is ")[1].split(",")[0]) for message in messages)
    assert there == pytest.approx(-back, rel=1e-3)


@pytest.mark.parametrize("end", [0, -1])
def test_motions_begin_and_end_at_rest(end: int) -> None:
    """By their velocities and, if these are 0, by their positions."""
    good = trajectory(2.0)
    moving = good.velocities.copy()
    moving[end, 0] = 0.5
    assert "rest" in wrong_rates(replace(good, velocities=moving))
    times = np.linspace(0, 1.2, 121)
    rates = np.tile((SWING[1] - SWING[0]) / 1.2, (121, 1))
    steady = SWING[0] + times[:, None] * rates
    rates[[0, -1]] = 0
    refused(verified(rd.Trajectory(good.joint_names, times, steady, rates, 0 * rates)), "acceleration")
    # Regressions: a motion of one row passed at rest; the message on a velocity in the wrong direction had no sign
    problem = rd.Problem(box_arm(), rd.Scene(), SWING[0], rd.JointGoal(SWING[1:]), start_velocity=[0.3, 0, 0])
    still = rd.Trajectory(good.joint_names, np.zeros(1), SWING[:1], 0 * SWING[:1], 0 * SWING[:1])
    assert "start_velocity 0.3" in refused(rd.verify(replace(problem, goal=problem.start), still), "rest").message
    back = replace(good, velocities=good.velocities - np.eye(101, 3) * [0.3, 0, 0])
    assert "velocity is -0.3" in {v.kind: v.message for v in rd.verify(problem, back).found}["rest"]


@given(st.integers(0, 2**31), st.sampled_from([1e-4, 0.01, 0.05, 0.3]))
def test_no_motion_within_the_limits_is_refused(seed: int, most: float) -> None:
    """Full acceleration, coasting and braking in random order; rows where it jumps make the cubics equal the motion."""
    rng = np.random.default_rng(seed)
    robot = box_arm()
    count = 800 if most < 1e-3 else 40
    fine = np.repeat(rng.choice([-1.0, 0.0, 1.0], (12, 3)), count, axis=0) * robot.acceleration[0]
    step = 0.5 * robot.velocity[0] / np.abs(np.cumsum(fine, axis=0)).max()
    fine = np.concatenate([fine, -fine])  # back to rest
    speed = np.concatenate([np.zeros((1, 3)), np.cumsum(fine, axis=0)]) * step
    place = np.concatenate([np.zeros((1, 3)), np.cumsum((speed[1:] + speed[:-1]) / 2, axis=0)]) * step
    every = max(int(most / step), 1)
    jumps = np.arange(0, len(place), count)
    rows = np.unique(np.concatenate([jumps, rng.choice(len(place), len(place) // every + 1), [len(place) - 1]]))
    accelerations = np.concatenate([fine, fine[-1:]])[rows]
    place += rng.uniform(-1, 1, place.shape) * 0.99 * RATES.limit_slack
    motion = rd.Trajectory(robot.joint_names, rows * step, place[rows], speed[rows], accelerations)
    assert not {w.message for w in rate_violations(robot, motion, replace(RATES, rate_agreement=2.0))}


def in_micro_steps(step: float, time: float, way: float) -> rd.Trajectory:
    """A motion at constant speed, in steps at the resolution of positions, with written velocities of zero."""
    count = np.arange(round(way / step) + 1.0)
    rows = np.outer(count * step, [1, 0, 0])
    return rd.Trajectory(box_arm().joint_names, count * time, rows, 0 * rows, 0 * rows)


@pytest.mark.parametrize(("step", "time"), [(1.9e-6, 1e-8), (1.9e-6, 1e-7), (1.9e-6, 5e-7), (1.0, 5e-324)])
def test_micro_steps_hide_no_velocity(step: float, time: float) -> None:
    """Each step is within the resolution of positions; together, the steps are 1.9 to 95 times as fast as the arm."""
    assert "j0 at" in wrong_rates(in_micro_steps(step, time, max(step, 0.01)))["velocity"]


@pytest.mark.parametrize("back", [False, True])
def test_micro_steps_hide_no_acceleration(back: bool) -> None:
    """The motion keeps the velocity limit, but is at 1.9 rad/s at once; with `back`, back and forth within 1 ms."""
    quick = in_micro_steps(1.9e-6, 1e-6, 0.01)
    if back:
        place = 1e-3 * np.abs((quick.times / 1e-3 + 0.5) % 1 - 0.5)
        quick = replace(quick, positions=np.outer(place, [1.9, 0, 0]))
    found = wrong_rates(quick)
    assert found.keys() == {"rates", "acceleration"} and "by its positions over 1 ms and more" in found["acceleration"]


def test_rows_far_apart_are_validated_as_controllers_move_between_them() -> None:
    """The arm moves out and back within one step: both rows of the step have equal positions."""
    robot = box_arm()
    of_first_joint = [0, 0.5, 0.5, 0], [0, 1, -1, 0], [1, 0, -2, 2]
    out = rd.Trajectory(robot.joint_names, np.arange(4.0), *(np.outer(values, [1.0, 0, 0]) for values in of_first_joint))
    assert verified(out).valid
    ball = rd.Sphere(1.1 * vector(np.cos(0.73), np.sin(0.73), 0), 0.02)
    assert 1.0 < refused(verified(out, ball), "scene_collision").time < 1.5
    times, positions = Cubics(out).sampled(1e-3)[:2]
    assert np.isin(out.times, times).all()
    assert np.abs(positions[:, 0]).max() == pytest.approx(0.75, abs=1e-3)


def test_jerk_is_reported_and_not_required() -> None:
    robot = rd.load_robot("ur5e")
    rows = np.array([[0.0, -1.5, 1.5, -1.5, -1.5, 0.0], [1.0, -1.2, 1.0, -1.5, -1.0, 0.0]])
    problem = rd.Problem(robot, rd.Scene(), rows[0], rd.JointGoal(rows[-1:]))
    path = rd.Path(robot.joint_names, rows)
    timings = (time_parameterize(robot, path, yes, yes, TimingSettings(jerk=jerk)) for jerk in (None, np.inf))
    reports = [rd.verify(problem, timing.trajectory) for timing in timings]
    limited, free = [report.jerk_share for report in reports]
    assert all(report.valid for report in reports) and limited is not None and free is not None
    assert 0.5 < limited <= 1 + 1e-6 < 5 < free


def yes(_: object) -> bool:
    return True


def between_rest(
    rows: np.ndarray, times: list[float], speeds: np.ndarray | None = None, robot: rd.Robot | None = None
) -> rd.Trajectory:
    """A trajectory with these velocities (by default 0) and the accelerations of its cubics."""
    v = np.zeros_like(rows) if speeds is None else speeds
    bare = rd.Trajectory((robot or box_arm()).joint_names, np.array(times), rows, v, np.zeros_like(rows))
    start, end = bare.cubic_accelerations
    return replace(bare, accelerations=(np.concatenate([start[:1], end]) + np.concatenate([start, end[-1:]])) / 2)


@pytest.mark.parametrize(("factor", "valid"), [(0.99, True), (1.03, False)])
def test_rates_between_two_rows_are_those_of_the_cubic(factor: float, valid: bool) -> None:
    """From rest to rest, the cubic reaches 1.5 times the mean velocity, and at its ends 6 times that over the duration."""
    robot = box_arm()
    report = verified(between_rest(SWING, [0.0, 1.5 * 1.2 / (factor * robot.velocity[0])]), robot=strong(1e3))
    assert report.valid if valid else refused(report, "velocity").subject == "j0"
    motion = between_rest(SWING, [0.0, np.sqrt(6 * 1.2 / (factor * robot.acceleration[0]))])
    report = verified(motion)
    assert report.valid if valid else refused(report, "acceleration").subject == "j0"
    assert not verified(replace(motion, accelerations=np.zeros_like(SWING))).valid


def test_limits_hold_between_rows() -> None:
    """Both rows are just within a limit, and the cubic between them exceeds it by 1.25 mrad."""
    high = box_arm().upper[1] - 0.5e-3
    rows = np.array([[0, 2.5, 0], [0, high, 0], [0, high, 0], [0, 2.5, 0]])
    v = np.zeros((4, 3))
    v[1:3, 1] = 0.01, -0.01
    motion = between_rest(rows, [0.0, 2.0, 2.7, 4.7], v)
    found = refused(verified(motion), "limits")
    problem = rd.Problem(box_arm(), rd.Scene(), rows[0], rd.JointGoal(rows[-1:]))
    assert [one.kind for one in violations(problem, motion)] == ["limits"]
    assert found.subject == "j1" and found.time == pytest.approx(2.35, abs=1e-6)
    assert found.excess == pytest.approx(0.01 * 0.7 / 4 - 0.5e-3, rel=1e-3)
    assert verified(between_rest(rows - [0, 2e-3, 0], [0.0, 2.0, 2.7, 4.7], v)).valid


def test_contacts_that_begin_together_are_all_listed_at_their_beginning() -> None:
    """Regression: all but one were listed 1 cm of motion later, or not at all if the arm rested; after a pause, at its end."""
    scene = rd.Scene([rd.Sphere(vector(x, 0, 0), 0.05, name=f"ball{x}") for x in (0.25, 1.05)])
    for rows in (np.zeros((1, 3)), np.zeros((3, 3)), np.array([np.zeros(3), np.zeros(3), vector(0.5, 0, 0)])):
        problem = rd.Problem(box_arm(), scene, rows[0], rd.JointGoal(rows[-1:]))
        listed = violations(problem, rd.Path(box_arm().joint_names, rows))
        assert [(one.subject, one.other, one.time) for one in listed] == [("l1", "ball0.25", 0), ("l3", "ball1.05", 0)]


@given(st.floats(0.0, 1e-3), st.floats(1e-4, 3e-3))
def test_clearance_is_that_of_the_cubic(bulge: float, gap: float) -> None:
    """Regression: 0.35 mm were certified, but the cubic, unlike the lines between the rows, was 0.29 mm inside the wall."""
    of_first_joint = [-0.5, 0, 0, -0.5], [0, 4 * bulge, -4 * bulge, 0]
    rows, v = (np.outer(values, [1.0, 0, 0]) for values in of_first_joint)
    motion = between_rest(rows, [0.0, 2.0, 3.0, 5.0], v)
    wall = rd.Box(vector(1.1, 0.03 + 0.1 + gap, 0), vector(0.5, 0.2, 1.0))
    report = verified(motion, wall)
    exact = ExactCollision(box_arm(), rd.Scene([wall]))
    dense = motion.at(np.linspace(1.9, 3.1, 41)).positions
    least = min(d.distance for q in dense for d in exact.distances(q)[:3])
    if report.valid:
        assert report.scene_clearance is not None and 0 < report.scene_clearance <= least + 1e-9
    else:
        assert least < 1e-3


@pytest.mark.parametrize(("factor", "valid"), [(1.02, True), (0.96, False)])
@pytest.mark.parametrize("count", [2, 3])
def test_a_frame_keeps_its_speed_between_rows(factor: float, valid: bool, count: int) -> None:
    """The arm rests at the rows; between them the hand reaches 1.5 times its mean speed."""
    start = np.array([0.0, 0.2, 0.0, -1.9, 0.0, 2.1, 0.785])
    rows = start + np.outer(np.linspace(0, 0.3, count), np.eye(7)[0])
    motion = between_rest(rows, [0.0, 1.0, 2.0][:count], robot=PANDA)
    speed = float(factor * 1.5 * np.linalg.norm(PANDA.fk(start, "panda_hand")[:2, 3]) * 0.3 / (count - 1))
    line = rd.CartesianLine("panda_hand", 0.1, None, speed)
    report = rd.verify(rd.Problem(PANDA, rd.Scene(), rows[0], rows[-1], constraints=[line]), motion)
    assert report.valid if valid else refused(report, "speed").subject == "panda_hand"


def test_resampled_motions_keep_the_accelerations() -> None:
    """With few rows, the cubics overshoot where the acceleration jumps between rows."""
    rows = np.array([[0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], [0.4, -0.5, 0.3, -2.0, 0.2, 1.8, 0.3]])
    problem = rd.Problem(PANDA, rd.Scene(), rows[0], rd.JointGoal(rows[-1:]))
    motion = time_parameterize(PANDA, rd.Path(PANDA.joint_names, rows), yes, yes).trajectory
    for rate in (30, 50, 125, 250, 1000):
        fewer = motion.resample(rate)
        assert rd.verify(problem, fewer).valid and np.allclose(fewer.times[:-1] * rate, np.arange(len(fewer.times) - 1))
        assert fewer.duration <= motion.duration + 3 / rate


def test_the_line_of_a_violation_names_the_place_once() -> None:
    assert Violation("limits", 0.5, "link1 is inside ball").line == "link1 is inside ball (at 0.500)"
    for message in ("joint1 at 0.500 s: its velocity is 3", "joint1 is 3 at waypoint 1"):
        assert Violation("limits", 0.5, message).line == message


def test_eight_threads_validate_motions_of_one_problem() -> None:
    """Regression: threads shared objects of the proof that are not safe for threads."""
    ball = rd.Sphere((-0.3, 0.4, 0.6), 0.15)
    shapes = [rd.Box((0.5, 0.1, 0.4), (0.2, 0.2, 0.2)), rd.Cylinder((0.3, -0.5, 0.5), 0.1, 0.6), ball]
    start = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8])
    problem = rd.Problem(robot=PANDA, scene=rd.Scene(shapes), start=start, goal=start)
    ends = start + np.random.default_rng(0).uniform(-0.1, 0.1, (64, 1, PANDA.dof)) * (PANDA.upper - PANDA.lower)
    motions = [rd.Path(PANDA.joint_names, np.stack([start, end, start])) for end in ends[:, 0]]
    alone = [rd.verify(problem, motion) for motion in motions]
    with ThreadPoolExecutor(8) as threads:
        together = list(threads.map(lambda motion: rd.verify(problem, motion), motions))
    assert [str(report) for report in together] == [str(report) for report in alone]
    assert {report.valid for report in alone} == {True, False}
