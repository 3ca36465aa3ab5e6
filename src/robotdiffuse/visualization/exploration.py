"""Pictures and pages of an exploration: what was known about the scene over time, and the steps of the arm.

A step of the kind `look` moves the arm to take a view with its camera.
"""

from collections import Counter
from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Int
from numpy import ndarray
from PIL import Image

from robotdiffuse.core.files import JsonObject, check_output, write_atomically
from robotdiffuse.core.transforms import placed
from robotdiffuse.core.types import Mask, Path, Points, Trajectory
from robotdiffuse.drawables import ASSUMED, OBSERVED, Color, Surface, drawables, painted
from robotdiffuse.perception.seen_points import near_scene
from robotdiffuse.perception.voxel_grid import MAP, Voxels
from robotdiffuse.planning.exploration.simulated import RecordedExplorer, RecordedStep, RecordedView
from robotdiffuse.planning.exploration.steps import DONE, LOOK
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.visualization.picture import (
    MARGINS,
    WHITE,
    Camera,
    ClearSurface,
    DrawnArm,
    Facts,
    PictureSettings,
    caption,
    faded_below,
    linear,
    render,
    save_png,
    tube,
    view_of_motion,
)
from robotdiffuse.visualization.replay_page import in_base64, page_data, page_shapes, page_text

LIKELY = 0.5
"""Voxels of unknown space with a larger predicted probability of being occupied are shown as predicted."""
UNKNOWN = (0x6E, 0x7B, 0x8C)
"""sRGB color of the boundary of unknown space."""
LOOK_COLOR = (0xD9, 0x8A, 0x12)
"""sRGB color of the camera's view pyramid at a viewpoint."""
FRUSTUM_DEPTH = 0.25
"""Height of the view pyramid [m]."""
READING_TIME = 1.5
"""Pause before each step on pages, so that the reason of the step can be read [s]."""
MAX_MOMENTS = 6
"""Largest number of moments in a picture."""
TILE = PictureSettings(width=720, height=450, ghosts=2)
"""Size and contents of the picture of one moment."""
GAP = 6
"""White space between the pictures of two moments [pixels]."""
UNKNOWN_ALPHA = 0.27
PREDICTED_ALPHA = 0.55
SHARE_COLORS = ((0x8A, 0x93, 0xA0), UNKNOWN)
"""Colors of the labels "seen free" and "unknown"."""
CAPTION_SIZE = 1.7
"""Factor on the size of a caption's letters."""
FADE = (0.7, 0.95)
"""Where pictures of moments fade behind their caption, and how much; arguments of `faded_below`."""
LAYERS = (
    {"name": "Occupied", "color": OBSERVED, "opacity": 1.0, "order": 0},
    {"name": "Predicted", "color": ASSUMED, "opacity": 0.6, "order": 1},
    {"name": "Unknown", "color": UNKNOWN, "opacity": 0.28, "order": 20},
)
"""Layers of voxels on the page; `order` is the order in which see-through layers are drawn."""


def shares(known: RecordedView) -> Facts:
    """Labels and values of two fractions of the map: seen free, and unknown."""
    parts = (("seen free", known.free), ("unknown", known.unknown))
    return [(name, f"{100 * voxels.mean():.0f} %") for name, voxels in parts]


def views_of(explorer: RecordedExplorer, index: int) -> list[RecordedView]:
    """What was known about the scene when the step with this index was chosen (the last view before the
    step), and then during its motion (the views that were taken)."""
    before = [view for view in explorer.views if view.step_index < index]
    during = [view for view in explorer.views if view.step_index == index]
    return [before[-1], *during]


def title(record: RecordedStep) -> str:
    """The name of a step, with the duration of its motion."""
    step = record.step
    duration = record.duration
    name = {DONE: "at the goal"}.get(step.kind, step.kind)
    return f"{name} ({duration:.1f} s)" if duration else name


def shown_voxels(
    view: RecordedView, record: RecordedStep | None, in_known_scene: Voxels
) -> tuple[tuple[Voxels, Voxels], ...]:
    """The layers to show after a view: occupied, predicted (unknown, and probably occupied) and unknown
    voxels.

    A layer is a pair of voxel sets, inside and outside; the faces between both sets are shown. The prediction
    is that of `record`; without a record there is none. Voxels in the scene that is known without views are
    left out.
    """
    occupied = view.occupied & ~in_known_scene
    unknown = view.unknown & ~in_known_scene
    probability = None if record is None else record.predicted
    predicted = np.zeros_like(unknown) if probability is None else unknown & (probability > LIKELY)
    return (occupied, ~occupied), (predicted, ~predicted), (unknown, view.free)


def in_known_scene(explorer: RecordedExplorer) -> Voxels:
    """The voxels in or near obstacles that are known without views."""
    return near_scene(explorer.robot, explorer.scene, MAP.all_centers, MAP.edge).reshape(MAP.shape)


def frustum(explorer: RecordedExplorer, record: RecordedStep) -> list[Points]:
    """The edges of the view pyramid of the arm's first camera at a viewpoint, as polylines in the base
    frame [m]; an empty list for other steps."""
    if record.T_base_camera is None:
        return []
    camera = explorer.cameras[0]
    fx, fy, cx, cy = camera.intrinsics
    width, height = camera.size
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)], float)
    in_camera = np.column_stack([(corners - (cx, cy)) / (fx, fy), np.ones(4)]) * FRUSTUM_DEPTH
    T = record.T_base_camera
    rim = placed(T, in_camera)
    return [np.stack([T[:3, 3], corner]) for corner in rim] + [np.concatenate([rim, rim[:1]])]


def faces_between(inside: Voxels, outside: Voxels) -> tuple[Int[ndarray, "n"], Mask]:
    """The numbers of all faces between a voxel of the set `inside` and a voxel of the set `outside`, in
    ascending order, and whether the voxel inside comes first along the axis.

    The number of a face is axis · (number of voxels) + the flat index of the voxel before the face along the
    axis.
    """
    numbers = []
    first = []
    for axis in range(3):
        before = [slice(None)] * 3
        after = [slice(None)] * 3
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        forward = np.zeros(inside.shape, np.bool_)
        backward = forward.copy()
        forward[tuple(before)] = inside[tuple(before)] & outside[tuple(after)]
        backward[tuple(before)] = outside[tuple(before)] & inside[tuple(after)]
        faces = np.flatnonzero(forward | backward)
        numbers.append(faces + axis * inside.size)
        first.append(forward.reshape(-1)[faces])
    return np.concatenate(numbers), np.concatenate(first)


def faces_surface(inside: Voxels, outside: Voxels, color: Color) -> Surface:
    """The faces between two sets of voxels of the map, as a surface in the base frame. Normals point out of
    the set `inside`, and corners are counterclockwise when seen from outside it."""
    numbers, first = faces_between(inside, outside)
    axis, flat = np.divmod(numbers, inside.size)
    at = np.stack(np.unravel_index(flat, inside.shape), axis=1)
    along, across, up = (np.eye(3)[(axis + k) % 3] for k in range(3))
    corner = at + along
    vertices = np.stack([corner, corner + across, corner + across + up, corner + up], axis=1)
    normals = np.where(first[:, None], along, -along)
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    corner_orders = np.where(first[:, None, None], triangles, triangles[:, ::-1])
    faces = (4 * np.arange(len(numbers))[:, None, None] + corner_orders).reshape(-1, 3)
    vertices = vertices.reshape(-1, 3) * MAP.edge + MAP.low
    return Surface(vertices, normals.repeat(4, axis=0), painted(color, len(vertices)), faces)


def write_exploration_picture(explorer: RecordedExplorer, scene: Scene, file: str | FilePath) -> None:
    """Write up to MAX_MOMENTS moments of an exploration as one .png, including the first and the last two.

    The picture of a moment shows the arm's motion and what was known when it was chosen: voxels seen occupied
    (blue), predicted voxels (violet), the boundary of unknown space (gray, see-through), and for the kind
    `look` the camera's view pyramid at the end of the motion. `scene` is the true scene, used only to choose
    the view. Raises InputError for a file name with another ending, or a file that cannot be written.
    """
    path = check_output(file, (".png",))
    chosen = _chosen(len(explorer.steps))
    waypoints = np.concatenate([record.waypoints for record in explorer.steps])
    size = TILE.width, TILE.height
    camera = view_of_motion(DrawnArm(explorer.robot), drawables(scene), waypoints, size, MARGINS)
    in_scene = in_known_scene(explorer)
    save_png(_joined([_tile(explorer, i, in_scene, camera) for i in chosen]), path)


def _chosen(count: int) -> list[int]:
    """Indices of the moments to show: all, or the first one, the last two, and evenly spaced ones in
    between."""
    if count <= MAX_MOMENTS:
        return list(range(count))
    return [*np.linspace(0, count - 3, MAX_MOMENTS - 2).round().astype(int), count - 2, count - 1]


def _tile(explorer: RecordedExplorer, index: int, in_scene: Voxels, camera: Camera) -> Image.Image:
    robot = explorer.robot
    record = explorer.steps[index]
    known = views_of(explorer, index)[0]
    layers = shown_voxels(known, record, in_scene)
    occupied, predicted, unknown = (
        faces_surface(*pair, color) for pair, color in zip(layers, (OBSERVED, WHITE, WHITE), strict=True)
    )
    clear = [
        ClearSurface(unknown, linear(UNKNOWN), UNKNOWN_ALPHA),
        ClearSurface(predicted, linear(ASSUMED), PREDICTED_ALPHA),
    ]
    look = [tube(edge, LOOK_COLOR, LOOK_COLOR) for edge in frustum(explorer, record)]
    motion = record.trajectory or Path(robot.joint_names, record.waypoints)
    pixels = render(robot, explorer.scene, motion, TILE, camera, added=(occupied, *look), clear=clear)
    image = Image.fromarray(faded_below(pixels, *FADE))
    legend = {
        "occupied": OBSERVED,
        **({} if record.predicted is None else {"predicted": ASSUMED}),
        **({"next look": LOOK_COLOR} if look else {}),
    }
    facts = [*shares(known), *((name, "") for name in legend)]
    colors = (*SHARE_COLORS, *legend.values())
    caption(image, f"{index + 1}  {title(record)}", facts, colors, CAPTION_SIZE)
    return image


def _joined(tiles: list[Image.Image]) -> Image.Image:
    """One image with the pictures in rows of two or three."""
    columns = min(len(tiles), 3 if len(tiles) > 4 else 2)
    rows = -(-len(tiles) // columns)
    width = tiles[0].width + GAP
    height = tiles[0].height + GAP
    sheet = Image.new("RGB", (columns * width - GAP, rows * height - GAP), WHITE)
    for i, tile in enumerate(tiles):
        sheet.paste(tile, (i % columns * width, i // columns * height))
    return sheet


def write_exploration(explorer: RecordedExplorer, scene: Scene, file: str | FilePath) -> None:
    """Write an exploration as a self-contained .html file, which shows what was known after each view.

    `scene` is the true scene, which the page can show too. Raises InputError for a file name with another
    ending, or a file that cannot be written.
    """
    target = check_output(file, (".html", ".htm"))
    robot = explorer.robot
    data = page_data(robot, scene, _whole_motion(explorer))
    data["exploration"] = {
        "shape": MAP.shape,
        "low": MAP.low,
        "edge": MAP.edge,
        "layers": LAYERS,
        "look_color": LOOK_COLOR,
        "known": _known(explorer),
        "steps": [_step(explorer, index) for index in range(len(explorer.steps))],
        "true_scene": data["scene"],
    }
    data["scene"] = page_shapes(explorer.scene)
    last = explorer.steps[-1].step
    kinds = Counter(record.step.kind for record in explorer.steps)
    data["facts"] = [
        ("status", "solved" if last.kind == DONE else last.kind),
        ("policy", explorer.settings.policy.replace("_", " ")),
        ("views by motions", str(kinds[LOOK])),
        ("images", str(len(explorer.views))),
        ("time in motion", f"{explorer.duration:.1f} s"),
    ]
    write_atomically(target, page_text(f"{robot.name} · exploration", data, "exploration.js"))


def _page_time(time: float, index: int) -> float:
    """The time on the page of a `time` during the motion of the step with this index [s]. On the page, a
    pause comes before each motion. The pause of step i begins at `_page_time(begins, i - 1)`, where `begins`
    is the time at which the step begins."""
    return round(time + READING_TIME * (index + 1), 4)


def _whole_motion(explorer: RecordedExplorer) -> Trajectory:
    """The motions of all steps as one trajectory, with the pauses between them."""
    times = []
    positions = []
    for index, record in enumerate(explorer.steps):
        times.append(np.array([_page_time(record.begins, index - 1)]))
        positions.append(record.configuration[None])
        if record.trajectory is not None:
            times.append(_page_time(record.begins, index) + record.trajectory.times)
            positions.append(record.trajectory.positions)
    q = np.concatenate(positions)
    return Trajectory(explorer.robot.joint_names, np.concatenate(times), q, 0 * q, 0 * q)


def _known(explorer: RecordedExplorer) -> list[JsonObject]:
    """For each view and each step: the time on the page, and for each layer the faces that appear or
    disappear."""
    known_scene = in_known_scene(explorer)
    before = [np.zeros(0, np.int64) for _ in LAYERS]
    states = []
    for index, record in enumerate(explorer.steps):
        for i, view in enumerate(views_of(explorer, index)):
            time = _page_time(view.time, index) if i else _page_time(record.begins, index - 1)
            layers = shown_voxels(view, record, known_scene)
            after = [faces_between(*pair)[0] for pair in layers]
            changed = [np.setxor1d(a, b) for a, b in zip(before, after, strict=True)]
            states.append({"time": time, "layers": [_packed(faces) for faces in changed]})
            before = after
    return states


def _packed(numbers: Int[ndarray, "n"]) -> str:
    """Ascending numbers in base64. The difference of each number to the one before is stored in bytes of 7
    bits, lowest bits first; the 8th bit is set in all but the last byte of a difference."""
    steps = np.diff(numbers, prepend=0)
    groups = np.stack([steps >> shift & 127 for shift in (0, 7, 14, 21)], axis=1)
    used = np.stack([np.ones(len(steps), bool), *(steps >= 1 << shift for shift in (7, 14, 21))], axis=1)
    marked = np.concatenate([used[:, 1:], np.zeros((len(steps), 1), bool)], axis=1)
    return in_base64((groups + 128 * marked)[used].astype(np.uint8))


def _step(explorer: RecordedExplorer, index: int) -> JsonObject:
    record = explorer.steps[index]
    moves = record.step.kind == LOOK and record.step.motion is not None
    end = record.waypoints[-1] if moves else None
    return {
        "time": _page_time(record.begins, index - 1),
        "title": f"{index + 1}  {title(record)}",
        "reason": record.step.reason,
        "known": ", ".join(f"{value} {name}" for name, value in shares(views_of(explorer, index)[0])),
        "look": [np.round(edge, 4).tolist() for edge in frustum(explorer, record)],
        "end": None if end is None else np.round(end, 5).tolist(),
    }
