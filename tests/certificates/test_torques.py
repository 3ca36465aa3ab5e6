"""Certificates of motions with payloads: the checker's own dynamics, its bounds, and tampering."""

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path as FilePath

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.heavy_arms import ROBOTS, TURNED, pendulum, wild
from robotdiffuse.certificates.proof import request_parts
from robotdiffuse.certificates.requirements import inverse_dynamics, torque_bounds
from robotdiffuse.robots.dynamics import Dynamics

pytest.importorskip("pinocchio", reason="the extra `dynamics` (pin) is not installed")
LOW = [-0.6, 0.2, 0, -1.2, 0, 2.2, 0.2]
FAR = [0.6, 0.6, 0, -1.0, 0, 2.2, 0.2]
PAYLOAD = rd.Payload(1.5, [0.05, 0.0, 0.1], None, [0.01, 0.02, 0.03])


@cache
def certified() -> tuple[rd.Problem, rd.Certificate]:
    """A certified motion at the torque limit of a joint."""
    problem = rd.Problem(rd.load_robot("panda"), rd.Scene(), LOW, FAR, payload=rd.Payload(3.0, [0.0, 0.0, 0.1]))
    motion = rd.plan(problem, time_limit=20.0).trajectory
    assert motion is not None
    return problem, rd.certify(problem, motion)


def loaded(name: str) -> rd.Problem:
    robot = ROBOTS[name]()
    middle = (robot.lower + robot.upper) / 2
    return rd.Problem(robot, rd.Scene(), middle, middle, payload=PAYLOAD, T_world_base=TURNED)


@pytest.mark.parametrize("name", ROBOTS)
def test_dynamics_are_pinocchios(name: str) -> None:
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
    problem, certificate = certified()
    certificate.save(tmp_path / "certificate.json")
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    read = rd.load_certificate(tmp_path / "certificate.json")
    assert read.check().differences == () and read.check(problem).differences == ()
    assert dict(read.torques)["panda_joint2"] == pytest.approx(87.0, rel=0.02)


def test_paths_and_motions_of_one_row_are_proved_to_be_held() -> None:
    problem, certificate = certified()
    held = rd.certify(problem, rd.Path(problem.robot.joint_names, certificate.motion.positions[[0, -1]]))
    assert held.check(problem).valid and len(held.torques) == 7
    still = np.zeros((1, 7))
    motion = rd.Trajectory(problem.robot.joint_names, np.zeros(1), np.array([LOW]), still, still)
    there = replace(problem, goal=rd.JointGoal([LOW]))
    assert rd.certify(there, motion).check(there).valid


def test_a_peak_between_rows_needs_samples() -> None:
    """The robot has no geometry, so there is nothing else to prove."""
    problem = rd.Problem(pendulum(9.75), rd.Scene(), [1.0], [2.0], payload=rd.Payload(0.0))
    certificate = rd.certify(problem, rd.Path(("hinge",), np.array([[1.0], [2.0]])))
    assert len(certificate.torque_samples) and certificate.check(problem).valid
    found = replace(certificate, torque_samples=np.zeros(0)).check(problem).differences
    assert any("hinge is not shown to keep its limit" in line for line in found)


def test_another_payload_needs_another_proof() -> None:
    problem, certificate = certified()
    for payload, wanted in (
        (rd.Payload(3.5, [0.0, 0.0, 0.1]), "panda_joint2 is not shown to keep its limit"),
        (None, "torques: the problem has no payload"),
    ):
        other = replace(problem, payload=payload)
        found = replace(certificate, request_parts=request_parts(other)).check(other).differences
        assert any(wanted in line for line in found), found
