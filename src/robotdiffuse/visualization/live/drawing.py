"""The 3D scene in viser: arms, obstacles, the trace of the tool, candidates and search trees."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import viser
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from robotdiffuse.core.transforms import quaternion_from_rotation
from robotdiffuse.core.types import Trajectory, Tree
from robotdiffuse.planning.diffusion.candidates import Candidates
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.scaling import reach
from robotdiffuse.scenes.mesh import Mesh
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import PointCloud, Shape
from robotdiffuse.visualization import style
from robotdiffuse.visualization.live.obstacles import dimensions, handle_pose, moved_to
from robotdiffuse.visualization.style import GOAL, START, Surface

POSE_RATE = 30.0
"""Poses of a motion that are precomputed per second."""
RED, AMBER = (0xD6, 0x3B, 0x3B), (0xE0, 0x9A, 0x2F)
GAMMA = 2.2
SAFE_CLEARANCE = 0.05
"""Candidates with at least this clearance are green [m]."""
TRACE_POINTS = 120
EDGE_POINTS, MAX_EDGES = 6, 4000
"""Points of the tool's trace along an edge of a tree; most edges drawn per tree, the first ones."""
TREES = ("/trees/start", "/trees/goal")
GHOST_OFFSET = 0.002
"""Offset of a see-through arm along its normals, so that it covers the solid arm at the same place [m];
scaled by its opacity over GHOST_OPACITY."""
TRACE_WIDTH, CANDIDATE_WIDTH, TREE_WIDTH = 0.0094, 0.0035, 0.0028
"""Line widths, as fractions of the arm's reach."""
GHOST_OPACITY = 0.3
"""Opacity of the start and goal arms."""
HIGHLIGHT = 0.35
"""Amount of white in the colour of the selected obstacle."""


def _colored(surface: Surface) -> list[tuple[tuple[int, int, int], Surface]]:
    """The surface split by colour."""
    rows, index = np.unique(np.round(255 * surface.colors).astype(int), axis=0, return_inverse=True)
    of_face = index.reshape(-1)[surface.faces[:, 0]]
    return [((r, g, b), _faces_of(surface, of_face == i)) for i, (r, g, b) in enumerate(rows.tolist())]


def _faces_of(surface: Surface, chosen: Bool[ndarray, "f"]) -> Surface:
    used, faces = np.unique(surface.faces[chosen], return_inverse=True)
    kept = surface.vertices[used], surface.normals[used], surface.colors[used]
    return Surface(*kept, faces.reshape(-1, 3))


def add_surface(
    server: viser.ViserServer,
    name: str,
    surface: Surface,
    color: tuple[int, int, int],
    opacity: float | None = None,
) -> viser.MeshHandle:
    """Draw a surface in one colour."""
    vertices, faces = surface.vertices.astype(np.float32), surface.faces.astype(np.uint32)
    return server.scene.add_mesh_simple(name, vertices, faces, color=color, opacity=opacity)


class Arm:
    """A robot in the 3D scene."""

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        surfaces: list[Surface],
        color: tuple[int, int, int] | None = None,
        opacity: float | None = None,
    ) -> None:
        """Draw in the robot's own colours, or in one colour, see-through and without the base."""
        self._server = server
        self.root = server.scene.add_frame(f"/{name}", show_axes=False, visible=False)
        self._frames = []
        for i, surface in enumerate(surfaces):
            frame = server.scene.add_frame(f"/{name}/{i}", show_axes=False)
            self._frames.append(frame)
            if len(surface.faces) == 0 or (i == 0 and color is not None):
                continue
            parts = _colored(surface) if color is None else [(color, surface)]
            for k, (own, part) in enumerate(parts):
                if opacity is not None:
                    part = replace(
                        part, vertices=part.vertices + opacity / GHOST_OPACITY * GHOST_OFFSET * part.normals
                    )
                add_surface(server, f"/{name}/{i}/{k}", part, own, opacity)

    def show(self, poses: "Poses | None", at: int = 0) -> None:
        """Show the arm in row `at` of the poses; hide it for None."""
        if poses is not None:
            with self._server.atomic():
                for i, frame in enumerate(self._frames):
                    frame.position, frame.wxyz = poses.xyz[at, i], poses.wxyz[at, i]
        if self.root.visible is not (poses is not None):
            self.root.visible = poses is not None

    def remove(self) -> None:
        """Remove the arm from the scene."""
        self.root.remove()


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of all frames of a robot in a sequence of configurations."""

    xyz: Float[ndarray, "n frames 3"]
    wxyz: Float[ndarray, "n frames 4"]

    @classmethod
    def of(cls, robot: Robot, q: Float[ndarray, "n dof"]) -> "Poses":
        """The poses in these configurations."""
        T = style.frames(robot, q)
        rotations = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_quat(scalar_first=True)
        return cls(T[..., :3, 3], rotations.reshape(*T.shape[:2], 4))


def sampled_poses(robot: Robot, motion: Trajectory) -> Poses:
    """Poses of a motion, POSE_RATE per second, and the last one."""
    at = np.append(np.arange(0.0, motion.duration, 1 / POSE_RATE), motion.duration)
    q = np.stack([np.interp(at, motion.times, column) for column in motion.positions.T], axis=1)
    return Poses.of(robot, q)


Drawn = viser.MeshHandle | viser.PointCloudHandle


class Obstacles:
    """The obstacles in the 3D scene. Moved obstacles are moved; changed ones are drawn again."""

    def __init__(self, server: viser.ViserServer, clicked: Callable[[str], None]) -> None:
        self._server, self._clicked = server, clicked
        self._drawn: dict[str, tuple[object, Drawn]] = {}

    def show(self, scene: Scene, selected: str) -> None:
        """Update the obstacles to a scene, and highlight the selected one."""
        colors = style.obstacle_colors(scene)
        wanted = {shape.name: (shape, color) for shape, color in zip(scene.shapes, colors, strict=True)}
        for name in [name for name in self._drawn if name not in wanted]:
            self._drawn.pop(name)[1].remove()
        for name, (shape, color) in wanted.items():
            key = _appearance(shape), color, name == selected
            known = self._drawn.get(name)
            if known is None or known[0] != key:
                if known is not None:
                    known[1].remove()
                handle = self._draw(shape, color, name == selected)
                self._drawn[name] = key, handle
            T, node = handle_pose(shape), self._drawn[name][1]
            wxyz = quaternion_from_rotation(T[:3, :3])
            if not (np.allclose(node.position, T[:3, 3]) and np.allclose(node.wxyz, wxyz)):
                node.position, node.wxyz = T[:3, 3], wxyz

    def _draw(self, shape: Shape, color: tuple[int, int, int], selected: bool) -> Drawn:
        if selected:
            r, g, b = (round(c + HIGHLIGHT * (255 - c)) for c in color)
            color = r, g, b
        name, at_origin = shape.name, moved_to(shape, np.eye(4))
        node = f"/obstacles/{name.encode().hex()}"  # viser takes slashes in names for a tree
        if isinstance(at_origin, PointCloud):
            points, size = style.thinned(at_origin.points).astype(np.float32), 2 * at_origin.point_radius
            return self._server.scene.add_point_cloud(node, points, color, point_size=size)
        handle = add_surface(self._server, node, style.shape_surface(at_origin, color), color)
        handle.on_click(lambda _event: self._clicked(name))
        return handle


def _appearance(shape: Shape) -> object:
    """A key of the shape's geometry without its pose."""
    if isinstance(shape, Mesh):
        return "mesh", shape.vertices.tobytes(), shape.faces.tobytes()
    if isinstance(shape, PointCloud):
        points = moved_to(shape, np.eye(4)).points  # type: ignore[attr-defined]
        return "points", shape.point_radius, np.round(points, 6).tobytes()
    known = dimensions(shape)
    return (shape.kind, *known.items()) if known else id(shape)


def draw_trace(
    server: viser.ViserServer, robot: Robot, tool: tuple[int, ndarray], motion: Trajectory
) -> None:
    """Draw the trace of the tool, coloured from start to goal."""
    points = style.trace(robot, tool, style.dense(motion.positions, TRACE_POINTS))
    share = np.linspace(0, 1, len(points))[:, None]
    colors = (1 - share) * np.array(START) + share * np.array(GOAL)
    draw_lines(server, "/trace", [points], [colors], TRACE_WIDTH * reach(robot))


def draw_candidates(
    server: viser.ViserServer, robot: Robot, tool: tuple[int, ndarray], candidates: Candidates | None
) -> None:
    """Draw the tool traces of all candidates: red in collision, else amber to green by clearance."""
    if candidates is None:
        server.scene.remove_by_name("/candidates")
        return
    ways = [style.trace(robot, tool, q) for q in candidates.positions]
    of = zip(ways, candidates.clearances, strict=True)
    colors = [np.tile(candidate_color(clearance), (len(way), 1)) for way, clearance in of]
    draw_lines(server, "/candidates", ways, colors, CANDIDATE_WIDTH * reach(robot))


def draw_trees(
    server: viser.ViserServer, robot: Robot, tool: tuple[int, ndarray], trees: tuple[Tree, ...]
) -> None:
    """Draw the tool traces along the edges of both search trees, in the colours of start and goal."""
    for name, color, tree in zip(TREES, (START, GOAL), trees or (None, None), strict=True):
        ways = [] if tree is None else _edges(robot, tool, tree)
        if len(ways):
            draw_lines(
                server, name, ways, [np.tile(color, (EDGE_POINTS, 1))] * len(ways), TREE_WIDTH * reach(robot)
            )
        else:
            server.scene.remove_by_name(name)


def _edges(robot: Robot, tool: tuple[int, ndarray], tree: Tree) -> list[Float[ndarray, "points 3"]]:
    children = np.flatnonzero(tree.parents >= 0)[:MAX_EDGES]
    begin, end = tree.nodes[tree.parents[children]], tree.nodes[children]
    share = np.linspace(0, 1, EDGE_POINTS)[:, None]
    q = (begin[:, None] + share * (end - begin)[:, None]).astype(np.float64)
    points = style.trace(robot, tool, q.reshape(-1, robot.dof))
    return list(points.reshape(-1, EDGE_POINTS, 3))


def candidate_color(clearance: float) -> Float[ndarray, "3"]:
    """Colour of a candidate by its clearance [m]; sRGB, 0 to 255."""
    if clearance <= 0:
        return np.array(RED, float)
    share = min(clearance / SAFE_CLEARANCE, 1.0)
    return (1 - share) * np.array(AMBER) + share * np.array(GOAL)


def draw_lines(
    server: viser.ViserServer, name: str, ways: list[ndarray], colors: list[ndarray], width: float
) -> None:
    """Draw polylines; `width` [m], colours in sRGB, converted because viser expects linear ones."""
    points = np.concatenate([np.stack([way[:-1], way[1:]], axis=1) for way in ways])
    ends = np.concatenate([np.stack([color[:-1], color[1:]], axis=1) for color in colors])
    linear = np.round(255 * (ends / 255) ** GAMMA).astype(np.uint8)
    server.scene.add_line_segments(name, points.astype(np.float32), linear, thickness=width)
