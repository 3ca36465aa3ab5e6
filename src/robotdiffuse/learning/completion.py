"""The occupancy completion network, which predicts obstacles in space that no camera saw.

This module defines the network's voxels, runs the network with ONNX Runtime, and draws its training samples:
random scenes seen by cameras that are placed as a person would place them.

Nothing here loads PyTorch. The network itself is in `completion_network`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Count, Settings
from robotdiffuse.core.types import Configuration
from robotdiffuse.learning.weight_files import (
    completion_folder,
    exported_files,
    kept_by_stamp,
    read_description,
)
from robotdiffuse.perception.depth_view import DepthNoise, DepthView
from robotdiffuse.perception.observed_volume import ObservedVolume, observe
from robotdiffuse.perception.occupancy_map import LOST_PROBABILITY, lost_regions
from robotdiffuse.perception.ray_caster import looking_at, ray_cast, voxels_within
from robotdiffuse.perception.seen_points import near_scene
from robotdiffuse.perception.voxel_grid import COARSE, FINE, SHAPE
from robotdiffuse.problems.families import load_family
from robotdiffuse.problems.families.family import Range, base_spheres
from robotdiffuse.robots.kinematic_tree import once_per_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

Packed = UInt8[ndarray, "56 56 32"]
SHOULDER = (0.0, 0.0, 0.33)
"""Position of a Panda's shoulder in the base frame [m]."""
REACH = 1.0
"""The network predicts the voxels within this distance of the shoulder [m]: no point of a Panda gets
farther."""


@dataclass(frozen=True)
class CompletionSettings(Settings, name="completion"):
    """Sizes of the network."""

    channels: tuple[Count, Count, Count] = (32, 64, 128)
    """Number of features of each cell of 8, 16 and 32 cm."""
    blocks: tuple[Count, Count, Count] = (1, 1, 2)
    """Number of residual blocks at each cell size of the U-Net: the first two numbers hold on the way down
    and again on the way up, the last one at the bottom."""


def voxel_centers() -> Float[ndarray, "56 56 32 3"]:
    """Centers of the voxels of an observed volume [m]."""
    return COARSE.all_centers.reshape(*SHAPE, 3)


def reachable() -> Bool[ndarray, "56 56 32"]:
    """The voxels that the arm can reach."""
    return np.linalg.norm(voxel_centers() - SHOULDER, axis=-1) <= REACH


REACH_SAMPLES = 256
"""Number of random configurations by which an arm's reach is estimated; thousands of configurations give a
reach that differs by less than 1 cm."""


@once_per_robot
def covers(robot: Robot) -> bool:
    """Whether the network predicts all voxels that the arm reaches in random configurations."""
    lower, upper = (
        np.where(robot.prismatic, limit, np.clip(limit, -np.pi, np.pi))
        for limit in (robot.lower, robot.upper)
    )
    q = np.random.default_rng(0).uniform(lower, upper, (REACH_SAMPLES, robot.dof))
    for link, spheres in robot.spheres.items():
        if robot.link_frame(link) == 0:
            continue
        T = robot.fk(q, link)
        centers = np.einsum("nij,mj->nmi", T[:, :3, :3], spheres[:, :3]) + T[:, None, :3, 3]
        if (np.linalg.norm(centers - SHOULDER, axis=2) + spheres[:, 3]).max(initial=0.0) > REACH:
            return False
    return True


DEPTH_STEP = 0.01
"""Depths behind surfaces are stored as multiples of this step [m]."""
OCCUPIED = 1
FREE = 2
SHADOW = 4
OUT_OF_VIEW = 8
BITS = (OCCUPIED, FREE, SHADOW, OUT_OF_VIEW)
"""The bits of `Samples.seen`. SHADOW: the arm hides the voxel."""


@dataclass(frozen=True)
class CameraPlaces(Settings, name="cameras"):
    """Distribution of camera poses. Lengths in [m], angles in [rad]."""

    distance: Range = (1.2, 2.0)
    """Horizontal distance of the camera from the base's axis."""
    height: Range = (0.4, 1.6)
    """Height of the camera above the base."""
    front_share: float = 0.75
    """Share of the cameras that stand opposite to the obstacles, as seen from the base. All other cameras may
    be in any direction from the base."""
    front: float = 2.0
    """Largest angle, at the base, of these `front_share` cameras from the direction exactly opposite to the
    obstacles."""
    target_spread: float = 0.2
    """Standard deviation, along each axis, of the point that a camera looks at. The mean of this point is
    0.3 m high, halfway between the base and the middle of the obstacles."""
    field_of_view: Range = (0.75, 1.1)
    """Vertical field of view."""
    roll: float = 0.05
    """Standard deviation of the roll about the optical axis."""

    def draw(self, scene: Scene, rng: Generator) -> tuple[ndarray, float]:
        """A random T_base_camera, and the vertical field of view."""
        middle = np.mean(
            [s.bounds.mean(axis=0)[:2] for s in scene.shapes if s.name != "floor"] or [np.zeros(2)], axis=0
        )
        bearing = np.arctan2(-middle[1], -middle[0]) + rng.uniform(-self.front, self.front)
        if rng.random() >= self.front_share:
            bearing = rng.uniform(-np.pi, np.pi)
        away = rng.uniform(*self.distance)
        position = np.array([away * np.cos(bearing), away * np.sin(bearing), rng.uniform(*self.height)])
        target = np.array([*(middle / 2), 0.3]) + self.target_spread * rng.standard_normal(3)
        T = looking_at(position, target, self.roll * rng.standard_normal())
        return T, rng.uniform(*self.field_of_view)


VIEW_COUNTS = (1, 1, 1, 2)
"""The number of views of a sample is a random item of this list."""
IMAGE_SIZE = (160, 120)
"""Width and height of images [pixels]."""
NOISE_SHARE = 0.5
"""Share of the samples that have noise, of up to twice the strength of the default `DepthNoise`."""
CAMERA_CLEARANCE = 0.05
"""Minimum distance of cameras from obstacles [m]. If none of `CAMERA_DRAWS` poses keeps it, the last pose is
used."""
CAMERA_DRAWS = 8
OUT_OF_RANGE_SHARE = 0.5
"""Share of the noisy samples in which surfaces out of range return no depth, as with most real cameras."""
MISSING_SHARE = 0.02
"""Share of all pixels that have no return, at the default strength of the noise."""
NOISE_FIELDS = ("spread", "missing", "stray", "flying", "edge_missing", "grazing")
"""Fields of `DepthNoise` that are multiplied by the strength of the noise."""
NO_FLOOR_SHARE = 0.1
"""Share of the samples without a floor, as for an arm on a pedestal (the pedestal itself is not modeled)."""


class Samples(NamedTuple):
    """Observed volumes and the true occupancies, packed."""

    seen: UInt8[ndarray, "n 56 56 32"]
    """The bits of `BITS`."""
    behind: UInt8[ndarray, "n 56 56 32"]
    """How far each voxel lies behind the surface that hides it from the camera, in units of DEPTH_STEP."""
    truth: UInt8[ndarray, "n 56 56 32"]
    """Whether each of a voxel's eight fine voxels holds an obstacle: bit 4 x + 2 y + z, with x, y and z the
    index of the fine voxel, 0 or 1."""


def pack(volume: ObservedVolume) -> tuple[Packed, Packed]:
    """`Samples.seen` and `Samples.behind` of an observed volume."""
    kinds = np.stack([volume.occupied, volume.free, volume.shadow, volume.out_of_view], axis=-1)
    seen = np.packbits(kinds, axis=-1, bitorder="little")[..., 0]
    return seen, np.minimum(np.rint(volume.behind / DEPTH_STEP), 255).astype(np.uint8)


def pack_fine(fine: Bool[ndarray, "112 112 64"]) -> Packed:
    """`Samples.truth` of the occupancy of fine voxels."""
    out = np.zeros(SHAPE, np.uint8)
    for bit in range(8):
        out |= fine[bit >> 2 :: 2, bit >> 1 & 1 :: 2, bit & 1 :: 2] * np.uint8(1 << bit)
    return out


def unpack_fine(truth: UInt8[ndarray, "*b"]) -> Bool[ndarray, "*b 8"]:
    """The eight bits of each number, the inverse of `pack_fine`."""
    return (truth[..., None] >> np.arange(8, dtype=np.uint8) & 1).astype(np.bool_)


def camera_view(scene: Scene, robot: Robot, q: Configuration, rng: Generator) -> DepthView:
    """A depth view of the scene from a random pose, without noise."""
    for _ in range(CAMERA_DRAWS):
        T, angle = CameraPlaces().draw(scene, rng)
        if not near_scene(robot, scene, T[None, :3, 3], CAMERA_CLEARANCE)[0]:
            break
    width, height = IMAGE_SIZE
    focal = height / 2 / np.tan(angle / 2)
    intrinsics = (focal, focal, (width - 1) / 2, (height - 1) / 2)
    return ray_cast(scene, T, intrinsics, IMAGE_SIZE, robot, q)


def draw_sample(families: Sequence[str], robot: Robot, rng: Generator) -> tuple[Packed, Packed, Packed]:
    """A random scene of one of the families, as cameras observe it: a row of `Samples`."""
    family = load_family(families[int(rng.integers(len(families)))])
    scene = family.scene(rng, base_spheres(robot))
    if rng.random() < NO_FLOOR_SHARE:
        scene = Scene([shape for shape in scene.shapes if shape is not family.floor])
    # the first of 64 random configurations that is free of collision, or the first one if none is
    q = rng.uniform(robot.lower, robot.upper, (64, robot.dof))
    q = q[CollisionChecker(robot, scene).free(q).argmax()]
    views = [camera_view(scene, robot, q, rng) for _ in range(rng.choice(VIEW_COUNTS))]
    if rng.random() < NOISE_SHARE:
        strength = 2 * rng.random()
        hide_far = rng.random() < OUT_OF_RANGE_SHARE
        default = replace(DepthNoise(), missing=MISSING_SHARE)
        noise = replace(default, **{name: strength * getattr(default, name) for name in NOISE_FIELDS})
        if hide_far:  # no measurement (0) where nothing is in range
            views = [replace(view, depth=np.nan_to_num(view.depth, posinf=0.0)) for view in views]
        views = [noise.applied(view, rng) for view in views]
    return *pack(observe(views, robot, q)), pack_fine(voxels_within(scene, FINE))


def draw_samples(families: Sequence[str], robot: Robot, seeds: Sequence[int]) -> Samples:
    """A sample for each seed."""
    samples = [draw_sample(families, robot, np.random.default_rng(seed)) for seed in seeds]
    return Samples(*map(np.stack, zip(*samples, strict=True)))


Completion = Callable[[ndarray, ndarray], ndarray]
"""A function from a volume packed by `pack` to the probability that each voxel of 2 cm is occupied."""


def predict(volume: ObservedVolume, network: Completion | None = None) -> Float32[ndarray, "112 112 64"]:
    """The probability that each voxel of 2 cm holds an obstacle.

    It is 0 in voxels that were seen free. It is also 0 farther than 1 m from a Panda's shoulder, since
    training did not cover these voxels. Lost regions are the exception (see `ObservedVolume.lost`): there it
    is at least LOST_PROBABILITY, also beyond 1 m, since the network mistakes them for free space. The lower
    corner of the grid is `voxel_grid.LOW`, in the base frame. network: None: the network that comes with the
    package.
    """
    return np.maximum(
        (network or exported_completion())(*pack(volume)),
        np.float32(LOST_PROBABILITY) * lost_regions(volume),
    )


def exported_completion(folder: str | Path | None = None) -> Completion:
    """The network of a folder, loaded once, and again if it was trained anew; None: the network that comes
    with the package.

    Raises InputError for damaged files, and if there is no network, naming the command that trains it.
    """
    return _exported("completion", completion_folder(folder))


@kept_by_stamp
def _exported(name: str, folder: Path) -> Completion:
    from robotdiffuse.learning.exported_model import OnnxNetwork  # imports ONNX Runtime

    parts = exported_files(folder, name, read_description(folder, name))
    if parts.keys() != {".onnx"}:
        raise InputError(
            f"{folder / name}.json lists ONNX files with the endings {sorted(parts)}; it must list "
            "exactly one, with the ending .onnx"
        )
    network = OnnxNetwork(parts[".onnx"], f"{folder / name}.onnx")
    return lambda seen, behind: network(seen=seen, behind=behind)
