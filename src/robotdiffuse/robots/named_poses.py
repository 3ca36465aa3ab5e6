"""Named poses of a robot, as of its SRDF."""

from robotdiffuse.core.errors import InputError, shown, unknown_name
from robotdiffuse.robots.robot import Robot


def named_pose(robot: Robot, field: str, name: str) -> list[float]:
    """The planned joints' values in a named pose of the robot [rad] or [m].

    Raises InputError, naming the field, for an unknown name (the message lists those that hold all planned
    joints) and for a pose that lacks some.
    """
    whole = [pose for pose, values in robot.poses.items() if {*robot.joint_names} <= values.keys()]
    if not whole:
        values = f"a list of {robot.dof} numbers: {', '.join(robot.joint_names)}"
        raise InputError(f"{field} is {shown(name)}; it must be {values} ({robot.name} has no named poses)")
    if name not in robot.poses:
        raise unknown_name(f"pose in {field}:", name, whole)
    values = robot.poses[name]
    missing = [joint for joint in robot.joint_names if joint not in values]
    if missing:
        raise InputError(
            f"{field}: the pose {name!r} has no {', '.join(missing)}; whole poses: {', '.join(whole)}"
        )
    return [values[joint] for joint in robot.joint_names]
