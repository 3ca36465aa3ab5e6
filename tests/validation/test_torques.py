"""Torques between samples: bounds against dense samples, and peaks between rows."""

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.heavy_arms import ROBOTS, TURNED, pendulum, wild
from robotdiffuse.robots.dynamics import Dynamics
from robotdiffuse.validation.validator import Excess, Pieces, first_excess, static_pieces, trajectory_pieces

pytest.importorskip("pinocchio", reason="the extra `dynamics` (pin) is not installed")
LOOKS = 41


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("step", [0.3, 0.03, 0.01])
def test_no_torque_leaves_its_chord_by_more_than_its_bound(name: str, step: float) -> None:
    robot = ROBOTS[name]()
    rng = np.random.default_rng(0)
    u = np.linspace(0.0, 1.0, LOOKS)
    dynamics = Dynamics(robot, rd.Payload(1.5, [0.05, 0.0, 0.1], None, [0.01, 0.02, 0.03]), TURNED)
    for _ in range(20):
        motion = wild(robot, rng, step)
        for pieces in (trajectory_pieces(motion), static_pieces(motion.positions)):
            bulges = dynamics.second_derivatives(pieces.along) / 8
            piece = np.repeat(np.arange(len(bulges)), LOOKS)
            torques = dynamics.torques(*pieces.states(piece, np.tile(u, len(bulges)))).reshape(len(bulges), LOOKS, -1)
            chords = torques[:, :1] + u[:, None] * (torques[:, -1:] - torques[:, :1])
            assert (np.abs(torques - chords).max(axis=1) <= bulges + 1e-9).all()


@pytest.mark.parametrize(("effort", "valid"), [(9.70, False), (9.73, True)])
def test_a_peak_between_two_rows_is_found(effort: float, valid: bool) -> None:
    """The torque is 9.81 N m when the rod is horizontal, between two rows; the validator allows an excess of 1 %."""
    path = rd.Path(("hinge",), np.array([[0.3], [2.84], [2.9]]))
    problem = rd.Problem(pendulum(effort), rd.Scene(), path.positions[0], path.positions[-1], payload=rd.Payload(0.0))
    violation = rd.verify(problem, path).violation
    assert (violation is None) == valid
    if violation is not None:
        assert violation.kind == "torque" and 0 < violation.time < 1 and violation.message.startswith("hinge needs 9.8")


def beyond(effort: float, pieces: Pieces) -> Excess | None:
    return first_excess(Dynamics(pendulum(effort), rd.Payload(0.0)), pieces, 0.01)


def test_a_peak_between_two_times_is_found() -> None:
    """At constant velocity, so that only gravity counts. Rows are a second apart, and the rod is horizontal at none of them."""
    rows = np.pi / 2 + np.array([[-0.375], [-0.125], [0.125], [0.375]])
    motion = rd.Trajectory(("hinge",), np.arange(4.0), rows, np.full((4, 1), 0.25), np.zeros((4, 1)))
    found = beyond(9.66, trajectory_pieces(motion))
    assert found is not None and 1 < found.place < 2 and 1.01 * 9.66 < found.value < 9.82
    assert beyond(9.75, trajectory_pieces(motion)) is None


def test_torques_are_those_of_the_cubics_also_of_long_motions_and_of_one_row() -> None:
    """At rest, the cubic has 12 rad/s² at both ends, whatever accelerations are written; gravity alone needs 2.4 N m."""
    still = np.zeros((2, 1))
    motion = rd.Trajectory(("hinge",), np.array([0.0, 0.5]), np.array([[-0.25], [0.25]]), still, still)
    assert beyond(5.3, trajectory_pieces(motion)) and not beyond(6.0, trajectory_pieces(motion))
    winds = rd.Trajectory(("hinge",), np.array([0.0, 1e5]), np.zeros((2, 1)), np.full((2, 1), 2.0), np.zeros((2, 1)))
    assert beyond(9.9, trajectory_pieces(winds))
    row = np.array([[1.5]])
    still = np.zeros((1, 1))
    for pieces in (static_pieces(row), trajectory_pieces(rd.Trajectory(("hinge",), np.zeros(1), row, still, still))):
        assert beyond(9.0, pieces) and not beyond(10.0, pieces)


def test_a_torque_that_touches_its_limit_is_settled() -> None:
    """The halving of intervals ends at a thousandth of the limit."""
    limit = 9.81 / 1.01
    held = static_pieces(np.array([[1.0], [2.0]]))
    assert beyond(limit, held) and not beyond(1.002 * limit, held)


def test_what_is_proved_holds_at_every_look() -> None:
    panda = rd.load_robot("panda")
    payload = rd.Payload(3.0, [0.0, 0.0, 0.1])
    low = [-0.6, 0.2, 0, -1.2, 0, 2.2, 0.2]
    problem = rd.Problem(panda, rd.Scene(), low, [0.6, 0.6, 0, -1.0, 0, 2.2, 0.2], payload=payload)
    motion = rd.plan(problem, time_limit=10.0).trajectory
    assert motion is not None
    dynamics = Dynamics(panda, payload)
    pieces = trajectory_pieces(motion)
    rng = np.random.default_rng(0)
    torques = np.abs(dynamics.torques(*pieces.states(rng.integers(len(motion.times) - 1, size=4000), rng.random(4000))))
    for share in (1.1, 1.003, 0.999, 0.95):
        dynamics.limits = share * torques.max(axis=0)
        assert (first_excess(dynamics, pieces, 0.0) is None) == (share > 1)
    assert rd.verify(problem, motion).valid
