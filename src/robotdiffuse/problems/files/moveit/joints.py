"""Compares the joints that MoveIt files name with those of the robot."""

from robotdiffuse.core.errors import InputError, joined, shortened
from robotdiffuse.problems.files.moveit.request import MoveItRequest
from robotdiffuse.problems.files.moveit.values import joint_state, list_of, mapping_of
from robotdiffuse.robots.robot import MIMIC_SLACK, MOVING_KINDS, Robot


def scene_robot_notes(data: object, robot: Robot, ignore_joints: bool = False) -> tuple[str, ...]:
    """Notes on differences between a robot and the one of a parsed planning scene.

    Raises InputError for joints that the robot lacks, unless `ignore_joints`. A different model name alone is
    only noted: the same arm has many names, and all joints are known. Names of multi-dof joints are ignored:
    they are virtual joints of an SRDF, whose transforms give the pose of the robot's root.
    """
    data = mapping_of("a planning scene", data)
    state = mapping_of("robot_state", data.get("robot_state"))
    values = joint_state("robot_state.joint_state", state.get("joint_state"))
    model = moveit_model(data)
    notes = joint_notes("robot_state.joint_state", values, robot, model, ignore_joints)
    for name, neutral in (("padding", 0), ("scale", 1)):
        entries = [
            mapping_of(f"link_{name}", entry) for entry in list_of(f"link_{name}", data.get(f"link_{name}"))
        ]
        changed = [str(entry.get("link_name")) for entry in entries if entry.get(name, neutral) != neutral]
        if changed:
            notes = (*notes, f"the scene's link_{name} of {joined(changed)} is ignored")
    if model not in ("", robot.name):
        notes = (f"the scene's robot_model_name is {shortened(model)}; planned for {robot.name}", *notes)
    return notes


def moveit_model(data: object) -> str:
    """The robot_model_name of a parsed planning scene; empty if it has none."""
    return str((data.get("robot_model_name") if isinstance(data, dict) else None) or "")


def request_robot_notes(
    request: MoveItRequest, robot: Robot, model: str = "", ignore_joints: bool = False
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


def mimic_notes(robot: Robot, start: dict[str, float]) -> tuple[str, ...]:
    """Notes on mimic joints whose value in a start state differs from what the joint they mimic implies."""
    mimics = {joint.name: joint.mimic.joint for joint in robot.joints if joint.mimic is not None}
    return tuple(
        f"start_state: {name} is {start[name]:g}; planned at {robot.locked[name]:g}, which {master} implies"
        for name, master in mimics.items()
        if name in start and name in robot.locked and abs(robot.locked[name] - start[name]) > MIMIC_SLACK
    )
