"""Draws a motion as a PNG picture, in software: without GPU, window or browser. The view is chosen so that
most of the arm and its trace are visible. HTML pages (`replay_page.py`, `live/`) use the arm's
surfaces and the facts about a motion too."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import ConvexHull

from robotdiffuse.collision.exact_meshes import forward_frames
from robotdiffuse.core.errors import InputError, check_type, joined
from robotdiffuse.core.files import check_output, write_atomically
from robotdiffuse.core.settings import Bound, Natural, NotNegative, Number, Settings
from robotdiffuse.core.transforms import ball_around
from robotdiffuse.core.types import (
    Configuration,
    Configurations,
    Path,
    PlanResult,
    Points,
    Rotation,
    Trajectory,
    Values,
    Vector,
    arc_lengths,
    frozen_dataclass,
    interpolated,
    step_lengths,
)
from robotdiffuse.drawables import (
    GOAL,
    START,
    Color,
    Drawable,
    Surface,
    drawables,
    join,
    link_surfaces,
    painted,
)
from robotdiffuse.perception.ray_caster import looking_at
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.visual_meshes import has_visual
from robotdiffuse.scenes.scene import MovingObstacle, Scene
from robotdiffuse.visualization.rasterizer import blend_ghost, draw, shade

UNTIMED_SPEED = 0.8
"""Speed in joint space at which a path without times is played [rad/s]."""
TRACE_POINTS = 240
"""Number of configurations along a motion for drawing the tool's trace and for choosing the view."""


class DrawnArm:
    """The surfaces of a robot on each of its dof + 1 frames, and the point of its tool that draws the trace.

    The point is on the z axis of the tip link, as far out as the surfaces on the tip's frame extend: for a
    gripper, this is between the fingertips.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        by_frame: list[list[Surface]] = [[] for _ in range(robot.dof + 1)]
        for link, surface in link_surfaces(robot).items():
            by_frame[robot.link_frame(link)].append(surface.moved(robot.T_frame_link(link)))
        self.surfaces = [join(surfaces) for surfaces in by_frame]
        """One surface for each frame, in the coordinates of the frame [m]."""
        self.tool_frame = robot.link_frame(robot.tip)
        T_frame_tip = robot.T_frame_link(robot.tip)
        heights = (self.surfaces[self.tool_frame].vertices - T_frame_tip[:3, 3]) @ T_frame_tip[:3, 2]
        self.tool_point = T_frame_tip[:3, 3] + max(0.0, heights.max(initial=0.0)) * T_frame_tip[:3, 2]
        """The point that draws the trace, in the coordinates of frame `tool_frame` [m]."""

    def frames(self, q: Float[ndarray, "*batch dof"]) -> Float[ndarray, "*batch frames 4 4"]:
        """T_base_frame of all dof + 1 frames at each configuration."""
        return forward_frames(self.robot, q)

    def posed(self, q: Configuration, begin: int = 0) -> Surface:
        """The surface of the arm at a configuration, in the base frame. Only frames from `begin` on are
        included: 1 leaves out the base."""
        poses = zip(self.surfaces[begin:], self.frames(q)[begin:], strict=True)
        return join([surface.moved(T) for surface, T in poses])

    def tool_points(self, q: Configurations) -> Points:
        """Positions of the tool point in the base frame [m]."""
        return self.frames(q)[:, self.tool_frame, :3] @ np.append(self.tool_point, 1.0)

    def trace(self, q: Configurations) -> Points:
        """Positions of the tool point at TRACE_POINTS configurations, equally spaced along a path in joint
        space [m]."""
        return self.tool_points(dense(q))


def dense(q: Configurations) -> Configurations:
    """TRACE_POINTS configurations, equally spaced along a path in joint space; one configuration if the path
    has no length."""
    s = arc_lengths(q)
    return q[:1] if s[-1] == 0 else interpolated(np.linspace(0, s[-1], TRACE_POINTS), s, q)


def timed(motion: Path | Trajectory) -> tuple[Values, Configurations]:
    """Times [s] and positions of a motion; a path without times gets a constant speed in joint space."""
    if isinstance(motion, Trajectory):
        return motion.times, motion.positions
    return arc_lengths(motion.positions) / UNTIMED_SPEED, motion.positions


def check_motion_of(robot: Robot, motion: Path | Trajectory) -> None:
    """Raises InputError for a motion of other joints, or with numbers that are not finite."""
    check_type("motion", motion, (Path, Trajectory), "a Path or a Trajectory")
    if tuple(motion.joint_names) != robot.joint_names:
        names = joined(motion.joint_names)
        raise InputError(f"the motion moves {names}; {robot.name} plans {joined(robot.joint_names)}")
    if not np.isfinite(motion.positions).all():
        raise InputError("the motion has positions that are not finite")


Facts = list[tuple[str, str]]
"""Labels and values, for headers and captions."""


def facts(motion: Path | Trajectory, result: PlanResult | None, robot: Robot | None = None) -> Facts:
    """Labels and values of facts about a motion, for headers and captions. With `robot`, one of them says
    that the arm is drawn by its collision geometry, if no visual meshes of this robot are bundled."""
    path = getattr(result, "path", None) or Path(motion.joint_names, motion.positions)
    rows = []
    if result is not None:
        rows.append(("status", result.status.value.replace("_", " ")))
        same_planner = result.stage in ("", result.planner)
        rows.append(("planner", result.planner if same_planner else f"{result.planner} · {result.stage}"))
        rows.append(("planning time", f"{1e3 * result.planning_time:.0f} ms"))
    rows.append(("path length", f"{path.length:.2f} rad"))
    if result is not None and result.min_clearance is not None:
        rows.append(("clearance", f"{result.min_clearance * 1e3:.1f} mm"))
    if result is not None and result.confidence is not None:
        rows.append(("free in unknown space", f"{100 * result.confidence:.0f} %"))
    rows.append(("duration", f"{motion.duration:.2f} s" if isinstance(motion, Trajectory) else "untimed"))
    if robot is not None and not has_visual(robot):
        rows.append(("drawn by", "collision geometry"))
    return rows


AZIMUTHS = 18
"""Number of azimuths of candidate views."""
ELEVATIONS = np.radians((15.0, 25.0))
"""Elevations of candidate views [rad]."""
VERTICAL_FIELD = np.radians(28)
"""Vertical field of view [rad]."""
VIEW_GHOSTS = 5
"""Number of poses along a motion, besides the last, that the chosen view should show."""
MAX_FRAMING_DISTANCE = 1.3
"""The view is framed to include obstacles up to this distance from the middle of the motion [m]."""


@frozen_dataclass
class Camera:
    """A pinhole camera that looks at `target`, with z up."""

    eye: Vector
    target: Vector
    width: int
    height: int

    @property
    def focal(self) -> float:
        """Focal length [pixels]."""
        return self.height / (2 * np.tan(VERTICAL_FIELD / 2))

    @property
    def rotation(self) -> Rotation:
        """R_camera_base; its rows are the directions right, down and forward."""
        return looking_at(self.eye, self.target)[:3, :3].T

    def project(self, points: Points) -> Points:
        """Pixel x and y, and 1 / depth (0 if the depth is at most 5 cm, as behind the camera)."""
        x, y, z = ((points - self.eye) @ self.rotation.T).T
        near = np.where(z > 0.05, 1 / np.maximum(z, 0.05), 0.0)
        columns = [0.5 * self.width + self.focal * x * near, 0.5 * self.height + self.focal * y * near, near]
        return np.stack(columns, axis=1).astype(np.float32)

    def rays(self) -> Rotation:
        """Matrix that maps (x, y, 1), with x and y in pixels, to the ray through the pixel in the base frame,
        with depth 1."""
        f = self.focal
        pixel = np.array([[1 / f, 0, -0.5 * self.width / f], [0, 1 / f, -0.5 * self.height / f], [0, 0, 1]])
        return self.rotation.T @ pixel


def drawn_by(camera: Camera, surface: Surface) -> tuple[Float[ndarray, "h w"], Int[ndarray, "h w"], Points]:
    """Nearness and index of the visible face at each pixel, and the vertices on the screen; see
    `rasterizer.draw`."""
    near = np.zeros((camera.height, camera.width), np.float32)
    ident = np.zeros(near.shape, np.int32)
    screen = camera.project(surface.vertices)
    draw(near, ident, screen, surface.faces)
    return near, ident, screen


def _direction(azimuth: float, elevation: float) -> Vector:
    c = np.cos(elevation)
    return np.array([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)])


def framed(
    points: Points,
    toward: Vector,
    size: tuple[int, int],
    free: tuple[float, float],
) -> Camera:
    """A camera in the direction `toward` from the points, as close as possible with all points in the
    picture.

    `size` is width and height [pixels]; `free` are the fractions of the height to leave free above and below.
    """
    target, _ = ball_around(points)
    distance = 1.0
    # borders of the part of the picture that is not left free, as coordinates at depth 1
    tangent = np.tan(VERTICAL_FIELD / 2)
    top = -(1 - 2 * free[0]) * tangent
    bottom = (1 - 2 * free[1]) * tangent
    side = 0.93 * tangent * size[0] / size[1]
    for _ in range(4):
        rotation = Camera(target + toward, target, *size).rotation
        x, y, z = ((points - target) @ rotation.T).T
        distance = max((np.abs(x) / side - z).max(), (y / bottom - z).max(), (y / top - z).max(), 0.3)
        u = x / (z + distance)
        v = y / (z + distance)
        offset = 0.5 * np.array([u.min() + u.max(), v.min() + v.max() - top - bottom])
        target = target + distance * rotation[:2].T @ offset
    return Camera(target + distance * toward, target, *size)


def view_of_motion(
    arm: DrawnArm,
    among: Sequence[Drawable],
    q: Configurations,
    size: tuple[int, int],
    free: tuple[float, float],
    azimuth: float | None = None,
    traces: Sequence[Points] = (),
) -> Camera:
    """Of the framed views from AZIMUTHS x ELEVATIONS, the one that shows most of the arm, of its trace along
    a motion and of the obstacles.

    `among` are the obstacles. `azimuth` fixes the azimuth, measured from the x axis of the base [rad]; None:
    the best one is chosen. `traces` are further points that the picture must show.
    """
    q = dense(q)
    goal = arm.posed(q[-1])
    ghosts = join([arm.posed(q[i], 1) for i in _earlier(len(q), VIEW_GHOSTS)])
    trace = arm.tool_points(q)
    obstacles = join([obstacle.surface for obstacle in among])
    owners = np.repeat(np.arange(len(among)), [len(obstacle.surface.faces) for obstacle in among])
    moving = np.concatenate([goal.vertices, ghosts.vertices, trace, *traces])
    middle, _ = ball_around(moving)
    near = np.linalg.norm(obstacles.vertices - middle, axis=1) < MAX_FRAMING_DISTANCE
    points = np.concatenate([moving, obstacles.vertices[near]])
    # the corners of the convex hull determine the frame
    points = points[ConvexHull(points, qhull_options="QJ").vertices]
    thumbnail_size = (160, max(1, 160 * size[1] // size[0]))
    around = np.arange(AZIMUTHS) * (2 * np.pi / AZIMUTHS) if azimuth is None else np.array([azimuth])

    def score(toward: Vector) -> float:
        camera = framed(points, toward, thumbnail_size, free)
        return _score(camera, goal, ghosts, trace, obstacles, owners)

    directions = (_direction(angle, elevation) for elevation in ELEVATIONS for angle in around)
    return framed(points, max(directions, key=score), size, free)


def _earlier(rows: int, count: int) -> list[int]:
    """Indices of `count` evenly spaced rows of a motion before its last one; none if the arm does not
    move."""
    return np.linspace(0, rows - 1, count + 1).round().astype(int).tolist()[:-1] if rows > 1 else []


def _score(
    camera: Camera,
    arm: Surface,
    ghosts: Surface,
    trace: Points,
    obstacles: Surface,
    owners: Int[ndarray, "faces"],
) -> float:
    """Score of a view: the visible fraction of the arm, plus half the visible fraction of the ghosts, plus
    half the mean visible fraction of the obstacles, plus the visible length of the trace relative to the
    height of the picture.

    owners: the index of the obstacle that each face of `obstacles` belongs to.
    """
    obstacle_nearness, faces, _ = drawn_by(camera, obstacles)
    arm_nearness, _, _ = drawn_by(camera, arm)
    ghost_nearness, _, _ = drawn_by(camera, ghosts)
    score = 0.0
    for nearness, weight in ((arm_nearness, 1.0), (ghost_nearness, 0.5)):
        score += weight * float((nearness > obstacle_nearness).sum() / max(1, (nearness > 0).sum()))
    obstacle_pixels = obstacle_nearness > 0
    if obstacle_pixels.any():
        count = owners[-1] + 1
        pixels_drawn = np.bincount(owners[faces[obstacle_pixels]], minlength=count)
        pixels_shown = np.bincount(owners[faces[obstacle_nearness > arm_nearness]], minlength=count)
        score += 0.5 * float((pixels_shown / np.maximum(1, pixels_drawn)).mean())
    pixels = camera.project(trace)
    column = pixels[:, 0].astype(int)
    row = pixels[:, 1].astype(int)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    column = column.clip(0, camera.width - 1)
    row = row.clip(0, camera.height - 1)
    visible = inside & (pixels[:, 2] > obstacle_nearness[row, column])
    steps = step_lengths(pixels[:, :2])
    return score + float(steps[visible[1:]].sum()) / camera.height


SUPERSAMPLING = 2
"""Number of rendered pixels per pixel along each side."""
# for the sky and for the main light: number of directional lights, and edge length of their shadow maps
# [pixels]
SKY_LIGHTS = 60
SKY_MAP = 320
KEY_LIGHTS = 28
KEY_MAP = 768
KEY_DIRECTION = np.array([0.35, -0.45, 0.82])
"""Direction towards the main light, in a frame with z up and x from the scene to the camera."""
KEY_SPREAD = 0.075
"""Angular radius of the main light [rad], for soft shadows."""
TUBE_SIDES = 10
"""Number of corners of the cross-section of the trace."""
TUBE_RADIUS = 0.006
"""Radius of the trace [m]."""
CAPTION_COLOR = (0xF2, 0xF4, 0xF6)
"""sRGB color to which the picture fades behind the caption."""
COMPARED = ((0xE3, 0xA8, 0x12), (0xCF, 0x33, 0x3B), (0x2F, 0x6F, 0xD0), (0x8B, 0x55, 0xB8))
"""sRGB colors of the traces of several motions in one picture."""
MOVED_ALPHA = 0.22
"""Opacity of later poses of moving obstacles."""
WHITE = (0xFF, 0xFF, 0xFF)
# sRGB color and opacity of the safety shell
SHELL_COLOR = (0x35, 0xB8, 0x5C)
SHELL_ALPHA = 0.2
MARGINS = (0.05, 0.11)
"""Fractions of the height left free above the arm, and below it for the caption."""


@frozen_dataclass
class ClearSurface:
    """A see-through surface. Only its part nearest to the camera is drawn."""

    surface: Surface
    tint: Vector
    """Linear color."""
    alpha: float


Pixels = Annotated[int, Bound(least=16.0)]


@dataclass(frozen=True)
class PictureSettings(Settings, name="picture"):
    """Size and contents of the picture."""

    width: Pixels = 1280
    height: Pixels = 800
    ghosts: Natural = 5
    """Number of see-through arms from the start towards the goal, and of later poses of moving obstacles."""
    azimuth: Number | None = None
    """Azimuth of the camera, measured from the x axis of the base [rad]; None: where most of the motion is
    visible."""
    shell: NotNegative = 0.0
    """Thickness of a see-through safety shell around the arm at the goal [m]; 0: no shell."""


def write_picture(
    robot: Robot,
    scene: Scene,
    motion: Path | Trajectory,
    file: str | FilePath,
    *,
    result: PlanResult | None = None,
    title: str | None = None,
    settings: PictureSettings = PictureSettings(),
    moving: Sequence[MovingObstacle] = (),
) -> None:
    """Write a picture of a motion as .png.

    The arm is solid at the goal and see-through at earlier configurations; a tube shows the tool's trace.
    `moving` obstacles are solid at the pose at the start, and see-through at later poses. `result` adds facts
    to the caption. Raises InputError for a file name with another ending, or a file that cannot be written.
    """
    path = check_output(file, (".png",))
    pixels = render(robot, scene, motion, settings, moving=moving)
    write_captioned(pixels, path, title or robot.name, facts(motion, result, robot))


def write_comparison(
    robot: Robot,
    scene: Scene,
    motions: Mapping[str, Path | Trajectory],
    file: str | FilePath,
    *,
    title: str | None = None,
    settings: PictureSettings = PictureSettings(),
    moving: Sequence[MovingObstacle] = (),
) -> None:
    """Write a picture of several motions of one arm in one scene as .png. `motions` are given by name.

    The arm is drawn along the first motion; each motion has a trace in its own color. Raises InputError in
    the cases in which `write_picture` raises it, and if there are no motions or more motions than colors.
    """
    path = check_output(file, (".png",))
    if not 0 < len(motions) <= len(COMPARED):
        raise InputError(f"{len(motions)} motions; a picture shows 1 to {len(COMPARED)}")
    first, *other_motions = motions.values()
    pixels = render(robot, scene, first, settings, others=other_motions, moving=moving)
    # without labels, "untimed" (see `facts`) would say nothing
    figures = [", ".join(v for k, v in facts(m, None) if v != "untimed") for m in motions.values()]
    captions = list(zip(motions, figures, strict=True))
    write_captioned(pixels, path, title or robot.name, captions, COMPARED)


def write_captioned(
    pixels: np.ndarray,
    path: FilePath,
    title: str,
    facts: Facts,
    colors: Sequence[Color] = (),
) -> None:
    """Write a picture with its caption; see `caption`."""
    image = Image.fromarray(faded_below(pixels))
    caption(image, title, facts, colors)
    save_png(image, path)


def save_png(image: Image.Image, path: FilePath) -> None:
    """Write an image as PNG; the file is written atomically."""
    write_atomically(path, lambda stream: image.save(stream, "PNG"))


def render(
    robot: Robot,
    scene: Scene,
    motion: Path | Trajectory,
    settings: PictureSettings,
    camera: Camera | None = None,
    others: Sequence[Path | Trajectory] = (),
    added: Sequence[Surface] = (),
    clear: Sequence[ClearSurface] = (),
    moving: Sequence[MovingObstacle] = (),
) -> np.ndarray:
    """Draws the picture of a motion without its caption.

    Args:
        robot: The robot.
        scene: Its static obstacles.
        motion: The motion along which the arm is drawn.
        settings: Size and contents of the picture.
        camera: The camera; its size is ignored, that of `settings` counts. None: a view that shows most of
            the motion is chosen.
        others: Further motions for which only traces are drawn; all traces then have the colors COMPARED.
        added: Further solid surfaces in the base frame.
        clear: Further see-through surfaces in the base frame.
        moving: Obstacles that are solid at the pose at the start, and see-through at later poses.

    Returns:
        The picture, uint8 [height, width, 3].

    Raises:
        InputError: For motions of other joints, or with numbers that are not finite.
    """
    for item in (motion, *others):
        check_motion_of(robot, item)
    arm = DrawnArm(robot)
    obstacles = drawables(scene, moving)
    q = dense(motion.positions)
    ghosts = [(arm.posed(q[i], 1), i / (len(q) - 1)) for i in _earlier(len(q), settings.ghosts)]
    traces = [arm.trace(item.positions) for item in (motion, *others)]
    if camera is None:
        size = settings.width, settings.height
        camera = view_of_motion(arm, obstacles, q, size, MARGINS, settings.azimuth, traces[1:])
    large_camera = Camera(
        camera.eye, camera.target, SUPERSAMPLING * settings.width, SUPERSAMPLING * settings.height
    )
    colors = [(color, color) for color in COMPARED] if others else [(START, GOAL)]
    tubes = [tube(points, *ends) for points, ends in zip(traces, colors, strict=False)]
    see_through = []
    if isinstance(motion, Trajectory):
        times = np.linspace(0.0, motion.duration, settings.ghosts + 1)[1:]
        # drawn in reverse order, so that the first obstacle is drawn over the others
        for item in reversed([item for item in obstacles if item.moving is not None and item.moving.known]):
            see_through += [
                ClearSurface(item.surface_at(time), linear(item.color), MOVED_ALPHA) for time in times
            ]
    ghosts.sort(key=lambda ghost: -float(np.linalg.norm(ghost[0].vertices.mean(0) - large_camera.eye)))
    for ghost, share in ghosts:
        color = linear(START) * (1 - share) + linear(GOAL) * share
        see_through.append(ClearSurface(ghost, color, 0.50 if share == 0 else 0.26))
    if settings.shell:
        see_through.append(ClearSurface(_shell(arm, q[-1], settings.shell), linear(SHELL_COLOR), SHELL_ALPHA))
    solid = join([arm.posed(q[-1]), *(item.surface for item in obstacles), *tubes, *added])
    image = _paint(large_camera, solid, [*clear, *see_through])
    s = SUPERSAMPLING
    image = image.reshape(settings.height, s, settings.width, s, 3).mean(axis=(1, 3))
    return _to_srgb(image)


def _shell(arm: DrawnArm, q: Configuration, thickness: float) -> Surface:
    """The safety shell: the covering spheres of the arm at q, enlarged by a thickness [m]."""
    spheres = arm.robot.placed_spheres(q)
    return join([_ball(sphere[:3], sphere[3] + thickness, WHITE, 3) for sphere in spheres])


def _ball(center: Vector, radius: float, color: Color, subdivisions: int) -> Surface:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = np.array(ball.vertices)
    faces = np.asarray(ball.faces, np.int64)
    return Surface(center + radius * vertices, vertices, painted(color, len(vertices)), faces)


def _paint(camera: Camera, solid: Surface, clear: Sequence[ClearSurface]) -> Float[ndarray, "h w 3"]:
    """Linear colors of the picture: the solid surfaces, and over them the see-through surfaces in their
    order."""
    near, ident, screen = drawn_by(camera, solid)
    image = np.zeros((*near.shape, 3), np.float32)
    view = (camera.eye, camera.rays())
    height = float(solid.vertices[:, 2].min(initial=0.0))
    toward = _key_direction(camera)
    sky = _light_maps(solid, _cone(np.array([0.0, 0.0, 1.0]), np.pi / 2, SKY_LIGHTS), SKY_MAP)
    key = _light_maps(solid, _cone(toward, KEY_SPREAD, KEY_LIGHTS), KEY_MAP)
    visible_triangles = (ident, screen, solid.faces, solid.normals, _linear_array(solid.colors))
    shade(image, near, visible_triangles, view, height - 1e-4, sky, key)
    for surface in clear:
        nearness, *buffers = drawn_by(camera, surface.surface)
        arrays = surface.surface.faces, surface.surface.normals, _linear_array(surface.surface.colors)
        blend_ghost(image, near, nearness, (*buffers, *arrays), view, toward, surface.tint, surface.alpha)
    return image


def _key_direction(camera: Camera) -> Vector:
    back = -camera.rotation[2] * [1, 1, 0]
    back /= np.linalg.norm(back)
    toward = KEY_DIRECTION[0] * back + KEY_DIRECTION[1] * np.cross([0, 0, 1], back)
    toward[2] = KEY_DIRECTION[2]
    return toward / np.linalg.norm(toward)


def _cone(toward: Vector, radius: float, count: int) -> Points:
    """Evenly spread directions within an angle [rad] of a direction (Fibonacci lattice)."""
    i = np.arange(count)
    z = 1 - (i + 0.5) / count * (1 - np.cos(radius))
    angle = i * np.pi * (3 - np.sqrt(5))
    aside = np.sqrt(1 - z * z)
    return np.stack([aside * np.cos(angle), aside * np.sin(angle), z], axis=1) @ _axes(toward)


def _axes(toward: Vector) -> Rotation:
    """Right-handed axes, as rows, with the direction as the third axis."""
    right = np.cross([0.0, 1.0, 0.0] if abs(toward[1]) < 0.9 else [1.0, 0.0, 0.0], toward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(toward, right), toward])


def _light_maps(solid: Surface, toward: Points, size: int) -> tuple:
    """Orthographic shadow maps of all lights, in the layout of `rasterizer.shade`."""
    center = np.zeros(3)
    radius = 0.1
    if len(solid.vertices):
        low = solid.vertices.min(0).clip(-2.5, 2.5)
        high = solid.vertices.max(0).clip(-2.5, 2.5)
        center = 0.5 * (low + high)
        distances = np.linalg.norm(solid.vertices - center, axis=1)
        radius = max(radius, min(3.0, float(distances.max())))
    scale = 0.49 * size / radius
    axes = np.stack([_axes(d) for d in toward])
    maps = np.zeros((len(toward), size, size), np.float32)
    ident = np.zeros((size, size), np.int32)
    for k in range(len(toward)):
        x, y, z = ((solid.vertices - center) @ axes[k].T).T
        screen = np.stack(
            [scale * x + 0.5 * size, scale * y + 0.5 * size, z + 100.0], axis=1, dtype=np.float32
        )
        draw(maps[k], ident, screen, solid.faces)
    return maps, axes, scale, center


def tube(points: Points, first: Color, last: Color) -> Surface:
    """A round tube along a polyline, with spheres at both ends. Its color changes from `first` to `last`."""
    balls = [_ball(points[i], 2.2 * TUBE_RADIUS, color, 2) for i, color in ((0, first), (-1, last))]
    n = len(points)
    if n < 2:
        return join(balls)
    along = np.gradient(points, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    across = np.empty_like(points)
    previous = _axes(along[0])[0]
    for i in range(n):
        # parallel transport of the cross-section, so that the tube is not twisted or pinched in turns
        previous = previous - along[i] * (along[i] @ previous)
        previous = previous / max(float(np.linalg.norm(previous)), 1e-9)
        across[i] = previous
    angle = np.arange(TUBE_SIDES) * (2 * np.pi / TUBE_SIDES)
    normals = (
        np.cos(angle)[:, None] * across[:, None] + np.sin(angle)[:, None] * np.cross(along, across)[:, None]
    )
    t = np.linspace(0, 1, n)[:, None, None]
    colors = np.broadcast_to(((1 - t) * first + t * last) / 255.0, normals.shape)
    i = np.arange(n - 1)[:, None] * TUBE_SIDES
    j = np.arange(TUBE_SIDES)
    following = (j + 1) % TUBE_SIDES
    quad = [i + j, i + following, i + TUBE_SIDES + j, i + TUBE_SIDES + following]
    faces = np.concatenate([np.stack(quad[:3], -1).reshape(-1, 3), np.stack(quad[1:], -1).reshape(-1, 3)])
    vertices = points[:, None] + TUBE_RADIUS * normals
    pipe = Surface(vertices.reshape(-1, 3), normals.reshape(-1, 3), colors.reshape(-1, 3), faces)
    return join([pipe, *balls])


def linear(rgb: Color) -> Vector:
    """The linear color, in [0, 1], of an sRGB color."""
    return _linear_array(np.array(rgb) / 255.0)


def _linear_array(srgb: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n 3"]:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _to_srgb(image: Float[ndarray, "h w 3"]) -> np.ndarray:
    """Converts linear colors to sRGB bytes. Values above a knee are compressed smoothly instead of
    clipped."""
    knee = 0.75
    over = np.maximum(image - knee, 0)
    image = np.minimum(image, knee) + (1 - knee) * (1 - np.exp(-over / (1 - knee)))
    srgb = np.where(image <= 0.0031308, 12.92 * image, 1.055 * np.maximum(image, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(255 * srgb.clip(0, 1)).astype(np.uint8)


def faded_below(pixels: np.ndarray, begin: float = 0.84, most: float = 0.8) -> np.ndarray:
    """The picture, faded towards its lower edge so that the caption is readable.

    It begins to fade at the fraction `begin` of the height. `most` is the fraction by which it is faded at
    the edge.
    """
    rise = (np.linspace(0, 1, len(pixels)) - begin).clip(0, None)[:, None, None] / (1 - begin)
    cover = most * rise * rise * (3 - 2 * rise)
    return (pixels + cover * (np.array(CAPTION_COLOR) - pixels)).round().astype(np.uint8)


def caption(
    image: Image.Image,
    title: str,
    facts: Facts,
    colors: Sequence[Color] = (),
    enlarged: float = 1.0,
) -> None:
    """Draws a title, and facts as pairs of label and value, in the lower left corner. `colors` are those of
    the labels; without colors, labels are gray. `enlarged` is a factor on the size of the letters."""
    scale = enlarged * image.width / 1600
    pen = ImageDraw.Draw(image)
    title_font = ImageFont.load_default(max(8, 30 * scale))
    label_font = ImageFont.load_default(max(7, 19 * scale))
    pen_x = 44 * scale
    bottom = image.height - 40 * scale
    pen.text((pen_x, bottom - 30 * scale), title, fill=(0x22, 0x2B, 0x38), font=title_font, anchor="ls")
    for i, (label, value) in enumerate(facts):
        for text, fill, gap in (
            (label, colors[i] if colors else (0x8A, 0x93, 0xA0), 7),
            (value, (0x3A, 0x45, 0x54), 22),
        ):
            pen.text((pen_x, bottom), text, fill=fill, font=label_font, anchor="ls")
            pen_x += label_font.getlength(text) + gap * scale
