"""Cameras and settings of an Explorer, and the steps that it returns."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from robotdiffuse.core.errors import InputError, positive, rigid_transform, shown, vector
from robotdiffuse.core.settings import Count, Natural, OneOf, Positive, Settings, Share
from robotdiffuse.core.types import Configurations, PlanResult, Pose, Poses, Value, frozen_dataclass
from robotdiffuse.perception.depth_view import checked_intrinsics
from robotdiffuse.perception.voxel_grid import Voxels
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene


@frozen_dataclass
class ArmCamera(Value):
    """A depth camera on a link of the arm. Attach the camera's body to the robot, so that it is checked for
    collisions."""

    link: str
    """Name of the link."""
    T_link_camera: Pose
    """Pose of the optical frame: x to the right in the image, y down, z ahead."""
    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy [pixels]."""
    size: tuple[int, int]
    """Width and height of the image [pixels]."""
    range: float = 2.0
    """Farther surfaces are not seen [m]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "range", positive("camera", "range", self.range))
        pose = rigid_transform("camera.T_link_camera", self.T_link_camera)
        object.__setattr__(self, "T_link_camera", pose)
        size = vector("camera", "size", self.size, 2)
        if (size < 1).any() or (size % 1).any():
            raise InputError(f"camera.size is {shown(self.size)}; it must be two whole numbers of at least 1")
        object.__setattr__(self, "size", (int(size[0]), int(size[1])))
        object.__setattr__(self, "intrinsics", checked_intrinsics("camera", self.intrinsics))
        super().__post_init__()

    def poses(self, robot: Robot, q: Configurations) -> Poses:
        """Poses of the camera at configurations of the arm.

        Args:
            robot: The robot that carries the camera.
            q: Configurations [n, dof] of its planned joints [rad] or [m].

        Returns:
            T_base_camera of each [n, 4, 4].

        Raises:
            InputError: If the robot lacks the link, and for q of the wrong shape.
        """
        return robot.fk(q, self.link) @ self.T_link_camera


# What a step asks for.
GO = "go"
LOOK = "look"
DONE = "done"
STUCK = "stuck"
# Policies for unknown space, see `ExplorerSettings.policy`.
STRICT = "strict"
PROBABILISTIC = "probabilistic"
STRICT_THEN_PROBABILISTIC = "strict_then_probabilistic"
POLICIES = (STRICT, PROBABILISTIC, STRICT_THEN_PROBABILISTIC)


@dataclass(frozen=True)
class ExplorerSettings(Settings, name="explorer"):
    policy: Annotated[str, OneOf(POLICIES)] = STRICT
    """strict: motions only through space seen free; probabilistic: motions whose stated confidence is high
    enough; strict_then_probabilistic: the probabilistic policy where the strict policy finds no step."""
    confidence: Share = 0.98
    """Minimum stated confidence of motions under the probabilistic policy."""
    time_limit: Positive = 1.0
    """Time limit of each search [s]."""
    max_views: Natural = 16
    """Maximum number of steps of the kind look on the way to a goal."""
    look_attempts: Count = 4
    """A step tries to plan motions to the best viewpoints: to at most this number times the number of
    cameras."""
    predict: bool = True
    """Whether the occupancy completion network weighs viewpoints and gives confidences, if it covers the
    arm's reach."""
    see_goal: bool = False
    """Whether the arm's whole surface at the goal must have been seen free before the arm goes there; for
    policy strict. This takes more views, and fails if an obstacle is nearer than about 1 cm to the arm at the
    goal."""
    max_age: Positive | None = None
    """Observations that are older than the latest view by more than this are forgotten [s]; None: never."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.see_goal and self.policy != STRICT:
            raise InputError(
                f"explorer.see_goal is true and explorer.policy {self.policy!r}; see_goal needs policy "
                f"{STRICT!r}: the others take unseen space as free where that is likely enough"
            )


@frozen_dataclass
class Step:
    """What the arm shall do next."""

    kind: Literal["go", "look", "done", "stuck"]
    """go: execute the motion, which ends at the goal; look: execute the motion, if there is one, then
    observe; done: the arm is at the goal; stuck: see `reason`."""
    reason: str
    policy: str = ""
    """The policy that the motion keeps, "strict" or "probabilistic"."""
    motion: PlanResult | Any = None
    """A solved result; None if the arm shall stay. A strict motion is certified against obstacles that cover
    all space not seen free; `motion.problem` holds these obstacles."""
    confidence: float | None = None
    """Stated probability that `motion` is free, under the probabilistic policy."""
    seen: Scene | None = None
    """The known scene and the points of the views that the Explorer still uses; None if nothing was
    planned."""
    wanted: Voxels | None = None
    """The voxels that the next view should show. No view saw them yet, and the arm would fill them at the
    goal or pass through them on a motion to the goal that was planned as if unseen space were free. None if
    the step asks for no view of particular voxels."""
