"""Allowed collisions on arms made by hand: pairs of links that never, always or by default collide."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from helpers.box_arm import box_arm, box_mesh
from robotdiffuse.core.transforms import inverse, transform
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.bodies import Surface
from robotdiffuse.robots.fitting.convex_parts import convex_hull
from robotdiffuse.robots.fitting.covering_spheres import cover
from robotdiffuse.robots.fitting.preparation import AddReport
from robotdiffuse.robots.fitting.sampled_links import Links
from robotdiffuse.robots.fitting.self_collisions import (
    FalseCollisions,
    PairReport,
    SamplingSettings,
    find_allowed_collisions,
    measure_false_collisions,
)
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.robots.robot import ConvexMesh, Robot

QUICK = SamplingSettings(samples=1500)


def reasons(robot: Robot, seed: int = 0) -> dict[tuple[str, str], str]:
    return {r.links: r.reason for r in find_allowed_collisions(robot, QUICK, np.random.default_rng(seed))}


def limited(robot: Robot, bound: float) -> Robot:
    return replace(robot, joints=tuple(replace(j, lower=-bound, upper=bound) for j in robot.joints))


def test_arm_that_can_fold_is_checked() -> None:
    found = reasons(box_arm())
    assert found == {("l1", "l2"): "adjacent", ("l2", "l3"): "adjacent", ("l1", "l3"): "checked"}


def test_arm_that_cannot_fold_is_not() -> None:
    assert reasons(limited(box_arm(), 0.5))["l1", "l3"] == "never"


def test_rare_collision_is_found_by_descent() -> None:
    """The links collide only in a hundredth of the range of both joints, which 100 samples miss."""
    robot = limited(box_arm(), 2.2)
    few = SamplingSettings(samples=100)
    for seed in range(3):
        reports = find_allowed_collisions(robot, few, np.random.default_rng(seed))
        (pair,) = (r for r in reports if r.links == ("l1", "l3"))
        assert pair.reason == "checked"


def overlapping(lower: float, own: bool = True) -> Robot:
    """Links a and c, two joints apart, whose meshes overlap while joint 2 is near zero."""
    z = np.array([0, 0, 1.0])
    kind = "revolute" if own else "fixed"
    joints = [
        Joint("1", "revolute", "a", "b", np.eye(4), z, -1.0, 1.0),
        Joint("2", "prismatic", "b", "m", np.eye(4), z, lower, 1.0),
        Joint("3", kind, "m", "c", transform(np.array([0.0, 0.0, 0.05])), z, -1.0, 1.0),
    ]
    cube = (box_mesh(np.full(3, -0.05), np.full(3, 0.05)),)
    tip = "c" if own else "m"
    ball = np.array([[0, 0, 0, 0.0867]])
    spheres = {"a": ball, "c": ball}
    return Robot("overlap", "a", tip, tuple(joints), spheres=spheres, meshes={"a": cube, "c": cube})


def test_links_between_joints_without_geometry_are_adjacent() -> None:
    assert reasons(overlapping(0.0))["a", "c"] == "adjacent"


def with_middle(robot: Robot) -> Robot:
    far = (box_mesh(np.array([1.0, 1.0, 1.0]), np.array([1.1, 1.1, 1.1])),)
    return replace(
        robot,
        meshes=robot.meshes | {"b": far, "m": far},
        spheres=robot.spheres
        | {"b": np.array([[1.05, 1.05, 1.05, 0.1]]), "m": np.array([[1.05] * 3 + [0.1]])},
    )


def test_collision_in_the_default_pose_is_allowed_if_the_limits_allow_the_pose() -> None:
    assert reasons(with_middle(overlapping(0.0)))["a", "c"] == "default"
    assert reasons(with_middle(overlapping(0.02)))["a", "c"] == "checked"


def test_tool_that_collides_in_the_default_pose_is_checked() -> None:
    assert reasons(with_middle(overlapping(0.0, own=False)))["a", "c"] == "checked"


def test_what_a_link_carries_is_the_arms_own() -> None:
    """Like Fetch's bellows: fixed to the lift, and inside the base while the lift is down."""
    robot = with_middle(overlapping(0.0, own=False))
    turn = Joint("4", "revolute", "m", "hand", np.eye(4), np.array([0, 0, 1.0]), -1.0, 1.0)
    assert reasons(replace(robot, tip="hand", joints=(*robot.joints, turn)))["a", "c"] == "default"


@pytest.mark.parametrize(
    ("held", "found"),
    [({"3": 0.0}, "default"), ({"3": 0.5}, "checked"), ({"3": 0.0, "5": 0.0}, "checked")],
    ids=["where it overlaps", "elsewhere", "two joints"],
)
def test_what_a_link_carries_on_a_held_joint_is_the_arms_own(held: dict[str, float], found: str) -> None:
    """The bellows of the vendor's Fetch have a joint of their own, which planning holds."""
    robot = with_middle(overlapping(0.0))
    z = np.array([0, 0, 1.0])
    *rest, bellows = robot.joints
    carried = [Joint("3", "prismatic", "m", "c", bellows.T_parent_joint, z, 0.0, 1.0)]
    if "5" in held:
        carried = [replace(carried[0], child="n"), Joint("5", "prismatic", "n", "c", np.eye(4), z, 0.0, 1.0)]
    turn = Joint("4", "revolute", "m", "hand", np.eye(4), z, -1.0, 1.0)
    robot = replace(robot, tip="hand", joints=(*rest, *carried, turn), locked=held)
    assert robot.joint_names == ("1", "2", "4")
    assert reasons(robot)["a", "c"] == found


@pytest.mark.parametrize(("bend", "found"), [(2.2, "pose"), (2.1, "checked")])
def test_what_touches_in_a_named_pose_is_allowed(bend: float, found: str) -> None:
    """Links of tucked arms touch each other."""
    arm = box_arm()
    pose = dict(zip(arm.joint_names, (0.0, 2.2, bend), strict=True))
    assert reasons(replace(arm, poses={"tucked": pose}))["l1", "l3"] == found


@pytest.mark.parametrize(("bound", "found"), [(2.5, "limits"), (3.1, "checked")])
def test_what_one_joint_folds_into_up_to_its_stop_is_allowed(bound: float, found: str) -> None:
    """The meshes of Baxter's forearm and wrist collide in half of the joint's range; the real links never do.
    The range of a joint that makes a full turn proves nothing."""
    wide = limited(box_arm(), bound)
    last = wide.joint_names[2]
    joints = (replace(j, lower=-0.2, upper=0.2) if j.name == last else j for j in wide.joints)
    wide = replace(wide, joints=tuple(joints))
    (box,) = wide.meshes["l1"]
    thick = ConvexMesh(box.vertices * (1, 16, 1), box.faces)
    ball = np.array([[0.25, 0, 0, 0.6]])
    meshes = wide.meshes | {"l1": (thick,)}
    spheres = wide.spheres | {"l1": ball}
    assert reasons(replace(wide, meshes=meshes, spheres=spheres))["l1", "l3"] == found


def test_pairs_that_meet_and_are_not_checked_are_told() -> None:
    pairs = (PairReport(("l1", "l3"), "limits", 0.27), PairReport(("l1", "l2"), "adjacent", 1.0))
    report = AddReport(box_arm(), Path(), (), pairs, FalseCollisions(0.7, 0.0, 0.0, ()), 0.0, 0)
    (warning,) = report.warnings
    assert "l1 against l3 is not checked" in warning and "27.0%" in warning


def test_always_colliding() -> None:
    robot = with_middle(overlapping(0.01))
    robot = replace(
        robot, joints=tuple(replace(j, upper=0.011) if j.name == "2" else j for j in robot.joints)
    )
    assert reasons(robot)["a", "c"] == "always"


def test_share_of_collisions_by_hand() -> None:
    robot = with_middle(overlapping(0.02))
    (pair,) = (
        r for r in find_allowed_collisions(robot, QUICK, np.random.default_rng(0)) if r.links == ("a", "c")
    )
    # the cubes overlap up to joint 2 = 0.05, of 0.02 to 1; the spheres, which do not count, up to 0.1234
    assert pair.colliding == pytest.approx(0.03 / 0.98, abs=0.015)


def test_links_stand_to_each_other_as_seen_from_the_base() -> None:
    """Poses of wanted links are relative to their last common ancestor."""
    robot = load_robot("panda")
    links = Links(robot)
    q = links.random(3, np.random.default_rng(0))
    poses = links.poses(q)
    names = list(robot.meshes)
    for a, b in zip(names, names[1:] + names[:1], strict=True):
        some = links.poses(q, frozenset((a, b)))
        for i in range(3):
            expected = inverse(poses[a][i]) @ poses[b][i]
            np.testing.assert_allclose(inverse(some[a][i]) @ some[b][i], expected, atol=1e-12)


def test_same_seed_same_pairs() -> None:
    robot = limited(box_arm(), 2.2)
    runs = [find_allowed_collisions(robot, QUICK, np.random.default_rng(1)) for _ in range(2)]
    assert runs[0] == runs[1]
    allowed = {frozenset(run.links) for run in runs[0] if run.reason != "checked"}
    assert allowed == {frozenset(("l1", "l2")), frozenset(("l2", "l3"))}


def test_bundled_panda_has_the_expected_pairs() -> None:
    """Checked pairs include those of MoveIt's Panda with real contacts, and the hand against the forearm."""
    checked = set(map(frozenset, load_robot("panda").checked_pairs()))
    for a in ("panda_link0", "panda_link1", "panda_link2"):
        for b in ("panda_link5", "panda_link6", "panda_link7", "panda_hand", "panda_leftfinger"):
            assert frozenset((a, b)) in checked
    assert frozenset(("panda_link5", "panda_hand")) in checked
    for i in range(7):
        assert frozenset((f"panda_link{i}", f"panda_link{i + 1}")) not in checked
    assert frozenset(("panda_link5", "panda_link7")) not in checked


def test_false_collisions_of_parts_after_true_ones_are_counted() -> None:
    """A box slides through two plates, whose convex part fills the space between them."""
    plates = [trimesh.creation.box((0.02, 0.2, 0.2)).apply_translation((x, 0, 0)) for x in (0.0, 0.3)]
    box = trimesh.creation.box((0.04, 0.04, 0.04))
    surfaces = {
        link: tuple(Surface(np.array(mesh.vertices), np.array(mesh.faces)) for mesh in meshes)
        for link, meshes in {"plates": plates, "box": [box]}.items()
    }
    parts = {
        link: (convex_hull(np.concatenate([one.vertices for one in pieces])),)
        for link, pieces in surfaces.items()
    }
    slide = Joint("slide", "prismatic", "plates", "box", np.eye(4), np.array([1.0, 0, 0]), -0.1, 0.4)
    spheres = {link: cover(part) for link, (part,) in parts.items()}
    robot = Robot("slider", "plates", "box", (slide,), spheres, parts)
    measured = measure_false_collisions(robot, surfaces, 2000, np.random.default_rng(0))
    # of 0.5 m, the box is in a plate for 0.12 m and between them, without touching one, for 0.24 m
    assert measured.free == pytest.approx(0.76, abs=0.05)
    assert measured.by_parts == pytest.approx(0.24 / 0.38, abs=0.05)
