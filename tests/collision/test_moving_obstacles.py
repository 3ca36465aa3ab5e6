"""The motion certificate among moving obstacles against Coal at many times; and what moving obstacles reject."""

from pathlib import Path

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.refusals import refuses
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.collision.moving_obstacles import CONTACT_TIME_TOLERANCE, MovingCollision
from robotdiffuse.core.transforms import rotation_about, transform
from robotdiffuse.problems.files import problem_from_record, problem_record, save_problem

PANDA = rd.load_robot("panda")
START, END = np.array([-0.6, 0.2, 0, -2.0, 0, 2.2, 0.2]), np.array([0.6, 0.2, 0, -2.0, 0, 2.2, 0.2])
STEP = 0.01
"""Time between the samples by Coal [s]."""
MOVED = 0.02
"""Upper bound on all motion in that time [m]."""
AXIS = np.array([0.0, 0.6, 0.8])


def obstacle(k: int, rng: np.random.Generator) -> rd.MovingObstacle:
    """An obstacle; its shape and kind of motion depend on the number, so that all combinations occur."""
    at = rng.uniform([-0.2, -0.8, 0.2], [0.9, 0.8, 1.0])
    velocity = 0.4 * rng.normal(size=3)
    shape = [
        rd.Sphere(at, 0.08),
        rd.Box(at, [0.1, 0.15, 0.2]),
        rd.Capsule(at, 0.05, 0.2),
        rd.Cylinder(at, 0.07, 0.2),
        rd.Mesh(np.vstack([np.eye(3), np.zeros(3)]) * 0.2, [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]], at),
    ][k % 5]
    if k % 2:
        return rd.MovingObstacle(shape, velocity=velocity)
    times = np.arange(4.0)
    poses = [transform(at + velocity * t, rotation_about(AXIS, 0.5 * t)) for t in times]
    return rd.MovingObstacle(shape, times=times, poses=poses)


def as_coal_sees(moves: rd.MovingObstacle, times: np.ndarray, q: np.ndarray) -> tuple[float | None, float]:
    """The first time at which arm and obstacle touch by Coal, and the smallest distance before."""
    moments = np.arange(0.0, times[-1], STEP)
    k = 0
    least = np.inf
    while k < len(moments):
        now = moments[k]
        row = np.array([np.interp(now, times, column) for column in q.T])
        distances = ExactCollision(PANDA, rd.Scene([moves.at(now)])).distances(row)
        near = min(d.distance for d in distances if d.other not in PANDA.link_names)
        least = min(least, near)
        if near <= 0:
            return now, least
        k += max(1, int(near / MOVED) - 1)  # until then they cannot have touched
    return None, least


def test_certificate_is_coals_verdict() -> None:
    rng = np.random.default_rng(3)
    times = np.linspace(0.0, 3.0, 3)
    q = np.stack([START, END, START])
    found = []
    for k in range(30):
        moves = obstacle(k, rng)
        sweep = MovingCollision(PANDA, [moves], 1e-4, 0.5).sweep(times, q)
        touching, least = as_coal_sees(moves, times, q)
        if touching is not None:
            assert sweep.contact is not None
            assert sweep.contact.time <= touching + CONTACT_TIME_TOLERANCE, "later than Coal"
            assert sweep.contact.time >= touching - 2 * STEP and sweep.clearance == 0.0
        elif least > 0.005:  # nearer than that, something may have happened between two moments
            assert sweep.contact is None and 0 < sweep.clearance <= least
        found.append(sweep.contact is not None)
    assert 0 < sum(found) < 30


def test_meshes_decide_for_a_single_row_too() -> None:
    """Regression: where only the covering spheres touched an obstacle, a motion of one row counted as in contact."""
    beside = rd.Sphere(PANDA.fk(START, "panda_link6")[:3, 3] + [0.0, 0.0, 0.125], 0.05)
    moving = MovingCollision(PANDA, [rd.MovingObstacle(beside, velocity=[0, 0, 0])], 1e-4, 0.5)
    assert moving.sweep(np.zeros(1), START[None]).contact is None


def test_what_is_unknown_is_anywhere_that_it_can_be() -> None:
    """The arm rests beside a ball that may approach at 0.1 m/s: it is free until the ball can have reached it."""
    ball = rd.Sphere([0.3, 0.0, 1.4], 0.1)
    distances = ExactCollision(PANDA, rd.Scene([ball])).distances(START)
    gap = min(d.distance for d in distances if d.other not in PANDA.link_names)
    validator = MovingCollision(PANDA, [rd.MovingObstacle(ball, max_speed=0.1)], 1e-4, 0.5)
    free = validator.sweep(np.array([0.0, 0.99 * gap / 0.1]), np.stack([START, START]))
    hit = validator.sweep(np.array([0.0, 1.5 * gap / 0.1]), np.stack([START, START]))
    assert free.contact is None and hit.contact is not None
    assert hit.contact.time == pytest.approx(gap / 0.1, abs=0.01)


def test_one_that_goes_faster_is_not_missed_between_rows() -> None:
    """A ball at 80 m/s is inside the arm for a few milliseconds between two rows."""
    ball = rd.MovingObstacle(rd.Sphere([0.35, -40.0, 0.5], 0.05), velocity=[0, 80, 0])
    sweep = MovingCollision(PANDA, [ball], 1e-4, 0.5).sweep(np.array([0.0, 1.0]), np.stack([START, START]))
    assert sweep.contact is not None and sweep.contact.time == pytest.approx(0.5, abs=0.01)


def test_validator_names_link_obstacle_and_time() -> None:
    ball = rd.MovingObstacle(rd.Sphere([0.45, -0.8, 0.5], 0.1, name="ball"), velocity=[0, 0.4, 0])
    rows = np.tile(START, (2, 1))
    still = rd.Trajectory(PANDA.joint_names, np.array([0.0, 3.0]), rows, 0 * rows, 0 * rows)
    violation = rd.verify(rd.Problem(PANDA, rd.Scene(), START, START, moving=[ball]), still).violation
    assert violation is not None and (violation.kind, violation.other) == ("scene_collision", "ball")
    assert violation.subject in PANDA.link_names and 0.5 < violation.time < 3.0
    assert violation.message.endswith(f"at {violation.time:.3f} s")


BALL = rd.Sphere([0.5, 0.5, 0.5], 0.1)
STANDS = transform(BALL.center)
AWAY = transform(BALL.center + 2)


def test_motions_that_are_none() -> None:
    for motion, message in (
        ({}, "it must have exactly one of velocity"),
        ({"velocity": [0, 1, 0], "max_speed": 1.0}, "it must have exactly one of velocity"),
        ({"velocity": [0, np.nan, 0]}, r"sphere.velocity is .* it must be 3 finite numbers"),
        ({"velocity": [0, 1]}, r"sphere.velocity is .* it must be 3 finite numbers"),
        ({"max_speed": -0.1}, "sphere.max_speed is -0.1; it must be a speed from 0 to 100 m/s"),
        ({"max_speed": np.inf}, "sphere.max_speed is inf; it must be a speed"),
        ({"times": [0.0], "poses": [STANDS]}, "sphere.times .* two or more times"),
        ({"times": [0.0, 1.0], "poses": [STANDS]}, "sphere.poses is .*; it must be 2 transforms"),
        ({"times": [1.0, 1.0], "poses": [STANDS] * 2}, "sphere: times do not increase: 1 s in row 0, 1 s in row 1"),
        ({"times": [0.0, np.nan], "poses": [STANDS] * 2}, "sphere.times .* two or more times"),
        ({"times": [0, 0.01], "poses": [STANDS, AWAY]}, r"sphere.poses\[1\] is a jump: from .* at 346 m/s"),
        ({"times": [0, 1], "poses": [AWAY] * 2}, r"sphere.poses\[0\] is at .*; it must be the pose of"),
        ({"times": [0.0, 1.0], "poses": [STANDS, 2 * STANDS]}, r"sphere.poses\[1\] is .*must be a homogeneous transform"),
    ):
        refuses(message, rd.MovingObstacle, BALL, **motion)
    refuses("time is nan; it must be a finite number", rd.MovingObstacle(BALL, velocity=[0, 1, 0]).pose, np.nan)
    refuses("point_cloud", rd.MovingObstacle, rd.PointCloud([[0.5, 0, 0.5]]), velocity=[0, 1, 0])


@pytest.mark.parametrize("base", [None, transform(np.array([0, 0, 0.7]), rotation_about(AXIS, 0.5))])
def test_files_hold_every_motion(tmp_path: Path, base: np.ndarray | None) -> None:
    turned = transform(BALL.center + 0.1, rotation_about(AXIS, 0.4))
    moving = [
        rd.MovingObstacle(BALL, velocity=[0, 0.3, 0]),
        rd.MovingObstacle(rd.Box(BALL.center, [0.1] * 3), times=[0, 1], poses=[STANDS, turned]),
        rd.MovingObstacle(rd.Capsule([0.4, 0, 1.2], 0.05, 0.1, name="hand"), max_speed=0.5),
    ]
    problem = rd.Problem(PANDA, rd.Scene([BALL]), START, END, T_world_base=base, moving=moving)
    assert [one.name for one in problem.moving] == ["sphere_2", "box", "hand"], "names are unique in a scene"
    save_problem(problem, tmp_path / "p.yaml")
    for again in (rd.load_problem(tmp_path / "p.yaml"), problem_from_record(problem_record(problem))):
        for one, other in zip(problem.moving, again.moving, strict=True):
            assert (one.name, one.max_speed) == (other.name, other.max_speed)
            for time in (0.0, 0.5, 2.0):
                assert np.allclose(one.pose(time), other.pose(time), atol=1e-9)


def test_files_name_the_field() -> None:
    record = problem_record(rd.Problem(PANDA, rd.Scene(), START, END))
    sphere = {"sphere": {"center": [0, 0, 1], "radius": 0.1}}
    for entry, message in (
        ({}, r"moving is .*; it must be a list"),
        ([3], r"moving\[0\] is 3; it must be a shape and its motion"),
        ([sphere | {"speed": 1}], r"moving\[0\] has the fields .* max_speed"),
        ([sphere], r"moving\[0\]: .* has no motion"),
        ([{"sphere": {"center": [0, 0, 1], "radius": -1}, "max_speed": 1}], r"moving\[0\].*radius"),
    ):
        refuses(message, problem_from_record, record | {"moving": entry})


def test_moving_obstacles_stand_beside_neither_blends_nor_start_velocities() -> None:
    ball = rd.MovingObstacle(BALL, velocity=[0, 1, 0])
    for more, message in (
        ({"waypoints": [END], "blend": 0.1}, "moving cannot be combined with blend: among moving obstacles, motions stop"),
        ({"start_velocity": [0.1] * 7}, "start_velocity cannot be combined with moving"),
    ):
        refuses(message, rd.Problem, PANDA, rd.Scene(), START, END, moving=[ball], **more)
