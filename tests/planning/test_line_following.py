"""Straight lines of the tool: motions lie on them at every millisecond, or the result says where a line ends and why."""

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

import robotdiffuse as rd
from robotdiffuse.core.transforms import rotation_about, rotation_angle
from robotdiffuse.planning import line_following
from robotdiffuse.planning.search.rrt import AORRTC
from robotdiffuse.trajectories.speed_limits import jerk_limits

PANDA = rd.load_robot("panda")
HAND = "panda_hand"
START = np.array([0.1, 0.2, 0.0, -2.0, 0.0, 2.2, 0.8])
T_START = PANDA.fk(START, HAND)


def moved(xyz: list[float], axis: list[float] | None = None, angle: float = 0.0) -> np.ndarray:
    T = T_START.copy()
    T[:3, 3] += xyz
    T[:3, :3] = rotation_about(np.array(axis or [0.0, 0.0, 1.0]), angle) @ T[:3, :3]
    return T


def planned(T_end: np.ndarray, scene: rd.Scene | None = None, **options) -> rd.PlanResult:
    line = options.pop("line", rd.CartesianLine(HAND))
    goal = options.pop("goal", rd.PoseGoal(HAND, T_end))
    return rd.plan(rd.Problem(PANDA, scene or rd.Scene(), START, goal, constraints=[line]), **options)


LINES = {
    "down": moved([0, 0, -0.2]),
    "aside and turned": moved([-0.1, 0.2, -0.05], [0.0, 0.6, 0.8], 0.7),
    "half a millimeter": moved([0, 0, -0.0005]),
    "turn in place": moved([0, 0, 0], [0.0, 0.0, 1.0], 0.9),
    "tilt in place": moved([0, 0, 0], [1.0, 0.0, 0.0], -0.5),
}


@pytest.mark.parametrize("name", LINES)
def test_motion_is_on_the_line_at_every_millisecond(name: str) -> None:
    T_end = LINES[name]
    result = planned(T_end)
    assert result.solved, result.reason
    assert (result.stage, result.fraction) == ("line", 1.0)
    t = result.trajectory
    assert rd.verify(result.problem, t).valid
    if name == "tilt in place":
        assert rd.certify(result.problem, t) is not None
    T = PANDA.fk(CubicHermiteSpline(t.times, t.positions, t.velocities)(np.arange(0.0, t.duration, 1e-3)), HAND)
    way = T_end[:3, 3] - T_START[:3, 3]
    turn = T_end[:3, :3] @ T_START[:3, :3].T
    angle = rotation_angle(turn)
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    axis = axis / (np.linalg.norm(axis) or 1.0)
    for at in T:
        if np.linalg.norm(way) > 0:
            share = (at[:3, 3] - T_START[:3, 3]) @ way / (way @ way)
        else:
            share = rotation_angle(at[:3, :3] @ T_START[:3, :3].T) / angle
        assert -1e-3 < share < 1 + 1e-3
        assert np.linalg.norm(at[:3, 3] - T_START[:3, 3] - share * way) < 2e-5
        wanted = rotation_about(axis, share * angle) @ T_START[:3, :3]
        assert rotation_angle(wanted.T @ at[:3, :3]) < 2e-4
    # within limits, of which one is used, with few changes of the sign of an acceleration
    jerks = np.diff(t.accelerations, axis=0) / np.diff(t.times)[:, None]
    rates = (t.velocities, PANDA.velocity), (t.accelerations, PANDA.acceleration), (jerks, jerk_limits(PANDA))
    assert 0.95 < max((np.abs(rate) / limit).max() for rate, limit in rates) <= 1 + 1e-6
    strong = np.abs(t.accelerations) > 0.05 * np.abs(t.accelerations).max()
    for column, kept in zip(t.accelerations.T, strong.T, strict=True):
        assert (np.diff(np.sign(column[kept])) != 0).sum() <= 3


def test_no_slower_than_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    followed = planned(LINES["down"], planner="aorrtc")
    monkeypatch.setattr(AORRTC, "follows_lines", False)
    searched = planned(LINES["down"], planner="aorrtc", time_limit=5.0)
    assert searched.stage == "constrained_rrt_connect" and followed.duration <= 1.08 * searched.duration


def test_ends_where_the_arm_gets_sooner(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of several configurations at the last pose, the line leads to one that may be further away than another."""
    found = {name: planned(T).duration for name, T in LINES.items()}
    monkeypatch.setattr(line_following, "faster_ends", lambda *_: [])
    ratios = [found[name] / planned(T).duration for name, T in LINES.items()]
    assert max(ratios) < 1.02 and min(ratios) < 0.97, ratios


def test_configuration_at_the_end_is_reached() -> None:
    end = PANDA.ik(LINES["down"], link=HAND, near=START)[0]
    result = planned(LINES["down"], goal=rd.JointGoal(end))
    assert result.stage == "line", result.reason
    assert np.array_equal(result.path.positions[-1], result.trajectory.positions[-1])
    assert np.abs(result.path.positions[-1] - end).max() < 1e-4


def test_lines_out_of_reach_or_into_a_box_end_there() -> None:
    result = planned(moved([0.6, 0, 0]), time_limit=0.3)
    assert not result.solved and "from the start the line can be followed for" in result.reason
    assert result.fraction is not None and 0.1 < result.fraction < 0.9
    assert len(PANDA.ik(moved([0.6 * result.fraction, 0, 0]), link=HAND, near=START))
    result = planned(moved([0, 0, -0.3]), rd.Scene([rd.Box([0.5, 0.05, 0.05], [0.3, 0.3, 0.1], name="table")]), time_limit=0.3)
    assert not result.solved and "table" in result.reason
    # fingertips are 0.112 m below the hand's origin; the table's top is at 0.1 m
    assert result.fraction == pytest.approx((T_START[2, 3] - 0.112 - 0.1) / 0.3, abs=0.05)
