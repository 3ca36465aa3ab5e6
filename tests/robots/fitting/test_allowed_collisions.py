"""Allowed collisions on arms made by hand: pairs of links that never, always or by default collide."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from helpers.box_arm import box_arm, box_mesh
from helpers.boxes import surface
from robotdiffuse.core.transforms import transform
from robotdiffuse.robots.fitting.convex_parts import convex_hull
from robotdiffuse.robots.fitting.covering_spheres import cover
from robotdiffuse.robots.fitting.preparation import AddReport
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


def limited(robot: Robot, bound: float) -> Robot:
    return replace(robot, joints=tuple(replace(j, lower=-bound, upper=bound) for j in robot.joints))


def test_rare_collision_is_found_by_descent() -> None:
    """The links collide only in a hundredth of the range of both joints, which 100 samples miss."""
    robot = limited(box_arm(), 2.2)
    few = SamplingSettings(samples=100)
    for seed in range(3):
        (pair,) = (r for r in find_allowed_collisions(robot, few, np.random.default_rng(seed)) if r.links == ("l1", "l3"))
        assert pair.reason == "checked"


def overlapping(lower: float, own: bool = True) -> Robot:
    """A robot with links a and c, two joints apart, whose meshes overlap while joint 2 is near zero."""
    z = np.array([0, 0, 1.0])
    joints = [
        Joint("1", "revolute", "a", "b", np.eye(4), z, -1.0, 1.0),
        Joint("2", "prismatic", "b", "m", np.eye(4), z, lower, 1.0),
        Joint("3", "revolute" if own else "fixed", "m", "c", transform(np.array([0.0, 0.0, 0.05])), z, -1.0, 1.0),
    ]
    cube = (box_mesh(np.full(3, -0.05), np.full(3, 0.05)),)
    tip = "c" if own else "m"
    ball = np.array([[0, 0, 0, 0.0867]])
    return Robot("overlap", "a", tip, tuple(joints), spheres={"a": ball, "c": ball}, meshes={"a": cube, "c": cube})


def with_middle(robot: Robot) -> Robot:
    far = (box_mesh(np.array([1.0, 1.0, 1.0]), np.array([1.1, 1.1, 1.1])),)
    return replace(
        robot,
        meshes=robot.meshes | {"b": far, "m": far},
        spheres=robot.spheres | {"b": np.array([[1.05, 1.05, 1.05, 0.1]]), "m": np.array([[1.05] * 3 + [0.1]])},
    )


def far_apart() -> Robot:
    """Four joints between links a and c, as between the upper arm and the wrist of a Z1 that is folded at zero."""
    robot = with_middle(overlapping(0.0))
    *rest, last = robot.joints
    turn = Joint("4", "revolute", "m", "n", np.eye(4), last.axis, -1.0, 1.0)
    return replace(robot, joints=(*rest, turn, replace(last, parent="n")))


def carrying(held: dict[str, float] | None = None) -> Robot:
    """Link m carries the hand on a joint, and c, fixed or by locked joints (`held`), as the vendor's Fetch its bellows."""
    robot = with_middle(overlapping(0.0, own=held is not None))
    z = np.array([0, 0, 1.0])
    turn = Joint("4", "revolute", "m", "hand", np.eye(4), z, -1.0, 1.0)
    if held is None:
        return replace(robot, tip="hand", joints=(*robot.joints, turn))
    *rest, bellows = robot.joints
    carried = [Joint("3", "prismatic", "m", "c", bellows.T_parent_joint, z, 0.0, 1.0)]
    if "5" in held:
        carried = [replace(carried[0], child="n"), Joint("5", "prismatic", "n", "c", np.eye(4), z, 0.0, 1.0)]
    return replace(robot, tip="hand", joints=(*rest, *carried, turn), locked=held)


def tucked(bend: float) -> Robot:
    """The arm of boxes with a named pose in which links touch, as in tucked arms."""
    arm = box_arm()
    return replace(arm, poses={"tucked": dict(zip(arm.joint_names, (0.0, 2.2, bend), strict=True))})


def thick(bound: float) -> Robot:
    """An arm whose first and last link collide in half of a joint's range, as the meshes of Baxter's forearm and wrist do,
    although the real links do not; the range is evidence of a stop only below a full turn."""
    wide = limited(box_arm(), bound)
    joints = tuple(replace(j, lower=-0.2, upper=0.2) if j.name == wide.joint_names[2] else j for j in wide.joints)
    (box,) = wide.meshes["l1"]
    meshes = wide.meshes | {"l1": (ConvexMesh(box.vertices * (1, 16, 1), box.faces),)}
    return replace(wide, joints=joints, meshes=meshes, spheres=wide.spheres | {"l1": np.array([[0.25, 0, 0, 0.6]])})


def always() -> Robot:
    robot = with_middle(overlapping(0.01))
    return replace(robot, joints=tuple(replace(j, upper=0.011) if j.name == "2" else j for j in robot.joints))


FOUND = {
    "beside each other": (box_arm, ("l1", "l2"), "adjacent"),
    "an arm that can fold": (box_arm, ("l1", "l3"), "checked"),
    "an arm that cannot fold": (lambda: limited(box_arm(), 0.5), ("l1", "l3"), "never"),
    "joints without geometry between": (lambda: overlapping(0.0), ("a", "c"), "adjacent"),
    "the default pose": (lambda: with_middle(overlapping(0.0)), ("a", "c"), "default"),
    "the default pose of links far apart": (far_apart, ("a", "c"), "checked"),
    "no pose within the limits": (lambda: with_middle(overlapping(0.02)), ("a", "c"), "checked"),
    "a tool in the default pose": (lambda: with_middle(overlapping(0.0, own=False)), ("a", "c"), "checked"),
    "what a link carries": (carrying, ("a", "c"), "default"),
    "what it carries on a held joint": (lambda: carrying({"3": 0.0}), ("a", "c"), "default"),
    "held elsewhere": (lambda: carrying({"3": 0.5}), ("a", "c"), "checked"),
    "held by two joints": (lambda: carrying({"3": 0.0, "5": 0.0}), ("a", "c"), "checked"),
    "a named pose": (lambda: tucked(2.2), ("l1", "l3"), "pose"),
    "a named pose without contact": (lambda: tucked(2.1), ("l1", "l3"), "checked"),
    "the stop of one joint": (lambda: thick(2.5), ("l1", "l3"), "limits"),
    "a full turn of one joint": (lambda: thick(3.1), ("l1", "l3"), "checked"),
    "everywhere": (always, ("a", "c"), "always"),
}


@pytest.mark.parametrize("case", FOUND)
def test_pairs_that_need_no_check_are_found(case: str) -> None:
    make, pair, found = FOUND[case]
    reports = find_allowed_collisions(make(), QUICK, np.random.default_rng(0))
    assert {report.links: report.reason for report in reports}[pair] == found


@pytest.mark.parametrize("reason", ["default", "limits", "pose"])
def test_pairs_that_meet_and_are_not_checked_are_told(reason: str) -> None:
    pairs = (PairReport(("l1", "l3"), reason, 0.27), PairReport(("l1", "l2"), "adjacent", 1.0))
    (warning,) = AddReport(box_arm(), Path(), (), pairs, FalseCollisions(0.7, 0.0, 0.0, ()), 0.0, 0).warnings
    assert "l1 against l3 is not checked" in warning and "27.0%" in warning


def test_share_of_collisions_by_hand() -> None:
    robot = with_middle(overlapping(0.02))
    (pair,) = (r for r in find_allowed_collisions(robot, QUICK, np.random.default_rng(0)) if r.links == ("a", "c"))
    # the cubes overlap up to joint 2 = 0.05, of 0.02 to 1; the spheres, which do not count, up to 0.1234
    assert pair.colliding == pytest.approx(0.03 / 0.98, abs=0.015)


def test_false_collisions_of_parts_after_true_ones_are_counted() -> None:
    """A box slides through two plates; the convex part of the plates fills the space between them."""
    plates = [trimesh.creation.box((0.02, 0.2, 0.2)).apply_translation((x, 0, 0)) for x in (0.0, 0.3)]
    box = trimesh.creation.box((0.04, 0.04, 0.04))
    surfaces = {"plates": tuple(map(surface, plates)), "box": (surface(box),)}
    parts = {link: (convex_hull(np.concatenate([one.vertices for one in pieces])),) for link, pieces in surfaces.items()}
    slide = Joint("slide", "prismatic", "plates", "box", np.eye(4), np.array([1.0, 0, 0]), -0.1, 0.4)
    spheres = {link: cover(part) for link, (part,) in parts.items()}
    robot = Robot("slider", "plates", "box", (slide,), spheres, parts)
    measured = measure_false_collisions(robot, surfaces, 2000, np.random.default_rng(0))
    # of 0.5 m, the box is in a plate for 0.12 m and between them, without touching one, for 0.24 m
    assert measured.free == pytest.approx(0.76, abs=0.05)
    assert measured.by_parts == pytest.approx(0.24 / 0.38, abs=0.05)
