"""An arm that explores a simulated scene: cameras by ray casting, motions executed as planned."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_scene_for
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.results import PlanResult
from robotdiffuse.perception.depth_view import DepthNoise, DepthView
from robotdiffuse.perception.ray_caster import looking_at, ray_cast
from robotdiffuse.perception.seen_points import near_scene
from robotdiffuse.planning.exploration.cameras import ArmCamera
from robotdiffuse.planning.exploration.explorer import Explorer
from robotdiffuse.planning.exploration.recorded import RecordedExplorer
from robotdiffuse.planning.exploration.steps import ExplorerSettings, Step
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.validation.validator import verify, verify_trajectory

WRIST_OFFSET = (0.04, 0.0, 0.03)
"""Position of the simulated camera in the frame of the arm's tip [m]."""
SIZE, FIELD_OF_VIEW = (320, 240), (1.22, 0.96)
"""Width and height of its images [pixels], and horizontal and vertical field of view [rad]."""
LENS_RADIUS = 0.005
"""A camera nearer to an obstacle than this sees nothing [m]."""
MIN_DEPTH = 0.15
"""Nearer surfaces give no return [m]."""
BESIDE_POSITION, BESIDE_TARGET = (-0.5, 1.1, 1.2), (0.6, 0.0, 0.5)
"""Of the camera beside the arm [m]."""
BESIDE_SIZE, BESIDE_FOCAL_LENGTH = (640, 480), 460.0
"""Width, height and focal length of its images [pixels]."""
FLOOR = "floor"
"""Shapes of this name are known without being seen."""
FREE_ZONE = ((-0.36, -0.36, 0.0), (0.36, 0.36, 0.7))
"""The space around the base that is declared free [m]."""
UNSUPPORTED = (
    "waypoints", "constraints", "moving", "payload", "start_velocity", "views", "unknown", "clearance"
)  # fmt: skip
"""Fields of problems that an Explorer does not take into account."""
IMAGE_PERIOD, MAX_IMAGES = 0.25, 8
"""Time between images during a motion [s], and the most images of a motion, that at its end included."""


@dataclass(frozen=True, eq=False)
class Event:
    """A step of the loop."""

    step: Step
    configuration: Float[ndarray, "dof"]
    """Of the arm after the step."""
    violation: str = ""
    """Why the validator refuses the motion in the true scene; "" if it accepts it, and without a motion."""

    @property
    def free(self) -> bool:
        return not self.violation


def wrist_camera(robot: Robot) -> ArmCamera:
    """A camera beside the arm's tip that looks along the tip's z axis."""
    T_tip_camera = looking_at(np.array(WRIST_OFFSET), np.add(WRIST_OFFSET, (0.0, 0.0, 1.0)))
    focal = [n / 2 / np.tan(angle / 2) for n, angle in zip(SIZE, FIELD_OF_VIEW, strict=True)]
    return ArmCamera(robot.tip, T_tip_camera, (*focal, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2), SIZE)


def camera_beside(problem: Problem, noise: DepthNoise | None, seed: int) -> DepthView:
    """The image of a camera that stands beside the arm, behind its shoulder, with the arm at the start."""
    T = looking_at(np.array(BESIDE_POSITION), np.array(BESIDE_TARGET))
    width, height = BESIDE_SIZE
    intrinsics = (BESIDE_FOCAL_LENGTH, BESIDE_FOCAL_LENGTH, (width - 1) / 2, (height - 1) / 2)
    view = ray_cast(problem.scene, T, intrinsics, BESIDE_SIZE, problem.robot, problem.start)
    return measured(view, np.inf, noise, np.random.default_rng(seed))


def simulated_explorer(
    problem: Problem, settings: ExplorerSettings, noise: DepthNoise | None, seed: int
) -> RecordedExplorer:
    """An explorer with a camera at the arm's tip that knows the floor, and one image of a camera beside the
    arm.

    Raises InputError for a problem with fields that exploring would ignore.
    """
    ignored = [name for name in UNSUPPORTED if getattr(problem, name) not in (None, ())]
    if ignored:
        names = ", ".join(ignored)
        raise InputError(f"the problem has {names}, which explore does not support: remove {names}")
    known = Scene([shape for shape in problem.scene.shapes if shape.name == FLOOR])
    cameras = [wrist_camera(problem.robot)]
    explorer = RecordedExplorer(problem.robot, cameras, known, FREE_ZONE, settings, seed)
    explorer.observe(camera_beside(problem, noise, seed))
    return explorer


def taken(
    problem: Problem,
    camera: ArmCamera,
    q: Float[ndarray, "dof"],
    noise: DepthNoise | None,
    rng: np.random.Generator,
) -> DepthView:
    """The image of the problem's true scene that a camera on the arm takes."""
    T = camera.poses(problem.robot, q[None])[0]
    view = ray_cast(problem.scene, T, camera.intrinsics, camera.size, problem.robot, q)
    obstacles = compile_scene_for(problem.robot, problem.scene)
    if near_scene(obstacles, T[None, :3, 3].astype(np.float32), np.float32(LENS_RADIUS))[0]:
        # the ray caster leaves out shapes around a camera, which would be seen as free
        view = replace(view, depth=np.zeros_like(view.depth))
    return measured(view, camera.range, noise, rng)


def measured(view: DepthView, reach: float, noise: DepthNoise | None, rng: np.random.Generator) -> DepthView:
    """An image as a sensor of a range gives it: without a return where it is too near, infinite beyond."""
    depth = np.where(view.depth > reach, np.inf, np.where(view.depth < MIN_DEPTH, 0.0, view.depth))
    view = DepthView(depth, view.intrinsics, view.T_base_camera, view.configuration)
    return view if noise is None else noise.applied(view, rng)


def explore(
    problem: Problem,
    explorer: Explorer,
    noise: DepthNoise | None = None,
    seed: int = 0,
    beside: DepthView | None = None,
) -> Iterator[Event]:
    """The loop from the problem's start to its goal, in the problem's scene; ends with a step without a
    motion, and after a collision.

    The cameras on the arm take images during each motion. beside: an image of a camera that stands; it takes
    another one after each motion, of what the arm hid before.
    """
    rng, q = np.random.default_rng(seed), problem.start
    explorer.set_goal(problem.goal)
    for camera in explorer.cameras:
        explorer.observe(taken(problem, camera, q, noise, rng))
    while True:
        step = explorer.next(q)
        if step.motion is None or step.motion.path is None:
            yield Event(step, q)
            return
        path, trajectory = step.motion.path, step.motion.trajectory
        asked = step.motion.problem
        true = Problem(problem.robot, problem.scene, asked.start, asked.goal)
        found = verify(true, path).violation
        if found is None and trajectory is not None:
            found = verify_trajectory(true, trajectory).violation
        for camera in explorer.cameras:
            for at in _during(step.motion):
                explorer.observe(taken(problem, camera, at, noise, rng))
        q = path.positions[-1]
        if beside is not None:
            explorer.observe(_again(problem, beside, q, noise, rng))
        yield Event(step, q, "" if found is None else found.message)
        if found is not None:
            return


def _during(motion: PlanResult) -> Float[ndarray, "n dof"]:
    """The configurations of a motion in which images are taken, its end the last."""
    assert motion.path is not None
    end = motion.path.positions[-1:]
    if motion.trajectory is None:
        return end
    duration = motion.trajectory.duration
    count = int(np.clip(duration / IMAGE_PERIOD, 1, MAX_IMAGES))
    times = duration * np.arange(1, count) / count
    return np.concatenate([motion.trajectory.at(times).positions, end]) if count > 1 else end


def _again(
    problem: Problem,
    beside: DepthView,
    q: Float[ndarray, "dof"],
    noise: DepthNoise | None,
    rng: np.random.Generator,
) -> DepthView:
    """Another image of a camera that stands."""
    height, width = beside.depth.shape
    T, size = beside.T_base_camera, (width, height)
    view = ray_cast(problem.scene, T, beside.intrinsics, size, problem.robot, q)
    return measured(view, np.inf, noise, rng)
