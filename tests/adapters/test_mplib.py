"""MPlib's methods, arguments and results: motions end at the requested goal, and failures have a reason."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import robotdiffuse as rd
from helpers.refusals import refuses
from robotdiffuse.adapters.mplib import Planner, Pose, matrix
from robotdiffuse.robots import ROBOTS, known_robots
from robotdiffuse.robots.kinematic_tree import Mimic

JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
QPOS = np.array([0.0, 0.4, 0.0, -2.0, 0.0, 2.4, 0.8, 0.04, 0.04])
DOWN = [0.0, 1.0, 0.0, 0.0]
POSE = np.array([0.5, 0.2, 0.4, *DOWN])
HAND = "panda_hand"


def planner(**options: object) -> Planner:
    return Planner("panda", HAND, **{"user_joint_names": JOINTS + FINGERS, "srdf": ""} | options)  # type: ignore[arg-type]


@pytest.fixture
def made() -> Planner:
    return planner()


@pytest.mark.parametrize("later", [False, True])
def test_a_pose_is_reached_by_rows_of_one_time_step_within_the_limits_given(later: bool) -> None:
    limits = {"joint_vel_limits": np.full(7, 0.5), "joint_acc_limits": np.full(7, 2.0)}
    made = planner() if later else planner(**limits)
    if later:
        assert np.array_equal(made.joint_vel_limits, np.ones(7))
        made.joint_vel_limits, made.joint_acc_limits = limits.values()
    result = made.plan_qpos_to_pose(POSE, QPOS, time_step=0.05, planning_time=10.0, wrt_world=True)
    assert result["status"] == "Success" and result["position"].shape == (len(result["time"]), 7)
    assert np.allclose(result["position"][0], QPOS[:7], atol=0.5 * 2.0 * 0.05**2)
    assert np.allclose(result["time"], 0.05 * np.arange(1, len(result["time"]) + 1))
    assert np.allclose(made.workspace.pose(result["position"][-1]), matrix(POSE), atol=1e-3)
    assert np.abs(result["velocity"]).max() <= 0.5 + 1e-6
    assert np.abs(result["acceleration"]).max() <= 2.0 + 1e-6


def test_rows_begin_after_the_start_and_last_until_controllers_have_settled() -> None:
    """ManiSkill lets go of a sphere right after the last row; without a pause, the arm was still 5 mm from its goal."""
    result = planner().plan_qpos([QPOS + 0.2], QPOS, time_step=0.05, planning_time=10.0)
    off = np.abs(result["position"] - QPOS[:7] - 0.2).max(axis=1)
    assert off[0] < 0.2 and off[-7] > 1e-6
    assert off[-5:].max() < 1e-9 and not result["velocity"][-5:].any()
    assert result["time"][-1] >= result["duration"] + 0.24 - 1e-9


def test_fingers_need_not_be_equally_far_open(made: Planner) -> None:
    """Regression: the second finger mimics the first. In a grasp they differ by a millimeter, and the call was refused."""
    first, second = FINGERS
    joints = [replace(joint, mimic=Mimic(first, 1.0, 0.0) if joint.name == second else None) for joint in made.robot.joints]
    made.workspace.robot = replace(made.robot, joints=tuple(joints))
    assert made.check_for_self_collision([*QPOS[:7], 0.0205, 0.0213]) == []
    assert made.workspace.robot.locked == {first: 0.02, second: 0.02}


def test_both_versions_and_objects_with_p_and_q(made: Planner) -> None:
    goal = SimpleNamespace(p=POSE[:3], q=DOWN)
    assert made.plan_pose(goal, QPOS, planning_time=10.0)["status"] == "Success"
    status, ends = made.IK(goal, QPOS)
    assert status == "Success" and ends is not None and len(ends[0]) == 9
    assert np.allclose(made.plan_qpos([ends[0]], QPOS, planning_time=10.0)["position"][-1], ends[0][:7], atol=1e-6)


def test_arguments_of_both_versions(made: Planner) -> None:
    """Regressions: a screw took no arguments of 0.2; time_step by position failed; return_closest, None, [] were wrong."""
    for result in (made.plan_screw(POSE, QPOS, 0.1, 0.05), made.plan_screw(target_pose=POSE, qpos=QPOS, time_step=0.05)):
        assert np.allclose(result["time"][:2], [0.05, 0.1])
    assert made.plan_screw(goal_pose=POSE, current_qpos=QPOS, wrt_world=True, verbose=False)["status"] == "Success"
    for result in (made.plan_qpos_to_pose(POSE, QPOS, [], 0.05, 0.1, 5.0), made.plan_qpos_to_qpos([QPOS], QPOS, 0.05)):
        assert np.allclose(result["time"][:2], [0.05, 0.1])
    assert made.plan_qpos([QPOS], QPOS, fixed_joint_indices=[], constraint_function=None)["status"] == "Success"
    _, closest = made.IK(POSE, QPOS, return_closest=True)
    assert isinstance(closest, np.ndarray) and closest.shape == (9,)
    assert np.array_equal(planner(joint_vel_limits=None, joint_acc_limits=None, srdf=None).joint_vel_limits, np.ones(7))
    with pytest.raises(TypeError, match="joint_vel_limit'"):
        planner(joint_vel_limit=np.full(7, 0.2))


def test_a_screw_is_a_straight_line(made: Planner) -> None:
    start = made.workspace.pose(QPOS[:7])
    end = start.copy()
    end[2, 3] -= 0.15
    result = made.plan_screw(end, QPOS, time_step=0.02, use_point_cloud=False)
    assert result["status"] == "Success"
    places = np.array([made.workspace.pose(q)[:3, 3] for q in result["position"]])
    assert np.allclose(places[:, :2], start[:2, 3], atol=1e-3)
    assert np.allclose(places[-1], end[:3, 3], atol=1e-4)


def test_obstacles_and_held_objects_count_and_are_removed(made: Planner) -> None:
    """Regression: `remove_point_cloud("scene_pcd")` and `detach_object("attached_geom")` found nothing, and both stayed."""
    made.update_point_cloud(np.mgrid[-0.1:0.1:5j, -0.1:0.1:5j, -0.1:0.1:5j].reshape(3, -1).T + POSE[:3], resolution=0.03)
    assert made.check_for_env_collision(np.r_[made.workspace.ik(matrix(POSE), near=QPOS[:7])[0], QPOS[7:]])
    assert "collision" in made.plan_pose(POSE, QPOS)["status"]
    assert made.IK(POSE, QPOS)[0].startswith("IK Failed!")
    assert made.remove_point_cloud("scene_pcd") and not made.remove_point_cloud()
    made.update_attached_box([0.05, 0.05, 0.1], [0, 0, 0.15, 1, 0, 0, 0])
    assert [body.name for body in made.workspace.robot.attached] == ["attached_geom"]
    assert made.check_for_self_collision(QPOS) == []
    assert made.plan_pose(POSE, QPOS, planning_time=10.0)["status"] == "Success"
    assert made.detach_object("attached_geom") and not made.detach_object()
    made.update_point_cloud(np.array([[2.0, 2.0, 2.0]]))
    made.update_attached_sphere(0.02, [0, 0, 0.15, 1, 0, 0, 0])
    assert made.remove_point_cloud() and made.detach_object()


def test_the_base_stands_in_the_world(made: Planner) -> None:
    made.set_base_pose([0.3, -0.2, 0.7, 1, 0, 0, 0])
    goal = np.array([0.8, 0.0, 1.1, *DOWN])
    assert made.plan_pose(goal, QPOS, planning_time=10.0)["status"] == "Success"
    relative = made.plan_pose(goal - [0.3, -0.2, 0.7, 0, 0, 0, 0], QPOS, wrt_world=False, planning_time=10.0)
    assert np.allclose(made.workspace.pose(relative["position"][-1]), matrix(goal), atol=1e-3)


def test_failures_say_why(made: Planner) -> None:
    far = [2.0, 0.0, 0.5, *DOWN]
    assert "no configuration" in made.plan_pose(far, QPOS)["status"]
    assert "can be followed for" in made.plan_screw(far, QPOS, planning_time=0.2)["status"]
    assert made.IK(far, QPOS) == (f"IK Failed! The pose of {HAND} is out of reach", None)


def test_bad_input(tmp_path: Path) -> None:
    refuses(r"objects must be empty; add obstacles with `planner\.workspace\.add", planner, objects=["box"])
    refuses(r"pose is \[0.5, 0, 0.4\]; it must be x, y, z and a quat", planner().plan_pose, [0.5, 0, 0.4], QPOS)
    refuses("pose is 'here'; it must be x, y, z and a quaternion", planner().plan_pose, "here", QPOS)
    refuses("pose is .*; it must be a homogeneous", planner().update_attached_box, [0.1] * 3, np.zeros((4, 4)))
    refuses("qpos is .*; it must be 9 numbers", planner().plan_pose, [0.5, 0, 0.4, *DOWN], QPOS[:8])
    refuses("qpos is 'ready'; it must be 9 numbers", planner().plan_pose, [0.5, 0, 0.4, *DOWN], "ready")
    for size in (7, 9):
        refuses("qpos is .*nan.*; it must be 9 numbers", planner().plan_pose, [0.5, 0, 0.4, *DOWN], np.full(size, np.nan))
    refuses("qpos: locked: panda_finger_joint1 is 0.2", planner().plan_qpos, [QPOS], [*QPOS[:7], 0.2, 0.2])
    refuses("unknown option 'tim_step'.*did you mean time_step", planner().plan_pose, [0.5, 0, 0.4, *DOWN], QPOS, tim_step=1)
    for call, goal in ((planner().plan_pose, POSE), (planner().plan_screw, POSE), (planner().plan_qpos, [QPOS])):
        refuses("planning_time is -1.0; it must be a number from", call, goal, QPOS, planning_time=-1.0)
    refuses("unknown option 'constraint_function'", planner().plan_qpos, [QPOS], QPOS, constraint_function=print)
    refuses("unknown option 'fixed_joint_indices'", planner().plan_qpos, [QPOS], QPOS, fixed_joint_indices=[0])
    refuses("time_step is 0.0; it must be", planner().plan_pose, [0.5, 0, 0.4, *DOWN], QPOS, time_step=0.0)
    refuses("goal_qposes is .*; it must be rows of 9 numbers", planner().plan_qpos, [QPOS, QPOS[:3]], QPOS)
    refuses("n_init_qpos: .*count is 0; it must be an integer", planner().IK, [0.5, 0, 0.4, *DOWN], QPOS, n_init_qpos=0)
    refuses("radius is -1.0; it must be a number", planner().update_point_cloud, [[1, 1, 1]], -1.0)
    refuses(r"velocity limits are \[1.0\]; they must be 7 positive numbers", planner, joint_vel_limits=[1.0])
    refuses("acceleration limits are .*; they must be 7 positive", planner, joint_acc_limits=[-1.0] * 7)
    refuses("user_joint_names is 'panda_joint1'; it must be a list", planner, user_joint_names="panda_joint1")
    refuses("URDF missing.urdf does not exist", Planner, "missing.urdf", HAND)
    (tmp_path / "arm.urdf.xacro").write_text("<robot name='arm'><link name='base'/></robot>")
    refuses("is a xacro file, and compiling it would run code in it", Planner, tmp_path / "arm.urdf.xacro", "base")
    refuses("package_keyword_replacement is 'missing'; it must be a folder", Planner, __file__, HAND, "", "missing")
    for names in (JOINTS[1:], JOINTS[::-1], (*JOINTS, JOINTS[0])):
        refuses(f"user_joint_names is .*; it must name each joint that moves {HAND} once", planner, user_joint_names=names)
    refuses("unknown joint in user_joint_names 'nose'", planner, user_joint_names=(*JOINTS, "nose"))
    refuses("user_link_names is 'panda_hand'; it must be a list", planner, user_link_names=HAND)
    refuses("unknown link 'nose'", rd.Workspace, planner().robot, "nose")


def test_a_moved_base_keeps_obstacles_held_objects_and_allowed_contacts_and_a_release_keeps_limits(made: Planner) -> None:
    made.workspace.add(rd.Box([0.5, 0.0, 0.1], [0.2, 0.2, 0.2], name="block"))
    made.workspace.allow("block", [HAND])
    made.update_attached_sphere(0.02, [0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0])
    made.set_base_pose([0.1, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0])
    assert made.workspace.scene.allowed_contacts == (("block", (HAND,)),)
    block = made.workspace.scene.shapes[0]
    assert isinstance(block, rd.Box) and np.allclose(block.center, [0.4, 0.0, -0.2])
    assert len(made.workspace.robot.attached) == 1
    made.joint_vel_limits = np.full(7, 0.1)
    made.detach_object()
    assert np.array_equal(made.joint_vel_limits, np.full(7, 0.1))


def test_inverse_kinematics_take_poses_in_the_frame_of_the_base(made: Planner) -> None:
    """Regression: in both versions of MPlib, IK takes poses in the base's frame although plans take them in the world's."""
    made.set_base_pose(rd.pose([0.3, -0.2, 0.7], rpy=[0.0, 0.0, 1.0]))
    _, found = made.IK(POSE, QPOS, [], 5, 1e-3)
    assert isinstance(found, list) and len(found) > 1
    assert np.allclose([made.robot.fk(q[:7], HAND) for q in found], matrix(POSE), atol=1e-3)


def test_names_and_places_of_arguments_of_both_versions(made: Planner) -> None:
    """Regression: MPlib 0.1's `pc`, `radius` and robot before `qpos`, and 0.2's `state` and `art_name` were TypeErrors."""
    made.update_point_cloud(pc=[made.workspace.pose(QPOS[:7])[:3, 3]], radius=0.03)
    assert isinstance(made.workspace.scene.shapes[0], rd.PointCloud) and made.workspace.scene.shapes[0].point_radius == 0.03
    calls = [((QPOS,), {}), ((made.robot, QPOS, True), {}), ((), {"qpos": QPOS, "use_attach": True}), ((), {"state": QPOS})]
    for arguments, named in calls:
        assert made.check_for_env_collision(*arguments, **named) and not made.check_for_self_collision(*arguments, **named)
    refuses(r"qpos is \(\); it must be 9 numbers", made.check_for_self_collision)


def test_objects_are_held_by_the_link_that_is_named() -> None:
    """Regression: `link_id` was ignored, so that a pose in another link's frame placed the object elsewhere."""
    made = planner(user_link_names=["panda_link0", "panda_link7", HAND])
    above = [0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0]
    for arguments, named in (((1,), {}), ((None, 1), {}), ((), {"art_name": "panda", "link_id": 1}), ((np.int64(1),), {})):
        made.update_attached_sphere(0.02, above, *arguments, **named)
        assert made.workspace.robot.attached[0].link == "panda_link7"
    made.update_attached_box([0.02] * 3, above)
    assert made.workspace.robot.attached[0].link == HAND
    refuses("unknown link_id 3; known: -1, 0, 1, 2", made.update_attached_box, [0.02] * 3, above, link_id=3)
    refuses("no planned joint moves 'panda_link0'", made.update_attached_box, [0.02] * 3, above, link_id=0)
    assert [body.link for body in made.workspace.robot.attached] == [HAND]


def test_planners_with_equal_limits_share_a_robot() -> None:
    """Regression: arrays for collision checks, most of the time of ManiSkill's plans, were computed anew in each episode."""
    first, second = [planner(joint_vel_limits=np.full(7, 0.5)) for _ in range(2)]
    for made in (first, second):
        made.joint_vel_limits = 0.9 * made.joint_vel_limits
        assert made.check_for_self_collision(QPOS) == []
    assert first.robot is second.robot


def test_a_mask_may_hold_joints_that_are_not_planned_only(made: Planner) -> None:
    """Regression: a mask of planned joints was ignored, and they moved."""
    assert made.IK(POSE, QPOS, mask=[False] * 7 + [True] * 2)[0] == "Success"
    for call in (made.IK, made.plan_pose):
        refuses("mask holds panda_joint2; planned joints cannot be held", call, POSE, QPOS, [0, 1, 0])


def test_a_robot_is_prepared_again_if_its_meshes_or_srdf_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: only the URDF, the SRDF given and the move group were compared with those that had been prepared."""
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path / "robots"))
    robots = tmp_path / "robots" / "mplib"
    cube = trimesh.creation.box([0.1, 0.1, 0.2])
    cube.export(tmp_path / "arm.stl")
    link = "<collision><geometry><mesh filename='arm.stl'/></geometry></collision>"
    limit = "<limit lower='-1' upper='1' velocity='1' effort='1'/>"
    joint = f"<joint name='j' type='revolute'><parent link='base'/><child link='tool'/><axis xyz='0 1 0'/>{limit}</joint>"
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(f"<robot name='arm'><link name='base'/><link name='tool'>{link}</link>{joint}</robot>")
    for _ in range(2):
        Planner(urdf, "tool")
    assert len([*robots.iterdir()]) == 1
    (tmp_path / "arm.srdf").write_text("<robot name='arm'/>")
    Planner(urdf, "tool")
    assert len([*robots.iterdir()]) == 2
    cube.apply_scale(1.5).export(tmp_path / "arm.stl")
    made = Planner(urdf, "tool")
    assert len([*robots.iterdir()]) == 3
    assert np.isclose(np.ptp(made.robot.meshes["tool"][0].vertices[:, 2]), 0.3, atol=5e-3)
    # Regression: load_robot took one of these for the URDF, though it may have another tip and other pairs
    assert known_robots().keys() == {*ROBOTS}
    next(robots.iterdir()).rename(tmp_path / "robots" / "mine")
    assert Planner("mine", "tool").robot.joint_names == made.robot.joint_names


def test_where_no_motion_turns_evenly_one_that_turns_otherwise_has_a_note() -> None:
    """A rotation in place by 35 degrees with the arm nearly stretched, from ManiSkill's LiftPegUpright."""
    made = Planner("panda", "panda_hand_tcp", user_joint_names=JOINTS + FINGERS, srdf="")
    arm = [-0.1748361, 1.1052635, 0.3719087, -0.3689424, -0.3424939, 1.4765055, 0.748881]
    q = np.array([*arm, 0.0237, 0.0236])
    pose = [0.7810504, -0.0747778, 0.325, 0.0, 0.9510565, 0.0, 0.309017]
    result = made.plan_screw(pose, q, planning_time=0.5)
    assert result["status"] == "Success" and "this motion turns unevenly" in result["note"]
    line = [made.workspace.pose(q)[:3, 3] for q in result["position"]]
    assert np.allclose(line, pose[:3], atol=8e-3) and np.allclose(line[-1], pose[:3], atol=1e-3)


def test_a_line_to_the_edge_of_reach_ends_tilted_with_a_note(made: Planner) -> None:
    q = np.array([-0.23, 0.58, 0.0, -1.27, 0.0, 1.84, 0.56])
    far = made.workspace.pose(q)
    far[:3] = rd.pose([0.777, -0.226, 0.122], rpy=[np.pi, 0.0, 0.0])[:3]
    assert not len(made.workspace.ik(far))
    result = made.plan_screw(far, q, planning_time=10.0)
    assert result["status"] == "Success" and "out of reach; the motion ends tilted by" in result["note"]
    end = made.workspace.pose(result["position"][-1])
    assert np.allclose(end[:3, 3], far[:3, 3], atol=1e-3)
    assert 0.01 < np.arccos(end[2, 2] * far[2, 2]) < np.radians(15)
    far[0, 3] = 1.2
    assert re.search("out of reach|brings", made.plan_screw(far, q)["status"])


def test_self_collisions_are_checked_with_the_other_arm_where_qpos_has_it() -> None:
    left = rd.load_robot("baxter_left")
    other = [f"right_{joint}" for joint in ("s0", "s1", "e0", "e1", "w0", "w1", "w2")]
    made = Planner("baxter_left", left.tip, user_joint_names=[*left.joint_names, *other])
    arm = [-0.8, 0.5, -2.0, 1.5, 2.8, 1.1, 2.9]
    assert not made.check_for_self_collision([*arm, *np.zeros(7)])
    assert made.check_for_self_collision([*arm, 0.3, 1.0, 2.1, 2.0, 2.4, 0.7, -0.9])


def test_scripts_of_mplib_02_run_and_held_meshes_are_not_turned(tmp_path: Path) -> None:
    """Regressions: a whole qpos was refused without user_joint_names, there was no Pose, and a held .glb lay across."""
    planner = Planner("panda", "panda_hand")
    status, found = planner.IK(Pose([0.5, 0.2, 0.4], [0, 1, 0, 0]), [0, 0.4, 0, -2, 0, 2.4, 0.8, 0.01, 0.01])
    assert status == "Success" and found and len(found[0]) == 9 and planner.robot.locked["panda_finger_joint1"] == 0.01
    trimesh.creation.box([0.02, 0.04, 0.3]).export(tmp_path / "rod.glb")
    planner.update_attached_mesh(tmp_path / "rod.glb", [0, 0, 0.2, 1, 0, 0, 0])
    [rod] = planner.robot.attached[0].shapes
    assert isinstance(rod, rd.Mesh)
    np.testing.assert_allclose(rod.bounds[1] - [0, 0, 0.2], [0.01, 0.02, 0.15], atol=1e-6)
