"""Publishes motions to ROS through rosbridge."""

from time import sleep

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Trajectory
from robotdiffuse.interop import missing_package
from robotdiffuse.interop.plain_messages import joint_trajectory

try:
    import roslibpy
except ImportError:
    raise missing_package("roslibpy", "ros") from None

JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
PORT = 9090
MATCH_TIME = 0.5
"""Time for subscribers to match the publisher before it sends, and to receive before it ends [s]."""


def publish(
    trajectory: Trajectory,
    host: str,
    port: int = PORT,
    topic: str = "/joint_trajectory",
    timeout: float = 5.0,
) -> None:
    """Publish a trajectory once, as a JointTrajectory; the caller must have validated it.

    Whether a subscriber received it is not known: ROS does not confirm deliveries. Raises InputError if no
    rosbridge answers within `timeout` [s].
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
        sleep(MATCH_TIME)
        publisher.publish(roslibpy.Message(joint_trajectory(trajectory.joint_names, trajectory)))
        sleep(MATCH_TIME)
        publisher.unadvertise()
    finally:
        ros.close()
