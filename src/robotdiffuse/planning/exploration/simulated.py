"""Simulated exploration: images are ray cast, and motions are executed exactly as planned.

A RecordedExplorer keeps all views, occupancy maps and steps, for pictures, replays and recordings.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from robotdiffuse.core.errors import InputError, vector
from robotdiffuse.core.types import (
    Configuration,
    Configurations,
    PlanResult,
    Pose,
    Trajectory,
    frozen_dataclass,
)
from robotdiffuse.perception.depth_view import DepthNoise, DepthView
from robotdiffuse.perception.ray_caster import MAX_RANGE, looking_at, ray_cast
from robotdiffuse.perception.seen_points import near_scene
from robotdiffuse.perception.voxel_grid import Probabilities, Voxels
from robotdiffuse.planning.exploration.explorer import Explorer
from robotdiffuse.planning.exploration.steps import LOOK, ArmCamera, ExplorerSettings, Step
from robotdiffuse.problems.problem import Problem, is_given
from robotdiffuse.robots.robot import Robot
from robotdiffuse.validation.validator import verify


@frozen_dataclass
class RecordedView:
    """A view, and the occupancy map after it."""

    time: float
    """Time since the first step, without pauses between motions [s]."""
    step_index: int
    """Index of the step that was being executed; -1 before the first step."""
    view: DepthView
    camera: int | None
    """Index of the arm's camera that took the view; None for a camera that is not on the arm."""
    occupied: Voxels
    free: Voxels

    @property
    def unknown(self) -> Voxels:
        return ~(self.occupied | self.free)


@frozen_dataclass
class RecordedStep:
    """A step, and the state of the arm when it began."""

    begins: float
    """When the step begins: time since the first step [s]."""
    step: Step
    configuration: Configuration
    """Configuration of the arm before the step."""
    predicted: Probabilities | None
    """The probability that each voxel is occupied, when the step was chosen; None without the network."""
    T_base_camera: Pose | None
    """Pose of the arm's first camera at the end of a step of kind `look`; None for other steps."""

    @property
    def trajectory(self) -> Trajectory | None:
        return None if self.step.motion is None else self.step.motion.trajectory

    @property
    def waypoints(self) -> Configurations:
        """Waypoints of the motion; without a motion, the configuration."""
        return _waypoints(self.step, self.configuration)

    @property
    def duration(self) -> float:
        """Duration of the motion [s]; 0 without a motion."""
        return 0.0 if self.trajectory is None else self.trajectory.duration


class RecordedExplorer(Explorer):
    """An Explorer that records all views and steps, on the assumption that each step is executed immediately
    and completely.

    The recorded time of a view is the time at which the last step's motion is closest to the view's
    configuration.
    """

    def __init__(self, *values: Any, **named: Any) -> None:
        """See `Explorer`."""
        super().__init__(*values, **named)
        self.views = list[RecordedView]()
        self.steps = list[RecordedStep]()

    @property
    def duration(self) -> float:
        """Duration of all motions so far [s]."""
        return self.steps[-1].begins + self.steps[-1].duration if self.steps else 0.0

    def observe(self, view: DepthView, stamp: float = 0.0) -> None:
        """See `Explorer.observe`."""
        super().observe(view, stamp)
        number = len(self.steps) - 1
        voxels = self.map.occupied, self.map.free
        self.views.append(RecordedView(self._time_of(view), number, view, self._camera_of(view), *voxels))

    def next(self, configuration: ArrayLike) -> Step:
        """See `Explorer.next`."""
        q = vector("explorer", "configuration", configuration, self.robot.dof)
        begins = self.duration
        step = super().next(q)
        T = None
        if step.kind == LOOK and self.cameras:
            T = self.cameras[0].poses(self.robot, _waypoints(step, q)[-1:])[0]
        self.steps.append(RecordedStep(begins, step, q, self.predicted(), T))
        return step

    def _time_of(self, view: DepthView) -> float:
        trajectory = self.steps[-1].trajectory if self.steps else None
        if trajectory is None or view.configuration is None:
            return self.duration
        distances = np.abs(trajectory.positions - view.configuration).max(axis=1)
        nearest = int(len(distances) - 1 - np.argmin(distances[::-1]))
        return self.steps[-1].begins + float(trajectory.times[nearest])


def _waypoints(step: Step, q: Configuration) -> Configurations:
    motion = step.motion
    return q[None] if motion is None else motion.path.positions


WRIST_OFFSET = (0.04, 0.0, 0.03)
"""Position of the simulated camera in the frame of the arm's tip [m]."""
# Width and height of this camera's images [pixels], and its horizontal and vertical field of view [rad].
SIZE = (320, 240)
FIELD_OF_VIEW = (1.22, 0.96)
LENS_RADIUS = 0.005
"""A camera closer to an obstacle than this gets an image without returns [m]."""
MIN_DEPTH = 0.15
"""Nearer surfaces give no return [m]."""
# Position and target of the camera beside the arm [m].
BESIDE_POSITION = (-0.5, 1.1, 1.2)
BESIDE_TARGET = (0.6, 0.0, 0.5)
# Width, height and focal length of its images [pixels].
BESIDE_SIZE = (640, 480)
BESIDE_FOCAL_LENGTH = 460.0
FLOOR = "floor"
"""Name of the shapes that the explorer knows from the start."""
FREE_ZONE = ((-0.36, -0.36, 0.0), (0.36, 0.36, 0.7))
"""The space around the base that is declared free [m]."""
UNSUPPORTED = (
    "waypoints", "constraints", "moving", "payload", "start_velocity", "views", "unknown", "clearance"
)  # fmt: skip
"""Fields of problems that an Explorer does not take into account."""
# Smallest time between images during a motion [s], and largest number of images per motion, including the one
# at its end.
IMAGE_PERIOD = 0.25
MAX_IMAGES = 8


@frozen_dataclass
class Event:
    """A step of `explore`, after its execution."""

    step: Step
    configuration: Configuration
    """Configuration of the arm after the step."""
    violation: str = ""
    """Why the validator refuses the motion in the true scene; "" if it accepts it or there is no motion."""

    @property
    def free(self) -> bool:
        return not self.violation


def wrist_camera(robot: Robot) -> ArmCamera:
    """A camera beside the arm's tip that looks along the tip's z axis."""
    T_tip_camera = looking_at(np.array(WRIST_OFFSET), np.add(WRIST_OFFSET, (0.0, 0.0, 1.0)))
    focal = [n / 2 / np.tan(angle / 2) for n, angle in zip(SIZE, FIELD_OF_VIEW, strict=True)]
    return ArmCamera(robot.tip, T_tip_camera, (*focal, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2), SIZE)


def seen_from_beside(problem: Problem) -> DepthView:
    """What a fixed camera beside the arm and behind its shoulder sees, with the arm at the start."""
    T = looking_at(np.array(BESIDE_POSITION), np.array(BESIDE_TARGET))
    width, height = BESIDE_SIZE
    intrinsics = (BESIDE_FOCAL_LENGTH, BESIDE_FOCAL_LENGTH, (width - 1) / 2, (height - 1) / 2)
    return ray_cast(problem.scene, T, intrinsics, BESIDE_SIZE, problem.robot, problem.start)


def camera_beside(problem: Problem, noise: DepthNoise | None, seed: int) -> DepthView:
    """The image of `seen_from_beside`, as a real depth camera would measure it."""
    return measured(seen_from_beside(problem), np.inf, noise, np.random.default_rng(seed))


def simulated_explorer(
    problem: Problem, settings: ExplorerSettings, noise: DepthNoise | None, seed: int
) -> RecordedExplorer:
    """An explorer with a camera at the arm's tip. It knows the floor, and has observed an image of the camera
    beside the arm.

    Raises InputError for a problem with fields that exploring would ignore.
    """
    ignored = [name for name in UNSUPPORTED if is_given(getattr(problem, name))]
    if ignored:
        names = ", ".join(ignored)
        raise InputError(f"the problem has {names}, which explore does not support: remove {names}")
    known_scene = problem.scene.with_shapes(shape for shape in problem.scene.shapes if shape.name == FLOOR)
    cameras = [wrist_camera(problem.robot)]
    explorer = RecordedExplorer(problem.robot, cameras, known_scene, FREE_ZONE, settings, seed)
    explorer.observe(camera_beside(problem, noise, seed))
    return explorer


def taken(
    problem: Problem,
    camera: ArmCamera,
    q: Configuration,
    noise: DepthNoise | None,
    rng: np.random.Generator,
) -> DepthView:
    """The image of the problem's true scene that a camera on the arm takes with the arm at configuration
    `q`."""
    T = camera.poses(problem.robot, q[None])[0]
    view = ray_cast(problem.scene, T, camera.intrinsics, camera.size, problem.robot, q)
    if near_scene(problem.robot, problem.scene, T[None, :3, 3], LENS_RADIUS)[0]:
        # the ray caster ignores shapes that enclose the camera, so their inside would appear free
        view = replace(view, depth=np.zeros_like(view.depth))
    return measured(view, camera.range, noise, rng)


def measured(view: DepthView, reach: float, noise: DepthNoise | None, rng: np.random.Generator) -> DepthView:
    """The image as a sensor measures it: depths below MIN_DEPTH are 0, those beyond `reach` [m] infinite;
    noise is added if it is given."""
    depth = np.where(view.depth > reach, np.inf, np.where(view.depth < MIN_DEPTH, 0.0, view.depth))
    view = replace(view, depth=depth, range=reach if np.isfinite(reach) else MAX_RANGE)
    return view if noise is None else noise.applied(view, rng)


def explore(
    problem: Problem,
    explorer: Explorer,
    noise: DepthNoise | None = None,
    seed: int = 0,
) -> Iterator[Event]:
    """Explore the problem's scene from its start to its goal, and yield each step. Ends with a step without a
    motion, or after a motion that the validator refuses in the true scene.

    The cameras on the arm take images during each motion. Images of other cameras may be observed after each
    step.
    """
    rng = np.random.default_rng(seed)
    q = problem.start
    explorer.set_goal(problem.goal)
    for camera in explorer.cameras:
        explorer.observe(taken(problem, camera, q, noise, rng))
    while True:
        step = explorer.next(q)
        if step.motion is None:
            yield Event(step, q)
            return
        path = step.motion.path
        planned_problem = step.motion.problem
        true_problem = Problem(problem.robot, problem.scene, planned_problem.start, planned_problem.goal)
        violation = verify(true_problem, path).violation
        if violation is None:
            violation = verify(true_problem, step.motion.trajectory).violation
        for camera in explorer.cameras:
            for at in _image_configurations(step.motion):
                explorer.observe(taken(problem, camera, at, noise, rng))
        q = path.positions[-1]
        yield Event(step, q, "" if violation is None else violation.message)
        if violation is not None:
            return


def _image_configurations(motion: PlanResult) -> Configurations:
    """The configurations of a motion at which images are taken; the last one is its end."""
    end = motion.path.positions[-1:]
    duration = motion.trajectory.duration
    count = int(np.clip(duration / IMAGE_PERIOD, 1, MAX_IMAGES))
    times = duration * np.arange(1, count) / count
    return np.concatenate([motion.trajectory.at(times).positions, end]) if count > 1 else end
