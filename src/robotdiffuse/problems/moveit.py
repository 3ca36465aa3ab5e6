"""Reads planning scenes and motion plan requests of MoveIt in YAML, as MotionBenchMaker and robowflex write
them.

Messages: PlanningScene and MotionPlanRequest in https://docs.ros.org/en/noetic/api/moveit_msgs/html/.
Vectors may be lists or mappings (x, y, z), and quaternions are xyzw.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import (
    InputError,
    check_name,
    check_type,
    joined,
    located,
    numbers,
    repeated,
    shortened,
    shown,
    unit_quaternion,
    unknown_name,
    vector,
)
from robotdiffuse.core.files import JsonObject, read_yaml
from robotdiffuse.core.mesh_files import read_triangles
from robotdiffuse.core.transforms import (
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_z_to,
    transform,
)
from robotdiffuse.core.types import Pose, Quaternion, Vector, frozen_dataclass
from robotdiffuse.robots.bodies import AttachedBody, polygon_around_circle
from robotdiffuse.robots.kinematic_tree import MOVING_KINDS
from robotdiffuse.robots.robot import MIMIC_SLACK, Robot
from robotdiffuse.scenes.files import check_fields
from robotdiffuse.scenes.point_cloud import cover_radius, occupied_voxels
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Cylinder, Mesh, PointCloud, Shape, Sphere

SCENE = "a planning scene"
REQUEST = "a motion plan request"
# Names in planning scenes: the field of the matrix, and the octomap's name in the matrix.
MATRIX = "allowed_collision_matrix"
OCTOMAP = "<octomap>"
SCENE_FIELDS = (
    *("name", "robot_state", "robot_model_name", "fixed_frame_transforms", MATRIX, "link_padding"),
    *("link_scale", "object_colors", "world", "is_diff"),
)
OBJECT_FIELDS = (
    *("header", "pose", "id", "type", "primitives", "primitive_poses", "meshes", "mesh_poses", "planes"),
    *("plane_poses", "subframe_names", "subframe_poses", "operation"),
)
REQUEST_FIELDS = (
    *("workspace_parameters", "start_state", "goal_constraints", "path_constraints", "group_name"),
    *("trajectory_constraints", "reference_trajectories", "pipeline_id", "planner_id"),
    *("num_planning_attempts", "allowed_planning_time", "max_velocity_scaling_factor"),
    *("max_acceleration_scaling_factor", "cartesian_speed_end_effector_link"),
    *("cartesian_speed_limited_link", "max_cartesian_speed"),
)
GOAL_FIELDS = (
    "name",
    *(f"{kind}_constraints" for kind in ("joint", "position", "orientation", "visibility")),
)
STATE_FIELDS = ("joint_state", "multi_dof_joint_state", "attached_collision_objects", "is_diff")
ATTACHED_FIELDS = ("link_name", "object", "touch_links", "detach_posture", "weight")
ADDITIONS = (None, 0, 2, "\0", "\2", b"\0", b"\2")
"""Values of an object's field `operation` that mean to add it or to append to it."""

# Edge length and thickness of the box that stands for a plane [m].
PLANE_EXTENT = 20.0
PLANE_THICKNESS = 0.01
MAX_PLANES = 1000
"""Maximum number of planes in a collision object; each becomes a box."""
WIDE_REGION = 0.01
"""A goal region with a dimension above this, the validator's tolerance, gets a note [m]."""
WIDE_ANGLE = 0.2618
"""A goal orientation with a tolerance above this, the validator's tolerance, gets a note [rad]."""
NO_POSE = {"position": [0, 0, 0], "orientation": [0, 0, 0, 1]}
TYPE_NUMBERS = {1: "box", 2: "sphere", 3: "cylinder", 4: "cone", 5: "prism"}
"""Names of the types of shape_msgs/SolidPrimitive, by their numbers in messages."""


def mapping_of(where: str, value: Any, *names: str) -> JsonObject:
    """The value as a mapping, or the mapping in its nested field names[0].names[1]...; None counts as empty.

    where: the place of the value, for messages.
    """
    for name in names:
        value = mapping_of(where, value).get(name)
        where = name if where in (SCENE, REQUEST) else f"{where}.{name}"
    check_type(where, value, (dict, NoneType), "a mapping")
    return value or {}


def list_of(where: str, entry: JsonObject, name: str) -> list[Any]:
    """The list in the field `name` of an entry; None counts as empty. where: prefix of the field's name in
    messages."""
    value = entry.get(name)
    check_type(f"{where}{name}", value, (list, NoneType), "a list")
    return value or []


def mappings_of(where: str, entry: JsonObject, name: str) -> list[tuple[str, JsonObject]]:
    """The mappings of the list in the field `name`, each with its place for messages."""
    places = [(f"{where}{name}[{i}]", value) for i, value in enumerate(list_of(where, entry, name))]
    return [(place, mapping_of(place, value)) for place, value in places]


def xyz_of(where: str, value: object) -> Vector:
    return vector(where, "xyz", [value.get(axis) for axis in "xyz"] if isinstance(value, dict) else value, 3)


def pose_of(where: str, value: object, position: str = "position", orientation: str = "orientation") -> Pose:
    """The transform of a geometry_msgs/Pose, or of a geometry_msgs/Transform, given the names of its
    fields."""
    value = mapping_of(where, value)
    xyzw = value.get(orientation)
    xyzw = [xyzw.get(axis) for axis in "xyzw"] if isinstance(xyzw, dict) else xyzw
    wxyz = np.roll(unit_quaternion(where, xyzw, orientation), 1)
    return transform(xyz_of(f"{where}.{position}", value.get(position)), rotation_from_quaternion(wxyz))


def joint_state(state: JsonObject, where: str) -> dict[str, float]:
    """Joint values by joint name of a RobotState."""
    joints = mapping_of(where, state, "joint_state")
    where = f"{where}.joint_state"
    names = list_of(f"{where}.", joints, "name")
    positions = vector(where, "position", list_of(f"{where}.", joints, "position"), len(names))
    return _by_joint(where, names, positions)


def _by_joint(where: str, names: Iterable[object], values: Iterable[float]) -> dict[str, float]:
    joint_names = list(map(str, names))
    twice = repeated(joint_names)
    if twice:
        raise InputError(f"{where} has {joined(twice)} more than once")
    return dict(zip(joint_names, map(float, values), strict=True))


def frame_name(where: str, entry: JsonObject) -> str:
    """The frame_id in the header of an entry, without a leading slash."""
    return str(mapping_of(where, entry, "header").get("frame_id") or "").removeprefix("/")


def read_moveit_scene(
    file: str | Path, robot: Robot, ignore_joints: bool = False
) -> tuple[Scene, Robot, tuple[str, ...]]:
    """The collision objects of a planning scene, in the frame of the robot's base; the robot, with its
    unplanned joints locked at their values in robot_state; and notes on differences between the scene's robot
    and `robot`.

    The pose of the root of the robot's URDF comes from robot_state.multi_dof_joint_state, and the pose of the
    base relative to this root from `robot`. Other known frames are those in fixed_frame_transforms and the
    links that are fixed to the base. The allowed collision matrix says which links may touch which objects;
    its entries for two links are ignored, because the robot has its own pairs of links to check.

    Raises InputError, naming file and object, for a missing or damaged file, unknown fields and frames,
    shapes that are not supported (prisms, octomaps that are not binary, mesh resources that are not files),
    objects attached to robot_state, and, unless `ignore_joints`, joints that the robot lacks.
    """
    data = read_yaml(file)
    with located(file):
        notes = scene_robot_notes(data, robot, ignore_joints)
        robot = at_state(robot, scene_state(data))
        scene = moveit_scene(data, moveit_frames(data, robot), Path(file).parent, robot.link_names)
        return scene, robot, notes


class MoveItFrames(dict[str, ndarray]):
    """T_base_frame, by name, of the frames in which a planning scene may give objects.

    These are the scene's own frame (named '' and, usually, `world`), the frames that the file defines, and
    the links that fixed joints connect with the robot's base.
    """

    links: frozenset[str] = frozenset()
    """Links of the robot; a file cannot change their poses."""
    unknown_reason: str = ""
    """Why the pose of the scene's own frame is unknown; empty if it is known."""
    T_own_root: Pose = np.eye(4)
    """Pose of the robot's root in the scene's own frame."""

    def of_header(self, where: str, entry: JsonObject) -> Pose:
        """T_base_frame of the frame that the header of an entry names.

        Raises InputError for an unknown frame. The message lists the known frames and, if the pose of the
        robot's base in the scene is unknown, says why.
        """
        name = frame_name(where, entry)
        if name in self:
            return self[name]
        frame_names = [frame for frame in self if frame]
        if self.unknown_reason:
            raise InputError(
                f"frame_id of {where} is {shown(name)}, and the robot's pose in this frame is unknown: "
                f"{self.unknown_reason}; known frames: {', '.join(frame_names)}"
            )
        raise unknown_name(f"frame_id of {where}:", name, frame_names)


def moveit_frames(data: object, robot: Robot) -> MoveItFrames:
    """The frames of a parsed planning scene; `robot` as in `read_moveit_scene`.

    The scene's own frame is the frame in which robot_state.multi_dof_joint_state gives the pose of the
    robot's root, by default `world`. Raises InputError if the field has more than one transform, if
    robot_state has attached objects, and for wrong transforms and unknown frames.
    """
    state = check_fields("robot_state", mapping_of(SCENE, data, "robot_state"), (), STATE_FIELDS)
    if state.get("attached_collision_objects"):
        raise InputError("robot_state has attached_collision_objects; they belong to a request's start_state")
    location = "multi_dof_joint_state"
    floating = mapping_of(SCENE, data, "robot_state", location)
    count = len(list_of(f"{location}.", floating, "transforms"))
    if count > 1:
        raise InputError(f"{location} has {count} transforms; it must have one, of the robot's root")
    root_pose = _root_pose(location, floating)
    T_own_root = np.eye(4) if root_pose is None else root_pose
    named = frame_name(location, floating)
    frames = MoveItFrames(robot.above | robot.links_fixed_to_base)
    frames.links = frozenset(frames)
    frames.T_own_root = T_own_root
    if robot.T_base_root is None:
        frames.unknown_reason = f"a joint moves {robot.base} relative to {robot.root}"
    else:
        T_base_own = robot.T_base_root @ inverse(T_own_root)
        # a header that names the robot's root says nothing about the frame of the scene
        scene_frame = "world" if named in ("", robot.root or robot.base) else named
        frames.update({name: T_base_own for name in ("", scene_frame) if name not in frames.links})
    for location, entry in mappings_of("", mapping_of(SCENE, data), "fixed_frame_transforms"):
        child = str(entry.get("child_frame_id", "")).removeprefix("/")
        T = pose_of(f"{location}.transform", entry.get("transform"), "translation", "rotation")
        frame = frame_name(location, entry)
        # as MoveIt writes them: T is the pose of the header's frame in the child frame, the planning frame;
        # if the child frame is unknown, T is read as in TF: the pose of the child in the header's frame
        if frame and child in frames:
            frames |= {} if frame in frames.links else {frame: frames[child] @ T}
        elif not frames.unknown_reason and child not in frames.links:
            frames[child] = frames.of_header(location, entry) @ T
    return frames


def _root_pose(location: str, floating: JsonObject) -> Pose | None:
    """The first transform of a multi_dof_joint_state, that of the robot's root; None if there is none."""
    transforms = list_of(f"{location}.", floating, "transforms")
    if not transforms:
        return None
    return pose_of(f"{location}.transforms[0]", transforms[0], "translation", "rotation")


def moveit_scene(
    data: object,
    frames: MoveItFrames,
    folder: Path,
    links: Collection[str] = (),
    contacts: Iterable[tuple[str, Any]] = (),
) -> Scene:
    """`read_moveit_scene` for a parsed file; names of mesh files are relative to `folder`.

    links: names of the robot's links and held objects. contacts: allowed contacts in addition to those of the
    file, as pairs that `Scene` accepts.
    """
    check_fields(SCENE, data, (), SCENE_FIELDS)
    world = check_fields("world", mapping_of(SCENE, data, "world"), (), ("collision_objects", "octomap"))
    shapes = _octomap(mapping_of("world", world, "octomap"), frames)
    for i, entry in enumerate(list_of("world.", world, "collision_objects")):
        object_entry = mapping_of(f"collision object {i}", entry)
        with located(f"collision object {object_entry.get('id', i)}"):
            shapes.extend(object_shapes(object_entry, frames, folder))
    names = dict.fromkeys(shape.name for shape in shapes)
    allowed = matrix_contacts(mapping_of(SCENE, data, MATRIX), names, links)
    return Scene(shapes, [*allowed.items(), *contacts])


def matrix_contacts(
    matrix: object, obstacles: Iterable[str], links: Collection[str]
) -> dict[str, tuple[str, ...]]:
    """For each obstacle, the links that may touch it; obstacles that no link may touch are left out.

    The matrix entry of a link and an obstacle decides. If there is no entry, the default entries of the two
    names decide: contact is allowed if at least one name has a default and no default forbids it. Pairs of
    links, and names that are neither links nor obstacles, are ignored. Raises InputError for a matrix that is
    not square.
    """
    matrix = mapping_of(MATRIX, matrix)
    names, rows, default_names, default_values = (
        list_of(f"{MATRIX}.", matrix, f"{part}entry_{column}")
        for part in ("", "default_")
        for column in ("names", "values")
    )
    # a row may be a list or a message AllowedCollisionEntry
    rows = [
        list_of(f"{MATRIX}.", row if isinstance(row, dict) else {"enabled": row}, "enabled") for row in rows
    ]
    if any(len(row) != len(names) for row in (rows, *rows)):
        raise InputError(f"{MATRIX} has {len(names)} entry_names; entry_values must be square, of this size")
    for value in (*default_values, *(value for row in rows for value in row)):
        if value not in (False, True):
            raise InputError(f"{MATRIX} has the value {shown(value)}; its values must be true or false")
    if len(default_values) != len(default_names):
        raise InputError(
            f"{MATRIX} has {len(default_names)} default_entry_names; it must have as many "
            "default_entry_values"
        )
    pairs = {
        (str(name), str(partner)): bool(value)
        for name, row in zip(names, rows, strict=True)
        for partner, value in zip(names, row, strict=True)
    }
    default = dict(zip(map(str, default_names), map(bool, default_values), strict=False))

    def allowed(link: str, obstacle: str) -> bool:
        defaults = [default[name] for name in (link, obstacle) if name in default]
        return pairs.get((link, obstacle), bool(defaults) and all(defaults))

    touch_links = {
        obstacle: tuple(
            link for link in links if allowed(link, OCTOMAP if obstacle == "octomap" else obstacle)
        )
        for obstacle in obstacles
    }
    return {obstacle: touching for obstacle, touching in touch_links.items() if touching}


def _octomap(entry: JsonObject, frames: MoveItFrames) -> list[Shape]:
    """A point cloud whose spheres cover the occupied voxels of an OctomapWithPose; no shape without data."""
    location = "world.octomap"
    message = mapping_of(location, entry, "octomap")
    data = list_of(f"{location}.octomap.", message, "data")
    if not data:
        return []
    if not message.get("binary"):
        raise InputError(f"{location} is not binary; publish it as a binary octomap (octomap_binary)")
    octets = vector(f"{location}.octomap", "data", data, len(data), 255.0).astype(np.int64)
    edge = float(vector(f"{location}.octomap", "resolution", [message.get("resolution")], 1)[0])
    T = frames.of_header(location, entry) @ pose_of(f"{location}.origin", entry.get("origin") or NO_POSE)
    with located(location):
        voxels = occupied_voxels((octets % 256).astype(np.uint8).tobytes(), edge)
        return [PointCloud(voxels, cover_radius(edge), name="octomap").moved(T)]


def object_shapes(entry: JsonObject, frames: MoveItFrames, folder: Path) -> list[Shape]:
    """The shapes of a CollisionObject in the frame of the robot's base, each named like the object.

    folder: names of mesh files are relative to it.
    """
    check_fields("the object", entry, (), OBJECT_FIELDS)
    if entry.get("operation") not in ADDITIONS:
        raise InputError(
            f"operation is {shown(entry['operation'])}; only objects that are added (0) or appended (2) can "
            "be read"
        )
    T_base_object = frames.of_header("header", entry) @ pose_of("pose", entry.get("pose") or NO_POSE)
    name = "object" if entry.get("id") in (None, "") else str(entry["id"])
    shapes = list[Shape]()
    for key, plural in (("plane", "planes"), ("primitive", "primitives"), ("mesh", "meshes")):
        parts = mappings_of("", entry, plural)
        poses = list_of("", entry, f"{key}_poses")
        if key == "plane" and len(parts) > MAX_PLANES:
            raise InputError(f"has {len(parts):,} planes; at most {MAX_PLANES:,} are read")
        if not poses and (key == "plane" or entry.get("pose")):
            poses = [NO_POSE] * len(parts)
        if len(poses) != len(parts):
            raise InputError(
                f"has {len(parts)} {plural} and {len(poses)} {key}_poses; it must have a pose for each"
            )
        for i, ((location, part), pose) in enumerate(zip(parts, poses, strict=True)):
            T = T_base_object @ pose_of(f"{key}_poses[{i}]", pose)
            if key == "plane":
                shapes.append(_plane(vector(location, "coef", part.get("coef"), 4), name).moved(T))
                continue
            placed = T[:3, 3], quaternion_from_rotation(T), name
            if key == "mesh":
                shapes.append(Mesh(*_triangles(location, part, folder), *placed[:2], name=name))
                continue
            kind = part.get("type")
            kind = TYPE_NUMBERS.get(kind, kind) if isinstance(kind, int) else kind
            check_name(f"type of {location}:", kind, PRIMITIVES)
            count, build = PRIMITIVES[str(kind)]
            shapes.append(build(vector(location, "dimensions", part.get("dimensions"), count), *placed))
    return shapes


def _triangles(where: str, part: JsonObject, folder: Path) -> tuple[ndarray, ndarray]:
    """Vertices and faces of a mesh."""
    if "resource" in part:
        file = str(part["resource"]).removeprefix("file://")
        if "://" in file:
            raise InputError(f"{where}.resource is {file}; it must be a file, or the mesh must have vertices")
        vertices, faces = read_triangles(folder / file, turn=False)
        return vertices * vector(where, "dimensions", part.get("dimensions", [1, 1, 1]), 3), faces
    rows = [xyz_of(f"{where}.vertices", row) for row in list_of(f"{where}.", part, "vertices")]
    triangles = list_of(f"{where}.", part, "triangles")
    indices = [t.get("vertex_indices") if isinstance(t, dict) else t for t in triangles]
    faces = np.array([vector(where, "triangles", triangle, 3) for triangle in indices])
    return np.array(rows).reshape(-1, 3), faces


def _cone(size: Float[ndarray, "2"], xyz: Vector, wxyz: Quaternion, name: str) -> Mesh:
    """A pyramid around a cone with size = (height, radius) [m] about the z axis; the origin is at half the
    height."""
    from robotdiffuse.robots.fitting.convex_parts import convex_hull  # SciPy, which few problems need

    height, radius = size
    if not (size > 0).all():
        raise InputError(f"dimensions of a cone are {shown(size)}; they must be positive")
    bottom = np.insert(polygon_around_circle(radius), 2, -height / 2, axis=1)
    hull = convex_hull(np.concatenate([bottom, [[0, 0, height / 2]]]))
    return Mesh(hull.vertices, hull.faces, xyz, wxyz, name=name)


PRIMITIVES: dict[str, tuple[int, Callable[[ndarray, ndarray, ndarray, str], Shape]]] = {
    "box": (3, lambda size, xyz, wxyz, name: Box(xyz, size, wxyz, name)),
    "sphere": (1, lambda size, xyz, wxyz, name: Sphere(xyz, size[0], name)),
    "cylinder": (2, lambda size, xyz, wxyz, name: Cylinder(xyz, size[1], size[0], wxyz, name)),
    "cone": (2, _cone),
}
"""For each type, the number of its dimensions, and a function that makes the shape from its dimensions,
position, quaternion wxyz and name. The dimensions of cylinders and cones are height and radius."""


def _plane(coefficients: Float[ndarray, "4"], name: str) -> Box:
    """A large, thin box below the plane a x + b y + c z + d = 0; (a, b, c) points away from the box.

    Raises InputError if a, b and c are all zero.
    """
    normal = coefficients[:3]
    length = np.linalg.norm(normal)
    if length < 1e-9:
        raise InputError(f"coef of a plane is {shown(coefficients)}; a, b and c must not all be zero")
    normal = normal / length
    center = -normal * (coefficients[3] / length + PLANE_THICKNESS / 2)
    wxyz = quaternion_from_rotation(rotation_z_to(normal))
    return Box(center, [PLANE_EXTENT, PLANE_EXTENT, PLANE_THICKNESS], wxyz, name)


def moveit_model(data: object) -> str:
    """The robot_model_name of a parsed planning scene; empty if the file names no model."""
    return str((data.get("robot_model_name") if isinstance(data, dict) else None) or "")


def scene_state(data: object) -> dict[str, float]:
    """The joint values of a parsed planning scene by name."""
    return joint_state(mapping_of(SCENE, data, "robot_state"), "robot_state")


def at_state(robot: Robot, values: Mapping[str, float], stated: Collection[str] = ()) -> Robot:
    """The robot with its joints locked at these values, except planned joints, joints that follow another
    joint, and joints in `stated`."""
    unplanned = {joint.name for joint in robot.joints if joint.movable and joint.mimic is None}
    unplanned -= {*robot.joint_names, *stated}
    return robot.with_locked({name: value for name, value in values.items() if name in unplanned})


def scene_robot_notes(data: object, robot: Robot, ignore_joints: bool = False) -> tuple[str, ...]:
    """Notes on differences between a robot and the robot of a parsed planning scene.

    Raises InputError for joints that the robot lacks, unless `ignore_joints`. A different model name alone is
    only noted, because the same arm has many names. Names of multi-dof joints are ignored: these are virtual
    joints of an SRDF, and their transforms only give the pose of the robot's root.
    """
    values = scene_state(data)
    model = moveit_model(data)
    notes = []
    if model not in ("", robot.name):
        notes.append(f"the scene's robot_model_name is {shortened(model)}; planned for {robot.name}")
    if mapping_of(SCENE, data).get("is_diff"):
        notes.append(
            "the scene is a difference (is_diff); all obstacles of the scene that it changes are missing"
        )
    notes += joint_notes("robot_state.joint_state", values, robot, model, ignore_joints)
    for name, neutral in (("padding", 0), ("scale", 1)):
        entries = mappings_of("", mapping_of(SCENE, data), f"link_{name}")
        changed = [str(entry.get("link_name")) for _, entry in entries if entry.get(name, neutral) != neutral]
        if changed:
            notes.append(f"the scene's link_{name} of {joined(changed)} is ignored")
    return tuple(notes)


def joint_notes(
    where: str, values: dict[str, float], robot: Robot, model: str, ignore_joints: bool
) -> tuple[str, ...]:
    """A note on joints of `values` that the robot lacks. Unless `ignore_joints`, raises InputError instead.

    A joint that is fixed in the robot counts as lacking if its value is not zero. model: name of the scene's
    robot, for the message.
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
    movable = joined(name for name, kind in kinds.items() if kind in MOVING_KINDS)
    raise InputError(
        f"{where} has values of {joined(lacking)}, movable joints that {robot.name} lacks{of_model}; its "
        f"movable joints are {movable}. Give another robot, or ignore these joints (--ignore-joints, "
        f"ignore_joints=True)"
    )


@frozen_dataclass
class MoveItAttached:
    """An object that the robot holds at the start."""

    name: str
    link: str
    shapes: tuple[Shape, ...]
    in_link: bool
    """Whether the shapes are in the frame of the link; otherwise they are in the frame of the base, at
    their poses at the start."""
    touch_links: tuple[str, ...] = ()

    def held_by(self, robot: Robot, start: list[float]) -> Robot:
        """The robot, holding this object as at the configuration `start`; touch_links that the robot
        lacks are ignored."""
        shapes = self.shapes
        if not self.in_link and self.link in robot.link_names:
            T_link_base = inverse(robot.fk(start, self.link))
            shapes = tuple(shape.moved(T_link_base) for shape in shapes)
        touch = tuple(link for link in self.touch_links if link in robot.link_names)
        T_link_body = shapes[0].solid()[0] if shapes else np.eye(4)
        return robot.with_body(AttachedBody(self.name, self.link, T_link_body, shapes, touch))


@frozen_dataclass
class MoveItRequest:
    """The content of a motion plan request. Either `joint_goals` is not empty or `pose_goal` is not None."""

    start: dict[str, float]
    """Joint values by name [rad] or [m], including fingers."""
    joint_goals: dict[str, dict[str, float]]
    """Joint values by name of each alternative goal. The keys are the goals' places in the request, for
    messages."""
    pose_goal: tuple[str, Pose] | None
    """A link and its goal pose T_base_link."""
    attached: tuple[MoveItAttached, ...]
    notes: tuple[str, ...]
    """Notes on parts of the request that are ignored."""


def moveit_request(data: object, frames: MoveItFrames, folder: Path = Path()) -> MoveItRequest:
    """Start, attached objects and goals of a parsed request.

    frames: the frames of the request's scene. folder: names of mesh files are relative to it.

    Several joint goal constraints are alternative goals; their tolerances are ignored. A position and an
    orientation constraint of one link are a pose goal at the center of the position's region; the region's
    size and the orientation's tolerances are ignored, with a note if they are large. Raises InputError for
    other goals, path and trajectory constraints, reference trajectories and max_cartesian_speed, because
    ignoring them would change the problem; and for scaling factors that are not from 0 to 1.
    """
    data = check_fields(REQUEST, mapping_of(REQUEST, data), (), REQUEST_FIELDS)
    for name in ("path_constraints", "trajectory_constraints"):
        if any(mapping_of(REQUEST, data, name).values()):
            raise InputError(f"{name} are not supported")
    for name in ("reference_trajectories", "max_cartesian_speed"):
        if data.get(name):
            raise InputError(f"{name} is not supported; leave it out")
    notes = []
    for quantity in ("velocity", "acceleration"):
        name = f"max_{quantity}_scaling_factor"
        factor = float(vector("request", name, [data.get(name) or 0], 1)[0])  # 0 means 1 in MoveIt
        if not 0 <= factor <= 1:
            raise InputError(f"{name} is {shown(data[name])}; it must be a number from 0 to 1")
        if 0 < factor < 1:
            notes.append(
                f"the request's {name} {factor:g} is ignored: plan with {quantity}_scaling={factor:g}"
            )
    state = check_fields("start_state", mapping_of(REQUEST, data, "start_state"), (), STATE_FIELDS)
    attached = tuple(
        _attached(location, entry, frames, folder)
        for location, entry in mappings_of("", state, "attached_collision_objects")
    )
    notes += [
        f"start_state: {body.name}, which {body.link} holds, has no shapes: it is not checked for collisions"
        for body in attached
        if not body.shapes
    ]
    start = joint_state(state, "start_state")
    location = "start_state.multi_dof_joint_state"
    floating = mapping_of("start_state", state, "multi_dof_joint_state")
    root_pose = _root_pose(location, floating)
    if root_pose is not None and not np.allclose(root_pose, frames.T_own_root, atol=1e-6):
        notes.append(f"{location} places the robot elsewhere than the scene does; it is ignored")
    velocity = list_of("", mapping_of("start_state", state, "joint_state"), "velocity")
    if any(velocity):
        notes.append(
            f"start_state.joint_state.velocity {shown(velocity)} is ignored: the motion begins at rest"
        )
    goals = mappings_of("", data, "goal_constraints")
    if not goals:
        raise InputError("goal_constraints is empty; it must hold at least one goal")
    for goal_name, goal in goals:
        check_fields(goal_name, goal, (), GOAL_FIELDS)
    joint_goals = {}
    pose_goal = None
    pose_fields = ("position_constraints", "orientation_constraints")
    if len(goals) == 1 and any(map(goals[0][1].get, pose_fields)):
        pose_goal = _pose_goal(*goals[0], frames, notes)
    else:
        joint_goals = {place: _joint_goal(place, goal, notes) for place, goal in goals}
    return MoveItRequest(start, joint_goals, pose_goal, attached, tuple(notes))


def _attached(location: str, entry: JsonObject, frames: MoveItFrames, folder: Path) -> MoveItAttached:
    check_fields(location, entry, (), ATTACHED_FIELDS)
    link = str(entry.get("link_name") or "")
    location, object_entry = f"{location}.object", mapping_of(location, entry, "object")
    in_link = frame_name(location, object_entry) == link
    if in_link:  # the shapes are already in the frame of the link
        frames = MoveItFrames({link: np.eye(4)})
    with located(location):
        shapes = tuple(object_shapes(object_entry, frames, folder))
    touch = tuple(map(str, list_of(f"{location}.", entry, "touch_links")))
    return MoveItAttached(str(object_entry.get("id") or "object"), link, shapes, in_link, touch)


def _joint_goal(where: str, goal: JsonObject, notes: list[str]) -> dict[str, float]:
    """Joint values by name. Notes on large tolerances are added to `notes`."""
    if any(goal.get(f"{kind}_constraints") for kind in ("position", "orientation", "visibility")):
        raise InputError(f"{where} must have joint_constraints alone; only a single goal may be a pose")
    entries = mappings_of(f"{where}.", goal, "joint_constraints")
    for at, entry in entries:
        tolerances = numbers([entry.get(f"tolerance_{side}", 0) for side in ("above", "below")])
        if tolerances is not None and tolerances.max() > WIDE_ANGLE:
            notes.append(f"{at}: its tolerance of {tolerances.max():g} is ignored")
    names = [entry.get("joint_name") for _, entry in entries]
    positions = [vector(at, "position", [entry.get("position")], 1)[0] for at, entry in entries]
    return _by_joint(where, names, positions)


def _wide_tolerances(region: JsonObject, orientation: JsonObject) -> list[str]:
    """Texts for dimensions of a goal's region above WIDE_REGION, and for tolerances above WIDE_ANGLE."""
    shapes = mappings_of("", region, "primitives")
    sizes = [size for _, shape in shapes for size in list_of("", shape, "dimensions")]
    angles = [orientation.get(f"absolute_{axis}_axis_tolerance", 0) for axis in "xyz"]
    limits = ((sizes, WIDE_REGION, "region", "m"), (angles, WIDE_ANGLE, "tolerance", "rad"))
    wide = []
    for values, limit, name, unit in limits:
        array = numbers(values)
        if array is not None and array.max(initial=0) > limit:
            wide.append(f"{name} of {array.max():g} {unit}")
    return wide


def _pose_goal(where: str, goal: JsonObject, frames: MoveItFrames, notes: list[str]) -> tuple[str, ndarray]:
    """The link and its goal pose T_base_link. A note on large tolerances is added to `notes`."""
    positions, orientations = (
        mappings_of(f"{where}.", goal, f"{kind}_constraints") for kind in ("position", "orientation")
    )
    has_others = any(goal.get(f"{kind}_constraints") for kind in ("joint", "visibility"))
    if len(positions) != 1 or len(orientations) != 1 or has_others:
        raise InputError(f"{where} must have one position and one orientation constraint, and no others")
    [(at, position)], [(_, orientation)] = positions, orientations
    link = position.get("link_name")
    if link != orientation.get("link_name"):
        raise InputError(
            f"{where} constrains the position of {link} and the orientation of "
            f"{orientation.get('link_name')}; both must be of one link"
        )
    check_type(f"{at}.link_name", link, str, "the name of a link")
    offset = xyz_of("target_point_offset", position.get("target_point_offset") or [0, 0, 0])
    if offset.any():
        raise InputError(f"{at}.target_point_offset is {shown(offset)}; it must be zero")
    name = "constraint_region"
    region = mapping_of(at, position, name)
    poses = mappings_of(f"{name}.", region, "primitive_poses")
    if len(poses) != 1:
        raise InputError(f"{where}: {name} has {len(poses)} primitive_poses; it must have one")
    wide = _wide_tolerances(region, orientation)
    if wide:
        notes.append(f"{where}: ignored {joined(wide)}, since the goal is the pose itself")
    T_base_region = frames.of_header("header", position) @ pose_of(*poses[0])
    T_frame_goal = pose_of(where, {"position": [0, 0, 0], "orientation": orientation.get("orientation")})
    T_base_goal = frames.of_header("header", orientation) @ T_frame_goal
    return str(link), transform(T_base_region[:3, 3], T_base_goal[:3, :3])
