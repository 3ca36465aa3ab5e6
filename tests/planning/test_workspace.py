"""A workspace: obstacles that are added, moved and removed, held objects, lines, a moved base, lists of steps."""

import pickle
from dataclasses import replace
from inspect import unwrap
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.panda import GOAL, HOME, PANDA, START
from helpers.refusals import refuses

T_WORLD_BASE = rd.pose([0.3, -0.2, 0.7], rpy=[0.0, 0.0, 0.5])


def panda(**options: object) -> rd.Workspace:
    return rd.Workspace(PANDA, **options)  # type: ignore[arg-type]


def test_motions_are_for_the_obstacles_as_they_are_then() -> None:
    space = panda()
    free = space.plan(GOAL, START, time_limit=10.0)
    assert free.stage == "straight_line"
    space.add(rd.Sphere([0.5, 0.0, 0.6], 0.2, name="ball"), rd.Box([0.5, 0.0, -0.2], [1.0, 1.0, 0.1], name="table"))
    assert space.obstacles == ("ball", "table")
    around = space.plan(GOAL, START, time_limit=10.0)
    assert around.solved and around.path_length > free.path_length + 0.1
    assert rd.verify(rd.Problem(space.robot, space.scene, START, GOAL), around.trajectory).valid
    space.move("ball", rd.pose([0.5, 0.0, 3.0]))
    assert space.plan(GOAL, START, time_limit=10.0).stage == "straight_line"
    space.add(rd.Sphere([0.5, 0.0, 0.6], 0.1, name="ball"))  # in place of the first
    assert space.obstacles == ("table", "ball")
    space.remove("ball")
    assert space.obstacles == ("table",)
    space.remove()
    assert space.obstacles == ()


def test_poses_are_in_the_world() -> None:
    """The same scene and goal relative to a base that stands elsewhere give the same motion."""
    here, there = panda(), panda(T_world_base=T_WORLD_BASE)
    ball = rd.Sphere([0.5, 0.0, 0.6], 0.2, name="ball")
    pose = here.pose(GOAL)
    assert np.allclose(there.pose(GOAL), T_WORLD_BASE @ pose)
    here.add(ball)
    there.add(ball.moved(T_WORLD_BASE))
    assert np.allclose(there.clearance(START), here.clearance(START))
    assert np.allclose(there.ik(T_WORLD_BASE @ pose, near=GOAL)[0], GOAL, atol=1e-3)
    asked = (here, pose), (there, T_WORLD_BASE @ pose)
    one, other = (space.plan(goal, START, time_limit=10.0, planner="aorrtc", until="first") for space, goal in asked)
    assert np.allclose(one.path.positions[-1], other.path.positions[-1], atol=1e-4)
    # Regression: the problem lacked its base, so files and pictures showed the obstacles elsewhere
    assert np.allclose(other.problem.robot_and_scene_in_world()[1].shapes[0].bounds, ball.moved(T_WORLD_BASE).bounds)
    there.move("ball", T_WORLD_BASE @ rd.pose([0.5, 0.0, 0.6]))
    assert np.allclose(there.scene.shapes[0].bounds, ball.bounds)


def test_the_nearest_goal_that_a_line_leads_to() -> None:
    space = panda(T_world_base=T_WORLD_BASE)
    T = space.robot.fk(HOME, space.tip)
    offsets = [[0.0, 0.0, 0.12], [0.0, 0.0, 0.06], [0.05, 0.0, 0.0], [0.0, 0.0, -2.0]]
    goal = rd.AnyGoal(tuple(rd.PoseGoal(space.tip, T @ rd.pose(xyz)) for xyz in offsets))
    line = rd.CartesianLine(space.tip, 0.001, 0.05)

    def check(index: int) -> None:
        result = space.plan_line(goal, HOME, time_limit=40.0)
        assert result.solved and result.goal_index == index and result.fraction == 1.0, result.reason
        problem = rd.Problem(space.robot, space.scene, HOME, goal.goals[index], constraints=[line])
        assert rd.verify(problem, result.trajectory).valid

    check(2)
    goal = rd.AnyGoal((goal.goals[0], goal.goals[1]))
    check(1)
    goal = rd.AnyGoal((rd.PoseGoal(space.tip, T @ rd.pose([0.0, 0.0, -2.0])),))
    result = space.plan_line(goal, HOME, time_limit=4.0)
    assert not result.solved and result.reason.startswith("goal 0: ")


def test_a_limit_that_has_run_out_before_the_line_is_planned() -> None:
    """Regression: the error was "time_limit is -0.00085"."""
    space = panda(T_world_base=T_WORLD_BASE)
    end = space.pose(HOME) @ rd.pose([0.0, 0.0, 0.05])
    for corners in ((), (end,)):
        assert space.plan_line(end, HOME, time_limit=1e-5, waypoints=corners).reason
        refuses("time_limit is -1", space.plan_line, end, HOME, time_limit=-1.0, waypoints=corners)


def test_lines_through_waypoints_are_one_motion() -> None:
    space = panda(T_world_base=T_WORLD_BASE)
    T = space.pose(HOME)
    corners = [T @ rd.pose(xyz) for xyz in ([0.05, 0.0, 0.0], [0.05, 0.05, 0.0], [0.0, 0.05, 0.0])]
    result = space.plan_line(T, HOME, waypoints=corners, time_limit=20.0)
    assert result.solved and result.fraction == 1.0 and result.stops == 3, result.reason
    assert rd.verify(result.problem, result.trajectory).valid
    x, y, z = (np.linalg.inv(T) @ np.array([space.pose(q) for q in result.trajectory.positions]))[:, :3, 3].T
    off = np.minimum(np.minimum(abs(x), abs(x - 0.05)), np.minimum(abs(y), abs(y - 0.05)))
    assert off.max() < 0.001 and np.abs(z).max() < 0.001
    far = space.plan_line(T @ rd.pose([0.0, 0.0, 2.0]), HOME, waypoints=corners[:1], time_limit=4.0)
    assert not far.solved and far.reason.startswith("line 2 of 2: ") and far.fraction is not None and 0.5 < far.fraction < 1.0


def test_a_line_to_a_goal_with_tolerances_turns_no_more_than_it_must() -> None:
    space = panda()
    T = space.pose(HOME)
    goal = rd.PoseGoal(space.tip, T @ rd.pose([0.0, 0.05, 0.05], rpy=[0, 0, 1.0]), None, [0, 0, np.pi])
    free = space.plan_line(goal, HOME, time_limit=20.0)
    assert free.solved, free.reason
    end = np.linalg.inv(T) @ space.pose(free.path.positions[-1])
    assert np.allclose(end, rd.pose([0.0, 0.05, 0.05]), atol=1e-3)
    goal = rd.PoseGoal(space.tip, T @ rd.pose([0.0, 0.05, 0.05], rpy=[0, 0, 1.0]), [0, 0.02, 0], [0, 0, 0.2])
    less = space.plan_line(goal, HOME, time_limit=20.0)
    end = np.linalg.inv(goal.T_base_frame) @ space.pose(less.path.positions[-1])
    assert np.arctan2(end[1, 0], end[0, 0]) == pytest.approx(-0.2, abs=1e-3)
    assert rd.verify(rd.Problem(space.robot, space.scene, HOME, goal), less.trajectory).valid


@pytest.mark.parametrize(("way", "turn", "angle"), [(0.0, 0.0, None), (0.0, 0.5, 0.05), (0.0, 0.5, None), (0.0005, 0.0, 0.05)])
def test_short_lines_and_turns_about_the_tool_point(way: float, turn: float, angle: float | None) -> None:
    space = panda()
    end = space.pose(HOME) @ rd.pose([0.0, 0.0, way], rpy=[0.0, 0.0, turn])
    result = space.plan_line(end, HOME, angle=angle, time_limit=20.0)
    assert result.solved and result.fraction == 1.0, result.reason
    line = rd.CartesianLine(space.tip, 0.001, angle)
    problem = rd.Problem(space.robot, space.scene, HOME, rd.PoseGoal(space.tip, end), constraints=[line])
    assert rd.verify(problem, result.trajectory).valid


def test_bad_input() -> None:
    space = panda()
    space.add(rd.Sphere([0.5, 0.0, 0.6], 0.2, name="ball"))
    refuses("pose is 2 poses; a line has one end", space.plan_line, [np.eye(4)] * 2, "ready")
    refuses("unknown obstacle 'bal'; known: ball", space.move, "bal", np.eye(4))
    refuses("T_world_shape is .*; it must be 4 x 4", space.move, "ball", np.eye(3))
    refuses("unknown obstacle 'cup'", space.attach, "cup", HOME)
    refuses("names must differ", space.add, *[rd.Sphere([1, 0, 0], 0.1, name="a")] * 2)
    refuses("start has 3 values; panda has 7 planned joints", space.plan, HOME, HOME[:3])
    refuses("unknown link 'nose'", rd.Workspace, space.robot, tip="nose")
    for step, message in (
        (rd.MoveTo("redy"), "move to: .*'redy'"),
        (rd.MoveTo("ready", "nose"), "move to: unknown link 'nose'"),
        (rd.Attach("cup", name="grasp"), "grasp: unknown obstacle 'cup'; known: ball"),
        (rd.MoveTo("ready", contacts={"cup": "all"}, name="go"), "go: unknown obstacle in"),
    ):
        refuses(f"step 1 of 1, {message}", space.plan_steps, [step], "ready")
    refuses("time_limit is -1", space.plan_steps, [rd.MoveTo("ready")], "ready", -1.0)
    refuses("frame is 'base'; it must be 'tip' or 'world'", rd.MoveRelative, [0, 0, 0.1], "base")
    refuses(r"xyz is .*; it must be 3 finite numbers", rd.MoveRelative, [0, 0.1])


def test_a_tool_that_is_detached_is_no_tip_and_its_shapes_have_names_of_their_own() -> None:
    """Regressions: the tip was a link that was gone; an obstacle had the name of a held object."""
    arm = PANDA.attach(rd.Box([0, 0, 0.15], [0.05] * 3, name="box"), "panda_hand")
    space = rd.Workspace(arm.with_tool("panda_hand", rd.pose([0, 0, 0.3]), [rd.Box([0, 0, 0.3], [0.02] * 3)]))
    refuses("a shape of tool is named box", space.detach, "tool", "ready")
    space = rd.Workspace(PANDA.with_tool("panda_hand", rd.pose([0, 0, 0.3])))
    space.detach("tool", "ready")
    assert space.tip == "panda_hand" and space.pose("ready").shape == (4, 4)
    goals = [space.pose("ready"), rd.JointGoal(GOAL)]  # regression: the matrix counted as values of joints
    assert space.plan(goals, "extended", until="first").solved
    refuses(r"shapes\[0\] is .*each an argument of its own", unwrap(rd.Workspace.add), space, [rd.Sphere([1, 1, 1], 0.1)])


def test_values_by_joint_are_a_configuration() -> None:
    space = panda()
    by_joint = dict(zip(space.robot.joint_names, GOAL.tolist(), strict=True))
    assert np.array_equal(rd.Problem(space.robot, space.scene, by_joint | {"panda_finger_joint1": 0.01}, "ready").start, GOAL)
    several = rd.Problem(space.robot, space.scene, "ready", [by_joint, "extended"])
    assert np.array_equal(several.goal.positions[0], GOAL)  # type: ignore[union-attr]
    assert np.array_equal(space.pose(by_joint), space.pose(GOAL))
    assert space.is_free(by_joint)
    fewer = {name: value for name, value in by_joint.items() if name[-1] != "7"}
    refuses("start has no panda_joint7", rd.Problem, space.robot, space.scene, fewer, GOAL)
    refuses(r"unknown joint in goal: 'joint_1'", rd.Problem, space.robot, space.scene, GOAL, by_joint | {"joint_1": 0.0})


FINGERS = ["panda_hand", "panda_leftfinger", "panda_rightfinger"]
ABOVE = rd.pose([0.5, -0.3, 0.3], rpy=[np.pi, 0.0, 0.0])


def table_with_can() -> rd.Workspace:
    space = rd.Workspace(PANDA, "panda_hand")
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
    steps = [
        *pick(ABOVE),
        rd.MoveTo(rd.pose([0.5, 0.3, 0.161]), link="can", name="carry"),
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
    refuses("no motion was planned for a step 'cary'", result.goal_index, "cary")


def test_grasps_whose_line_is_blocked_are_left_for_others() -> None:
    """The can stands between two walls, so the hand can come down to it in one orientation only."""
    space = table_with_can()
    for side in (-1, 1):
        space.add(rd.Box([0.5, -0.3 + side * 0.075, 0.09], [0.2, 0.02, 0.18], name=f"wall {side}"))
    grasps = [ABOVE @ rd.pose([0.0, 0.0, 0.0], rpy=[0.0, 0.0, turn]) for turn in [0.0, 0.2, np.pi / 2]]
    result = space.plan_steps(pick(grasps), "ready", time_limit=60.0)  # type: ignore[arg-type]
    assert result.solved, result.reason
    assert result.goal_index("approach") == 2
    blocked = space.plan_steps(pick(grasps[:1]), "ready", time_limit=60.0)  # type: ignore[arg-type]
    assert not blocked.solved and blocked.failed == "descend" and blocked.trajectory is None
    assert blocked.reason.startswith("step 2 of 4, descend: ")
    assert "inside wall" in blocked.reason and "ends of earlier steps were tried" in blocked.reason


def test_contacts_hold_for_their_step_only() -> None:
    space = table_with_can()
    steps = pick(ABOVE)
    result = space.plan_steps([*steps[:3], rd.MoveRelative([0, 0, 0.15], "world", name="lift")], "ready")  # type: ignore[list-item]
    assert result.failed == "lift" and "can touches table" in result.reason
    assert "if it stands there, name it in allowed_contacts of table" in result.reason
    assert space.scene.allowed_contacts == ()


def test_motions_are_joined_with_and_without_a_stop() -> None:
    space = table_with_can()
    there = space.plan("extended", "ready", time_limit=10.0)
    end = there.path.positions[-1]
    back = space.plan(ABOVE, end, time_limit=10.0)
    stopping = rd.join([there, back], time_limit=20.0)
    assert stopping.stops == 1 and stopping.duration == pytest.approx(there.duration + back.duration)
    passing = rd.join([there, back], 0.1, time_limit=20.0)
    assert passing.stops == 0 and passing.duration < stopping.duration
    for one in (stopping, passing):
        assert len(one.problem.waypoints) == 1
        assert rd.verify(one.problem, one.trajectory).valid and rd.certify(one.problem, one.trajectory).check(one.problem).valid
    line = space.plan_line(space.pose(end) @ rd.pose([0.0, 0.0, -0.05]), end, time_limit=10.0)
    assert rd.join([there, line], time_limit=10.0).solved
    space.remove("can")
    elsewhere = space.plan("ready", end, time_limit=10.0)
    refuses("constraints .or lines. of their own", rd.join, [there, line], 0.05)
    refuses(r"results\[1\] begins .* rad from the end of results\[0\] in", rd.join, [there, there], 0.0)
    refuses("it takes two to join", rd.join, [there], 0.0)
    refuses(r"results\[1\] is for another robot, scene or payload", rd.join, [there, elsewhere], 0.0)


def test_joined_motions_keep_the_limits_of_the_call() -> None:
    """Regression: where it was slower, the blended motion was replaced by one that stops, at full speed."""
    space = panda()
    there = space.plan("extended", "ready", time_limit=10.0)
    back = space.plan("ready", there.path.positions[-1], time_limit=10.0)
    for blend in (0.0, 0.2):
        limits = {"velocity_scaling": 0.4, "acceleration_scaling": 0.2, "jerk": 80.0}
        motion = rd.join([there, back], blend, time_limit=20.0, **limits).trajectory
        assert (np.abs(motion.velocities) <= 0.4 * PANDA.velocity * (1 + 1e-6)).all()
        assert (np.abs(motion.accelerations) <= 0.2 * PANDA.acceleration * (1 + 1e-6)).all()
        assert (motion.peak_jerks <= 80.0 * (1 + 1e-6)).all()


def test_motions_with_other_payloads_or_moving_obstacles_or_from_a_velocity_are_not_joined() -> None:
    """Regression: payload and obstacles of the first motion counted for all; for a velocity, accelerations were blamed."""
    scene, end = rd.Scene(), [0.6, 0.2, 0, -1.8, 0, 2.2, 0.2]
    cart = rd.MovingObstacle(rd.Sphere([3.0, 0.0, 0.5], 0.1, "cart"), velocity=[0.1, 0.0, 0.0])

    def planned(start: Any, goal: Any, **more: Any) -> rd.PlanResult:
        return rd.plan(rd.Problem(PANDA, scene, start, goal, **more), 10.0, until="first")

    there, loaded = (planned("ready", end, payload=load) for load in (None, rd.Payload(1.0, [0, 0, 0.1])))
    back = planned(end, "ready", payload=rd.Payload(1.0, [0, 0, 0.1]))
    for other in (back, planned(end, "ready", moving=[cart])):
        refuses("another robot, scene or payload", rd.join, [there, other])
    refuses(r"results\[1\] has a start_velocity", rd.join, [there, planned(end, "ready", start_velocity=[0.1] * 7)])
    assert rd.join([loaded, back]).problem.payload is not None
    cone = [rd.AxisCone("panda_hand", [0, 0, 1], [0, 0, -1], 3.0) for _ in range(2)]
    ways = [planned("ready", end, constraints=cone[:1]), planned(end, "ready", constraints=cone[1:])]
    equal = replace(ways[1], problem=replace(ways[1].problem, scene=rd.Scene()))
    assert len(rd.join([pickle.loads(pickle.dumps(ways[0])), equal]).problem.constraints) == 1, "equal, not the same"


def test_a_base_that_is_moved_leaves_obstacles_in_the_world() -> None:
    """Regressions: only `pose` knew the new base; contacts of a released object made every later plan an error."""
    space, there = panda(), panda(T_world_base=T_WORLD_BASE)
    for one in (space, there):
        one.add(rd.Sphere([0.5, 0.0, 0.6], 0.2, name="ball"))
    space.T_world_base = T_WORLD_BASE
    assert np.allclose(space.scene.shapes[0].bounds, there.scene.shapes[0].bounds)
    assert np.allclose(space.ik(space.pose(GOAL), near=GOAL)[0], GOAL, atol=1e-3)
    space.add(rd.Sphere(space.pose(GOAL)[:3, 3], 0.01, name="pea"))
    space.attach("pea", GOAL)
    refuses("a shape is named pea, like an object the robot holds", space.add, rd.Sphere([1, 1, 1], 0.1, "pea"))
    space.allow("ball", ["pea", "panda_hand"])
    space.detach("pea", GOAL)
    assert space.scene.allowed_contacts == (("ball", ("panda_hand",)),) and space.is_free("ready")


def test_steps_keep_what_they_were_given_and_may_be_a_thousand() -> None:
    """Regressions: a changed array changed the steps made with it; many steps were a RecursionError; constraints were lost."""
    xyz, T = np.array([0.0, 0.0, 0.1]), np.eye(4)
    one, other = rd.MoveRelative(xyz), rd.MoveTo(T)
    xyz[2] = T[2, 3] = 5.0
    assert np.asarray(one.xyz)[2] == 0.1 and other.goal[2, 3] == 0.0
    space = panda()
    space.add(rd.Sphere(space.pose(GOAL)[:3, 3], 0.01, name="pea"))
    result = space.plan_steps([rd.Attach("pea"), rd.Detach("pea")] * 600, GOAL)
    assert result.solved and len(result.results) == 1200 and result.workspace.obstacles == ("pea",)
    refuses("constraints are those of one step", space.plan_steps, [rd.MoveTo("ready")], HOME, constraints=[])


def test_lists_of_blends_and_of_four_configurations_of_four_joints() -> None:
    space = panda()
    there = space.plan_line(space.pose(HOME) @ rd.pose([0.0, 0.0, 0.03]), HOME)
    lines = [there, space.plan_line(space.pose(HOME), there.path.positions[-1])]
    assert rd.join(lines, [0.0]).solved
    refuses(r"blend is \[0.1\], but some motions have constraints", rd.join, lines, [0.1])
    space = rd.Workspace(PANDA.with_locked({"panda_joint1": 0.0, "panda_joint3": 0.0, "panda_joint5": 0.0}))
    assert space.plan([[0.1 * k, -1.8, 2.0, 0.8] for k in range(1, 5)], "ready", until="first").solved
