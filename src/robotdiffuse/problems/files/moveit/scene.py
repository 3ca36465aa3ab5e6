"""Reads MoveIt planning scenes in YAML, as MotionBenchMaker and robowflex write them.

Message: https://docs.ros.org/en/noetic/api/moveit_msgs/html/msg/PlanningScene.html
"""

from collections.abc import Collection
from pathlib import Path

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.input_files import read_yaml
from robotdiffuse.problems.files.moveit.contacts import matrix_contacts
from robotdiffuse.problems.files.moveit.frames import MoveItFrames, moveit_frames
from robotdiffuse.problems.files.moveit.joints import scene_robot_notes
from robotdiffuse.problems.files.moveit.objects import object_shapes, octomap
from robotdiffuse.problems.files.moveit.values import list_of, mapping_of
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene


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


def moveit_scene(
    data: object, frames: MoveItFrames, folder: Path, links: Collection[str] = (), contacts: object = ()
) -> Scene:
    """`read_moveit_scene` for a parsed file; names of mesh files are relative to `folder`.

    links: names of the robot's links and held objects; contacts: allowed contacts besides those of the file,
    as in `Scene`.
    """
    world = mapping_of("world", mapping_of("a planning scene", data).get("world"))
    shapes = octomap(mapping_of("world.octomap", world.get("octomap")), frames)
    for i, entry in enumerate(list_of("world.collision_objects", world.get("collision_objects"))):
        shown_id = mapping_of(f"collision object {i}", entry).get("id", i)
        try:
            shapes.extend(object_shapes(mapping_of("it", entry), frames, folder))
        except InputError as error:
            raise InputError(f"collision object {shown_id}: {error}") from None
    names = dict.fromkeys(shape.name for shape in shapes)
    matrix = mapping_of("a planning scene", data).get("allowed_collision_matrix")
    given = Scene(shapes, contacts).allowed_contacts  # type: ignore[arg-type]
    return Scene(shapes, (*matrix_contacts(matrix, names, links).items(), *given))
