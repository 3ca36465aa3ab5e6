"""The base class of all trained networks of a robot, so that one checkpoint format holds them all."""

from typing import Any, TypeVar

from jaxtyping import Float
from torch import Tensor, nn

from robotdiffuse.learning.robot_identity import RobotIdentity
from robotdiffuse.robots.normalizer import JointNormalizer

Module = TypeVar("Module", bound=nn.Module)


class Network(nn.Module):
    """A network for one robot, made from a `RobotIdentity` and settings of the class that NETWORKS names."""

    robot: RobotIdentity
    settings: Any
    normalizer: JointNormalizer

    def for_inference(self: Module) -> Module:
        """Freeze. Returns self."""
        return self.requires_grad_(False).eval()

    def exports(self) -> dict[str, bytes]:
        """The ONNX files that planning runs, by the ending after the network's name; empty for a network that
        planning runs by PyTorch."""
        return {}

    def to_unit(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
        """`JointNormalizer.to_unit` of a tensor, differentiable."""
        return (q - q.new_tensor(self.normalizer.middle)) / q.new_tensor(self.normalizer.half_range)

    def from_unit(self, x: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
        """`JointNormalizer.from_unit` of a tensor, differentiable."""
        return x * x.new_tensor(self.normalizer.half_range) + x.new_tensor(self.normalizer.middle)
