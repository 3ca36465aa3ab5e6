"""Which joints are planned: arms, grippers, hands, groups of an SRDF, mimic joints."""

from pathlib import Path

import pytest

from helpers.example_robots import urdf_file
from helpers.made_arms import chain, joint, link, read_urdf, row, written
from helpers.refusals import refuses
from robotdiffuse.robots.parsing.srdf import read_srdf, srdf_beside
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.robot_folder import read_robot_folder, write_robot_folder

ARM = chain("base", row("j", 6))


def finger(i: int, count: int) -> str:
    return chain("j6_link", row(f"f{i}_", count))


TCP = link("tcp", "") + joint("tool", "j6_link", "tcp", "fixed")
MIMIC = '<mimic joint="drive" multiplier="-1"/>'
FIVE = "".join(link(f"m{i}") + joint(f"m{i}_joint", "j6_link", f"m{i}", more=MIMIC) for i in range(5))
END = {
    "nothing": ("", "j6_link"),
    "flange": (link("flange", "") + joint("mount", "j6_link", "flange", "fixed"), "flange"),
    "two fingers": (finger(1, 1) + finger(2, 1), "j6_link"),
    "a hand of five fingers": ("".join(finger(i, 4) for i in range(5)), "j6_link"),
    "a jaw": (chain("j6_link", ["gripper"]), "j6_link"),
    "a jaw beside a fixed frame": (chain("j6_link", ["left_jaw"]) + TCP, "j6_link"),
    "a jaw that only its link names": (link("arm_fngr") + joint("f1x", "j6_link", "arm_fngr"), "j6_link"),
    "a gripper of one joint that five follow": (chain("j6_link", ["drive"]) + FIVE, "j6_link"),
}
"""End effectors by name, and the link where the arm ends."""


@pytest.mark.parametrize(("parts", "tip"), END.values(), ids=END)
def test_grippers_and_hands_are_known_and_held(parts: str, tip: str, tmp_path: Path) -> None:
    robot = read_urdf(written(tmp_path, ARM, parts))
    assert robot.tip == tip and robot.joint_names == tuple(row("j", 6))
    assert robot.locked.keys() == {j.name for j in robot.joints if j.kind != "fixed"} - {*robot.joint_names}


def test_a_gripper_is_no_word_that_all_joints_have_and_is_planned_if_the_tip_says_so(tmp_path: Path) -> None:
    """Regression: of a finger with three joints on a table, only the first was planned."""
    robot = read_urdf(written(tmp_path, chain("base", row("finger_", 3))))
    assert robot.tip == "finger_3_link"
    robot = read_urdf(written(tmp_path, chain("base", [*row("claw_", 4), "claw_jaw"])))
    assert robot.tip == "claw_4_link"
    robot = read_urdf(written(tmp_path, ARM, chain("j6_link", ["gripper"])), tip="gripper_link")
    assert robot.joint_names == (*row("j", 6), "gripper")


def test_head_wheels_and_a_branch_along_the_arm_are_held(tmp_path: Path) -> None:
    parts = (
        chain("base", ["lift"], kind="prismatic"),
        chain("base", ["wheel_1"]) + chain("base", ["wheel_2"]),
        chain("lift_link", ["pan", "tilt"]),
        chain("lift_link", row("j", 6)),
        chain("j3_link", ["lid"]),
    )
    robot = read_urdf(written(tmp_path, *parts))
    assert robot.joint_names == ("lift", *row("j", 6)) and robot.tip == "j6_link"
    assert robot.locked.keys() == {"wheel_1", "wheel_2", "pan", "tilt", "lid"}


def test_two_arms_are_listed_and_asked_about(tmp_path: Path) -> None:
    file = written(tmp_path, *chain("base", row("left_", 7)), chain("base", row("right_", 7)), chain("base", ["head"]))
    arms = r"has 2 arms: left \(7 joints to left_7_link\), right \(7 joints to right_7_link\)"
    assert "--group left" in refuses(arms, read_urdf, file)
    for group in ("right", "right_7_link"):
        robot = read_urdf(file, group=group)
        assert robot.joint_names == tuple(row("right_", 7)) and robot.locked.keys() == {*row("left_", 7), "head"}
        assert "left_7_link" in robot.meshes  # held, but still checked for collisions
    refuses(r"unknown group of .* 'middle'; known: all, both, left, right", read_urdf, file, group="middle")


@pytest.mark.parametrize(
    "first, second, names",
    [
        ("left_fr3_joint", "right_fr3_joint", "left_fr3 .*, right_fr3 "),
        ("l/joint_", "r/joint_", "l .*, r "),
        ("joint_1", "joint_2", "joint_16_link .*, joint_26_link "),
    ],
)
def test_names_of_arms(first: str, second: str, names: str, tmp_path: Path) -> None:
    refuses(f"2 arms: {names}", read_urdf, written(tmp_path, chain("base", row(first, 6)), chain("base", row(second, 6))))


def test_two_arms_and_a_head_on_a_torso_are_no_hand(tmp_path: Path) -> None:
    """A torso of six joints was planned, and both arms were held as its fingers."""
    branches = (chain("j6_link", row(side, 7)) for side in ("left_", "right_"))
    file = written(tmp_path, ARM, *branches, chain("j6_link", ["pan", "tilt"]))
    refuses("has 2 arms: left .13 joints to left_7_link., right ", read_urdf, file)


def test_published_arms_end_where_their_grippers_begin(tmp_path: Path) -> None:
    pytest.importorskip("pinocchio")
    data = urdf_file("panda", tmp_path).parents[2]
    for file, tip, dof in (
        ("so_arm_description/urdf/so100.urdf", "gripper", 5),
        ("z1_description/urdf/z1.urdf", "gripperStator", 6),
        ("tiago_description/robots/tiago.urdf", "hand_palm_link", 8),
        ("kinova_description/robots/kinova.urdf", "j2s6s200_end_effector", 6),  # not the tip of a fixed finger
    ):
        robot = read_urdf(data / file)
        assert (robot.tip, robot.dof) == (tip, dof)
    refuses(r"right .7 joints to right_gripper_base_link", read_urdf, data / "baxter_description/urdf/baxter.urdf")


def test_mimic_joints_follow(tmp_path: Path) -> None:
    """Including a mimic of a mimic joint, and a robot written to and read from a folder."""
    other = joint("other", "j6_link", "b", more='<mimic joint="grip" multiplier="-0.5" offset="0.1"/>')
    third = joint("third", "b", "c", more='<mimic joint="other" multiplier="2"/>')
    robot = read_urdf(written(tmp_path, ARM, chain("j6_link", ["grip"]), link("b"), other, link("c"), third))
    assert robot.locked == {"grip": 0.0, "other": 0.1, "third": 0.2}
    write_robot_folder(robot, tmp_path / "kept", {})
    for arm in (robot, read_robot_folder(tmp_path / "kept")):
        arm = arm.with_locked({"grip": 0.4})
        assert arm.locked == pytest.approx({"grip": 0.4, "other": -0.1, "third": -0.2})
        assert arm.with_locked({"grip": 0.4, "third": -0.2}).locked == arm.locked
        refuses(r"third is 0.3; it follows other, .* at -0.2; lock other", arm.with_locked, {"third": 0.3})


def test_mimics_of_planned_joints_raise_unless_these_are_locked_or_above_the_base(tmp_path: Path) -> None:
    bar = link("bar") + joint("rod", "j1_link", "bar", more='<mimic joint="j2" multiplier="-1"/>')
    file = written(tmp_path, ARM, bar)
    refuses(r"rod mimics j2, which is planned; .*--lock j2=VALUE.*, or remove rod and what it carries", read_urdf, file)
    held = read_urdf(file, locked={"j2": 0.5})
    assert held.locked == {"rod": -0.5, "j2": 0.5} and held.dof == 5
    framed = read_urdf(written(tmp_path, ARM, bar.replace(link("bar"), link("bar", ""))))
    assert framed.dof == 6 and "the pose of bar is wrong" in "".join(framed.notes)
    inside = link("end") + joint("last", "j6_link", "end", more='<mimic joint="j5" offset="0.2"/>')
    refuses("last mimics j5", read_urdf, written(tmp_path, ARM, inside), tip="end")
    alone = read_urdf(written(tmp_path, ARM, inside), tip="end", base="j5_link")
    assert alone.locked == {"last": 0.2} and "last mimics j5, which is above the base: it is held at 0.2" in alone.notes[-1]


@pytest.mark.parametrize("followed", ["nobody", "rod", "other"])
def test_mimic_of_nothing_or_in_a_circle(followed: str, tmp_path: Path) -> None:
    rod = joint("rod", "base", "bar", more=f'<mimic joint="{followed}"/>')
    file = written(tmp_path, ARM, link("bar"), rod, link("end"), joint("other", "base", "end", more='<mimic joint="rod"/>'))
    refuses("another joint of the file and must not mimic", read_urdf, file)


SRDF = (Path(__file__).parents[2] / "files" / "groups.srdf").read_text()


def test_groups_poses_and_passive_joints_of_an_srdf(tmp_path: Path) -> None:
    file = written(tmp_path, ARM, chain("j6_link", ["grip"]))
    (tmp_path / "srdf").mkdir()
    (tmp_path / "srdf" / "made.srdf").write_text(SRDF)
    assert srdf_beside(file, "any") == tmp_path / "srdf" / "made.srdf" and srdf_beside(tmp_path / "nothing.urdf", "any") is None
    srdf = read_srdf(tmp_path / "srdf" / "made.srdf")
    assert srdf.allowed[frozenset(("base", "j6_link"))] == "User"
    robot = read_urdf(file, group="arm", srdf=srdf)
    assert robot.joint_names == ("j2", "j3", "j5", "j6") and robot.tip == "j6_link"
    assert robot.locked == {"j1": 0.5, "j4": 0.0, "grip": 0.7} and any("j4 is passive" in note for note in robot.notes)
    assert robot.poses["home"] == {"j1": 0.5, "j3": 9.0}
    robot = read_urdf(file, group="short", srdf=srdf)
    assert robot.joint_names == ("j1", "j2") and robot.locked["j3"] == 2.0  # the pose, clipped
    assert read_urdf(file, group="all", srdf=srdf).joint_names == ("j2", "j3", "j5", "j6", "grip")
    for group, message in (
        ("wrong", "unknown joint of group wrong .* 'nobody'"),
        ("circle", "group circle contains itself"),
        ("nothing", "unknown group .* 'nothing'; known: all, arm, circle, hand, j, short, wrong"),
    ):
        refuses(message, read_urdf, file, group=group, srdf=srdf)
    refuses("below the robot's base lead from link j1_link to", read_urdf, file, base="j2_link", group="arm", srdf=srdf)


@pytest.mark.parametrize(
    "text, message",
    [
        ("<robot", "well-formed"),
        ("<mujoco/>", "not an SRDF"),
        ("<robot><disable_collisions link1='a'/></robot>", "has no link2"),
        ("<robot><group_state name='s'><joint name='j' value='x'/></group_state></robot>", "value is 'x'; it must be a number"),
        ("<robot><group_state name='s'><joint name='j' value=' '/></group_state></robot>", "value is ' '; it must be a number"),
    ],
)
def test_damaged_srdf(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.srdf").write_text(text)
    assert "a.srdf" in refuses(message, read_srdf, tmp_path / "a.srdf")


def test_chains_of_mimic_joints(tmp_path: Path) -> None:
    """Regressions: a joint that follows one that follows a fixed joint stayed; saved values of followers were refused."""

    def made(b: str, c: str) -> Robot:
        limbs = [joint("c", "j_link", "x", c), joint("b", "j_link", "y", b, more='<mimic joint="c"/>')]
        limbs.append(joint("a", "j_link", "z", limits='lower="0" upper="0.2"', more='<mimic joint="b" multiplier="2"/>'))
        return read_urdf(written(tmp_path, chain("base", ["j"]), *map(link, "xyz"), *limbs), tip="j_link")

    held = made("revolute", "fixed").with_locked({"b": 0.5})
    assert held.with_locked(held.locked).locked == {"b": 0.5, "a": 1.0}
    assert made("fixed", "revolute").locked == {"c": 0.0, "a": 0.0}
