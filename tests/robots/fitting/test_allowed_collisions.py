"""Allowed collisions of arms made by hand; a table over the joints of a flange in a fork, closer than spheres resolve."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.transformations import rotation_matrix

import robotdiffuse as rd
from helpers.box_arm import box_arm, box_mesh, surface
from helpers.quick_preparation import coarse_grids
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.core.transforms import transform
from robotdiffuse.robots.fitting import self_collisions
from robotdiffuse.robots.fitting.convex_parts import PartSettings, Surface, convex_hull
from robotdiffuse.robots.fitting.covering_spheres import cover
from robotdiffuse.robots.fitting.preparation import AddReport, PreparationSettings, Prepared, prepare
from robotdiffuse.robots.fitting.self_collisions import Links, joint_table
from robotdiffuse.robots.fitting.sphere_fitting import SphereSettings
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.robots.robot import ConvexMesh, LinkPairTable, Robot
from robotdiffuse.robots.robot_folder import read_robot_folder, write_robot_folder
from robotdiffuse.scenes.scene import Scene

QUICK = self_collisions.SamplingSettings(samples=1500)


def limited(robot: Robot, bound: float) -> Robot:
    return replace(robot, joints=tuple(replace(j, lower=-bound, upper=bound) for j in robot.joints))


def found_pairs(robot: Robot, seed: int = 0, settings: self_collisions.SamplingSettings = QUICK) -> dict:
    found = self_collisions.find_allowed_collisions(robot, settings, np.random.default_rng(seed))
    return {report.links: report for report in found}


def test_rare_collision_is_found_by_descent() -> None:
    """The links collide only in a hundredth of the range of both joints, which 100 samples miss."""
    robot = limited(box_arm(), 2.2)
    few = self_collisions.SamplingSettings(samples=100)
    for seed in range(3):
        assert found_pairs(robot, seed, few)["l1", "l3"].reason == "checked"


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
    """First and last link collide in half of a joint's range, as Baxter's meshes do: a stop only below a full turn."""
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
    assert found_pairs(make())[pair].reason == found


@pytest.mark.parametrize("reason", ["default", "limits", "pose"])
def test_pairs_that_meet_and_are_not_checked_are_told(reason: str) -> None:
    pairs = (self_collisions.PairReport(("l1", "l3"), reason, 0.27), self_collisions.PairReport(("l1", "l2"), "adjacent", 1.0))
    (warning,) = AddReport(box_arm(), Path(), (), pairs, self_collisions.FalseCollisions(0.7, 0.0, 0.0, ()), 0.0, 0).warnings
    assert "l1 against l3 is not checked" in warning and "27.0%" in warning


def test_share_of_collisions_by_hand() -> None:
    pair = found_pairs(with_middle(overlapping(0.02)))["a", "c"]
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
    measured = self_collisions.measure_false_collisions(robot, surfaces, 2000, np.random.default_rng(0))
    # of 0.5 m, the box is in a plate for 0.12 m and between them, without touching one, for 0.24 m
    assert measured.free == pytest.approx(0.76, abs=0.05) and measured.by_parts == pytest.approx(0.24 / 0.38, abs=0.05)


PAIR = ("fork", "flange")
COARSE = PreparationSettings(
    parts=PartSettings(voxels=50_000),
    spheres=SphereSettings(candidates=300, rounds=2),
    sampling=self_collisions.SamplingSettings(samples=1000, descents=3),
    samples=500,
)


def box(size: tuple[float, ...], at: tuple[float, ...]) -> Surface:
    return surface(trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)))


def fork(gap: float = 0.003) -> tuple[Robot, dict[str, tuple[Surface, ...]]]:
    """A flange as close to both prongs of a fork at any angle; bent far back, it hits the base of the fork."""
    y = np.array([0, 1.0, 0])
    x = np.array([1.0, 0, 0])
    rates = (2.0, 8.0, 80.0)
    joints = (
        Joint("bend", "revolute", "fork", "wrist", np.eye(4), y, -3.0, 3.0, *rates),
        Joint("spin", "continuous", "wrist", "flange", transform(np.array([0.09, 0, 0])), x, -9.0, 9.0, *rates),
    )
    disc_along_x = trimesh.creation.cylinder(0.05 - gap, 0.14, transform=rotation_matrix(np.pi / 2, [0, 1, 0]))
    prongs = (box((0.4, 0.04, 0.1), (0, 0.07, 0)), box((0.4, 0.04, 0.1), (0, -0.07, 0)))
    surfaces = {
        "fork": (*prongs, box((0.05, 0.1, 0.1), (-0.175, 0, 0))),
        "wrist": (box((0.04, 0.04, 0.04), (0, 0, 0)),),
        "flange": (surface(disc_along_x),),
    }
    return Robot("fork", "fork", "flange", joints, meshes=dict.fromkeys(surfaces, ())), surfaces


@cache
def made(gap: float = 0.003) -> Prepared:
    with coarse_grids():
        return prepare(*fork(gap), COARSE)


@cache
def by_hand() -> Robot:
    """The robot of `fork` without preparation, with a wrong table, which says that the pair never touches."""
    robot, surfaces = fork()
    meshes = {link: tuple(convex_hull(one.vertices) for one in of) for link, of in surfaces.items()}
    spheres = {link: np.concatenate([cover(mesh) for mesh in of]) for link, of in meshes.items()}
    beside = frozenset(map(frozenset, (("fork", "wrist"), ("wrist", "flange"))))
    table = LinkPairTable(PAIR, robot.joint_names, (-3.0, -np.pi), (3.0, np.pi), np.ones((8, 8), bool))
    return replace(robot, meshes=meshes, spheres=spheres, allowed_collisions=beside, tables=(table,))


def shares(robot: Robot) -> tuple[float, int]:
    """Fraction of free configurations with false collisions, and the number of configurations wrongly called free."""
    q = np.random.default_rng(3).uniform(robot.lower, robot.upper, (3000, robot.dof))
    checker = CollisionChecker(robot, Scene())
    free = checker.free(q)
    exact = ~ExactCollision(robot, Scene()).collides(q)
    assert (checker.pair_clearances(q)[free] > 0).all()
    return float(1 - free[exact].mean()), int((free & ~exact).sum())


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.003, 0.0067])
def test_a_pair_that_is_always_close_refuses_little(gap: float) -> None:
    """Regression: no spheres that refinement found fit into the 7 mm in a PR2's shoulder, and it had no free configuration."""
    prepared = made(gap)
    robot = prepared.robot
    assert [table.links for table in robot.tables] == [PAIR] and prepared.false_collisions.by_spheres < 0.08
    assert shares(replace(robot, tables=())) == (1.0, 0)
    refused, wrong = shares(robot)
    assert refused < 0.08 and wrong == 0


def test_tables_are_kept_in_the_robots_folder(tmp_path: Path) -> None:
    (table,) = by_hand().tables
    table = replace(table, apart=np.random.default_rng(0).random((8, 8)) < 0.5)
    write_robot_folder(replace(by_hand(), tables=(table,)), tmp_path, {})
    (kept,) = read_robot_folder(tmp_path).tables
    for name in ("links", "joints", "lower", "upper", "apart"):
        assert np.array_equal(getattr(kept, name), getattr(table, name)), name


def test_a_table_is_left_aside_where_a_joint_is_held_or_its_joints_are_others() -> None:
    robot = by_hand()
    refused, wrong = shares(robot)
    assert refused == 0.0 and wrong > 0
    (table,) = robot.tables
    # regression: where a table says that links are apart, their clearance was 1 m
    problem = rd.Problem(robot, rd.Scene(), np.zeros(robot.dof), np.full(robot.dof, 0.05))
    near = min(pair.distance for pair in ExactCollision(robot, rd.Scene()).distances(problem.start))
    assert problem.clearance_at(problem.start) <= near
    for other in (robot.with_locked({"spin": 0.3}), replace(robot, tables=(replace(table, joints=table.joints[::-1]),))):
        assert shares(other) == (1.0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("pair", [PAIR, ("wrist", "flange")])
def test_tables_say_no_more_than_the_parts(pair: tuple[str, str]) -> None:
    robot = made().robot
    links = Links(robot)
    table = joint_table(robot, links, pair, 1e-3)
    q = links.random(2000, np.random.default_rng(1))
    poses = links.poses(q)
    apart = table.at(*(q[:, robot.joint_names.index(name)] for name in table.joints))
    assert not any(links.collide(poses, *pair, int(i)) for i in np.flatnonzero(apart))


def test_intervals_are_apart_if_all_that_is_within_them_is() -> None:
    """Intervals along a joint with limits, and along a continuous one."""
    rng = np.random.default_rng(0)
    table = LinkPairTable(PAIR, ("a", "b"), (-1.0, -np.pi), (1.0, np.pi), rng.random((8, 8)) < 0.9)
    low = [rng.uniform(-1.4, 1.2, 40), rng.uniform(-9, 8, 40)]
    high = [low[0] + rng.uniform(0, 0.5, 40), low[1] + rng.uniform(0, 2, 40)]
    found = table.throughout(*zip(low, high, strict=True))
    share = np.linspace(0, 1, 60)
    for i in range(40):
        for k in range(40):
            a = low[0][i] + share * (high[0][i] - low[0][i])
            b = low[1][k] + share * (high[1][k] - low[1][k])
            assert found[i, k] == table.at(np.repeat(a, 60), np.tile(b, 60)).all()
