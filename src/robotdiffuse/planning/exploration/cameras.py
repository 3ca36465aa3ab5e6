"""Cameras of an Explorer: on a link of the arm, or standing beside it."""

from dataclasses import dataclass

from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.bounds import Value, rigid_transform
from robotdiffuse.core.errors import InputError
from robotdiffuse.robots.kinematics import link_poses
from robotdiffuse.robots.robot import Robot


@dataclass(frozen=True, eq=False)
class ArmCamera(Value):
    """A depth camera on a link of the arm. Its body should be part of the robot, as a held object is."""

    link: str
    T_link_camera: Float[ndarray, "4 4"]
    """x to the right in the image, y down, z ahead."""
    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy [pixels]."""
    size: tuple[int, int]
    """Width and height of the image [pixels]."""
    range: float = 2.0
    """Farther surfaces are not seen [m]."""

    def __post_init__(self) -> None:
        if not self.range > 0:
            raise InputError(f"camera.range is {self.range}; it must be positive [m]")
        pose = rigid_transform("camera.T_link_camera", self.T_link_camera)
        object.__setattr__(self, "T_link_camera", pose)
        super().__post_init__()

    def poses(self, robot: Robot, q: Float[ndarray, "n dof"]) -> Float[ndarray, "n 4 4"]:
        """T_base_camera at configurations."""
        return link_poses(robot, q, self.link) @ self.T_link_camera
