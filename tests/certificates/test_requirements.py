"""Certificates of motions with constraints, moving obstacles, start velocities and payloads: bounds, files, tampering."""

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.heavy_arms import ROBOTS, TURNED, pendulum, wild
from helpers.panda import PANDA
from robotdiffuse.certificates.bounds import MovingProver, Stretches
from robotdiffuse.certificates.checker import check
from robotdiffuse.certificates.proof import hash_of, request_parts, scene_parts
from robotdiffuse.certificates.requirements import constraint_bounds, inverse_dynamics, torque_bounds
from robotdiffuse.interop.recorded_motion import checked_motion, motion_of_robot
from robotdiffuse.problems.compiled_constraints import PathConstraints
from robotdiffuse.problems.files import problem_from_record, problem_record
from robotdiffuse.robots.dynamics import Dynamics

HAND = "panda_hand"
START = [-0.6, 0.2, 0, -2.0, 0, 2.2, 0.2]
GOAL = [0.6, 0.2, 0, -2.0, 0, 2.2, 0.2]
LOW = [-0.6, 0.2, 0, -1.2, 0, 2.2, 0.2]
FAR = [0.6, 0.6, 0, -1.0, 0, 2.2, 0.2]
PAYLOAD = rd.Payload(1.5, [0.05, 0.0, 0.1], None, [0.01, 0.02, 0.03])
TABLE = rd.Box([0.55, 0.0, 0.0], [0.5, 1.0, 0.2], name="table")
ACROSS = rd.MovingObstacle(rd.Cylinder([0.42, 0.35, 0.4], 0.06, 0.6, name="post"), velocity=[0.25, -0.1, 0.0])
ASKED: dict[str, dict[str, Any]] = {
    "line": {"constraints": [rd.CartesianLine(HAND, 0.002, 0.02, 0.2)]},
    "greatest speed": {"moving": [rd.MovingObstacle(rd.Sphere([0.6, 1.8, 0.5], 0.1, "ball"), max_speed=0.3)]},
    "start velocity": {"start_velocity": [0.5, 0, 0, 0, 0, 0, 0]},
}


@cache
def certified(asked: str) -> tuple[rd.Problem, rd.Certificate]:
    problem = rd.Problem(PANDA, rd.Scene([TABLE]), START, GOAL, **ASKED[asked])
    result = rd.load_planner("aorrtc").plan(problem, time_limit=20.0)
    assert result.trajectory is not None, result.reason
    return problem, rd.certify(problem, result.trajectory)


@pytest.mark.parametrize("asked", [pytest.param("line", marks=pytest.mark.slow), *list(ASKED)[1:]])
def test_each_is_proved_and_its_file_holds(asked: str, tmp_path: FilePath) -> None:
    problem, certificate = certified(asked)
    certificate.save(tmp_path / "certificate.json")
    read = rd.load_certificate(tmp_path / "certificate.json")
    assert read.check().differences == () and read.check(problem).differences == ()
    assert (read.moving is not None) == bool(problem.moving)
    assert len(read.constraints) == (2 if asked == "line" else len(problem.constraints))


def test_bounds_of_constraints_are_bounds() -> None:
    """Compares with the validator's values at dense samples, also for prismatic joints."""
    rng = np.random.default_rng(0)
    for k in range(40):
        robot = PANDA if k % 2 else box_arm()
        frame = HAND if k % 2 else robot.tip
        rows = rng.uniform(robot.lower, robot.upper, (4, robot.dof))
        rows[1:] = rows[0] + 10 ** rng.uniform(-1, 0) * (rows[1:] - rows[0])
        rows = np.clip(rows, robot.lower, robot.upper)
        normal = rng.normal(size=3)
        constraints: list[Any] = [
            rd.AxisCone(frame, rng.normal(size=3), rng.normal(size=3), 0.1),
            rd.PositionBox(frame, [-0.1] * 3, [0.3] * 3),
            rd.OnPlane(frame, rng.normal(size=3), normal, 0.1),
            rd.OnLine(frame, rng.normal(size=3), normal, 0.1),
            rd.CartesianLine(frame, 0.1, 0.1),
        ]
        problem = rd.Problem(robot, rd.Scene(), rows[0], rows[-1], constraints=constraints)
        _, bounds, _ = constraint_bounds(problem, rows, 0.0)
        s = np.linspace(0, 1, 60)[:, None]
        dense = np.concatenate([rows[i] + s * (rows[i + 1] - rows[i]) for i in range(3)])
        values = PathConstraints(problem).values(dense).reshape(3, 60, -1).max(axis=1)
        assert (values <= bounds + 1e-7).all(), (k, (values - bounds).max(axis=0))


def test_bounds_in_time_are_bounds() -> None:
    """At every time of a stretch, the distance of all spheres to a rotating box is at least clearance minus displacement."""
    times = np.linspace(0.0, 1.0, 6)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = [[0.5, 0.5, 0.5], [0.5, 0.0, 0.6], [0.3, -0.4, 0.4]]
    poses[1, :3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    poses[2, :3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    bar = rd.MovingObstacle(rd.Box(poses[0, :3, 3], [0.4, 0.1, 0.1], name="bar"), times=[0, 0.4, 1], poses=poses)
    ways = (bar, ACROSS, rd.MovingObstacle(rd.Sphere([0.7, 0.3, 0.5], 0.1, "ball"), max_speed=0.0))
    q = np.array(START) + 0.2 * np.random.default_rng(1).normal(size=(6, 7)).cumsum(axis=0)
    prover = MovingProver(PANDA, ways, q, times, np.zeros_like(q[1:]))
    count = len(prover.claims)
    found = prover.bounds(Stretches(np.arange(count), np.full(count, 1.2), np.full(count, 1.9)), np.zeros(count, bool), [])
    for place in np.linspace(1.2, 1.9, 15):
        point = Stretches(np.arange(count), np.full(count, place), np.full(count, place))
        assert (prover.bounds(point, np.zeros(count, bool), []).clearance >= found.clearance - found.displacement - 1e-9).all()


def refused(certificate: rd.Certificate, problem: rd.Problem, wanted: str) -> None:
    """Asserts that the certificate is refused for the problem, even with forged hashes."""
    found = replace(certificate, request_parts=request_parts(problem)).check(problem).differences
    assert any(wanted in line for line in found), found


def test_a_motion_that_begins_slower_is_refused() -> None:
    problem, certificate = certified("start velocity")
    assert isinstance(certificate.motion, rd.Trajectory)
    late = replace(certificate.motion, velocities=0.5 * certificate.motion.velocities)
    certificate = replace(certificate, motion=late, motion_hash=hash_of(late))
    refused(certificate, problem, "motion: it does not begin at the problem's start_velocity")


@pytest.mark.slow
def test_another_line_and_a_slower_one_need_another_proof() -> None:
    problem, certificate = certified("line")
    other = rd.CartesianLine("panda_link5", 0.0005, 0.02, 0.2)
    refused(certificate, replace(problem, constraints=[other]), "they are not those of the problem")
    refused(certificate, replace(problem, constraints=[rd.CartesianLine(HAND, 0.002, 0.02, 0.1)]), "moves at 0.2")


def test_paths_with_constraints_are_certified_and_with_moving_obstacles_refused(tmp_path: FilePath) -> None:
    path = rd.Path(PANDA.joint_names, np.array([START, GOAL]))
    cone, narrower = (rd.AxisCone(HAND, [0, 0, 1], [0, y, -1], angle) for y, angle in ((0.0, 0.1745), (0.3, 0.1)))
    problem = rd.Problem(PANDA, rd.Scene([TABLE]), START, GOAL, constraints=[cone])
    rd.certify(problem, path).save(tmp_path / "certificate.json")
    certificate = rd.load_certificate(tmp_path / "certificate.json")
    assert certificate.check().differences == certificate.check(problem).differences == ()
    refused(certificate, replace(problem, constraints=[narrower]), "is not shown to keep its limit")
    forged = replace(certificate, jerks=tuple((name, 1.0) for name in PANDA.joint_names))
    refused(forged, problem, "jerks: the motion is a path")
    with pytest.raises(rd.InputError, match="certificates prove nothing about moving obstacles"):
        rd.certify(replace(problem, constraints=(), moving=[ACROSS]), path)


@cache
def loaded_motion() -> tuple[rd.Problem, rd.Certificate]:
    """A certified motion at the torque limit of a joint."""
    pytest.importorskip("pinocchio", reason="the extra `dynamics` (pin) is not installed")
    problem = rd.Problem(rd.load_robot("panda"), rd.Scene(), LOW, FAR, payload=rd.Payload(3.0, [0.0, 0.0, 0.1]))
    motion = rd.plan(problem, time_limit=20.0).trajectory
    assert motion is not None
    return problem, rd.certify(problem, motion)


def loaded(name: str) -> rd.Problem:
    robot = ROBOTS[name]()
    middle = (robot.lower + robot.upper) / 2
    return rd.Problem(robot, rd.Scene(), middle, middle, payload=PAYLOAD, T_world_base=TURNED)


def test_a_cloud_on_a_base_is_the_same_after_writing() -> None:
    """Regression: 12 decimals in the frame of the world changed the hash of three clouds in four."""
    for seed in range(8):
        cloud = rd.PointCloud(np.random.default_rng(seed).uniform(0.4, 0.8, (500, 3)), 0.01)
        problem = rd.Problem(PANDA, rd.Scene([cloud]), START, GOAL, payload=PAYLOAD, T_world_base=TURNED)
        read = problem_from_record(problem_record(problem))
        assert scene_parts(read.scene) == scene_parts(problem.scene)
        assert request_parts(read) == request_parts(problem)


@pytest.mark.parametrize("name", ROBOTS)
def test_dynamics_are_pinocchios(name: str) -> None:
    pytest.importorskip("pinocchio", reason="the extra `dynamics` (pin) is not installed")
    problem = loaded(name)
    q, v, a = np.random.default_rng(0).normal(size=(3, 50, problem.robot.dof))
    expected = Dynamics(problem.robot, PAYLOAD, TURNED).torques(q, v, a)
    assert np.allclose(inverse_dynamics(problem, q, v, a), expected, atol=1e-9)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("step", [0.2, 0.02])
def test_bounds_are_bounds(name: str, step: float) -> None:
    """Compares with torques at many samples, made by adding a row at each sample, which does not change the motion."""
    problem = loaded(name)
    rng = np.random.default_rng(1)
    for _ in range(5):
        motion = wild(problem.robot, rng, step)
        samples = np.linspace(0, motion.times[-1], 201)[1:-1]
        # accelerations jump at rows, to which rounding would assign samples at random
        samples = samples[np.abs(samples[:, None] - motion.times).min(axis=1) > 1e-9]
        for one, at in ((motion, samples), (rd.Path(motion.joint_names, motion.positions), samples / step)):
            few = torque_bounds(problem, one, np.zeros(0))
            rows = np.sort(np.concatenate([motion.times / step, samples / step]))
            piece = np.clip(((rows[1:] + rows[:-1]) / 2).astype(int), 0, len(few) - 1)
            assert (torque_bounds(problem, one, at) <= few[piece] + 1e-9).all()


def test_a_payload_is_proved_and_its_file_holds_without_pinocchio(tmp_path: FilePath, monkeypatch: pytest.MonkeyPatch) -> None:
    problem, certificate = loaded_motion()
    certificate.save(tmp_path / "certificate.json")
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    read = rd.load_certificate(tmp_path / "certificate.json")
    assert read.check().differences == () and read.check(problem).differences == ()
    assert dict(read.torques)["panda_joint2"] == pytest.approx(87.0, rel=0.02)


def test_paths_and_motions_of_one_row_are_proved_to_be_held() -> None:
    problem, certificate = loaded_motion()
    held = rd.certify(problem, rd.Path(problem.robot.joint_names, certificate.motion.positions[[0, -1]]))
    assert held.check(problem).valid and len(held.torques) == 7
    still = np.zeros((1, 7))
    motion = rd.Trajectory(problem.robot.joint_names, np.zeros(1), np.array([LOW]), still, still)
    there = replace(problem, goal=rd.JointGoal([LOW]))
    assert rd.certify(there, motion).check(there).valid


def test_a_peak_between_rows_needs_samples() -> None:
    """The robot has no geometry, so there is nothing else to prove."""
    pytest.importorskip("pinocchio", reason="the extra `dynamics` (pin) is not installed")
    problem = rd.Problem(pendulum(9.75), rd.Scene(), [1.0], [2.0], payload=rd.Payload(0.0))
    certificate = rd.certify(problem, rd.Path(("hinge",), np.array([[1.0], [2.0]])))
    assert len(certificate.torque_samples) and certificate.check(problem).valid
    found = replace(certificate, torque_samples=np.zeros(0)).check(problem).differences
    assert any("hinge is not shown to keep its limit" in line for line in found)


def test_another_payload_needs_another_proof() -> None:
    problem, certificate = loaded_motion()
    heavier = replace(problem, payload=rd.Payload(3.5, [0.0, 0.0, 0.1]))
    refused(certificate, heavier, "panda_joint2 is not shown to keep its limit")
    refused(certificate, replace(problem, payload=None), "torques: the problem has no payload")


def test_blends_are_judged_on_the_cubics_as_by_the_validator() -> None:
    """Regression: on straight lines between rows, so a proof held for a motion that missed its waypoint."""
    x, y = np.eye(7)[:2]
    t = np.array([0.0, 1.0, 2.0])
    q = np.array(START) + np.outer(0.4 * t, x)
    v = np.outer([0, 1, 0], 0.4 * x + 0.3 * y)
    motion = motion_of_robot(checked_motion(PANDA.joint_names, q, t, v), PANDA).motion
    assert isinstance(motion, rd.Trajectory)
    on_cubic = motion.at(np.array([2 / 3])).positions[0]
    for waypoint, reached in ((on_cubic, True), ((q[0] + q[1]) / 2, False)):
        problem = rd.Problem(PANDA, rd.Scene(), q[0], q[-1], waypoints=[rd.JointGoal(waypoint)], blend=0.01)
        assert rd.verify(problem, motion).valid == reached
        proof = rd.certify(replace(problem, waypoints=(), blend=()), motion)
        errors = [line for line in check(proof, problem).differences if line.startswith("motion:")]
        assert errors == ([] if reached else ["motion: it does not pass within 0.01 of waypoints[0] after those before it"])
