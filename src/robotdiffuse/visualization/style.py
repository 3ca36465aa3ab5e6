"""Surfaces and colours shared by pictures, replays and the page."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.collision.exact_meshes import forward_frames
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.perception.depth_view import AssumedPoints, SeenPoints
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.visual_meshes import has_visual, load_visual
from robotdiffuse.scenes.mesh import Triangulated
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, PointCloud, Shape, Sphere

START, GOAL = (0x4F, 0x7F, 0xD9), (0x10, 0xA3, 0x7F)
"""sRGB colours of the start and goal of a motion; the trace fades from one to the other."""
OBSTACLES = ((0xD9, 0x7B, 0x5C), (0xE0, 0x9A, 0x5F), (0xC9, 0x6A, 0x6A), (0xD8, 0xAE, 0x63))
FURNITURE = (0xCD, 0xC0, 0xAC)
OBSERVED, ASSUMED = (0x4F, 0x7C, 0xAC), (0xB9, 0x8A, 0xD9)
"""Points that cameras observed, and points assumed to be occupied in unknown space."""
FURNITURE_SIZE = 0.7
"""Obstacles with a longer side than this count as furniture, with its own colour [m]."""
CREASE_ANGLE = np.radians(38)
"""Edges with a larger angle between their faces are drawn sharp [rad]."""
UNTIMED_SPEED = 0.8
"""Speed in joint space at which a path without times is shown [rad/s]."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles with a normal and an sRGB colour (0 to 1) at each vertex."""

    vertices: Float[ndarray, "v 3"]
    normals: Float[ndarray, "v 3"]
    colors: Float[ndarray, "v 3"]
    faces: Int[ndarray, "f 3"]

    def moved(self, T: Float[ndarray, "4 4"]) -> "Surface":
        """The surface after a rigid transform."""
        vertices = self.vertices @ T[:3, :3].T + T[:3, 3]
        return Surface(vertices, self.normals @ T[:3, :3].T, self.colors, self.faces)


def join(surfaces: Sequence[Surface]) -> Surface:
    """One surface from many; an empty one from none."""
    if not surfaces:
        return Surface(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    starts = np.cumsum([0] + [len(s.vertices) for s in surfaces[:-1]])
    return Surface(
        np.concatenate([s.vertices for s in surfaces]),
        np.concatenate([s.normals for s in surfaces]),
        np.concatenate([s.colors for s in surfaces]),
        np.concatenate([s.faces + start for s, start in zip(surfaces, starts, strict=True)]),
    )


def creased(
    vertices: Float[ndarray, "v 3"], faces: Int[ndarray, "f 3"], colors: Float[ndarray, "f 3"]
) -> Surface:
    """A surface that is shaded smoothly except across sharp edges (CREASE_ANGLE); vertices are split
    there."""
    edges = vertices[faces]
    area = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])
    unit = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-12)
    corner = np.argsort(faces.reshape(-1), kind="stable")
    owner = faces.reshape(-1)[corner]
    counts = np.bincount(owner, minlength=len(vertices))
    first = np.cumsum(counts) - counts
    # all pairs of corners that share a vertex: `mine` gathers from `other`
    repeats = counts[owner]
    mine = np.repeat(np.arange(len(owner)), repeats)
    within = np.arange(len(mine)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    other = first[owner[mine]] + within
    face = corner // 3
    alike = np.einsum("ij,ij->i", unit[face[mine]], unit[face[other]]) > np.cos(CREASE_ANGLE)
    summed = [np.bincount(mine[alike], area[face[other[alike]], i], minlength=len(owner)) for i in range(3)]
    normals = np.stack(summed, axis=1).astype(np.float64)  # integers if no face has an area
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    keys = np.column_stack([owner, np.round(normals * 100), np.round(colors[face] * 255)]).astype(np.int64)
    _, keep, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    split = np.empty(3 * len(faces), np.int64)
    split[corner] = index.reshape(-1)
    return Surface(vertices[owner[keep]], normals[keep], colors[face[keep]], split.reshape(-1, 3))


def robot_surfaces(robot: Robot) -> list[Surface]:
    """The surface of the links on each of the dof + 1 frames, in the coordinates of that frame."""
    by_frame: list[list[Surface]] = [[] for _ in range(robot.dof + 1)]
    for link, surface in link_surfaces(robot).items():
        by_frame[robot.link_frame(link)].append(surface)
    return [join(surfaces) for surfaces in by_frame]


def link_surfaces(robot: Robot) -> dict[str, Surface]:
    """The surface of each link, in the coordinates of its frame."""
    return {
        link: join([creased(mesh.vertices, mesh.faces, mesh.colors / 255.0) for mesh in meshes]).moved(
            robot.T_frame_link(link)
        )
        for link, meshes in load_visual(robot).items()
    }


def frames(robot: Robot, q: Float[ndarray, "*batch dof"]) -> Float[ndarray, "*batch frames 4 4"]:
    """T_base_frame of all frames in each configuration."""
    T = forward_frames(robot, q.reshape(-1, robot.dof))
    return T.reshape(*q.shape[:-1], *T.shape[1:])


def posed(surfaces: list[Surface], T_base_frame: Float[ndarray, "frames 4 4"]) -> Surface:
    """The whole arm in one pose."""
    return join([surface.moved(T) for surface, T in zip(surfaces, T_base_frame, strict=True)])


def tool_point(robot: Robot, surfaces: list[Surface]) -> tuple[int, Float[ndarray, "3"]]:
    """The frame of the tip, and the point in it whose trace is drawn [m].

    The point lies on the z axis of the tip link, as far out as the surfaces on its frame reach: between the
    fingertips of a gripper.
    """
    frame, T_frame_tip = robot.link_frame(robot.tip), robot.T_frame_link(robot.tip)
    along = (surfaces[frame].vertices - T_frame_tip[:3, 3]) @ T_frame_tip[:3, 2]
    return frame, T_frame_tip[:3, 3] + max(0.0, along.max(initial=0.0)) * T_frame_tip[:3, 2]


def trace(robot: Robot, tool: tuple[int, ndarray], q: Float[ndarray, "n dof"]) -> Float[ndarray, "n 3"]:
    """Positions of the tool point [m]."""
    frame, point = tool
    return frames(robot, q)[:, frame, :3] @ np.append(point, 1.0)


def dense(q: Float[ndarray, "n dof"], count: int) -> Float[ndarray, "m dof"]:
    """`count` configurations equally spaced along a polyline in joint space; one if it does not move."""
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1))])
    if s[-1] == 0:
        return q[:1]
    at = np.linspace(0, s[-1], count)
    return np.stack([np.interp(at, s, q[:, j]) for j in range(q.shape[1])], axis=1)


def timed(motion: Path | Trajectory) -> tuple[Float[ndarray, "n"], Float[ndarray, "n dof"]]:
    """Times [s] and positions of a motion; a path without times gets a constant speed in joint space."""
    if isinstance(motion, Trajectory):
        return motion.times, motion.positions
    steps = np.linalg.norm(np.diff(motion.positions, axis=0), axis=1) / UNTIMED_SPEED
    return np.concatenate([[0.0], np.cumsum(steps)]), motion.positions


def obstacle_colors(scene: Scene) -> list[tuple[int, int, int]]:
    """An sRGB colour for each shape."""
    return [_color(shape, OBSTACLES[i % len(OBSTACLES)]) for i, shape in enumerate(scene.shapes)]


def _color(shape: Shape, own: tuple[int, int, int]) -> tuple[int, int, int]:
    if isinstance(shape, SeenPoints | AssumedPoints):
        return OBSERVED if isinstance(shape, SeenPoints) else ASSUMED
    return FURNITURE if _extent(shape) > FURNITURE_SIZE else own


def _extent(shape: Shape) -> float:
    if isinstance(shape, Box):
        return float(shape.size.max())
    if isinstance(shape, Cylinder | Capsule):
        return max(shape.height, 2 * shape.radius)
    if isinstance(shape, Triangulated):
        return float(np.ptp(shape.mesh.vertices, axis=0).max())
    return 0.0


def shape_surface(shape: Shape, color: tuple[int, int, int]) -> Surface:
    """The surface of an obstacle in the base frame; a point cloud becomes octahedra."""
    import trimesh

    T = np.eye(4)
    if isinstance(shape, Sphere):
        solid = trimesh.creation.icosphere(subdivisions=4, radius=shape.radius)
        T[:3, 3] = shape.center
    elif isinstance(shape, Box):
        solid, T = trimesh.creation.box(shape.size), shape.T_base_shape
    elif isinstance(shape, Cylinder):
        solid = trimesh.creation.cylinder(shape.radius, shape.height, sections=72)
        T = shape.T_base_shape
    elif isinstance(shape, Capsule):
        solid = trimesh.creation.capsule(shape.height, shape.radius, count=(48, 32))
        solid.apply_translation([0, 0, -solid.bounds.mean(axis=0)[2]])
        T = shape.T_base_shape
    elif isinstance(shape, PointCloud):
        return _point_surface(shape, color)
    else:
        assert isinstance(shape, Triangulated)
        vertices, faces = decimated(shape.mesh.world_vertices, shape.mesh.faces)
        return creased(vertices, faces, np.tile(np.array(color) / 255.0, (len(faces), 1)))
    colors = np.tile(np.array(color) / 255.0, (len(solid.faces), 1))
    return creased(np.asarray(solid.vertices, np.float64), np.asarray(solid.faces, np.int64), colors).moved(T)


def _point_surface(cloud: PointCloud, color: tuple[int, int, int]) -> Surface:
    points = thinned(cloud.points)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    vertices = points[:, None] + cloud.point_radius * axes
    shape = (6 * len(points), 3)
    return Surface(
        vertices.reshape(shape),
        np.broadcast_to(axes, vertices.shape).reshape(shape),
        np.tile(np.array(color) / 255.0, (6 * len(points), 1)),
        (faces + 6 * np.arange(len(points))[:, None, None]).reshape(-1, 3),
    )


def thinned(points: Float[ndarray, "n 3"], most: int = 60_000) -> Float[ndarray, "m 3"]:
    """At most `most` of the points: every k-th one."""
    return points[:: -(-len(points) // most)] if len(points) else points


def decimated(
    vertices: Float[ndarray, "v 3"], faces: Int[ndarray, "f 3"], most: int = 60_000
) -> tuple[Float[ndarray, "w 3"], Int[ndarray, "g 3"]]:
    """At most `most` faces: merge the vertices in each cell of a grid, with growing cells until it
    suffices."""
    cell = float(np.ptp(vertices, axis=0).max()) / 400
    while len(faces) > most:
        _, index = np.unique(np.floor(vertices / cell), axis=0, return_inverse=True)
        index = index.reshape(-1)
        weight = np.bincount(index)
        vertices = np.stack([np.bincount(index, vertices[:, i]) / weight for i in range(3)], axis=1)
        faces = index[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        cell *= 1.5
    return vertices, faces


def facts(
    motion: Path | Trajectory, result: PlanResult | None, robot: Robot | None = None
) -> list[tuple[str, str]]:
    """Labels and values of facts about a motion, for headers and captions; of a robot whose visual meshes are
    not bundled, how it is drawn."""
    length = result.path_length if result is not None else None
    if length is None:
        length = Path(motion.joint_names, motion.positions).length
    rows = []
    if result is not None:
        rows.append(("status", result.status.value.replace("_", " ")))
        same = result.stage in ("", result.planner)
        rows.append(("planner", result.planner if same else f"{result.planner} · {result.stage}"))
        rows.append(("planning time", f"{1e3 * result.planning_time:.0f} ms"))
    rows.append(("path length", f"{length:.2f} rad"))
    if result is not None and result.min_clearance is not None:
        rows.append(("clearance", f"{result.min_clearance * 1e3:.1f} mm"))
    if result is not None and result.confidence is not None:
        rows.append(("free in unknown space", f"{100 * result.confidence:.0f} %"))
    if isinstance(motion, Trajectory):
        rows.append(("duration", f"{motion.duration:.2f} s"))
    else:
        rows.append(("duration", "untimed"))
    if robot is not None and not has_visual(robot):
        rows.append(("drawn by", "collision geometry"))
    return rows
