"""A motion published to ROS by a rosbridge, live."""

from typing import Any

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Trajectory
from robotdiffuse.interop import missing
from robotdiffuse.interop.plain_messages import joint_trajectory

try:
    import roslibpy
except ImportError:
    raise missing("roslibpy", "ros") from None

JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
PORT = 9090


def publish(
    trajectory: Trajectory,
    host: str,
    port: int = PORT,
    topic: str = "/joint_trajectory",
    timeout: float = 5.0,
) -> None:
    """Send a trajectory once, as a JointTrajectory. The caller has validated it.

    Raises InputError where no rosbridge answers within `timeout` [s].
    """
    ros = roslibpy.Ros(host, port)
    try:
        ros.run(timeout=timeout)  # type: ignore[arg-type]
    except Exception:
        ros.close()
        raise InputError(f"no rosbridge answers at {host}:{port} within {timeout:g} s") from None
    try:
        publisher = roslibpy.Topic(ros, topic, JOINT_TRAJECTORY, latch=True)
        publisher.advertise()
        publisher.publish(roslibpy.Message(_record(trajectory)))
        publisher.unadvertise()
    finally:
        ros.close()


def _record(trajectory: Trajectory) -> dict[str, Any]:
    return joint_trajectory(trajectory.joint_names, trajectory)
