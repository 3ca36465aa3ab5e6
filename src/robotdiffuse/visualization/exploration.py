"""What a picture and a page of an exploration show: its moments, and the voxels known at each."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_scene_for
from robotdiffuse.perception.occupancy_map import MAP
from robotdiffuse.perception.seen_points_kernel import near_scene
from robotdiffuse.planning.exploration.recorded import RecordedAct, RecordedExplorer, RecordedView
from robotdiffuse.planning.exploration.steps import DONE

LIKELY = 0.5
"""Voxels of unknown space that are occupied with a larger probability are shown as predicted."""
UNKNOWN = (0x6E, 0x7B, 0x8C)
"""sRGB colour of the boundary of unknown space."""
LOOK_COLOR = (0xD9, 0x8A, 0x12)
"""sRGB colour of the pyramid that shows where a camera looks."""
FRUSTUM_DEPTH = 0.25
"""Length of the pyramid that shows where a camera looks [m]."""
READING_TIME = 1.5
"""Pages rest before each step, for its reason to be read [s]."""
Voxels = Bool[ndarray, "nx ny nz"]


@dataclass(frozen=True, eq=False)
class Moment:
    """An act, and what was known when it was chosen."""

    number: int
    """From 1 on."""
    act: RecordedAct
    known: RecordedView

    @property
    def shares(self) -> list[tuple[str, str]]:
        """Labels and values of what was known."""
        parts = (("seen free", self.known.free), ("unknown", self.known.unknown))
        return [(name, f"{100 * voxels.mean():.0f} %") for name, voxels in parts]


def moments(explorer: RecordedExplorer) -> list[Moment]:
    """All acts for which something was known, in order."""
    found = []
    for number, act in enumerate(explorer.acts):
        before = [view for view in explorer.views if view.act < number]
        if before:
            found.append(Moment(number + 1, act, before[-1]))
    return found


def title(act: RecordedAct) -> str:
    """What the arm does in an act."""
    step, duration = act.step, act.duration
    name = {DONE: "at the goal"}.get(step.kind, step.kind)
    return f"{name} ({duration:.1f} s)" if duration else name


@dataclass(frozen=True, eq=False)
class ShownVoxels:
    """Sets of voxels that are shown, without those in the scene that is known anyway."""

    occupied: Bool[ndarray, "nx ny nz"]
    predicted: Bool[ndarray, "nx ny nz"]
    """Unknown, and probably occupied."""
    unknown: Bool[ndarray, "nx ny nz"]
    free: Bool[ndarray, "nx ny nz"]

    @property
    def layers(self) -> tuple[tuple[Voxels, Voxels], ...]:
        """The voxels inside and outside of the occupied, predicted and unknown layer; the faces between
        them are shown."""
        return (
            (self.occupied, ~self.occupied),
            (self.predicted, ~self.predicted),
            (self.unknown, self.free),
        )


def shown_voxels(
    view: RecordedView, act: RecordedAct | None, in_known_scene: Bool[ndarray, "nx ny nz"]
) -> ShownVoxels:
    """What is shown after a view, with the prediction of an act."""
    unknown = view.unknown & ~in_known_scene
    probability = None if act is None else act.predicted
    predicted = np.zeros_like(unknown) if probability is None else unknown & (probability > LIKELY)
    return ShownVoxels(view.occupied & ~in_known_scene, predicted, unknown, view.free)


def in_known_scene(explorer: RecordedExplorer) -> Bool[ndarray, "nx ny nz"]:
    """The voxels at or in the scene that is known without views."""
    if not explorer.scene.shapes:
        return np.zeros(MAP.shape, np.bool_)
    centers = MAP.centers(np.indices(MAP.shape).reshape(3, -1).T)
    scene = compile_scene_for(explorer.robot, explorer.scene)
    near = near_scene(scene, centers.astype(np.float32), np.float32(MAP.edge))
    return near.reshape(MAP.shape)


def frustum(explorer: RecordedExplorer, act: RecordedAct) -> list[Float[ndarray, "n 3"]]:
    """The edges of the pyramid that the arm's first camera sees at the end of a look, as polylines in the
    base frame [m]; none for other acts."""
    if act.T_base_camera is None:
        return []
    camera = explorer.cameras[0]
    fx, fy, cx, cy = camera.intrinsics
    width, height = camera.size
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)], float)
    in_camera = np.column_stack([(corners - (cx, cy)) / (fx, fy), np.ones(4)]) * FRUSTUM_DEPTH
    T = act.T_base_camera
    rim = in_camera @ T[:3, :3].T + T[:3, 3]
    return [np.stack([T[:3, 3], corner]) for corner in rim] + [np.concatenate([rim, rim[:1]])]
