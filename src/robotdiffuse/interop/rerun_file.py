"""Writes Rerun recordings (.rrd) of the scene, the arm and its joints."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from robotdiffuse.core.errors import needs
from robotdiffuse.core.files import write_atomically
from robotdiffuse.core.transforms import xyzw_of
from robotdiffuse.core.types import Pose, Trajectory
from robotdiffuse.drawables import Drawable, Surface, drawables, link_surfaces, own_frame
from robotdiffuse.problems.problem import Problem
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, PointCloud, Sphere

with needs("rerun-sdk", "rerun"):
    import rerun as rr

TIMELINE = "time"
FPS = 60.0
"""Largest number of poses per second that are logged for each link."""


def write(problem: Problem, trajectory: Trajectory, file: Path) -> None:
    """Write the entities scene/NAME, robot/LINK with its mesh, joints/NAME/positions and
    joints/NAME/velocities; see `interop.write_motion`. Scene and robot are in the world's frame if the
    problem has a `T_world_base`, else in the base's frame."""
    robot = problem.robot
    recording = rr.RecordingStream("robotdiffuse", recording_id=file.stem)
    # Recorded in memory, since Rerun's thread prints a long message if it cannot write a file.
    content = recording.memory_recording()
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if problem.T_world_base is not None:
        T = problem.T_world_base
        placed = rr.Transform3D(translation=T[:3, 3], quaternion=_quaternion(T))
        for part in ("scene", "robot"):
            recording.log(part, placed, static=True)
    for obstacle in drawables(problem.scene, problem.moving):
        recording.log(_entity(obstacle.name), _archetype(obstacle.fixed), static=True)
    for link, surface in link_surfaces(robot).items():
        recording.log(f"robot/{link}/surface", _mesh(surface), static=True)
    _log_motion(recording, problem, trajectory)
    write_atomically(file, content.drain_as_bytes())


def _log_motion(recording: rr.RecordingStream, problem: Problem, trajectory: Trajectory) -> None:
    robot = problem.robot
    times = trajectory.times
    count = max(int(np.ceil(times[-1] * FPS)), 1) + 1
    drawn_rows = np.unique(np.searchsorted(times, np.linspace(0, times[-1], count)).clip(0, len(times) - 1))
    drawn_times = rr.TimeColumn(TIMELINE, duration=times[drawn_rows])
    for link in robot.link_names:
        _send_poses(recording, f"robot/{link}", drawn_times, robot.fk(trajectory.positions[drawn_rows], link))
    for moving in problem.moving:
        _send_poses(
            recording, _entity(moving.name), drawn_times, [moving.pose(t) for t in times[drawn_rows].tolist()]
        )
    row_times = rr.TimeColumn(TIMELINE, duration=times)
    for j, name in enumerate(trajectory.joint_names):
        for quantity in ("positions", "velocities"):
            columns = rr.Scalars.columns(scalars=getattr(trajectory, quantity)[:, j])
            recording.send_columns(f"joints/{name}/{quantity}", [row_times], columns)


def _send_poses(recording: rr.RecordingStream, entity: str, at: rr.TimeColumn, poses: Iterable[Pose]) -> None:
    places, turns = zip(*((T[:3, 3], _quaternion(T)) for T in poses), strict=True)
    recording.send_columns(entity, [at], rr.Transform3D.columns(translation=places, quaternion=turns))


def _entity(obstacle: str) -> str:
    return f"scene/{rr.escape_entity_path_part(obstacle)}"


def _quaternion(T: Pose) -> rr.Quaternion:
    return rr.Quaternion(xyzw=xyzw_of(T))


def _archetype(obstacle: Drawable) -> rr.AsComponents:
    shape = obstacle.shape
    T = own_frame(shape)
    solid = rr.components.FillMode.Solid
    placed = {"quaternions": [_quaternion(T)], "colors": [obstacle.color], "fill_mode": solid}
    match shape:
        case PointCloud():
            return rr.Points3D(shape.points, radii=shape.point_radius, colors=[obstacle.color])
        case Box():
            return rr.Boxes3D(half_sizes=[shape.size / 2], centers=[T[:3, 3]], **placed)
        case Sphere():
            return rr.Ellipsoids3D(half_sizes=[[shape.radius] * 3], centers=[T[:3, 3]], **placed)
        case Cylinder():
            return rr.Cylinders3D(radii=[shape.radius], lengths=[shape.height], centers=[T[:3, 3]], **placed)
        case Capsule():
            # the origin of a capsule of Rerun is at one end
            begin = (T @ [0.0, 0.0, -0.5 * shape.height, 1.0])[:3]
            return rr.Capsules3D(radii=[shape.radius], lengths=[shape.height], translations=[begin], **placed)
        case _:
            return _mesh(obstacle.surface)


def _mesh(surface: Surface) -> rr.Mesh3D:
    return rr.Mesh3D(
        vertex_positions=surface.vertices,
        triangle_indices=surface.faces,
        vertex_colors=np.round(255 * surface.colors).astype(np.uint8),
    )
