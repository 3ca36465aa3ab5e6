"""Draws a problem without a motion: the arm at the start and at the goal, and links that collide there."""

from dataclasses import replace
from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import shortened
from robotdiffuse.core.output_files import check_output, write_atomically
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.transforms import IDENTITY
from robotdiffuse.core.types import Path
from robotdiffuse.drawables import START, Color, Surface, drawables, link_surfaces, painted
from robotdiffuse.planning.pose_goals import pose_configurations
from robotdiffuse.problems.goals import AnyGoal, JointGoal, poses_of
from robotdiffuse.problems.problem import Problem, StateValidity
from robotdiffuse.scenes.shapes import Sphere
from robotdiffuse.visualization.arm import DrawnArm
from robotdiffuse.visualization.camera import view_of_motion
from robotdiffuse.visualization.picture import (
    MARGINS,
    ClearSurface,
    PictureSettings,
    linear,
    render,
    tube,
    write_captioned,
)
from robotdiffuse.visualization.replay_page import page_data, page_shapes, page_surface, page_text

COLLIDING = (0xD0, 0x1F, 0x2B)
"""sRGB color of links that collide."""
OFFSET = 0.0015
"""Offset of these along their normals, so that they cover the arm in its own colors [m]."""
START_ALPHA = 0.5
AXES = ((0xC9, 0x3C, 0x3C), (0x3C, 0x9A, 0x4B), (0x3C, 0x64, 0xC9))
"""sRGB colors of the axes of goal poses."""
AXIS_LENGTH = 0.12
"""[m]"""
UNREACHED = StateValidity("no configuration within the joint limits")


def write_problem(problem: Problem, file: str | FilePath, result: PlanResult | None = None) -> None:
    """Write a problem without a motion as .html or .png.

    The arm is drawn at the start and at the goal; in pictures the start is see-through, on pages the goal.
    Links that collide are red, and goal poses have axes. Of several goals, the first free one is drawn, or
    else the first. Moving obstacles are where they begin. `result` holds the reason for the missing
    motion. Raises InputError for another ending or a file that cannot be written.
    """
    target = check_output(file, (".html", ".htm", ".png"))
    goal, validity = _goal_state(problem)
    validities = {"start": problem.is_free(problem.start), "goal": validity}
    states = np.stack([problem.start] if goal is None else [problem.start, goal])
    scene = problem.scene.with_shapes([*problem.scene.shapes, *(moving.shape for moving in problem.moving)])
    robot, scene = replace(problem, scene=scene, moving=()).standing()
    T_world_poses = _goal_poses(problem)
    near_poses = [Sphere(T[:3, 3], AXIS_LENGTH) for T in T_world_poses]
    framed = scene.with_shapes([*scene.shapes, *near_poses])  # what the camera shows
    arm = DrawnArm(robot)
    marks = [*_colliding_links(arm, states, list(validities.values())), *_axes(T_world_poses)]
    facts = [(label, state.reason or "free") for label, state in validities.items()]
    if result is not None and all(validities.values()):
        facts = [("reason", shortened(result.reason))]
    status = "" if result is None else f" · {result.status.value.replace('_', ' ')}"
    title = f"{robot.name}{status}"
    if target.suffix.lower() == ".png":
        settings = PictureSettings()
        size = settings.width, settings.height
        camera = view_of_motion(arm, drawables(framed), states, size, MARGINS)
        start = ClearSurface(arm.posed(states[0], 1), linear(START), START_ALPHA)
        ghost = [start] if len(states) > 1 else []
        end = Path(robot.joint_names, states[-1:])
        surfaces = [surface for surface, _ in marks]
        pixels, _ = render(robot, scene, end, settings, camera, added=surfaces, clear=ghost)
        return write_captioned(pixels, target, title, facts)
    data = page_data(robot, framed, Path(robot.joint_names, states))
    data["scene"] = [*page_shapes(scene), *(page_surface("mark", *mark) for mark in marks)]
    data["times"] = [0.0] * len(states)  # nothing moves
    data["facts"] = facts
    return write_atomically(target, page_text(title, data))


def _goal_state(problem: Problem) -> tuple[Float[ndarray, "dof"] | None, StateValidity]:
    """The first free configuration of the goal, or else the first one; None if none reaches it."""
    goals = problem.goal.goals if isinstance(problem.goal, AnyGoal) else (problem.goal,)
    rng = np.random.default_rng(0)
    first = None
    for goal in goals:
        joints = isinstance(goal, JointGoal)
        for q in goal.positions if joints else pose_configurations(problem, goal, rng):
            validity = problem.is_free(q)
            if validity:
                return q, validity
            first = first or (q, validity)
    return first or (None, UNREACHED)


def _colliding_links(
    arm: DrawnArm, states: Float[ndarray, "n dof"], validities: list[StateValidity]
) -> list[tuple[Surface, Color]]:
    """The surfaces of the links that collide in each state, and their color."""
    robot = arm.robot
    links = link_surfaces(arm.robot)
    marks = []
    for q, validity in zip(states, validities, strict=False):  # there may be no goal state
        T_base_frame = arm.frames(q)
        for link in validity.links:
            T_base_link = T_base_frame[robot.link_frame(link)] @ robot.T_frame_link(link)
            marks.append((_raised(links[link]).moved(T_base_link), COLLIDING))
    return marks


def _raised(surface: Surface) -> Surface:
    """The surface in the color of collisions, a little larger."""
    _, corner = np.unique(surface.vertices, axis=0, return_inverse=True)  # edges have a vertex on each side
    corner = corner.reshape(-1)
    normals = np.stack([np.bincount(corner, column) for column in surface.normals.T], axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    vertices = surface.vertices + OFFSET * normals[corner]
    return replace(surface, vertices=vertices, colors=painted(COLLIDING, len(vertices)))


def _goal_poses(problem: Problem) -> list[Float[ndarray, "4 4"]]:
    """All goal poses in the world's frame."""
    goals = problem.goal.goals if isinstance(problem.goal, AnyGoal) else (problem.goal,)
    T_world_base = IDENTITY if problem.T_world_base is None else problem.T_world_base
    return [T_world_base @ pose.T_base_frame for goal in goals for pose in poses_of(goal)]


def _axes(poses: list[Float[ndarray, "4 4"]]) -> list[tuple[Surface, Color]]:
    """The axes of poses, and their colors."""
    axes = []
    for T in poses:
        for axis, color in enumerate(AXES):
            ends = np.stack([T[:3, 3], T[:3, 3] + AXIS_LENGTH * T[:3, axis]])
            axes.append((tube(ends, color, color), color))
    return axes
