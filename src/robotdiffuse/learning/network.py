"""The base class of all trained networks of a robot, so that one checkpoint format holds them all."""

from typing import Any

from torch import nn

from robotdiffuse.learning.robot_identity import RobotIdentity


class Network(nn.Module):
    """A network for one robot, made from a `RobotIdentity` and settings of the class that NETWORKS names."""

    robot: RobotIdentity
    settings: Any

    def for_inference(self) -> "Network":
        """Freeze. Returns self."""
        return self.requires_grad_(False).eval()
