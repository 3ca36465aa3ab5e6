"""Bounds on the numbers that users give; `rd.pose`."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.refusals import refuses
from robotdiffuse.core.bounds import rigid_transform
from robotdiffuse.core.transforms import transform
from robotdiffuse.scenes.shapes import Shape

TRIANGLE = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]
FAR = [1e20, 0, 0]


def test_numbers_out_of_bounds() -> None:
    for make, message in (
        (lambda: rd.Sphere([0, 0, 0], 1e7), "sphere.radius is 10000000.0; it must be a number from 1e-09"),
        (lambda: rd.Sphere([0, 0, 0], 1e-300), "sphere.radius is 1e-300"),
        (lambda: rd.Sphere(FAR, 1), r"sphere.center is \[1e\+20, 0, 0\]; it must be 3 finite numbers within ±10000"),
        (lambda: rd.Box([0, 0, 0], [1, 1, 1e-30]), "box.size .* at least 1e-09 m"),
        (lambda: rd.Box([0, 0, 0], [1, 1, 1], [1e200, 1e200, 0, 0]), "box.wxyz .* within ±10000"),
        (lambda: rd.Mesh([*TRIANGLE, [5e37, 0, 0]], [[0, 1, 2]]), r"mesh.vertices\[3\] is .* within ±10000"),
        (lambda: rd.Mesh(TRIANGLE, [[0, 1, np.nan]]), "mesh.faces"),
        (lambda: rd.PointCloud([[0, 0, 0], [1e39, 0, 0], [0, 1e39, 0]]), r"points\[1\] is"),
        (lambda: rd.PoseGoal("l3", transform(np.array(FAR))), "goal.T_base_frame .* within ±10000"),
        (lambda: rd.DepthView([[1.0]], (1, 1, 0, 0), transform(np.array(FAR))), "view.T_base_camera"),
        (lambda: box_arm().with_locked({"j0": 1e20}), r"locked: j0 is 1e\+20; it must be a number within"),
        (lambda: rd.Problem(box_arm(), rd.Scene(), [1e20, 0, 0], [0, 0, 0]), "start: j0"),
        (lambda: rd.Sphere([False, 0.5, 0], 1), r"sphere.center is \[False, 0.5, 0\]; it must be 3 finite"),
        (lambda: rd.PointCloud([[0, 0, 1], [0, True, 0]]), r"points is \[\[.*; it must be n x 3"),
        (lambda: rd.Problem(box_arm(), rd.Scene(), [0, 0, 0], [0, 0, 0], clearance=1e39), "clearance"),
    ):
        refuses(message, make)


@pytest.mark.parametrize("distance", [10.0, 1e3, 9e3])
@pytest.mark.parametrize("kind", [rd.Sphere, rd.Box, rd.Cylinder, rd.Capsule])
def test_huge_shapes_are_never_called_valid(kind: type[Shape], distance: float) -> None:
    """The surface of each shape is 2 mm inside the arm, or 2 cm away from it."""
    robot = box_arm()
    rows = np.zeros((2, 3))
    rows[:, 0] = 0.0, 0.2
    problem = rd.Problem(robot, rd.Scene(), rows[0], rd.JointGoal(rows[1:]))
    turn = [np.sqrt(0.5), 0, np.sqrt(0.5), 0]  # z along x
    for depth, valid in ((0.002, False), (-0.02, True)):
        half = distance - 1.2 + depth  # the arm ends at x = 1.2 m
        center = [distance, 0, 0]
        shape = {
            rd.Sphere: lambda half=half, center=center: rd.Sphere(center, half),
            rd.Box: lambda half=half, center=center: rd.Box(center, 2 * np.array([half, half, half])),
            rd.Cylinder: lambda half=half, center=center: rd.Cylinder(center, half, 2 * half, turn),
            rd.Capsule: lambda half=half, center=center: rd.Capsule(center, half / 2, half, turn),
        }[kind]
        if max(2 * half, distance) > 1e4 and kind in (rd.Box, rd.Cylinder):
            return
        validated = rd.verify(replace(problem, scene=rd.Scene([shape()])), rd.Path(robot.joint_names, rows))
        assert validated.valid == valid, (depth, validated)


def test_naming_is_not_quadratic() -> None:
    scene = rd.Scene([rd.Sphere([0, 0, i], 0.1) for i in range(1000)])
    names = [shape.name for shape in scene.shapes]
    assert len({*names}) == 1000
    assert names[:3] == ["sphere", "sphere_2", "sphere_3"]
    mixed = rd.Scene([rd.Sphere([0, 0, 0], 1, name) for name in ("a", "a_2", "a", "a", "a_2")])
    assert [shape.name for shape in mixed.shapes] == ["a", "a_2", "a_3", "a_4", "a_2_2"]


def test_poses_with_rounding_errors_are_accepted() -> None:
    T = np.linalg.inv(transform(np.array([0.3, 0.1, 0.2])))
    T[3] += 1e-12
    assert (rigid_transform("a pose", T)[3] == [0, 0, 0, 1]).all()
    T[3, 0] = 0.01
    refuses(r"a pose is .* over a row 0 0 0 1", rigid_transform, "a pose", T)


def test_a_pose_by_quaternion_and_by_rpy_is_scipys() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        xyz, rpy = rng.normal(size=(2, 3))
        right = Rotation.from_euler("xyz", rpy)
        for T in (rd.pose(xyz, rpy=rpy), rd.pose(xyz, wxyz=3 * right.as_quat(scalar_first=True))):
            np.testing.assert_allclose(T[:3, :3], right.as_matrix(), atol=1e-12)
            np.testing.assert_array_equal(T[:3, 3], xyz)
            np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    np.testing.assert_array_equal(rd.pose([1, 2, 3])[:3, :3], np.eye(3))


def test_wrong_poses_are_refused() -> None:
    for fields, message in (
        ({"wxyz": [1, 0, 0, 0], "rpy": [0, 0, 0]}, "pose has wxyz and rpy; give one of them"),
        ({"rpy": [0, 0]}, r"pose.rpy is \[0, 0\]; it must be 3 finite numbers"),
        ({"wxyz": [0, 0, 0, 0]}, "a quaternion must not be zero"),
        ({"xyz": [0, 0, np.nan]}, "pose.xyz is .*; it must be 3 finite numbers"),
    ):
        refuses(message, rd.pose, **{"xyz": [0, 0, 0]} | fields)
