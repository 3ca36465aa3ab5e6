"""The 3D scene in viser: arms, obstacles, the trace of the tool, candidates and search trees."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import viser
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from robotdiffuse.core.transforms import quaternion_from_rotation
from robotdiffuse.core.types import Trajectory, Tree
from robotdiffuse.drawables import GOAL, START, Color, Drawable, Surface, thinned
from robotdiffuse.planning.hybrid import Candidates
from robotdiffuse.robots.kinematics import reach
from robotdiffuse.scenes.shapes import Mesh, PointCloud, Shape
from robotdiffuse.visualization.arm import DrawnArm, interpolated
from robotdiffuse.visualization.live.session import dimensions

POSE_RATE = 30.0
"""Poses of a motion that are precomputed per second."""
RED = (0xD6, 0x3B, 0x3B)
AMBER = (0xE0, 0x9A, 0x2F)
GAMMA = 2.2
SAFE_CLEARANCE = 0.05
"""Candidates with at least this clearance are green [m]."""
# Points of the tool's trace along an edge of a tree; most edges drawn per tree, the first ones.
EDGE_POINTS = 6
MAX_EDGES = 4000
TREES = ("/trees/start", "/trees/goal")
GHOST_OFFSET = 0.002
"""Offset of a see-through arm along its normals, so that it covers the solid arm at the same place [m];
scaled by its opacity over GHOST_OPACITY."""
# Line widths, as fractions of the arm's reach.
TRACE_WIDTH = 0.0094
CANDIDATE_WIDTH = 0.0035
TREE_WIDTH = 0.0028
GHOST_OPACITY = 0.3
"""Opacity of the start and goal arms."""
HIGHLIGHT = 0.35
"""Amount of white in the color of the selected obstacle."""


def add_surface(
    server: viser.ViserServer,
    name: str,
    surface: Surface,
    color: Color,
    opacity: float | None = None,
) -> viser.MeshHandle:
    """Draw a surface in one color."""
    vertices = surface.vertices.astype(np.float32)
    faces = surface.faces.astype(np.uint32)
    return server.scene.add_mesh_simple(name, vertices, faces, color=color, opacity=opacity)


class Arm:
    """A robot in the 3D scene."""

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        drawn: DrawnArm,
        color: Color | None = None,
        opacity: float | None = None,
    ) -> None:
        """Draw in the robot's own colors, or in one color, see-through and without the base."""
        self._server = server
        self._drawn = drawn
        self.root = server.scene.add_frame(f"/{name}", show_axes=False, visible=False)
        self._frames = []
        for i, surface in enumerate(drawn.surfaces):
            self._frames.append(server.scene.add_frame(f"/{name}/{i}", show_axes=False))
            if len(surface.faces) == 0 or (i == 0 and color is not None):
                continue
            parts = surface.by_color if color is None else [(color, surface)]
            for k, (part_color, part) in enumerate(parts):
                if opacity is not None:
                    vertices = part.vertices + opacity / GHOST_OPACITY * GHOST_OFFSET * part.normals
                    part = replace(part, vertices=vertices)
                add_surface(server, f"/{name}/{i}/{k}", part, part_color, opacity)

    def show(self, q: Float[ndarray, "dof"] | None) -> None:
        """Show the arm in a configuration; hide it for None."""
        self.show_frames(None if q is None else self._drawn.frames(q))

    def show_frames(self, T_base_frame: Float[ndarray, "frames 4 4"] | None) -> None:
        """Show the arm with its frames at these poses; hide it for None."""
        if T_base_frame is not None:
            turns = Rotation.from_matrix(T_base_frame[:, :3, :3]).as_quat(scalar_first=True)
            with self._server.atomic():
                for frame, T, wxyz in zip(self._frames, T_base_frame, turns, strict=True):
                    frame.position = T[:3, 3]
                    frame.wxyz = wxyz
        if self.root.visible is not (T_base_frame is not None):
            self.root.visible = T_base_frame is not None


def sampled_frames(arm: DrawnArm, motion: Trajectory) -> Float[ndarray, "n frames 4 4"]:
    """Poses of the frames along a motion, POSE_RATE per second, and the last one."""
    at = np.append(np.arange(0.0, motion.duration, 1 / POSE_RATE), motion.duration)
    return arm.frames(interpolated(at, motion.times, motion.positions))


def place(node: Any, T: Float[ndarray, "4 4"]) -> None:
    """Move a node, without a message to browsers if it is there."""
    wxyz = quaternion_from_rotation(T[:3, :3])
    if not (np.allclose(node.position, T[:3, 3]) and np.allclose(node.wxyz, wxyz)):
        node.position = T[:3, 3]
        node.wxyz = wxyz


class Obstacles:
    """The obstacles in the 3D scene. Moved obstacles are moved; changed ones are drawn again."""

    def __init__(self, server: viser.ViserServer, clicked: Callable[[str], None] = lambda _: None) -> None:
        self._server = server
        self._clicked = clicked
        self._nodes: dict[str, tuple[object, Any]] = {}

    def show(self, obstacles: Sequence[Drawable], selected: str = "", time: float = 0.0) -> None:
        """Update to obstacles where they are at a time [s], and highlight the selected one."""
        names = {one.name for one in obstacles}
        for name in [name for name in self._nodes if name not in names]:
            self._nodes.pop(name)[1].remove()
        for one in obstacles:
            key = _appearance(one.shape), one.color, one.name == selected
            drawn_node = self._nodes.get(one.name)
            if drawn_node is None or drawn_node[0] != key:
                if drawn_node is not None:
                    drawn_node[1].remove()
                self._nodes[one.name] = key, self._draw(one, one.name == selected)
            place(self._nodes[one.name][1], one.frame(time))

    def _draw(self, obstacle: Drawable, selected: bool) -> Any:
        """A node in the obstacle's own frame."""
        color = obstacle.color
        name = obstacle.name
        if selected:
            r, g, b = (round(c + HIGHLIGHT * (255 - c)) for c in color)
            color = r, g, b
        obstacle_frame = obstacle.own
        node = f"/obstacles/{name.encode().hex()}"  # viser takes slashes in names for a tree
        if isinstance(obstacle_frame.shape, PointCloud):
            points = thinned(obstacle_frame.shape.points).astype(np.float32)
            return self._server.scene.add_point_cloud(
                node, points, color, point_size=2 * obstacle_frame.shape.point_radius
            )
        handle = add_surface(self._server, node, obstacle_frame.surface, color)
        handle.on_click(lambda _event: self._clicked(name))
        return handle


def _appearance(shape: Shape) -> object:
    """A key of the shape's geometry without its pose."""
    if isinstance(shape, Mesh):
        return "mesh", shape.vertices.tobytes(), shape.faces.tobytes()
    if isinstance(shape, PointCloud):
        points = shape.points - shape.bounds.mean(axis=0)
        return "points", shape.point_radius, np.round(points, 6).tobytes()
    sizes = dimensions(shape)
    return (shape.kind, *sizes.items()) if sizes else id(shape)


def draw_trace(server: viser.ViserServer, arm: DrawnArm, motion: Trajectory | None) -> None:
    """Draw the trace of the tool, colored from start to goal."""
    if motion is None:
        server.scene.remove_by_name("/trace")
        return
    points = arm.trace(motion.positions)
    share = np.linspace(0, 1, len(points))[:, None]
    colors = (1 - share) * np.array(START) + share * np.array(GOAL)
    draw_lines(server, "/trace", [points], [colors], TRACE_WIDTH * reach(arm.robot))


def draw_candidates(server: viser.ViserServer, arm: DrawnArm, candidates: Candidates | None) -> None:
    """Draw the tool traces of all candidates: red in collision, else amber to green by clearance."""
    traces = []
    colors = []
    if candidates is not None:
        traces = [arm.trace(q) for q in candidates.positions]
        colors = [candidate_color(clearance) for clearance in candidates.clearances]
    draw_lines(server, "/candidates", traces, colors, CANDIDATE_WIDTH * reach(arm.robot))


def draw_trees(server: viser.ViserServer, arm: DrawnArm, trees: tuple[Tree, ...]) -> None:
    """Draw the tool traces along the edges of both search trees, in the colors of start and goal."""
    for name, color, tree in zip(TREES, (START, GOAL), trees or (None, None), strict=True):
        edges = [] if tree is None else _edges(arm, tree)
        colors = [np.array(color, float)] * len(edges)
        draw_lines(server, name, edges, colors, TREE_WIDTH * reach(arm.robot))


def _edges(arm: DrawnArm, tree: Tree) -> list[Float[ndarray, "points 3"]]:
    children = np.flatnonzero(tree.parents >= 0)[:MAX_EDGES]
    begin = tree.nodes[tree.parents[children]]
    end = tree.nodes[children]
    share = np.linspace(0, 1, EDGE_POINTS)[:, None]
    q = (begin[:, None] + share * (end - begin)[:, None]).astype(np.float64)
    return list(arm.tool_points(q.reshape(-1, arm.robot.dof)).reshape(-1, EDGE_POINTS, 3))


def candidate_color(clearance: float) -> Float[ndarray, "3"]:
    """Color of a candidate by its clearance [m]; sRGB, 0 to 255."""
    if clearance <= 0:
        return np.array(RED, float)
    share = min(clearance / SAFE_CLEARANCE, 1.0)
    return (1 - share) * np.array(AMBER) + share * np.array(GOAL)


def draw_lines(
    server: viser.ViserServer, name: str, lines: list[ndarray], colors: list[ndarray], width: float
) -> None:
    """Draw polylines, each in one color or with a color for each point; remove the node without any.

    `width` [m]; colors in sRGB, converted because viser expects linear ones.
    """
    if not lines:
        server.scene.remove_by_name(name)
        return
    points = np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in lines])
    along = [np.broadcast_to(color, line.shape) for color, line in zip(colors, lines, strict=True)]
    ends = np.concatenate([np.stack([color[:-1], color[1:]], axis=1) for color in along])
    linear = np.round(255 * (ends / 255) ** GAMMA).astype(np.uint8)
    server.scene.add_line_segments(name, points.astype(np.float32), linear, thickness=width)
