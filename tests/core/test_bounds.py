"""Bounds on the numbers that users give; `rd.pose`; for arguments of the wrong type, every public function says so."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.commands import python
from helpers.refusals import refuses
from robotdiffuse.core.errors import rigid_transform
from robotdiffuse.core.transforms import transform
from robotdiffuse.scenes.shapes import Shape

TRIANGLE = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]
FAR = [1e20, 0, 0]


def test_numbers_out_of_bounds() -> None:
    refuses("sphere.radius is 10000000.0; it must be a number from 1e-09", rd.Sphere, [0, 0, 0], 1e7)
    refuses("sphere.radius is 1e-300", rd.Sphere, [0, 0, 0], 1e-300)
    refuses(r"sphere.center is \[1e\+20, 0, 0\]; it must be 3 finite numbers within ±10000", rd.Sphere, FAR, 1)
    refuses("box.size .* at least 1e-09 m", rd.Box, [0, 0, 0], [1, 1, 1e-30])
    refuses("box.wxyz .* within ±10000", rd.Box, [0, 0, 0], [1, 1, 1], [1e200, 1e200, 0, 0])
    refuses(r"mesh.vertices\[3\] is .* within ±10000", rd.Mesh, [*TRIANGLE, [5e37, 0, 0]], [[0, 1, 2]])
    refuses("mesh.faces", rd.Mesh, TRIANGLE, [[0, 1, np.nan]])
    refuses(r"points\[1\] is", rd.PointCloud, [[0, 0, 0], [1e39, 0, 0], [0, 1e39, 0]])
    refuses("goal.T_base_frame .* within ±10000", rd.PoseGoal, "l3", transform(np.array(FAR)))
    refuses("view.T_base_camera", rd.DepthView, [[1.0]], (1, 1, 0, 0), transform(np.array(FAR)))
    far = {"panda_finger_joint1": 0.2}
    refuses("locked: panda_finger_joint1 is 0.2; it is far beyond its limits, 0 to 0.04", rd.load_robot, "panda", locked=far)
    refuses(r"locked: j0 is 1e\+20; it must be a number within", box_arm().with_locked, {"j0": 1e20})
    refuses("start: j0", rd.Problem, box_arm(), rd.Scene(), [1e20, 0, 0], [0, 0, 0])
    refuses(r"sphere.center is \[False, 0.5, 0\]; it must be 3 finite", rd.Sphere, [False, 0.5, 0], 1)
    refuses(r"points is \[\[.*; it must be n x 3", rd.PointCloud, [[0, 0, 1], [0, True, 0]])
    refuses("clearance", rd.Problem, box_arm(), rd.Scene(), [0, 0, 0], [0, 0, 0], clearance=1e39)


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
        side = 2 * half
        if max(side, distance) > 1e4 and kind in (rd.Box, rd.Cylinder):
            return
        sizes = {rd.Sphere: (half,), rd.Box: ([side] * 3,), rd.Cylinder: (half, side, turn), rd.Capsule: (half / 2, half, turn)}
        shape = kind([distance, 0, 0], *sizes[kind])  # type: ignore
        validated = rd.verify(replace(problem, scene=rd.Scene([shape])), rd.Path(robot.joint_names, rows))
        assert validated.valid == valid, (depth, validated)


def test_naming_is_not_quadratic() -> None:
    names = [shape.name for shape in rd.Scene([rd.Sphere([0, 0, i], 0.1) for i in range(1000)]).shapes]
    assert len({*names}) == 1000
    assert names[:3] == ["sphere", "sphere_2", "sphere_3"]
    mixed = rd.Scene([rd.Sphere([0, 0, 0], 1, name) for name in ("a", "a_2", "a", "a", "a_2")])
    assert [shape.name for shape in mixed.shapes] == ["a", "a_2", "a_3", "a_4", "a_2_2"]


def test_poses_with_rounding_errors_are_accepted() -> None:
    T = np.linalg.inv(transform(np.array([0.3, 0.1, 0.2])))
    T[3] += 1e-12
    assert (rigid_transform("a pose", T)[3] == [0, 0, 0, 1]).all()
    T[3, 0] = 0.01
    refuses(r"a pose is .* homogeneous transform", rigid_transform, "a pose", T)


def test_a_pose_by_quaternion_and_by_rpy_is_scipys_and_wrong_ones_are_refused() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        xyz, rpy = rng.normal(size=(2, 3))
        right = Rotation.from_euler("xyz", rpy)
        for T in (rd.pose(xyz, rpy=rpy), rd.pose(xyz, wxyz=3 * right.as_quat(scalar_first=True))):
            np.testing.assert_allclose(T[:3, :3], right.as_matrix(), atol=1e-12)
            np.testing.assert_array_equal(T[:3, 3], xyz)
            np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    np.testing.assert_array_equal(rd.pose([1, 2, 3])[:3, :3], np.eye(3))
    refuses("pose has wxyz and rpy; give one of them", rd.pose, [0, 0, 0], wxyz=[1, 0, 0, 0], rpy=[0, 0, 0])
    refuses(r"pose.rpy \[rad\] is \[0, 0\]; it must be 3 finite numbers", rd.pose, [0, 0, 0], rpy=[0, 0])
    refuses("a quaternion must not be zero", rd.pose, [0, 0, 0], wxyz=[0, 0, 0, 0])
    refuses("pose.xyz is .*; it must be 3 finite numbers", rd.pose, [0, 0, np.nan])


CALLS = """
import os, sys
import numpy as np
import robotdiffuse as rd

panda = rd.load_robot("panda")
middle = (panda.lower + panda.upper) / 2
problem = rd.Problem(panda, rd.Scene([]), middle, middle)
path = rd.Path(panda.joint_names, np.array([middle]))
of_lists, of_none = rd.Path(panda.joint_names, [[0.0] * 7]), rd.Path(None, path.positions)
still = rd.Trajectory(panda.joint_names, None, path.positions, path.positions, path.positions)
motion = rd.Trajectory(panda.joint_names, np.arange(2.0), *3 * [np.zeros((2, 7))])
calls = {
    "plan": rd.plan,
    "plan: time_limit": lambda wrong: rd.plan(problem, time_limit=wrong),
    "plan: seed": lambda wrong: rd.plan(problem, seed=wrong),
    "plan: until": lambda wrong: rd.plan(problem, until=wrong),
    "plan: velocity_scaling": lambda wrong: rd.plan(problem, velocity_scaling=wrong),
    "plan_many": rd.plan_many,
    "plan_many: problem": lambda wrong: rd.plan_many([wrong]),
    "plan_many: workers": lambda wrong: rd.plan_many([], workers=0 if wrong is None else wrong),
    "load_planner": rd.load_planner,
    "load_planner: settings": lambda wrong: rd.load_planner("rrt_connect", wrong),
    "load_planner: weights": lambda wrong: rd.load_planner("diffusion", weights=wrong),
    "verify": lambda wrong: rd.verify(wrong, path),
    "verify: path": lambda wrong: rd.verify(problem, wrong),
    "verify: settings": lambda wrong: rd.verify(problem, path, wrong),
    "certify": lambda wrong: rd.certify(wrong, path),
    "certify: motion": lambda wrong: rd.certify(problem, wrong),
    "load_robot": rd.load_robot,
    "load_robot: locked": lambda wrong: rd.load_robot("panda", {"panda_joint1": wrong}),
    "load_problem": rd.load_problem,
    "load_problem: index": lambda wrong: rd.load_problem("x.yaml", wrong),
    "load_result": rd.load_result,
    "load_certificate": rd.load_certificate,
    "next_view": lambda wrong: rd.next_view(problem, wrong),
    "Replanner": rd.Replanner,
    "show": rd.show,
    "RopDataset": rd.RopDataset,
    "trajectory.at": motion.at,
    "trajectory.resample": motion.resample,
}
for name, call in calls.items():
    for wrong in (None, -1.5, "x", b"x", [], {"a": 1}, np.zeros(2), rd.plan, of_lists, of_none, still):
        try:
            call(wrong)
            print(name, repr(wrong), "is taken")
        except rd.InputError as error:
            if len(str(error).splitlines()) != 1:
                print(name, repr(wrong), "is more than a line")
        except Exception as error:
            print(name, repr(wrong), type(error).__name__, error)
try:
    rd.plan("shelf.yaml")
except rd.InputError as error:
    print(error)
"""


def test_arguments_of_the_wrong_type_are_one_line() -> None:
    ended = python(CALLS)
    rightly = ["plan_many []", *(f"load_planner: {what} None" for what in ("settings", "weights"))]
    at = "trajectory.at []", "trajectory.at array([0., 0.])"
    taken = [f"{call} is taken" for call in (*rightly, "load_robot: locked -1.5", *at)]
    right = "problem is 'shelf.yaml'; it must be a Problem: rd.load_problem('shelf.yaml') reads one from a file"
    assert (ended.stdout.splitlines(), ended.stderr) == ([*taken, right], "")
