"""Lists of steps and joined motions: each verified, contacts for a step, other ends where a step fails."""

from itertools import pairwise

import numpy as np
import pytest

import robotdiffuse as rd

FINGERS = ["panda_hand", "panda_leftfinger", "panda_rightfinger"]
DOWN = [np.pi, 0.0, 0.0]
GRASP = rd.pose([0.5, -0.3, 0.18], rpy=DOWN)


def table_with_can() -> rd.Workspace:
    space = rd.Workspace(rd.load_robot("panda"), "panda_hand")
    space.add(
        rd.Box([0.55, 0.0, -0.05], [0.8, 1.4, 0.1], name="table"),
        rd.Cylinder([0.5, -0.3, 0.06], radius=0.03, height=0.12, name="can"),
    )
    return space


def pick(before: object) -> list[object]:
    return [
        rd.MoveTo(before, name="approach"),
        rd.MoveRelative([0.0, 0.0, 0.12], contacts={"can": FINGERS}, name="descend"),
        rd.Attach("can", touch_links=FINGERS),
        rd.MoveRelative([0.0, 0.0, 0.15], "world", contacts={"table": ["can"]}, name="lift"),
    ]


def test_pick_and_place_is_verified_step_by_step() -> None:
    space = table_with_can()
    at_place = rd.pose([0.5, 0.3, 0.161])
    steps = [
        *pick(GRASP @ rd.pose([0.0, 0.0, -0.12])),
        rd.MoveTo(at_place, link="can", name="carry"),
        rd.MoveRelative([0.0, 0.0, -0.1], "world", name="lower"),
        rd.Detach("can"),
        rd.MoveRelative([0.0, 0.0, -0.1], contacts={"can": FINGERS}, name="retreat"),
    ]
    result = space.plan_steps(steps, "ready", time_limit=60.0)  # type: ignore[arg-type]
    assert result.solved and result.failed is None, result.reason
    motions = [one for one in result.results if one is not None]
    assert len(motions) == 6
    for before, after in pairwise(motions):
        assert np.array_equal(before.path.positions[-1], after.path.positions[0])
    for one in motions:
        assert rd.verify(one.problem, one.trajectory).valid
    whole = result.trajectory
    assert whole.duration == pytest.approx(sum(one.duration for one in motions))
    for begin, one in zip(result.begins, result.results, strict=True):
        if one is not None:
            assert np.allclose(whole.at(begin).positions, one.path.positions[0])
            assert np.abs(whole.at(begin).velocities).max() < 1e-9
    assert space.obstacles == ("table", "can")
    can = next(shape for shape in result.workspace.scene.shapes if shape.name == "can")
    assert np.allclose(can.bounds.mean(axis=0), [0.5, 0.3, 0.061], atol=0.012)
    assert result.goal_index("carry") == 0
    with pytest.raises(rd.InputError, match="no motion was planned for a step 'cary'"):
        result.goal_index("cary")


def test_grasps_whose_line_is_blocked_are_left_for_others() -> None:
    """The can stands between two walls, so that the hand comes down to it across one direction only."""
    space = table_with_can()
    for side in (-1, 1):
        space.add(rd.Box([0.5, -0.3 + side * 0.075, 0.09], [0.2, 0.02, 0.18], name=f"wall {side}"))
    turns = [0.0, 0.2, np.pi / 2, -0.2]
    grasps = [GRASP @ rd.pose([0.0, 0.0, -0.12], rpy=[0.0, 0.0, turn]) for turn in turns]
    result = space.plan_steps(pick(grasps), "ready", time_limit=60.0)  # type: ignore[arg-type]
    assert result.solved, result.reason
    assert result.goal_index("approach") == 2
    blocked = space.plan_steps(pick(grasps[:2]), "ready", time_limit=60.0)  # type: ignore[arg-type]
    assert not blocked.solved and blocked.failed == "descend" and blocked.trajectory is None
    assert blocked.reason.startswith("step 2 of 4, descend: ")
    assert "inside wall" in blocked.reason and "ends of earlier steps were tried" in blocked.reason


def test_contacts_hold_for_their_step_only() -> None:
    space = table_with_can()
    steps = pick(GRASP @ rd.pose([0.0, 0.0, -0.12]))
    result = space.plan_steps([*steps[:3], rd.MoveRelative([0, 0, 0.15], "world", name="lift")], "ready")  # type: ignore[list-item]
    assert result.failed == "lift" and "can touches table" in result.reason
    assert space.scene.allowed_contacts == ()


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ([rd.Attach("cup", name="grasp")], "step 1 of 1, grasp: unknown obstacle 'cup'; known: can, table"),
        ([rd.MoveTo("ready", contacts={"cup": "all"}, name="go")], "step 1 of 1, go: unknown obstacle in"),
        ([rd.MoveTo("redy")], "step 1 of 1, move to: .*'redy'"),
    ],
)
def test_bad_steps(steps: list[object], message: str) -> None:
    with pytest.raises(rd.InputError, match=message):
        table_with_can().plan_steps(steps, "ready")  # type: ignore[arg-type]
    with pytest.raises(rd.InputError, match="frame is 'base'; it must be 'tip' or 'world'"):
        rd.MoveRelative([0, 0, 0.1], "base")
    with pytest.raises(rd.InputError, match=r"xyz is .*; it must be 3 finite numbers"):
        rd.MoveRelative([0, 0.1])


def test_motions_are_joined_with_and_without_a_stop() -> None:
    space = table_with_can()
    there = space.plan(GRASP @ rd.pose([0.0, 0.0, -0.12]), "ready", time_limit=10.0)
    back = space.plan("extended", there.path.positions[-1], time_limit=10.0)
    stopping = rd.join([there, back], time_limit=20.0)
    assert stopping.stops == 1
    assert stopping.duration == pytest.approx(there.duration + back.duration)
    passing = rd.join([there, back], 0.1, time_limit=20.0)
    assert passing.stops == 0 and passing.duration < stopping.duration
    for one in (stopping, passing):
        assert len(one.problem.waypoints) == 1
        assert rd.verify(one.problem, one.trajectory).valid
        assert rd.certify(one.problem, one.trajectory).check(one.problem).valid


def test_motions_that_cannot_be_joined() -> None:
    space = table_with_can()
    there = space.plan("extended", "ready", time_limit=10.0)
    end = there.path.positions[-1]
    line = space.plan_line(space.pose(end) @ rd.pose([0.0, 0.0, -0.05]), end, time_limit=10.0)
    assert rd.join([there, line], time_limit=10.0).solved
    with pytest.raises(rd.InputError, match="constraints of their own, which a corner would leave"):
        rd.join([there, line], 0.05)
    with pytest.raises(rd.InputError, match=r"results\[1\] begins .* rad from the end of results\[0\] in"):
        rd.join([there, there])
    with pytest.raises(rd.InputError, match="it takes two to join"):
        rd.join([there])
    space.remove("can")
    other = space.plan("ready", end, time_limit=10.0)
    with pytest.raises(rd.InputError, match=r"results\[1\] is for another robot or scene"):
        rd.join([there, other])
