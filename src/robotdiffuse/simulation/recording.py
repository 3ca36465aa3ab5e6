"""Pictures (.png) and films (.gif) of a replay, rendered by PyBullet in software."""

from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Annotated

import numpy as np
import pybullet
from jaxtyping import Float, UInt8
from numpy import ndarray

from robotdiffuse.core.output_files import write_atomically
from robotdiffuse.core.settings import Bound, Settings
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.simulation.camera import DepthCamera, Light, RawImage, capture, render
from robotdiffuse.simulation.replay import Replay
from robotdiffuse.simulation.world import World

LIGHT = Light(direction=(0.5, -0.7, 1.6), ambient=0.62, diffuse=0.42, specular=0.04)
FLOOR_COLORS = ((0xF0, 0xF1, 0xF3), (0xE4, 0xE6, 0xEA))
TILE_SIZE = 0.25
"""Edge length of a floor tile [m]."""
GHOST_OPACITY = 0.4
"""Opacity of ghosts in a picture."""
AZIMUTHS = np.radians(np.arange(-60, 300, 45))
"""Candidate camera directions [rad]; the one that shows most of the arm is used."""
ELEVATION = 0.42
"""Camera elevation [rad]."""
SHOWN_DISTANCE = 0.4
"""The picture shows obstacles up to this distance from a box around the arm [m]."""
FRAME_MARGIN = 1.03
"""Factor on the camera distance at which everything just fits."""
FLOOR_GAP = 0.002
"""Gap between the floor and the lowest object [m]."""
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
PICTURE_TIMES = (0.0, 0.33, 0.67, 1.0)
"""Times of the poses in a picture, as fractions of the duration; the last pose is drawn solid."""


@dataclass(frozen=True)
class FilmSettings(Settings, name="film"):
    """Size and quality of pictures and films."""

    width: Annotated[int, Bound(least=16.0, most=1920.0)] = 640
    """[pixels]"""
    height: Annotated[int, Bound(least=16.0, most=1080.0)] = 480
    """[pixels]"""
    oversampling: Annotated[int, Bound(least=1.0, most=4.0)] = 2
    """Rendered pixels per pixel of the picture along each side, against jagged edges."""
    rate: Annotated[float, Bound(least=1.0, most=50.0)] = 20.0
    """Frame rate of a film [1/s]; films run in real time."""
    max_frames: Annotated[int, Bound(least=2.0, most=1000.0)] = 150
    """Most frames of a film; longer films get a lower frame rate."""
    colors: Annotated[int, Bound(least=2.0, most=256.0)] = 128
    """Colours of a film's palette."""
    field_of_view: Annotated[float, Bound(least=0.05, most=2.0)] = 0.6
    """Vertical angle [rad]."""


DEFAULT = FilmSettings()


GROUND_HEIGHT = 0.02
"""Obstacles that rise at most this far above the arm's lowest point count as ground [m]."""


def write_png(
    robot: Robot, scene: Scene, run: Replay, file: str | Path, settings: FilmSettings = DEFAULT
) -> None:
    """Write a picture of the arm at the end of the replay, with earlier poses as ghosts.

    Raises InputError if the file cannot be written.
    """
    from PIL import Image

    with World(robot, scene, visuals=True, moving=run.moving) as world:
        camera = _prepare(world, run, settings)
        *ghosts, picture = [_shot(world, run, share, camera) for share in PICTURE_TIMES]
    pixels, nearest = picture.rgb.astype(np.float64), picture.depth
    for ghost in reversed(ghosts):
        over = (ghost.bodies == world.body) & (ghost.depth < nearest)
        pixels[over] = GHOST_OPACITY * ghost.rgb[over] + (1 - GHOST_OPACITY) * pixels[over]
        nearest = np.where(over, ghost.depth, nearest)
    content = BytesIO()
    Image.fromarray(_reduced(pixels, settings.oversampling)).save(content, "PNG")
    write_atomically(Path(file), content.getvalue())


def write_gif(
    robot: Robot, scene: Scene, run: Replay, file: str | Path, settings: FilmSettings = DEFAULT
) -> None:
    """Write a film of the replay in real time, which stops for a second at its end and repeats.

    Raises InputError if the file cannot be written.
    """
    from PIL import Image

    duration = float(run.times[-1])
    # GIF delays are in hundredths of a second
    delay = max(round(100 / settings.rate), int(np.ceil(100 * duration / (settings.max_frames - 1))))
    shares = np.append(np.arange(0, 100 * duration, delay) / (100 * duration), 1.0)
    with World(robot, scene, visuals=True, moving=run.moving) as world:
        camera = _prepare(world, run, settings)
        shots = [
            Image.fromarray(_reduced(_shot(world, run, share, camera).rgb, settings.oversampling))
            for share in shares
        ]
    strip = Image.fromarray(np.concatenate([np.asarray(shots[i]) for i in (0, len(shots) // 2, -1)]))
    palette = strip.quantize(settings.colors, method=Image.Quantize.MEDIANCUT)
    frames = [shot.quantize(palette=palette, dither=Image.Dither.NONE) for shot in shots]
    durations = [10 * delay] * (len(frames) - 1) + [1000]
    content = BytesIO()
    frames[0].save(content, "GIF", save_all=True, append_images=frames[1:], duration=durations, loop=0)
    write_atomically(Path(file), content.getvalue())


def _at(run: Replay, shares: "Float[ndarray, 'n'] | tuple[float, ...]") -> Float[ndarray, "n dof"]:
    """The simulated configurations at fractions of the duration."""
    return run.positions[np.rint(np.multiply(shares, len(run.times) - 1)).astype(np.int64)]


def _shot(world: World, run: Replay, share: float, camera: DepthCamera) -> RawImage:
    """The image at a fraction of the duration."""
    world.place(_at(run, (share,))[0])
    world.move(share * float(run.times[-1]))
    return capture(world, camera, LIGHT)


def _reduced(pixels: ndarray, factor: int) -> UInt8[ndarray, "h w 3"]:
    """The mean of each block of pixels."""
    h, w = pixels.shape[0] // factor, pixels.shape[1] // factor
    blocks = pixels.reshape(h, factor, w, factor, 3).astype(np.float64)
    return np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)


def _prepare(world: World, run: Replay, settings: FilmSettings) -> DepthCamera:
    """Add a floor, and choose the camera that shows most of the arm."""
    poses = _at(run, PICTURE_TIMES)
    low, high = _extent(world, poses)
    _add_floor(world, low, high)
    cameras = [_camera(low, high, azimuth, settings) for azimuth in AZIMUTHS]
    seen = [sum(_visible(world, q, camera) for q in poses) for camera in cameras]
    return cameras[int(np.argmax(seen))]


def _camera(
    low: Float[ndarray, "3"], high: Float[ndarray, "3"], azimuth: float, settings: FilmSettings
) -> DepthCamera:
    """A camera in this direction, as close as the box fits into the image."""
    flat = np.cos(ELEVATION)
    sight = np.array([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(ELEVATION)])
    middle = (low + high) / 2
    slope = np.tan(settings.field_of_view / 2)
    camera = DepthCamera(
        _point(middle + sight),
        _point(middle),
        width=settings.width * settings.oversampling,
        height=settings.height * settings.oversampling,
        field_of_view=settings.field_of_view,
    )
    corners = (CORNERS * (high - low) / 2) @ camera.rotation
    wide = slope * np.array([settings.width / settings.height, 1.0])
    distance = FRAME_MARGIN * float((np.abs(corners[:, :2]) / wide - corners[:, 2:]).max())
    place = _point(middle + distance * sight)
    return replace(camera, position=place, near=0.02 * distance, far=20 * distance)


def _point(xyz: Float[ndarray, "3"]) -> tuple[float, float, float]:
    return float(xyz[0]), float(xyz[1]), float(xyz[2])


def _visible(world: World, q: Float[ndarray, "dof"], camera: DepthCamera) -> int:
    """Number of pixels of a small image that show the arm."""
    world.place(q)
    small = replace(camera, width=120, height=round(120 * camera.height / camera.width))
    return int((render(world, small).labels == 0).sum())


def _extent(world: World, poses: Float[ndarray, "n dof"]) -> tuple[Float[ndarray, "3"], Float[ndarray, "3"]]:
    """Corners of a box around the arm in these poses and the nearby parts of obstacles [m]."""
    boxes = []
    for q in poses:
        world.place(q)
        pybullet.performCollisionDetection(physicsClientId=world.client)
        boxes += [
            pybullet.getAABB(world.body, world.links[link], physicsClientId=world.client)
            for link, meshes in world.robot.meshes.items()
            if meshes
        ]
    low, high = np.min(boxes, axis=(0, 1)), np.max(boxes, axis=(0, 1))
    wide, foot = (low - SHOWN_DISTANCE, high + SHOWN_DISTANCE), low[2]
    for body in world.obstacles.values():
        bounds = np.array(pybullet.getAABB(body, physicsClientId=world.client))
        if bounds[1, 2] <= foot + GROUND_HEIGHT:
            continue  # the ground need not fit into the image
        box = np.clip(bounds, *wide)
        low, high = np.minimum(low, box[0]), np.maximum(high, box[1])
    return low, high


def _add_floor(world: World, low: Float[ndarray, "3"], high: Float[ndarray, "3"]) -> None:
    """Add a floor of tiles in two greys, without collision."""
    middle, radius = (low + high) / 2, TILE_SIZE + float((high - low)[:2].max()) / 2
    count = int(np.ceil(radius / TILE_SIZE))
    cells = np.stack(np.meshgrid(*[np.arange(-count, count)] * 2), axis=-1).reshape(-1, 2)
    cells = cells[np.linalg.norm(cells + 0.5, axis=1) * TILE_SIZE < radius]
    for parity, color in enumerate(FLOOR_COLORS):
        corners = cells[cells.sum(axis=1) % 2 == parity][:, None] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        vertices = np.pad(corners.reshape(-1, 2) * TILE_SIZE, ((0, 0), (0, 1)))
        faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(corners))[:, None, None]
        xyz = np.array([*middle[:2], low[2] - FLOOR_GAP])
        world.add_surface(vertices, faces.reshape(-1, 3), color, xyz)
