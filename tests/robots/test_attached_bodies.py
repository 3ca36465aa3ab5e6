"""Tools and held objects: compared with the same geometry built into a robot, by hand, and by sampling."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from numpy import ndarray

import robotdiffuse as rd
from helpers.box_arm import box_arm, box_mesh
from helpers.panda import PANDA
from helpers.refusals import refuses
from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.core.transforms import rotation_about, transform
from robotdiffuse.robots.bodies import ConvexMesh
from robotdiffuse.robots.fitting.convex_parts import convex_hull, planes_of
from robotdiffuse.robots.fitting.covering_spheres import MAX_SPHERES, cover
from robotdiffuse.robots.motion_bounds import motion_radii
from robotdiffuse.robots.robot import robot_fingerprint
from robotdiffuse.scenes.shapes import Shape
from robotdiffuse.scenes.surface_points import draw

STICK = box_mesh(np.zeros(3), np.array([0.3, 0.02, 0.02]))
SOLIDS = {
    "cube": box_mesh(np.full(3, -0.02), np.full(3, 0.02)),
    "box": box_mesh(np.array([-0.03, -0.03, -0.1]), np.array([0.03, 0.03, 0.1])),
    "tray": box_mesh(np.array([-0.2, -0.15, -0.005]), np.array([0.2, 0.15, 0.005])),
    "stone": convex_hull(np.random.default_rng(0).normal(size=(40, 3)) * [0.05, 0.03, 0.1]),
    "tilted": convex_hull(STICK.vertices @ rotation_about(np.array([1.0, 2.0, 3.0]) / np.sqrt(14), 0.7)),
}
SHAPES = [
    rd.Sphere([0.1, 0.0, 0.05], 0.03, name="ball"),
    rd.Box([0.1, 0.02, 0.05], [0.05, 0.08, 0.1], [0.9, 0.1, 0.3, 0.0], name="crate"),
    rd.Cylinder([0.0, 0.0, 0.1], 0.03, 0.12, [0.7, 0.7, 0.0, 0.1], name="cup"),
    rd.Capsule([0.0, 0.1, 0.1], 0.02, 0.2, name="pen"),
    rd.Mesh(SOLIDS["stone"].vertices, SOLIDS["stone"].faces, [0.1, 0, 0], name="stone"),
]


def inside(mesh: ConvexMesh, points: ndarray, slack: float = 0.0) -> ndarray:
    normals, offsets = planes_of(mesh)
    return (offsets + slack - points @ normals.T).min(axis=1) >= 0


@pytest.mark.parametrize("mesh", SOLIDS.values(), ids=SOLIDS)
def test_spheres_cover_surface_and_inside(mesh: ConvexMesh) -> None:
    spheres = cover(mesh)
    points = np.random.default_rng(1).uniform(mesh.vertices.min(0), mesh.vertices.max(0), (100_000, 3))
    points = np.concatenate([points[inside(mesh, points)], mesh.vertices])
    held = np.any([np.linalg.norm(points - center, axis=1) <= r for *center, r in spheres], axis=0)
    assert held.all() and len(spheres) <= MAX_SPHERES


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.kind)
def test_polyhedra_hold_shapes_and_are_little_larger(shape: Shape) -> None:
    robot = box_arm().attach(shape, "l3")
    [body] = robot.attached
    T = body.T_link_body
    surface = shape.world_vertices if isinstance(shape, rd.Mesh) else draw(shape, 2000, np.random.default_rng(2))
    points = (surface - T[:3, 3]) @ T[:3, :3]
    [mesh] = robot.meshes[shape.name]
    assert inside(mesh, points, 1e-9).all() and (np.ptp(mesh.vertices, axis=0) <= np.ptp(points, axis=0) * 1.03 + 1e-3).all()


def test_what_is_made_of_the_arm_is_what_is_made_anew() -> None:
    robot = box_arm().attach(SHAPES[1], "l3").attach(SHAPES[2], "crate")
    anew = replace(robot, attached=(), bare=None)
    assert np.allclose(motion_radii(robot), motion_radii(anew), atol=1e-12)
    for a, b in zip(compile_robot(robot), compile_robot(anew), strict=True):
        assert np.array_equal(np.asarray(a), np.asarray(b))
    assert robot.joint_names == box_arm().joint_names and robot.dof == 3


def test_same_content_is_the_same_robot() -> None:
    box = {"center": [0.1, 0, 0], "size": [0.05, 0.05, 0.1]}
    one, two = (box_arm().attach(rd.Box(**box), "l3") for _ in range(2))
    assert one is two and box_arm().attach(rd.Box(**box, name="other"), "l3") is not one
    assert box_arm().attach(rd.Box(**box), "l3", ["l1"]) is not one
    assert one.detach("box") is box_arm() and one.arm is box_arm()
    assert robot_fingerprint(one) != robot_fingerprint(box_arm())
    assert robot_fingerprint(pickle.loads(pickle.dumps(one))) == robot_fingerprint(one)


def test_allowed_contacts_are_named_and_all_else_is_checked() -> None:
    pairs = {frozenset(pair) for pair in box_arm().attach(SHAPES[1], "l3", ["l2"]).checked_pairs()}
    assert frozenset(("l1", "crate")) in pairs
    assert frozenset(("l2", "crate")) not in pairs, "it is named"
    assert frozenset(("l3", "crate")) not in pairs, "it moves with it"


def test_held_objects_stay_with_other_locked_joints() -> None:
    closed = PANDA.attach(SHAPES[2], "panda_hand").with_locked({"panda_finger_joint1": 0.0})
    assert closed is PANDA.with_locked({"panda_finger_joint1": 0.0}).attach(SHAPES[2], "panda_hand")
    assert closed.detach("cup") is PANDA.with_locked({"panda_finger_joint1": 0.0})


def test_a_tool_is_the_tip_and_its_shapes_are_in_the_frame_of_its_link() -> None:
    T_hand_tool = transform(np.array([0.0, 0.0, 0.15]), rotation_about(np.array([1.0, 0, 0]), 0.3))
    robot = PANDA.with_tool("panda_hand", T_hand_tool, [rd.Cylinder([0, 0, 0.1], 0.01, 0.1)])
    q = np.array([0.1, 0.2, 0.3, -1.5, 0.2, 1.5, 0.3])
    assert robot.tip == "tool"
    assert np.allclose(robot.fk(q, "tool"), PANDA.fk(q, "panda_hand") @ T_hand_tool)
    for point in (np.array([0.0, 0.0, 0.05, 1.0]), np.array([0.0, 0.0, 0.15, 1.0])):
        local = np.linalg.inv(T_hand_tool) @ point
        assert inside(robot.meshes["tool"][0], local[None, :3], 1e-9).all()
    assert "tool" not in PANDA.with_tool("panda_hand", T_hand_tool).spheres, "a mere frame"


def test_what_cannot_be_held_is_refused_in_one_line_that_calls_no_held_object_a_link() -> None:
    held = PANDA.attach(SHAPES[2], "panda_hand")
    refuses("'cup'; it must be a name that no link or held object of panda has", held.attach, SHAPES[2], "panda_hand")
    refuses("unknown link in attached.link: 'hand'; known: l1, l2, l3", box_arm().attach, SHAPES[0], "hand")
    refuses("no planned joint moves .*; moved links: l1", box_arm().attach, SHAPES[0], box_arm().base)
    refuses("'l2'; it must be a name that no link", box_arm().attach, rd.Sphere([0, 0, 0], 0.1, name="l2"), "l3")
    refuses("'point_cloud' is a point_cloud; it must be", box_arm().attach, rd.PointCloud([[0, 0, 0]]), "l3")
    refuses("attached.touch_links is 'l2'; it must be a list of names", box_arm().attach, SHAPES[0], "l3", "l2")
    refuses("'tool' already", box_arm().with_tool("l3", np.eye(4)).with_tool, "l3", np.eye(4), name="b")
    refuses("holds ball", box_arm().with_tool("l3", np.eye(4)).attach(SHAPES[0], "tool").detach, "tool")
