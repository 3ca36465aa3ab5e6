"""Values: bounds on the numbers that users give, one line about arguments of the wrong type, `rd.pose`, read-only arrays."""

import copy
import pickle
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from numpy import ndarray
from scipy.spatial.transform import Rotation

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.commands import python
from helpers.refusals import refuses
from robotdiffuse.core.errors import rigid_transform
from robotdiffuse.core.transforms import rpy_from_rotation, transform
from robotdiffuse.core.types import Value, no_type_check, read_only
from robotdiffuse.perception.depth_view import AssumedPoints, SeenPoints
from robotdiffuse.problems.constraints import FrameConstraint
from robotdiffuse.robots.bodies import AttachedBody, ConvexMesh, Surface
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.robots.robot import LinkPairTable
from robotdiffuse.robots.visual_meshes import VisualMesh
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
        np.testing.assert_allclose(rpy_from_rotation(right.as_matrix()), right.as_euler("xyz"), atol=1e-9)
        for T in (rd.pose(xyz, rpy=rpy), rd.pose(xyz, wxyz=3 * right.as_quat(scalar_first=True))):
            np.testing.assert_allclose(T[:3, :3], right.as_matrix(), atol=1e-12)
            np.testing.assert_array_equal(T[:3, 3], xyz)
            np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    np.testing.assert_array_equal(rd.pose([1, 2, 3])[:3, :3], np.eye(3))
    for pitch in (-np.pi / 2, np.pi / 2):  # gimbal lock
        R = rd.pose(xyz, rpy=[0.3, pitch, -1.1])[:3, :3]
        roll, *others = rpy_from_rotation(R)
        assert roll == 0.0
        np.testing.assert_allclose(rd.pose(xyz, rpy=[roll, *others])[:3, :3], R, atol=1e-9)
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
    "PlanResult.record": rd.PlanResult(rd.Status.TIMEOUT, "", "", "", 0.0, 0).record,
    "Trajectory": lambda wrong: rd.Trajectory(panda.joint_names, wrong, *3 * [np.zeros((2, 7))]),
    "trajectory.at": motion.at,
    "trajectory.resample": motion.resample,
    "Scene": rd.Scene,
    "Scene: may_touch": lambda wrong: rd.Scene().may_touch(wrong, wrong),
    "Problem.in_world: scene": lambda wrong: rd.Problem.in_world(np.eye(4), panda, wrong, middle, middle),
    "attach": lambda wrong: panda.attach(wrong, "panda_hand"),
    "Workspace.remove": rd.Workspace(panda).remove,
}
for name, call in calls.items():
    for wrong in (None, -1.5, "x", b"x", [], {"a": 1}, np.zeros(2), np.array(0.1), rd.Box, rd.plan, of_lists, of_none):
        try:
            call(wrong)
            print(name, repr(wrong), "is taken")
        except rd.InputError as error:
            if len(str(error).splitlines()) != 1:
                print(name, repr(wrong), "is more than a line")
        except Exception as error:
            print(name, repr(wrong), type(error).__name__, error)
lists = panda.joint_names, [0, 1], *2 * [[[0] * 7] * 2]
print(rd.Trajectory(*lists, [[0] * 7] * 2).resample(1).record() == motion.record())
for wrong in (lambda: rd.plan("shelf.yaml"), lambda: rd.Trajectory(*lists, np.zeros((2, 6)))):
    try:
        wrong()
    except rd.InputError as error:
        print(error)
"""


def test_arguments_of_the_wrong_type_are_one_line() -> None:
    ended = python(CALLS)
    rightly = ["plan_many []", *(f"load_planner: {what} None" for what in ("settings", "weights")), "load_robot: locked -1.5"]
    rightly += ["PlanResult.record None", "PlanResult.record {'a': 1}", "Trajectory array([0., 0.])", "trajectory.at []"]
    rightly += ["trajectory.at array([0., 0.])", "trajectory.at array(0.1)", "Scene []", "Scene: may_touch 'x'"]
    taken = [f"{call} is taken" for call in rightly]
    named = "problem is 'shelf.yaml'; it must be a Problem: rd.load_problem('shelf.yaml') reads one from a file"
    rows = "accelerations is an array of 2 x 6; it must be 2 x 7 finite numbers, a column for each joint"
    assert (ended.stdout.splitlines(), ended.stderr) == ([*taken, "True", named, rows], "")


CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
UP, HALF, ROWS = np.array([0.0, 0.0, 1.0]), np.full(3, 0.5), np.array([[0.0, 0.1, 0.2], [0.3, 0.2, 0.1]])
POSE, TIMES, IMAGE = np.eye(4), np.array([0.0, 1.0]), np.ones((2, 3), np.float32)
GIVEN = (CORNERS, FACES, UP, HALF, ROWS, POSE, TIMES, IMAGE)


def sphere() -> rd.Sphere:
    return rd.Sphere(HALF, 0.1)


def pose_goal() -> rd.PoseGoal:
    return rd.PoseGoal("l3", POSE, HALF, HALF)


def robot() -> rd.Robot:
    spheres = {link: np.array(rows) for link, rows in box_arm().spheres.items()}
    joints = tuple(Joint(j.name, j.kind, j.parent, j.child, POSE, UP) for j in box_arm().joints)
    return rd.Robot("arm", box_arm().base, box_arm().tip, joints, spheres, above={"root": POSE})


VALUES: dict[type[Value], Callable[[], Value]] = {
    rd.Sphere: sphere,
    rd.Box: lambda: rd.Box(HALF, HALF, [1, 0, 0, 0]),
    rd.Cylinder: lambda: rd.Cylinder(HALF, 0.1, 0.2),
    rd.Capsule: lambda: rd.Capsule(HALF, 0.1, 0.2),
    rd.Mesh: lambda: rd.Mesh(CORNERS, FACES, UP),
    rd.PointCloud: lambda: rd.PointCloud(CORNERS),
    rd.HeightMap: lambda: rd.HeightMap(ROWS, 0.1, UP),
    SeenPoints: lambda: SeenPoints(CORNERS),
    AssumedPoints: lambda: AssumedPoints(CORNERS),
    rd.Scene: lambda: rd.Scene([sphere()]),
    rd.MovingObstacle: lambda: rd.MovingObstacle(rd.Box([0, 0, 0], HALF), times=TIMES, poses=[POSE, POSE]),
    rd.DepthView: lambda: rd.DepthView(IMAGE, (1.0, 1.0, 0.0, 0.0), POSE, ROWS[0], CORNERS),
    rd.NextView: lambda: rd.NextView(POSE, 0.5),
    rd.ArmCamera: lambda: rd.ArmCamera("l3", POSE, (1.0, 1.0, 0.0, 0.0), (4, 3)),
    Joint: lambda: Joint("j", "revolute", "a", "b", POSE, UP),
    rd.Robot: robot,
    ConvexMesh: lambda: ConvexMesh(CORNERS, FACES),
    Surface: lambda: Surface(CORNERS, FACES),
    VisualMesh: lambda: VisualMesh(CORNERS, FACES, np.zeros((4, 3), np.uint8)),
    AttachedBody: lambda: AttachedBody("tool", "l3", POSE, (sphere(),)),
    LinkPairTable: lambda: LinkPairTable(("a", "b"), ("j",), (0.0,), (1.0,), np.ones(4, bool)),
    rd.Payload: lambda: rd.Payload(1.0, HALF, None, HALF),
    rd.JointGoal: lambda: rd.JointGoal(ROWS),
    rd.PoseGoal: pose_goal,
    rd.PosesGoal: lambda: rd.PosesGoal([pose_goal()]),
    rd.AnyGoal: lambda: rd.AnyGoal((rd.JointGoal(ROWS), pose_goal())),
    rd.AxisCone: lambda: rd.AxisCone("l3", UP, UP, 0.1),
    rd.PositionBox: lambda: rd.PositionBox("l3", -HALF, HALF, POSE),
    rd.OnPlane: lambda: rd.OnPlane("l3", HALF, UP, 0.1),
    rd.OnLine: lambda: rd.OnLine("l3", HALF, UP, 0.1),
    rd.CartesianLine: lambda: rd.CartesianLine("l3"),
    rd.Problem: lambda: rd.Problem(box_arm(), rd.Scene([sphere()]), ROWS[0], ROWS, T_world_base=POSE, start_velocity=HALF),
    rd.Path: lambda: rd.Path(("a", "b", "c"), ROWS),
    rd.Trajectory: lambda: rd.Trajectory(("a", "b", "c"), TIMES, ROWS, ROWS, ROWS),
}


def kinds(base: type[Value] = Value) -> Iterator[type[Value]]:
    """All classes of values, except abstract bases."""
    for kind in base.__subclasses__():
        if kind.__module__.startswith("robotdiffuse."):
            yield from kinds(kind)
            if is_dataclass(kind) and not kind.__name__.startswith("_"):
                yield kind


def arrays(value: object, name: str = "") -> Iterator[tuple[str, ndarray]]:
    """All arrays of a value, including cached properties."""
    if isinstance(value, ndarray):
        yield name, value
    elif isinstance(value, Value):
        derived = (key for key in dir(type(value)) if not key.startswith("_") and key != "solid")
        for key in {*derived, *(field.name for field in fields(value))}:  # type: ignore[arg-type]
            if isinstance(getattr(type(value), key, None), property):
                continue  # computed anew each time
            held = getattr(value, key)
            if not callable(held):
                yield from arrays(held, f"{name}.{key}")
    elif isinstance(value, tuple | dict):
        for key, held in value.items() if isinstance(value, dict) else enumerate(value):
            yield from arrays(held, f"{name}[{key}]")


def test_every_kind_of_value_is_tried() -> None:
    public = [kind for kind in (getattr(rd, name) for name in dir(rd)) if isinstance(kind, type) and is_dataclass(kind)]
    with_arrays = {kind for kind in public if any("Float" in str(f.type) for f in fields(kind))}
    assert {*kinds()} - {FrameConstraint} | {SeenPoints, AssumedPoints} == {*VALUES}
    assert with_arrays - {*VALUES} == {rd.Certificate}  # nothing is kept of one: each check begins anew


@pytest.mark.parametrize("kind", VALUES, ids=lambda kind: kind.__name__)
def test_the_text_of_a_value_is_one_line(kind: type[Value]) -> None:
    value = VALUES[kind]()
    assert "\n" not in repr(value) and len(repr(value)) < 300 and repr(value).startswith(kind.__name__)


def test_large_arrays_are_shown_by_their_shape_and_defaults_not_at_all() -> None:
    assert repr(rd.Box(HALF, HALF)) == "Box(center=[0.5, 0.5, 0.5], size=[0.5, 0.5, 0.5])"
    assert repr(rd.PointCloud(np.zeros((5000, 3)))) == "PointCloud(points=<5000 x 3 array>)"
    assert "solved" in repr(rd.PlanResult(rd.Status.SOLVED, "", "aorrtc", "arm", 0.1, 0, path=VALUES[rd.Path]()))  # type: ignore[arg-type]
    unsolved = rd.PlanResult(rd.Status.TIMEOUT, "no path", "aorrtc", "arm", 0.1, 0)
    assert repr(unsolved) == "PlanResult(timeout, aorrtc in 100 ms: no path)"


@pytest.mark.parametrize("kind", VALUES, ids=lambda kind: kind.__name__)
def test_nobody_can_write_to_the_arrays_of_a_value(kind: type[Value]) -> None:
    before = [array.copy() for array in GIVEN]
    value = VALUES[kind]()
    for one in (value, pickle.loads(pickle.dumps(value)), copy.deepcopy(value), copy.copy(value)):
        for name, array in arrays(one):
            assert not array.flags.writeable, name
            if array.size:
                with pytest.raises(ValueError, match="read-only"):
                    array[...] = 1
            assert not any(np.shares_memory(array, given) for given in GIVEN), name
    assert all(given.flags.writeable for given in GIVEN)
    assert all(np.array_equal(*pair) for pair in zip(before, GIVEN, strict=True))


def test_nobody_can_change_a_robot_that_a_cache_shares() -> None:
    """Regression: `robot.locked["panda_finger_joint1"] = 0` changed what `load_robot` returned from then on."""
    for robot in (PANDA := rd.load_robot("panda"), pickle.loads(pickle.dumps(PANDA)), copy.deepcopy(PANDA)):
        for change in (robot.locked.clear, robot.spheres.popitem, lambda robot=robot: robot.poses["ready"].update(j=1.0)):
            with pytest.raises(TypeError, match="change a copy"):
                change()


def test_views_of_what_can_be_written_to_are_copied() -> None:
    mine = np.zeros((2, 3))
    view = mine[:1]
    view.setflags(write=False)
    kept = read_only(view)
    mine[:] = 1
    assert (kept == 0).all()
    assert read_only(kept) is kept


SIGNATURES = """
import sys
import robotdiffuse as rd
from numba.core.types import Array
from numba.core.dispatcher import Dispatcher

task = rd.Problem(
    rd.load_robot("panda"),
    rd.Scene([rd.Sphere([0.5, 0.0, 0.5], 0.2), rd.Box([0.5, 0, -0.06], [2, 2, 0.1])]),
    [-1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8],
    [1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8],
)
result = rd.load_planner("aorrtc").plan(task, 60.0, until="first")
assert rd.verify(task, result.trajectory).valid
modules = [module for name, module in sys.modules.items() if name.startswith("robotdiffuse.")]
compiled = {one for module in modules for one in vars(module).values() if isinstance(one, Dispatcher)}
signatures = [signature for one in compiled for signature in one.signatures]
read_only = [of for signature in signatures for of in signature if isinstance(of, Array) and not of.mutable]
print(len(signatures) > 0, read_only)
"""


def test_nothing_is_compiled_for_read_only_arrays() -> None:
    """Otherwise a plan's kernels would be compiled twice. Apart, since tests call kernels with arrays of their own."""
    assert python(SIGNATURES).stdout == "True []\n"


class Unreadable:
    def __get__(self, *_: object) -> None:
        raise AttributeError


def test_a_class_is_marked_although_an_attribute_of_its_base_is_unreadable() -> None:
    """Regression: `import roslibpy, robotdiffuse` was an AttributeError; Twisted adds such an attribute to ABC."""

    class Child(type("Base", (), {"__provides__": Unreadable()})):
        def method(self) -> None: ...

    assert all(hasattr(marked, "__no_type_check__") for marked in (no_type_check(Child), Child.method))
