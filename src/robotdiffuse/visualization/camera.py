"""Camera placement: the view that shows most of the arm and its trace, framed tightly."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import ConvexHull

from robotdiffuse.core.types import Configurations, Points, Rotation, Vector
from robotdiffuse.drawables import Drawable, Surface, join
from robotdiffuse.visualization.arm import TRACE_POINTS, DrawnArm, dense
from robotdiffuse.visualization.rasterizer import draw

AZIMUTHS = 18
ELEVATIONS = np.radians((15.0, 25.0))
"""Candidate views: number of azimuths, and elevations [rad]."""
VERTICAL_FIELD = np.radians(28)
"""Vertical field of view [rad]."""
MAX_FRAMING_DISTANCE = 1.3
"""Obstacles are framed up to this distance from the middle of the arm [m]."""


@dataclass(frozen=True, eq=False)
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
        """R_camera_base: right, down, forward."""
        forward = (self.target - self.eye) / np.linalg.norm(self.target - self.eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    def project(self, points: Points) -> Points:
        """Pixel x and y, and 1 / depth (0 behind the camera)."""
        x, y, z = ((points - self.eye) @ self.rotation.T).T
        near = np.where(z > 0.05, 1 / np.maximum(z, 0.05), 0.0)
        columns = [0.5 * self.width + self.focal * x * near, 0.5 * self.height + self.focal * y * near, near]
        return np.stack(columns, axis=1).astype(np.float32)

    def rays(self) -> Rotation:
        """Matrix from (x, y, 1) in pixels to the direction in the base frame with depth 1."""
        f = self.focal
        pixel = np.array([[1 / f, 0, -0.5 * self.width / f], [0, 1 / f, -0.5 * self.height / f], [0, 0, 1]])
        return self.rotation.T @ pixel


def drawn_by(
    camera: Camera, surface: Surface
) -> tuple[Float[ndarray, "h w"], Int[ndarray, "h w"], Float[ndarray, "v 3"]]:
    """Nearness and face at each pixel, and the vertices on the screen; see `rasterizer.draw`."""
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
    """A camera in the direction `toward`, as close as all points fit.

    size: width and height [pixels]. free: fractions of the height to leave free above and below.
    """
    target = 0.5 * (points.min(0) + points.max(0))
    distance = 1.0
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
        off = 0.5 * np.array([u.min() + u.max(), v.min() + v.max() - top - bottom])
        target = target + distance * rotation[:2].T @ off
    return Camera(target + distance * toward, target, *size)


def best_view(
    arm: Surface,
    ghosts: Surface,
    trace: Points,
    obstacles: Surface,
    size: tuple[int, int],
    free: tuple[float, float],
    azimuth: float | None = None,
) -> Camera:
    """The framed view, of AZIMUTHS x ELEVATIONS, that shows most of the arm and its trace.

    azimuth: the only one to look from, from the x axis of the base [rad]; None: the best.
    """
    moving = np.concatenate([arm.vertices, ghosts.vertices, trace])
    middle = 0.5 * (moving.min(0) + moving.max(0))
    near = np.linalg.norm(obstacles.vertices - middle, axis=1) < MAX_FRAMING_DISTANCE
    points = np.concatenate([moving, obstacles.vertices[near]])
    points = points[ConvexHull(points, qhull_options="QJ").vertices]
    thumbnail_size = (160, max(1, 160 * size[1] // size[0]))
    best = _direction(0.0, ELEVATIONS[0])
    best_score = -1.0
    around = np.arange(AZIMUTHS) * (2 * np.pi / AZIMUTHS) if azimuth is None else np.array([azimuth])
    for elevation in ELEVATIONS:
        for angle in around:
            camera = framed(points, _direction(angle, elevation), thumbnail_size, free)
            score = _score(camera, arm, ghosts, trace, obstacles)
            if score > best_score:
                best = _direction(angle, elevation)
                best_score = score
    return framed(points, best, size, free)


def view_of_motion(
    arm: DrawnArm,
    obstacles: Sequence[Drawable],
    q: Configurations,
    size: tuple[int, int],
    free: tuple[float, float],
) -> Camera:
    """The best view of a motion among obstacles."""
    q = dense(q, TRACE_POINTS)
    ghosts = join([arm.posed(row) for row in (q[0], q[len(q) // 2])])
    surfaces = join([one.surface for one in obstacles])
    return best_view(arm.posed(q[-1]), ghosts, arm.tool_points(q), surfaces, size, free)


def _score(camera: Camera, arm: Surface, ghosts: Surface, trace: Points, obstacles: Surface) -> float:
    """Visible fraction of the arm, plus half that of the ghosts, plus the visible length of the trace."""
    hidden, _, _ = drawn_by(camera, obstacles)
    score = 0.0
    for part, weight in ((arm, 1.0), (ghosts, 0.5)):
        nearness, _, _ = drawn_by(camera, part)
        score += weight * float((nearness > hidden).sum() / max(1, (nearness > 0).sum()))
    pixels = camera.project(trace)
    column = pixels[:, 0].astype(int)
    row = pixels[:, 1].astype(int)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    column = column.clip(0, camera.width - 1)
    row = row.clip(0, camera.height - 1)
    seen = inside & (pixels[:, 2] > hidden[row, column])
    steps = np.linalg.norm(np.diff(pixels[:, :2], axis=0), axis=1)
    return score + float(steps[seen[1:]].sum()) / camera.height
