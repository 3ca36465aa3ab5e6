"""Arrays of values are read-only, since verdicts and prepared data are cached by the identity of the value."""

import copy
import pickle
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
from numpy import ndarray

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.commands import python
from robotdiffuse.core.types import Value, no_type_check, read_only
from robotdiffuse.perception.depth_view import AssumedPoints, SeenPoints
from robotdiffuse.problems.constraints import FrameConstraint
from robotdiffuse.robots.bodies import AttachedBody, ConvexMesh, Surface
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.robots.robot import LinkPairTable
from robotdiffuse.robots.visual_meshes import VisualMesh

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
    public = [getattr(rd, name) for name in dir(rd)]
    with_arrays = {
        kind
        for kind in public
        if isinstance(kind, type) and is_dataclass(kind) and any("Float" in str(f.type) for f in fields(kind))
    }
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
    assert repr(rd.PlanResult(rd.Status.TIMEOUT, "no path", "aorrtc", "arm", 0.1, 0)) == (
        "PlanResult(timeout, aorrtc in 100 ms: no path)"
    )


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


def test_views_of_what_can_be_written_to_are_copied() -> None:
    mine = np.zeros((2, 3))
    view = mine[:1]
    view.setflags(write=False)
    kept = read_only(view)
    mine[:] = 1
    assert (kept == 0).all()
    assert read_only(kept) is kept


def test_a_verdict_is_of_the_scene_as_it_is() -> None:
    """A sphere cannot be moved into a motion that was found free."""
    task = rd.Problem(box_arm(), rd.Scene([rd.Sphere([-1, 0, 0], 0.1)]), ROWS[0], ROWS[1])
    assert rd.verify(task, rd.Path(box_arm().joint_names, ROWS)).valid
    with pytest.raises(ValueError, match="read-only"):
        task.scene.shapes[0].center[:] = 0.5, 0.1, 0.0  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="read-only"):
        rd.load_robot("panda").lower[0] = 0.0
    assert rd.load_robot("panda").lower[0] < -2


SIGNATURES = """
import sys
import robotdiffuse as rd
from numba.core.types import Array
from numba.core.dispatcher import Dispatcher
from robotdiffuse.validation.validator import verify_trajectory

task = rd.Problem(
    rd.load_robot("panda"),
    rd.Scene([rd.Sphere([0.5, 0.0, 0.5], 0.2), rd.Box([0.5, 0, -0.06], [2, 2, 0.1])]),
    [-1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8],
    [1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8],
)
result = rd.load_planner("aorrtc").plan(task, 60.0, until="first")
assert verify_trajectory(task, result.trajectory).valid
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
