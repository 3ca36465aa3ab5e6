"""Training samples of the completion network: random scenes seen by cameras placed as a person would place
them.

Nothing here loads PyTorch, so that processes that only draw samples start quickly.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernel_arrays import compile_scene_for
from robotdiffuse.perception.depth_noise import DepthNoise
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.observed_volume import LOW, SHAPE, VOXEL, ObservedVolume, observe
from robotdiffuse.perception.ray_caster import looking_at, ray_cast, voxels_within
from robotdiffuse.perception.seen_points_kernel import near_scene
from robotdiffuse.problems.families import load_family
from robotdiffuse.problems.families.family import Range, base_spheres
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

FINE_VOXEL_SIZE = VOXEL / 2
"""Edge of the voxels that are predicted [m]."""
FINE_SHAPE = (2 * SHAPE[0], 2 * SHAPE[1], 2 * SHAPE[2])
DEPTH_STEP = 0.01
"""Depths behind surfaces are stored in whole steps of this [m]."""
OCCUPIED, FREE, SHADOW, OUT_OF_VIEW = 1, 2, 4, 8
BITS = (OCCUPIED, FREE, SHADOW, OUT_OF_VIEW)
"""The bits of `Sample.seen`."""


@dataclass(frozen=True)
class CameraPlaces:
    """Distribution of camera poses. Lengths in [m], angles in [rad]."""

    distance: Range = (1.2, 2.0)
    """Horizontal distance from the base's axis."""
    height: Range = (0.4, 1.6)
    """Above the base."""
    front_share: float = 0.75
    """Share of the cameras that stand in front, on the arm's side of the obstacles."""
    front: float = 2.0
    """Largest angle about the base between such a camera and the direction opposite the obstacles."""
    target_spread: float = 0.2
    """Standard deviation of the point that a camera looks at, about a point in front of the arm."""
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


@dataclass(frozen=True)
class Views:
    """Distribution of the views of a sample."""

    places: tuple[CameraPlaces, ...]
    """Each camera is at one of these, drawn evenly."""
    wrist_share: float
    """Share of the cameras that are on the arm's hand instead."""
    sizes: tuple[tuple[int, int], ...]
    """Widths and heights of images, drawn evenly [pixels]."""
    counts: tuple[int, ...]
    """Numbers of views, drawn evenly."""
    noise_share: float
    """Share of the samples with noise, of up to twice the usual strength."""


VIEWS = {
    "around": Views((CameraPlaces(),), 0.0, ((160, 120),), (1, 1, 1, 2), 0.5),
    "everywhere": Views(
        (
            CameraPlaces(),
            CameraPlaces(
                distance=(0.4, 1.3), height=(0.1, 0.9), target_spread=0.3, field_of_view=(0.75, 1.2)
            ),
            CameraPlaces(distance=(0.1, 0.8), height=(1.2, 2.2), field_of_view=(0.75, 1.2), roll=0.5),
            CameraPlaces(distance=(2.0, 3.0), height=(0.3, 2.0), field_of_view=(0.5, 1.0)),
        ),
        wrist_share=0.15,
        sizes=((160, 120), (320, 240), (640, 480)),
        counts=(1, 1, 1, 2, 3),
        noise_share=0.65,
    ),
}
"""Views by name: of cameras that stand around the arm; and of those near, low, overhead, far and on the hand,
of several resolutions."""
CAMERA_CLEARANCE = 0.05
"""Cameras stand at least this far from obstacles, where a few draws find such a place [m]."""
CAMERA_DRAWS = 8
WRIST_TURN = 0.4
"""Largest angle between the axes of a camera on the hand and the hand [rad]."""
WRIST_OFFSET = 0.07
"""Distance of a camera on the hand from the hand's axis [m]."""
OUT_OF_RANGE_SHARE = 0.5
"""Share of the noisy samples in which surfaces out of range return no depth, as with most real cameras."""
MISSING_SHARE = 0.02
"""Share of the pixels without a return, anywhere, with noise of the usual strength."""
NO_FLOOR_SHARE = 0.1
"""Share of the samples without a floor: the arm stands on a pedestal."""


class Sample(NamedTuple):
    """An observed volume and the true occupancy, packed."""

    seen: UInt8[ndarray, "56 56 32"]
    """The bits of `BITS`."""
    behind: UInt8[ndarray, "56 56 32"]
    """Depth behind the nearest surface, in units of DEPTH_STEP."""
    truth: UInt8[ndarray, "56 56 32"]
    """Whether each of a voxel's eight voxels of 2 cm holds an obstacle: bit 4 x + 2 y + z."""


class Samples(NamedTuple):
    """Many samples: the arrays of `Sample` with a leading axis."""

    seen: UInt8[ndarray, "n 56 56 32"]
    behind: UInt8[ndarray, "n 56 56 32"]
    truth: UInt8[ndarray, "n 56 56 32"]


def pack(volume: ObservedVolume) -> tuple[UInt8[ndarray, "56 56 32"], UInt8[ndarray, "56 56 32"]]:
    """`Sample.seen` and `Sample.behind` of an observed volume."""
    seen = np.zeros(SHAPE, np.uint8)
    for bit, of in zip(BITS, (volume.occupied, volume.free, volume.shadow, volume.out_of_view), strict=True):
        seen |= of * np.uint8(bit)
    return seen, np.minimum(np.rint(volume.behind / DEPTH_STEP), 255).astype(np.uint8)


def true_voxels(scene: Scene) -> Bool[ndarray, "112 112 64"]:
    """The voxels of 2 cm that hold obstacles."""
    return voxels_within(scene, LOW, FINE_VOXEL_SIZE, FINE_SHAPE)


def pack_fine(fine: Bool[ndarray, "112 112 64"]) -> UInt8[ndarray, "56 56 32"]:
    """`Sample.truth` of an occupancy."""
    out = np.zeros(SHAPE, np.uint8)
    for bit in range(8):
        out |= fine[bit >> 2 :: 2, bit >> 1 & 1 :: 2, bit & 1 :: 2] * np.uint8(1 << bit)
    return out


def unpack_fine(truth: UInt8[ndarray, "*b"]) -> Bool[ndarray, "*b 8"]:
    """The eight bits of each number, the inverse of `pack_fine`."""
    return (truth[..., None] >> np.arange(8, dtype=np.uint8) & 1).astype(np.bool_)


def camera_view(
    scene: Scene, robot: Robot, q: Float[ndarray, "dof"], rng: Generator, views: Views
) -> DepthView:
    """A depth view of the scene from a random pose, without noise."""
    width, height = views.sizes[int(rng.integers(len(views.sizes)))]
    obstacles = compile_scene_for(robot, scene)
    on_wrist = rng.random() < views.wrist_share
    for _ in range(CAMERA_DRAWS):
        places = views.places[int(rng.integers(len(views.places)))]
        T, angle = _wrist_camera(robot, q, rng) if on_wrist else places.draw(scene, rng)
        if not near_scene(obstacles, T[None, :3, 3].astype(np.float32), np.float32(CAMERA_CLEARANCE))[0]:
            break
    focal = height / 2 / np.tan(angle / 2)
    intrinsics = (focal, focal, (width - 1) / 2, (height - 1) / 2)
    # a camera on the hand looks past the gripper: the spheres that cover it would hide everything
    return ray_cast(scene, T, intrinsics, (width, height), None if on_wrist else robot, q)


def _wrist_camera(robot: Robot, q: Float[ndarray, "dof"], rng: Generator) -> tuple[ndarray, float]:
    """T_base_camera of a camera beside the hand that looks about along its axis, and its field of view."""
    T_base_hand = link_pose(robot, q, robot.tip)
    turn = rng.uniform(-np.pi, np.pi)
    aside = WRIST_OFFSET * np.array([np.cos(turn), np.sin(turn), 0.0])
    aim = np.array([*np.tan(rng.uniform(-WRIST_TURN, WRIST_TURN, 2)), 1.0])
    T_hand_camera = looking_at(aside, aside + aim, rng.uniform(-np.pi, np.pi))
    return T_base_hand @ T_hand_camera, rng.uniform(0.75, 1.0)


def random_configuration(checker: CollisionChecker, robot: Robot, rng: Generator) -> Float[ndarray, "dof"]:
    """A uniform configuration without collision; with collision if 64 draws find none without."""
    q = rng.uniform(robot.lower, robot.upper, (64, robot.dof))
    free = np.flatnonzero(checker.free(q))
    return q[free[0]] if len(free) else q[0]


def draw_sample(families: Sequence[str], robot: Robot, rng: Generator, views: Views) -> Sample:
    """A random scene of one of the families, as cameras observe it."""
    family = load_family(families[int(rng.integers(len(families)))])
    scene = family.scene(rng, base_spheres(robot))
    if rng.random() < NO_FLOOR_SHARE:
        scene = Scene([shape for shape in scene.shapes if shape is not family.floor])
    q = random_configuration(CollisionChecker(robot, scene), robot, rng)
    count = views.counts[int(rng.integers(len(views.counts)))]
    taken = [camera_view(scene, robot, q, rng, views) for _ in range(count)]
    if rng.random() < views.noise_share:
        strength, hide_far = 2 * rng.random(), rng.random() < OUT_OF_RANGE_SHARE
        usual = DepthNoise()
        noise = DepthNoise(
            strength * usual.spread,
            strength * MISSING_SHARE,
            strength * usual.stray,
            strength * usual.flying,
            strength * usual.edge_missing,
            grazing=strength * usual.grazing,
        )
        taken = [noise.applied(_without_infinity(view) if hide_far else view, rng) for view in taken]
    seen, behind = pack(observe(taken, robot, q))
    return Sample(seen, behind, pack_fine(true_voxels(scene)))


def _without_infinity(view: DepthView) -> DepthView:
    """The view with no measurement (0) where nothing was in range."""
    depth = np.where(np.isfinite(view.depth), view.depth, 0.0)
    return DepthView(depth, view.intrinsics, view.T_base_camera, view.configuration)


def draw_samples(
    families: Sequence[str], robot: Robot, seeds: Sequence[int], views: str = "around"
) -> Samples:
    """A sample for each seed; `views` is a name in VIEWS."""
    drawn = [draw_sample(families, robot, np.random.default_rng(seed), VIEWS[views]) for seed in seeds]
    return Samples(*(np.stack(arrays) for arrays in zip(*drawn, strict=True)))
