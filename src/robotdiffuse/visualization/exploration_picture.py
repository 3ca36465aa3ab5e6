"""Draws an exploration as a picture: its moments beside each other, each with what was known then."""

from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Bool
from numpy import ndarray
from PIL import Image

from robotdiffuse.core.output_files import check_output
from robotdiffuse.core.types import Path
from robotdiffuse.planning.exploration.recorded import RecordedExplorer
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.visualization import style
from robotdiffuse.visualization.camera import Camera, view_of_motion
from robotdiffuse.visualization.exploration import (
    LOOK_COLOR,
    UNKNOWN,
    Moment,
    frustum,
    in_known_scene,
    moments,
    shown_voxels,
    title,
)
from robotdiffuse.visualization.picture import (
    MARGINS,
    ClearSurface,
    PictureSettings,
    caption,
    faded_below,
    linear,
    render,
    save_png,
    tube,
)
from robotdiffuse.visualization.voxel_faces import faces_surface

MAX_MOMENTS = 6
TILE = PictureSettings(width=720, height=450, ghosts=2)
GAP = 6
"""Between moments [pixels]."""
GAP_COLOR = (0xFF, 0xFF, 0xFF)
UNKNOWN_ALPHA, PREDICTED_ALPHA = 0.27, 0.55
SHARE_COLORS = ((0x8A, 0x93, 0xA0), UNKNOWN)
"""Of the labels of the shares that were seen free, and unknown."""
CAPTION_SIZE = 1.7
FADE = (0.7, 0.95)
"""Where moments fade behind their caption, and how much; see `faded_below`."""
WHITE = (0xFF, 0xFF, 0xFF)


def write_exploration_picture(
    explorer: RecordedExplorer, scene: Scene, file: str | FilePath, settings: PictureSettings = TILE
) -> None:
    """Write the moments of an exploration as one .png: at most MAX_MOMENTS, the first and the last included.

    Each shows the arm's motion among what was known when it was chosen: voxels seen occupied (blue),
    predicted ones (violet), the boundary of unknown space (grey, see-through), and at the end of a look what
    the camera will see (a pyramid). scene: the true one, from which the view is chosen. settings: of each
    moment. Raises InputError for another ending or a file that cannot be written.
    """
    path = check_output(file, (".png",))
    found = moments(explorer)
    chosen = _chosen(len(found))
    whole = np.concatenate([moment.act.waypoints for moment in found])
    surfaces = style.robot_surfaces(explorer.robot)
    tool = style.tool_point(explorer.robot, surfaces)
    size = settings.width, settings.height
    camera = view_of_motion(explorer.robot, scene, surfaces, tool, whole, *size, MARGINS)
    known = in_known_scene(explorer)
    tiles = [_tile(explorer, found[i], known, camera, settings) for i in chosen]
    save_png(_joined(tiles), path)


def _chosen(count: int) -> list[int]:
    """The first moment, the last two, and others between them."""
    if count <= MAX_MOMENTS:
        return list(range(count))
    return [*np.linspace(0, count - 3, MAX_MOMENTS - 2).round().astype(int), count - 2, count - 1]


def _tile(
    explorer: RecordedExplorer,
    moment: Moment,
    known: Bool[ndarray, "nx ny nz"],
    camera: Camera,
    settings: PictureSettings,
) -> Image.Image:
    robot, act = explorer.robot, moment.act
    shown = shown_voxels(moment.known, act, known)
    occupied = faces_surface(shown.occupied, ~shown.occupied, style.OBSERVED)
    predicted = faces_surface(shown.predicted, ~shown.predicted, WHITE)
    unknown = faces_surface(shown.unknown, shown.free, WHITE)
    clear = [
        ClearSurface(unknown, linear(UNKNOWN), UNKNOWN_ALPHA),
        ClearSurface(predicted, linear(style.ASSUMED), PREDICTED_ALPHA),
    ]
    look = [tube(edge, LOOK_COLOR, LOOK_COLOR) for edge in frustum(explorer, act)]
    motion = act.trajectory or Path(robot.joint_names, act.waypoints)
    pixels, _ = render(robot, explorer.scene, motion, settings, camera, added=(occupied, *look), clear=clear)
    image = Image.fromarray(faded_below(pixels, *FADE))
    drawn = {
        "occupied": style.OBSERVED,
        **({} if act.predicted is None else {"predicted": style.ASSUMED}),
        **({"next look": LOOK_COLOR} if look else {}),
    }
    facts = [*moment.shares, *((name, "") for name in drawn)]
    colors = (*SHARE_COLORS, *drawn.values())
    caption(image, f"{moment.number}  {title(moment.act)}", facts, colors, CAPTION_SIZE)
    return image


def _joined(tiles: list[Image.Image]) -> Image.Image:
    """The pictures in rows of two or three."""
    columns = min(len(tiles), 3 if len(tiles) > 4 else 2)
    rows = -(-len(tiles) // columns)
    width, height = tiles[0].width + GAP, tiles[0].height + GAP
    sheet = Image.new("RGB", (columns * width - GAP, rows * height - GAP), GAP_COLOR)
    for i, tile in enumerate(tiles):
        sheet.paste(tile, (i % columns * width, i // columns * height))
    return sheet
