"""An Explorer that keeps what it saw, knew and did, for pictures, replays and recordings of it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.bounds import vector
from robotdiffuse.core.types import Trajectory
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.occupancy_map import Corners
from robotdiffuse.planning.exploration.cameras import ArmCamera
from robotdiffuse.planning.exploration.explorer import DEFAULTS, NOTHING, Explorer
from robotdiffuse.planning.exploration.steps import LOOK, ExplorerSettings, Step
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

SAME_POSE = 1e-9
"""Largest difference of an entry of two poses that are the same."""


@dataclass(frozen=True, eq=False)
class RecordedView:
    """A view, and what was known of each voxel after it."""

    time: float
    """Since the first step, without pauses [s]."""
    act: int
    """The number of the step under way; -1 before the first."""
    view: DepthView
    camera: int | None
    """The number of the camera on the arm; None: another one."""
    occupied: Bool[ndarray, "nx ny nz"]
    free: Bool[ndarray, "nx ny nz"]

    @property
    def unknown(self) -> Bool[ndarray, "nx ny nz"]:
        return ~(self.occupied | self.free)


@dataclass(frozen=True, eq=False)
class RecordedAct:
    """A step, and where the arm was."""

    begins: float
    """[s]"""
    step: Step
    configuration: Float[ndarray, "dof"]
    """Of the arm before the step."""
    predicted: Float32[ndarray, "nx ny nz"] | None
    """The probability that each voxel is occupied, when the step was chosen; None without the network."""
    T_base_camera: Float[ndarray, "4 4"] | None
    """Where the arm's first camera is at the end of a look; None for other steps."""

    @property
    def trajectory(self) -> Trajectory | None:
        return None if self.step.motion is None else self.step.motion.trajectory

    @property
    def waypoints(self) -> Float[ndarray, "n dof"]:
        """Of the motion; without one, the configuration."""
        return _waypoints(self.step, self.configuration)

    @property
    def duration(self) -> float:
        """[s]; 0 for a step without a motion."""
        return 0.0 if self.trajectory is None else self.trajectory.duration


class RecordedExplorer(Explorer):
    """An Explorer that keeps all views, and all steps, which are taken as executed at once and to the end.

    A view counts as taken where the motion comes nearest to its configuration.
    """

    def __init__(
        self,
        robot: Robot,
        cameras: Sequence[ArmCamera] = (),
        scene: Scene = NOTHING,
        free_zone: Corners | None = None,
        settings: ExplorerSettings = DEFAULTS,
        seed: int = 0,
    ) -> None:
        """See `Explorer`."""
        super().__init__(robot, cameras, scene, free_zone, settings, seed)
        self.views: list[RecordedView] = []
        self.acts: list[RecordedAct] = []

    @property
    def duration(self) -> float:
        """Of all motions so far [s]."""
        return self.acts[-1].begins + self.acts[-1].duration if self.acts else 0.0

    def observe(self, view: DepthView, stamp: float = 0.0) -> None:
        """See `Explorer.observe`."""
        super().observe(view, stamp)
        number = len(self.acts) - 1
        known = self.map.occupied, self.map.free
        self.views.append(RecordedView(self._time_of(view), number, view, self._camera_of(view), *known))

    def next(self, configuration: ArrayLike) -> Step:
        """See `Explorer.next`."""
        q = vector("explorer", "configuration", configuration, self.robot.dof)
        begins, step = self.duration, super().next(q)
        T = None
        if step.kind == LOOK and self.cameras:
            T = self.cameras[0].poses(self.robot, _waypoints(step, q)[-1:])[0]
        self.acts.append(RecordedAct(begins, step, q, self.predicted(), T))
        return step

    def _time_of(self, view: DepthView) -> float:
        trajectory = self.acts[-1].trajectory if self.acts else None
        if trajectory is None or view.configuration is None:
            return self.duration
        distances = np.abs(trajectory.positions - view.configuration).max(axis=1)
        nearest = int(len(distances) - 1 - np.argmin(distances[::-1]))
        return self.acts[-1].begins + float(trajectory.times[nearest])

    def _camera_of(self, view: DepthView) -> int | None:
        if view.configuration is not None:
            for number, camera in enumerate(self.cameras):
                T = camera.poses(self.robot, view.configuration[None])[0]
                if np.abs(T - view.T_base_camera).max() < SAME_POSE:
                    return number
        return None


def _waypoints(step: Step, q: Float[ndarray, "dof"]) -> Float[ndarray, "n dof"]:
    motion = step.motion
    return q[None] if motion is None or motion.path is None else motion.path.positions
