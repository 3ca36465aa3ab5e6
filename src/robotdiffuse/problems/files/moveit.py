"""Reads MoveIt planning scenes and motion plan requests in YAML, as MotionBenchMaker and robowflex write
them.

In these files, vectors may be lists or mappings (x, y, z), and quaternions are xyzw. Message definitions:
https://docs.ros.org/en/noetic/api/moveit_msgs/html/msg/PlanningScene.html and MotionPlanRequest.html.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.bounds import unit_quaternion, vector
from robotdiffuse.core.errors import InputError, joined, shortened, shown, unknown_name
from robotdiffuse.core.input_files import read_triangles, read_yaml
from robotdiffuse.core.transforms import (
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform,
)
from robotdiffuse.problems.files.moveit_contacts import list_of, mapping_of, matrix_contacts
from robotdiffuse.problems.files.moveit_shapes import cone, plane
from robotdiffuse.robots.bodies import AttachedBody
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import MIMIC_SLACK, MOVING_KINDS, Robot
from robotdiffuse.scenes.mesh import Mesh
from robotdiffuse.scenes.octomap import cover_radius, occupied_voxels
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Cylinder, PointCloud, Shape, Sphere

PRIMITIVES: dict[str, tuple[int, Callable[[ndarray, ndarray, ndarray, str], Shape]]] = {
    "box": (3, lambda size, xyz, wxyz, name: Box(xyz, size, wxyz, name)),
    "sphere": (1, lambda size, xyz, wxyz, name: Sphere(xyz, size[0], name)),
    "cylinder": (2, lambda size, xyz, wxyz, name: Cylinder(xyz, size[1], size[0], wxyz, name)),
    "cone": (2, cone),
}
"""For each type, the number of its dimensions and the shape (of cylinders and cones height and radius)."""
TYPE_NUMBERS = {1: "box", 2: "sphere", 3: "cylinder", 4: "cone", 5: "prism"}
"""Numbers of the types in messages (shape_msgs/SolidPrimitive)."""
NO_POSE = {"position": [0, 0, 0], "orientation": [0, 0, 0, 1]}


@dataclass(frozen=True, eq=False)
class MoveItAttached:
    """An object that the robot holds at the start."""

    name: str
    link: str
    shapes: tuple[Shape, ...]
    in_link: bool
    """Whether the shapes are in the frame of the link; otherwise they are in the frame of the base, at the
    start."""
    touch_links: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class MoveItRequest:
    """The content of a motion plan request. Either `joint_goals` is not empty or `pose_goal` is not None."""

    start: dict[str, float]
    """Joint values by name [rad] or [m], including fingers."""
    joint_goals: tuple[dict[str, float], ...] = ()
    """Alternative goals, each with joint values by name."""
    pose_goal: tuple[str, Float[ndarray, "4 4"]] | None = None
    """A link and its goal pose T_base_link."""
    attached: tuple[MoveItAttached, ...] = ()
    notes: tuple[str, ...] = ()
    """Notes on parts of the request that are ignored."""


def read_moveit_scene(
    file: str | Path, robot: Robot | None = None, ignore_joints: bool = False
) -> tuple[Scene, tuple[str, ...]]:
    """The collision objects of a planning scene, in the frame of the robot's base, and notes on differences
    between the scene's robot and `robot`.

    The pose of the root of the robot's URDF comes from robot_state.multi_dof_joint_state, the pose of its
    base relative to the root from the robot (None: base and root are the same), and frames from
    fixed_frame_transforms and from the links that are fixed to the base. Contacts of the robot's links with
    objects are allowed as in the allowed collision matrix; its pairs of links are ignored, because the robot
    has its own. Raises InputError, naming file and object, for a missing or
    damaged file, unknown frames, shapes that are not supported (prisms), and, unless
    `ignore_joints`, joints that the robot lacks.
    """
    data = read_yaml(file)
    try:
        notes = () if robot is None else scene_robot_notes(data, robot, ignore_joints)
        links = () if robot is None else robot.link_names
        return moveit_scene(data, moveit_frames(data, robot), Path(file).parent, links), notes
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def scene_robot_notes(data: object, robot: Robot, ignore_joints: bool = False) -> tuple[str, ...]:
    """Notes on differences between a robot and the one of a parsed planning scene.

    Raises InputError for joints that the robot lacks, unless `ignore_joints`. A different model name alone is
    only noted: the same arm has many names, and all joints are known. Names of multi-dof joints are ignored:
    they are virtual joints of an SRDF, whose transforms give the pose of the robot's root.
    """
    data = mapping_of("a planning scene", data)
    state = mapping_of("robot_state", data.get("robot_state"))
    values = _joint_state("robot_state.joint_state", state.get("joint_state"))
    model = moveit_model(data)
    notes = joint_notes("robot_state.joint_state", values, robot, model, ignore_joints)
    if model not in ("", robot.name):
        notes = (f"the scene's robot_model_name is {shortened(model)}; planned for {robot.name}", *notes)
    return notes


def moveit_model(data: object) -> str:
    """The robot_model_name of a parsed planning scene; empty if it has none."""
    return str((data.get("robot_model_name") if isinstance(data, dict) else None) or "")


def request_robot_notes(
    request: "MoveItRequest", robot: Robot, model: str = "", ignore_joints: bool = False
) -> tuple[str, ...]:
    """`scene_robot_notes` for a request; `model` is its scene's robot_model_name."""
    notes = joint_notes("start_state.joint_state", request.start, robot, model, ignore_joints)
    for i, goal in enumerate(request.joint_goals):
        notes += joint_notes(f"goal_constraints[{i}]", goal, robot, model, ignore_joints)
    return notes


def joint_notes(
    where: str, values: dict[str, float], robot: Robot, model: str, ignore_joints: bool
) -> tuple[str, ...]:
    """A note on joints that the robot lacks. Raises InputError for them unless `ignore_joints`.

    A fixed joint of the robot counts as known if its value is zero.
    """
    kinds = {joint.name: joint.kind for joint in robot.joints}
    lacking = [
        name
        for name, value in values.items()
        if kinds.get(name) not in MOVING_KINDS and (name not in kinds or abs(value) > MIMIC_SLACK)
    ]
    if not lacking:
        return ()
    if ignore_joints:
        return (f"{where}: ignored {joined(lacking)}, which {robot.name} lacks",)
    of_model = f" (robot_model_name is {shortened(model)})" if model not in ("", robot.name) else ""
    own = joined(name for name, kind in kinds.items() if kind in MOVING_KINDS)
    raise InputError(
        f"{where} has values of {joined(lacking)}, movable joints that {robot.name} lacks{of_model}; its own "
        f"are {own}: give the robot that is meant, or ignore these joints (--ignore-joints, "
        f"ignore_joints=True)"
    )


class MoveItFrames(dict[str, ndarray]):
    """T_base_frame of the frames that objects of a planning scene may be given in; '' is the scene's own.

    These are the scene's own frame, the frames that the file defines, and the links that fixed joints connect
    with the robot's base. Looking up an unknown frame raises InputError, which lists the known frames, or
    says why the pose of the robot's base in the scene is unknown.
    """

    def __init__(
        self, robot: Robot | None, T_own_root: Float[ndarray, "4 4"], own: tuple[str, ...] = ("", "world")
    ) -> None:
        """own: names of the scene's own frame; T_own_root: pose of the URDF's root in it."""
        super().__init__({} if robot is None else robot.above | robot.links_fixed_to_base)
        self.links = frozenset(self)
        """Frames of the robot, whose poses a file cannot change."""
        T_base_root = np.eye(4) if robot is None else robot.T_base_root
        self.lost = ""
        """Why the pose of the scene's own frame is unknown; empty if it is known."""
        if T_base_root is not None:
            T_base_own = T_base_root @ inverse(T_own_root)
            self.update({name: T_base_own for name in own if name not in self.links})
        elif robot is not None:
            self.lost = f"a joint moves {robot.base} in {robot.root}"

    def of(self, where: str, entry: dict[str, Any]) -> Float[ndarray, "4 4"]:
        """T_base_frame of the frame that the header of an entry names."""
        name = str(mapping_of(f"{where}.header", entry.get("header")).get("frame_id") or "").removeprefix("/")
        if name in self:
            return self[name]
        known = [frame for frame in self if frame]
        if self.lost:
            raise InputError(
                f"frame_id of {where} is {shown(name)}, and the pose of the robot's base in it is unknown: "
                f"{self.lost}; known frames: {', '.join(known)}"
            )
        raise unknown_name(f"frame_id of {where}:", name, known)


def moveit_frames(data: object, robot: Robot | None = None) -> MoveItFrames:
    """The frames of a parsed planning scene; `robot` as in `read_moveit_scene`.

    The scene's own frame is the one in which robot_state.multi_dof_joint_state gives the pose of the robot,
    by default `world`. Raises InputError if it has more than one transform, that of the robot's root.
    """
    state = mapping_of("robot_state", mapping_of("a planning scene", data).get("robot_state"))
    if state.get("attached_collision_objects"):
        raise InputError("attached_collision_objects are for the start_state of a request")
    floating = mapping_of("multi_dof_joint_state", state.get("multi_dof_joint_state"))
    transforms = list_of("multi_dof_joint_state.transforms", floating.get("transforms"))
    T_own_root = np.eye(4)
    if len(transforms) > 1:
        raise InputError(
            f"multi_dof_joint_state has {len(transforms)} transforms; it must have one, of the robot's root"
        )
    if transforms:
        T_own_root = _pose("multi_dof_joint_state.transforms[0]", transforms[0], "translation", "rotation")
    header = mapping_of("multi_dof_joint_state.header", floating.get("header"))
    named = str(header.get("frame_id") or "").removeprefix("/")
    root = "" if robot is None else robot.root or robot.base
    frames = MoveItFrames(robot, T_own_root, ("", "world" if named in ("", root) else named))
    fixed = list_of(
        "fixed_frame_transforms", mapping_of("a planning scene", data).get("fixed_frame_transforms")
    )
    for i, entry in enumerate(fixed):
        where = f"fixed_frame_transforms[{i}]"
        entry = mapping_of(where, entry)
        child = str(entry.get("child_frame_id", "")).removeprefix("/")
        T = _pose(f"{where}.transform", entry.get("transform"), "translation", "rotation")
        if not frames.lost and child not in frames.links:
            frames[child] = frames.of(where, entry) @ T
    return frames


def moveit_scene(
    data: object, frames: MoveItFrames, folder: Path, links: Collection[str] = (), contacts: object = ()
) -> Scene:
    """`read_moveit_scene` for a parsed file; names of mesh files are relative to `folder`.

    links: names of the robot's links and held objects; contacts: allowed contacts besides those of the file,
    as in `Scene`.
    """
    world = mapping_of("world", mapping_of("a planning scene", data).get("world"))
    shapes = _octomap(mapping_of("world.octomap", world.get("octomap")), frames)
    for i, entry in enumerate(list_of("world.collision_objects", world.get("collision_objects"))):
        shown_id = mapping_of(f"collision object {i}", entry).get("id", i)
        try:
            shapes.extend(_object(mapping_of("it", entry), frames, folder))
        except InputError as error:
            raise InputError(f"collision object {shown_id}: {error}") from None
    names = dict.fromkeys(shape.name for shape in shapes)
    matrix = mapping_of("a planning scene", data).get("allowed_collision_matrix")
    given = Scene(shapes, contacts).allowed_contacts  # type: ignore[arg-type]
    return Scene(shapes, (*matrix_contacts(matrix, names, links).items(), *given))


def _octomap(entry: dict[str, Any], frames: MoveItFrames) -> list[Shape]:
    """The occupied voxels of an OctomapWithPose as a cloud of spheres around them; none without data."""
    message = mapping_of("world.octomap.octomap", entry.get("octomap"))
    data = list_of("world.octomap.octomap.data", message.get("data"))
    if not data:
        return []
    if not message.get("binary"):
        raise InputError("world.octomap is not binary; publish it as a binary octomap (octomap_binary)")
    where = "world.octomap.octomap.data"
    bytes_ = (vector(where, "data", data, len(data)).astype(np.int64) % 256).astype(np.uint8).tobytes()
    edge = float(vector("world.octomap.octomap", "resolution", [message.get("resolution")], 1)[0])
    T = frames.of("world.octomap", entry) @ _pose("world.octomap.origin", entry.get("origin") or NO_POSE)
    try:
        cloud = PointCloud(occupied_voxels(bytes_, edge), cover_radius(edge), name="octomap")
    except InputError as error:
        raise InputError(f"world.octomap: {error}") from None
    return [cloud.moved(T)]


def _object(entry: dict[str, Any], frames: MoveItFrames, folder: Path) -> list[Shape]:
    T_base_object = frames.of("header", entry) @ _pose("pose", entry.get("pose") or NO_POSE)
    name = str(entry.get("id") or "object")
    planes = list_of("planes", entry.get("planes"))
    poses = list_of("plane_poses", entry.get("plane_poses")) or [NO_POSE] * len(planes)
    if len(poses) != len(planes):
        raise InputError(f"has {len(planes)} planes and {len(poses)} plane_poses; it must be one for each")
    shapes: list[Shape] = []
    for i, (part, pose) in enumerate(zip(planes, poses, strict=True)):
        coefficients = vector(f"planes[{i}]", "coef", mapping_of(f"planes[{i}]", part).get("coef"), 4)
        shapes.append(plane(coefficients, name).moved(T_base_object @ _pose(f"plane_poses[{i}]", pose)))
    for key, build in (("primitive", _primitive), ("mesh", _mesh)):
        plural = "meshes" if key == "mesh" else "primitives"
        parts = list_of(plural, entry.get(plural))
        poses = list_of(f"{key}_poses", entry.get(f"{key}_poses"))
        if not poses and entry.get("pose"):
            poses = [NO_POSE] * len(parts)
        if len(poses) != len(parts):
            raise InputError(
                f"has {len(parts)} {plural} and {len(poses)} {key}_poses; it must be one for each"
            )
        for i, (part, pose) in enumerate(zip(parts, poses, strict=True)):
            T = T_base_object @ _pose(f"{key}_poses[{i}]", pose)
            where = f"{plural}[{i}]"
            wxyz = quaternion_from_rotation(T[:3, :3])
            shapes.append(build(where, mapping_of(where, part), T[:3, 3], wxyz, name, folder))
    return shapes


def _primitive(
    where: str, part: dict[str, Any], xyz: ndarray, wxyz: ndarray, name: str, _folder: Path
) -> Shape:
    kind = part.get("type")
    kind = TYPE_NUMBERS.get(kind, kind) if isinstance(kind, int) else kind
    if not isinstance(kind, str) or kind not in PRIMITIVES:
        raise unknown_name(f"type of {where}:", kind, PRIMITIVES)
    count, build = PRIMITIVES[kind]
    return build(vector(where, "dimensions", part.get("dimensions"), count), xyz, wxyz, name)


def _mesh(where: str, part: dict[str, Any], xyz: ndarray, wxyz: ndarray, name: str, folder: Path) -> Shape:
    if "resource" in part:
        file = str(part["resource"]).removeprefix("file://")
        if "://" in file:
            raise InputError(f"{where}.resource is {file}; it must be a file, or the mesh must have vertices")
        vertices, faces = read_triangles(folder / file)
        vertices = vertices * vector(where, "dimensions", part.get("dimensions", [1, 1, 1]), 3)
    else:
        rows = list_of(f"{where}.vertices", part.get("vertices"))
        vertices = np.array([_xyz(f"{where}.vertices", row) for row in rows]).reshape(-1, 3)
        triangles = list_of(f"{where}.triangles", part.get("triangles"))
        indices = [t.get("vertex_indices") if isinstance(t, dict) else t for t in triangles]
        faces = np.array([vector(where, "triangles", triangle, 3) for triangle in indices])
    return Mesh(vertices, faces, xyz, wxyz, name=name)


def moveit_request(data: object, frames: MoveItFrames, folder: Path = Path()) -> MoveItRequest:
    """Start, attached objects and goals of a parsed request; `frames` and `folder` are those of its scene.

    Several joint goal constraints are alternative goals. A position and an orientation constraint of one link
    are a pose goal at the centre of the region, whose size and tolerances are ignored. Raises InputError for
    anything else, and for path constraints, because ignoring them would change the problem.
    """
    data = mapping_of("a motion plan request", data)
    for name in ("path_constraints", "trajectory_constraints"):
        if any(mapping_of(name, data.get(name)).values()):
            raise InputError(f"{name} are not supported")
    for name in ("reference_trajectories", "max_cartesian_speed"):
        if data.get(name):
            raise InputError(f"{name} is not supported; leave it out")
    notes = _scaling_notes(data)
    state = mapping_of("start_state", data.get("start_state"))
    held = list_of("attached_collision_objects", state.get("attached_collision_objects"))
    attached = tuple(_attached(i, entry, frames, folder) for i, entry in enumerate(held))
    start = _joint_state("start_state.joint_state", state.get("joint_state"))
    goals = list_of("goal_constraints", data.get("goal_constraints"))
    if not goals:
        raise InputError("goal_constraints is empty; it must hold at least one goal")
    if len(goals) == 1 and mapping_of("goal_constraints[0]", goals[0]).get("position_constraints"):
        return MoveItRequest(start, pose_goal=_pose_goal(goals[0], frames), attached=attached, notes=notes)
    each = tuple(_joint_goal(f"goal_constraints[{i}]", goal) for i, goal in enumerate(goals))
    return MoveItRequest(start, each, attached=attached, notes=notes)


def _joint_state(where: str, value: object) -> dict[str, float]:
    """Joint values by name."""
    state = mapping_of(where, value)
    names = list_of(f"{where}.name", state.get("name"))
    positions = vector(where, "position", list_of(f"{where}.position", state.get("position")), len(names))
    return dict(zip(map(str, names), positions.tolist(), strict=True))


def _scaling_notes(data: dict[str, Any]) -> tuple[str, ...]:
    """Notes on velocity and acceleration scaling factors below 1, which are ignored; 0 means 1 in MoveIt."""
    notes = []
    for what in ("velocity", "acceleration"):
        name = f"max_{what}_scaling_factor"
        share = float(vector("request", name, [data.get(name) or 0], 1)[0])
        if not 0 <= share <= 1:
            raise InputError(f"{name} is {shown(data[name])}; it must be a number from 0 to 1")
        if 0 < share < 1:
            notes.append(f"the request's {name} {share:g} is ignored: plan with {what}_scaling={share:g}")
    return tuple(notes)


def _attached(i: int, entry: object, frames: MoveItFrames, folder: Path) -> MoveItAttached:
    where = f"attached_collision_objects[{i}]"
    entry = mapping_of(where, entry)
    link, given = str(entry.get("link_name") or ""), mapping_of(f"{where}.object", entry.get("object"))
    header = mapping_of(f"{where}.object.header", given.get("header"))
    in_link = str(header.get("frame_id") or "").removeprefix("/") == link
    if in_link:  # the shapes are already in the frame of the link
        frames = MoveItFrames(None, np.eye(4), (link,))
    try:
        shapes = tuple(_object(given, frames, folder))
    except InputError as error:
        raise InputError(f"{where}.object: {error}") from None
    touch = tuple(map(str, list_of(f"{where}.touch_links", entry.get("touch_links"))))
    return MoveItAttached(str(given.get("id") or "object"), link, shapes, in_link, touch)


def holding_at(robot: Robot, held: MoveItAttached, start: list[float]) -> Robot:
    """The robot with an object attached at the start. touch_links that the robot lacks are ignored."""
    shapes = held.shapes
    if not held.in_link and held.link in robot.link_names:
        T_link_base = inverse(link_pose(robot, np.array(start), held.link))
        shapes = tuple(shape.moved(T_link_base) for shape in shapes)
    touch = tuple(link for link in held.touch_links if link in robot.link_names)
    T_link_body = shapes[0].solid()[0] if shapes else np.eye(4)
    return robot.with_body(AttachedBody(held.name, held.link, T_link_body, shapes, touch))


def linkable(robot: Robot, request: MoveItRequest | None) -> tuple[str, ...]:
    """Names of the robot's links and of what it holds at the start."""
    return (*robot.link_names, *(held.name for held in (request.attached if request else ())))


def mimic_notes(robot: Robot, start: dict[str, float]) -> tuple[str, ...]:
    """Notes on mimic joints whose value in a start state differs from what the joint they mimic implies."""
    mimics = {joint.name: joint.mimic.joint for joint in robot.joints if joint.mimic is not None}
    return tuple(
        f"start_state: {name} is {start[name]:g}; planned at {robot.locked[name]:g}, which {master} implies"
        for name, master in mimics.items()
        if name in start and name in robot.locked and abs(robot.locked[name] - start[name]) > MIMIC_SLACK
    )


def _joint_goal(where: str, goal: object) -> dict[str, float]:
    goal = mapping_of(where, goal)
    if any(goal.get(f"{kind}_constraints") for kind in ("position", "orientation", "visibility")):
        raise InputError(f"{where} must have joint_constraints alone, or be the only goal and a pose")
    values: dict[str, float] = {}
    for i, entry in enumerate(list_of(f"{where}.joint_constraints", goal.get("joint_constraints"))):
        at = f"{where}.joint_constraints[{i}]"
        entry = mapping_of(at, entry)
        values[str(entry.get("joint_name"))] = float(vector(at, "position", [entry.get("position")], 1)[0])
    return values


def _pose_goal(goal: dict[str, Any], frames: MoveItFrames) -> tuple[str, ndarray]:
    where = "goal_constraints[0]"
    places = list_of(f"{where}.position_constraints", goal.get("position_constraints"))
    turns = list_of(f"{where}.orientation_constraints", goal.get("orientation_constraints"))
    if len(places) != 1 or len(turns) != 1 or goal.get("joint_constraints"):
        raise InputError(f"{where} must have one position and one orientation constraint, and no others")
    place, turn = (mapping_of(where, entry) for entry in (places[0], turns[0]))
    link = place.get("link_name")
    if link != turn.get("link_name"):
        raise InputError(
            f"{where} constrains {link} and {turn.get('link_name')}; both must constrain one link"
        )
    if _xyz("target_point_offset", place.get("target_point_offset") or [0, 0, 0]).any():
        raise InputError(f"{where}.position_constraints[0].target_point_offset must be zero")
    region = mapping_of("constraint_region", place.get("constraint_region"))
    poses = list_of("constraint_region.primitive_poses", region.get("primitive_poses"))
    if len(poses) != 1:
        raise InputError(f"{where}: constraint_region has {len(poses)} primitive_poses; it must have one")
    T_base_region = frames.of("header", place) @ _pose("constraint_region.primitive_poses[0]", poses[0])
    turned = _pose(where, {"position": [0, 0, 0], "orientation": turn.get("orientation")})
    rotation = (frames.of("header", turn) @ turned)[:3, :3]
    return str(link), transform(T_base_region[:3, 3], rotation)


def _xyz(where: str, value: object) -> ndarray:
    value = [value.get(axis) for axis in "xyz"] if isinstance(value, dict) else value
    return vector(where, "xyz", value, 3)


def _pose(where: str, value: object, position: str = "position", orientation: str = "orientation") -> ndarray:
    value = mapping_of(where, value)
    turn = value.get(orientation)
    xyzw = [turn.get(axis) for axis in "xyzw"] if isinstance(turn, dict) else turn
    x, y, z, w = unit_quaternion(where, xyzw, orientation)
    rotation = rotation_from_quaternion(np.array([w, x, y, z]))
    return transform(_xyz(f"{where}.{position}", value.get(position)), rotation)
