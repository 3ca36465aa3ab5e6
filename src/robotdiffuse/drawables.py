"""Surfaces and colors of a robot and of obstacles, over time, for everything that draws them: pictures,
replays, the live page, recordings for Rerun and Foxglove, and PyBullet's cameras."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import inverse, placed, transform
from robotdiffuse.core.types import Points, Pose, frozen_dataclass
from robotdiffuse.perception.depth_view import AssumedPoints, SeenPoints
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.visual_meshes import load_visual
from robotdiffuse.scenes.scene import MovingObstacle, Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, PointCloud, Shape, Sphere, Triangulated

Color = tuple[int, int, int]
"""sRGB."""
# Colors of the start and goal of a motion; the trace fades from one to the other.
START = (0x4F, 0x7F, 0xD9)
GOAL = (0x10, 0xA3, 0x7F)
OBSTACLES = ((0xD9, 0x7B, 0x5C), (0xE0, 0x9A, 0x5F), (0xC9, 0x6A, 0x6A), (0xD8, 0xAE, 0x63))
FURNITURE = (0xCD, 0xC0, 0xAC)
# Points that cameras observed, and points assumed to be occupied in unknown space.
OBSERVED = (0x4F, 0x7C, 0xAC)
ASSUMED = (0xB9, 0x8A, 0xD9)
FURNITURE_SIZE = 0.7
"""Obstacles with a longer side than this count as furniture, with its own color [m]."""
CREASE_ANGLE = np.radians(38)
"""Edges with a larger angle between their faces are drawn sharp [rad]."""
MAX_SIZE = 60_000
"""Largest number of points of a cloud, and of faces of a mesh, that are drawn."""


@frozen_dataclass
class Surface:
    """Triangles with a normal and an sRGB color (0 to 1) at each vertex."""

    vertices: Float[ndarray, "v 3"]
    normals: Float[ndarray, "v 3"]
    colors: Float[ndarray, "v 3"]
    faces: Int[ndarray, "f 3"]

    def moved(self, T: Pose) -> "Surface":
        """The surface after a rigid transform."""
        return Surface(placed(T, self.vertices), self.normals @ T[:3, :3].T, self.colors, self.faces)

    @property
    def by_color(self) -> list[tuple[Color, "Surface"]]:
        """The surface split by the colors of its faces."""
        colors, color_index = np.unique(np.round(255 * self.colors).astype(int), axis=0, return_inverse=True)
        face_color = color_index.reshape(-1)[self.faces[:, 0]]
        parts = []
        for i, (r, g, b) in enumerate(colors.tolist()):
            used, faces = np.unique(self.faces[face_color == i], return_inverse=True)
            arrays = self.vertices[used], self.normals[used], self.colors[used]
            parts.append(((r, g, b), Surface(*arrays, faces)))
        return parts


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


def painted(color: Color, count: int) -> Points:
    """A color for each of `count` vertices or faces."""
    return np.tile(np.array(color) / 255.0, (count, 1))


def creased(vertices: Points, faces: Int[ndarray, "f 3"], colors: Float[ndarray, "f 3"]) -> Surface:
    """A surface that is shaded smoothly except across sharp edges (CREASE_ANGLE), where vertices are
    duplicated so that each side has a normal of its own. colors: a color per face, 0 to 1."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    smooth = mesh.face_adjacency[mesh.face_adjacency_angles < CREASE_ANGLE]
    patches = trimesh.graph.connected_component_labels(smooth, len(faces))
    owner = faces.reshape(-1)
    # each patch gets its own copy of its vertices, with the normals of this patch alone
    copies, copy = np.unique(np.column_stack([owner, np.repeat(patches, 3)]), axis=0, return_inverse=True)
    patched = trimesh.Trimesh(vertices[copies[:, 0]], copy.reshape(-1, 3), process=False)
    # a vertex where faces of several colors meet is duplicated too, with the same normal
    colors_of_corners = np.round(np.repeat(colors, 3, axis=0) * 255)
    keys = np.column_stack([copy.reshape(-1), colors_of_corners])
    _, keep, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    normals = patched.vertex_normals[copy.reshape(-1)[keep]]
    return Surface(vertices[owner[keep]], normals, colors[keep // 3], index.reshape(-1, 3))


def link_surfaces(robot: Robot) -> dict[str, Surface]:
    """The surface of each link, in the link's frame."""
    return {
        link: join([creased(mesh.vertices, mesh.faces, mesh.colors / 255.0) for mesh in meshes])
        for link, meshes in load_visual(robot).items()
    }


@frozen_dataclass
class Drawable:
    """An obstacle as it is drawn."""

    shape: Shape
    """The obstacle's shape where it is at time 0, in the base frame."""
    color: Color
    moving: MovingObstacle | None = None

    @property
    def name(self) -> str:
        return self.shape.name

    @cached_property
    def surface(self) -> Surface:
        """The surface where the obstacle is at time 0, in the base frame; a point cloud becomes octahedra."""
        return _surface(self.shape, self.color)

    def frame(self, time: float = 0.0) -> Pose:
        """The pose of the obstacle's own frame in the base frame at a time [s]."""
        return own_frame(self.shape) if self.moving is None else self.moving.pose(time)

    @property
    def own(self) -> "Drawable":
        """The obstacle without its motion, in coordinates of its own frame."""
        return Drawable(self.shape.moved(inverse(self.frame())), self.color)

    @property
    def fixed(self) -> "Drawable":
        """The obstacle in coordinates of the frame that it is fixed to: the base frame, or its own frame if
        it moves."""
        return self if self.moving is None else self.own

    def surface_at(self, time: float) -> Surface:
        """The surface where the obstacle is at a time [s], in the base frame."""
        return self.surface.moved(self.frame(time) @ inverse(self.frame()))


def drawables(scene: Scene, moving: Sequence[MovingObstacle] = ()) -> list[Drawable]:
    """All obstacles, the moving ones last."""
    shapes = [(shape, None) for shape in scene.shapes] + [(obstacle.at(0.0), obstacle) for obstacle in moving]
    return [
        Drawable(shape, _color(shape, OBSTACLES[i % len(OBSTACLES)]), obstacle)
        for i, (shape, obstacle) in enumerate(shapes)
    ]


def own_frame(shape: Shape) -> Pose:
    """The pose of a shape's own frame in the base frame. A point cloud's frame is at the middle of its
    bounds; a shape without a frame of its own has the base frame."""
    if isinstance(shape, PointCloud):
        return transform(shape.bounds.mean(axis=0))
    try:
        return shape.T_base_shape
    except InputError:
        return np.eye(4)


def _color(shape: Shape, usual: Color) -> Color:
    if isinstance(shape, SeenPoints | AssumedPoints):
        return OBSERVED if isinstance(shape, SeenPoints) else ASSUMED
    size = 0.0
    if isinstance(shape, Box):
        size = shape.size.max()
    elif isinstance(shape, Cylinder | Capsule):
        size = max(shape.height, 2 * shape.radius)
    elif isinstance(shape, Triangulated):
        size = np.ptp(shape.mesh.vertices, axis=0).max()
    return FURNITURE if size > FURNITURE_SIZE else usual


def _surface(shape: Shape, color: Color) -> Surface:
    import trimesh

    T = np.eye(4)
    if isinstance(shape, PointCloud):
        return _point_surface(shape, color)
    if isinstance(shape, Triangulated):
        vertices, faces = decimated(shape.mesh.world_vertices, shape.mesh.faces)
    else:
        T = shape.T_base_shape
        match shape:
            case Sphere():
                solid = trimesh.creation.icosphere(subdivisions=4, radius=shape.radius)
            case Box():
                solid = trimesh.creation.box(shape.size)
            case Cylinder():
                solid = trimesh.creation.cylinder(shape.radius, shape.height, sections=72)
            case _:
                assert isinstance(shape, Capsule)
                solid = trimesh.creation.capsule(shape.height, shape.radius, count=(48, 32))
                solid.apply_translation([0, 0, -solid.bounds.mean(axis=0)[2]])
        vertices = np.asarray(solid.vertices, np.float64)
        faces = np.asarray(solid.faces, np.int64)
    return creased(vertices, faces, painted(color, len(faces))).moved(T)


def _point_surface(cloud: PointCloud, color: Color) -> Surface:
    points = thinned(cloud.points)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    vertices = (points[:, None] + cloud.point_radius * axes).reshape(-1, 3)
    many = (faces + 6 * np.arange(len(points))[:, None, None]).reshape(-1, 3)
    return Surface(vertices, np.tile(axes, (len(points), 1)), painted(color, len(vertices)), many)


def thinned(points: Points) -> Points:
    """At most MAX_SIZE of the points: every k-th one."""
    return points[:: -(-len(points) // MAX_SIZE)] if len(points) else points


def decimated(vertices: Points, faces: Int[ndarray, "f 3"]) -> tuple[Points, Int[ndarray, "g 3"]]:
    """The mesh with at most MAX_SIZE faces: the vertices in each cell of a grid are merged, and the cells
    grow until few enough faces are left."""
    cell = float(np.ptp(vertices, axis=0).max()) / 400
    while len(faces) > MAX_SIZE:
        _, index = np.unique(np.floor(vertices / cell), axis=0, return_inverse=True)
        index = index.reshape(-1)
        weight = np.bincount(index)
        vertices = np.stack([np.bincount(index, vertices[:, i]) / weight for i in range(3)], axis=1)
        faces = index[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        cell *= 1.5
    return vertices, faces
