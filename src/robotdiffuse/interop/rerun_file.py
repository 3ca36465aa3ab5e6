"""Writes Rerun recordings (.rrd) of the scene, the arm and its joints."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.output_files import write_atomically
from robotdiffuse.core.transforms import quaternion_from_rotation
from robotdiffuse.core.types import Trajectory
from robotdiffuse.interop import missing_package
from robotdiffuse.interop.scene_primitives import (
    BoxPrimitive,
    CylinderPrimitive,
    MeshPrimitive,
    PointsPrimitive,
    Primitive,
    SpherePrimitive,
    arm,
    obstacles,
)
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.kinematics import link_poses

try:
    import rerun as rr
except ImportError:
    raise missing_package("rerun-sdk", "rerun") from None

TIMELINE = "time"
FPS = 60.0
"""Most poses of each link per second."""


def write(problem: Problem, trajectory: Trajectory, file: Path) -> None:
    """Write the entities scene/NAME, robot/LINK with its meshes, and joints/NAME/positions and velocities
    over time, in the world's frame if the problem has one; see `interop.write_motion`."""
    robot, recording = problem.robot, rr.RecordingStream("robotdiffuse", recording_id=file.stem)
    # in memory: what Rerun cannot write to a disk ends a thread of its own, with messages of several lines
    content = recording.memory_recording()
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if problem.T_world_base is not None:
        T, turn = problem.T_world_base, _quaternion(problem.T_world_base)
        for part in ("scene", "robot"):
            recording.log(part, rr.Transform3D(translation=T[:3, 3], quaternion=turn), static=True)
    for name, _, drawn in obstacles(problem):
        recording.log(_entity(name), *_archetypes(drawn), static=True)
    for name, link, drawn in arm(robot):
        recording.log(f"robot/{link}/{name.partition('/')[2]}", *_archetypes(drawn), static=True)
    _motion(recording, problem, trajectory)
    write_atomically(file, content.drain_as_bytes())


def _motion(recording: rr.RecordingStream, problem: Problem, trajectory: Trajectory) -> None:
    robot, times = problem.robot, trajectory.times
    frames = max(int(np.ceil(times[-1] * FPS)), 1) + 1
    shown = np.unique(np.searchsorted(times, np.linspace(0, times[-1], frames)).clip(0, len(times) - 1))
    at = rr.TimeColumn(TIMELINE, duration=times[shown])
    for link in robot.link_names:
        _send_poses(recording, f"robot/{link}", at, link_poses(robot, trajectory.positions[shown], link))
    for moving in problem.moving:
        _send_poses(recording, _entity(moving.name), at, [moving.pose(t) for t in times[shown].tolist()])
    every = rr.TimeColumn(TIMELINE, duration=times)
    for j, name in enumerate(trajectory.joint_names):
        for what in ("positions", "velocities"):
            columns = rr.Scalars.columns(scalars=getattr(trajectory, what)[:, j])
            recording.send_columns(f"joints/{name}/{what}", [every], columns)


def _send_poses(
    recording: rr.RecordingStream, entity: str, at: rr.TimeColumn, poses: Iterable[Float[ndarray, "4 4"]]
) -> None:
    places, turns = zip(*((T[:3, 3], _quaternion(T)) for T in poses), strict=True)
    recording.send_columns(entity, [at], rr.Transform3D.columns(translation=places, quaternion=turns))


def _entity(obstacle: str) -> str:
    return f"scene/{rr.escape_entity_path_part(obstacle)}"


def _quaternion(T: Float[ndarray, "4 4"]) -> rr.Quaternion:
    return rr.Quaternion(xyzw=quaternion_from_rotation(T[:3, :3])[[1, 2, 3, 0]])


def _archetypes(drawn: Primitive) -> tuple[rr.AsComponents, ...]:
    if isinstance(drawn, PointsPrimitive):
        return (rr.Points3D(drawn.points, radii=drawn.radius, colors=[drawn.color]),)
    x, y, z = drawn.T[:3, 3].tolist()
    placed = {"centers": [[x, y, z]], "quaternions": [_quaternion(drawn.T)], "colors": [drawn.color]}
    solid = rr.components.FillMode.Solid
    match drawn:
        case BoxPrimitive(_, size, _):
            return (rr.Boxes3D(half_sizes=[size / 2], fill_mode=solid, **placed),)
        case SpherePrimitive(_, radius, _):
            return (rr.Ellipsoids3D(half_sizes=[[radius] * 3], fill_mode=solid, **placed),)
        case CylinderPrimitive(_, radius, height, _):
            return (rr.Cylinders3D(radii=[radius], lengths=[height], fill_mode=solid, **placed),)
        case MeshPrimitive(T, vertices, faces, color):
            points = vertices @ T[:3, :3].T + T[:3, 3]
            return (rr.Mesh3D(vertex_positions=points, triangle_indices=faces, albedo_factor=color),)
    raise TypeError(f"no archetype for {type(drawn).__name__}")
