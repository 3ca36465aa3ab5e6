"""Differentiable parts of the paper's losses L_joint, L_point and L_collision, which rate predicted motions.

L_joint compares motions of the joints, L_point motions of points on the arm's surface, and L_collision is the
hinge h on the signed distance of the arm to obstacles (paper, section "Optimize via Robot Feedback").
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy import ndarray
from torch import Tensor

from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Count, NotNegative, Settings, Share
from robotdiffuse.core.transforms import placed, rotation_from_quaternion
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.packed_scenes import BOX, SPHERE, PackedScenes
from robotdiffuse.scenes.shapes import Mesh
from robotdiffuse.scenes.surface_points import draw


class ForwardKinematics:
    """Poses of a robot's frames at batches of configurations; differentiable any number of times.

    Configurations `q` [rad], or [m] for prismatic joints, have any batch shape. They are converted to `dtype`
    and moved to `device`; so the results are of this type and on this device.

    The frame of joint j is T[j + 1] = T[parents[j]] @ (C + cos(q) A + sin(q) B) with constant A, B and C; for
    a prismatic joint it is T[parents[j]] @ (C + q S) with constant C and S (the slide).
    Each frame takes one small matrix product and one or two multiply-adds over the batch.
    """

    def __init__(
        self, robot: Robot, dtype: torch.dtype = torch.float32, device: str | torch.device = "cpu"
    ) -> None:
        self.robot = robot
        self.dtype = dtype
        self.device = torch.device(device)
        # C, A and B of a rotation about z; for a translation along z, C and the slide S, which q multiplies
        turns = np.zeros((3, 4, 4))
        turns[0, 2, 2] = turns[0, 3, 3] = 1
        turns[1, 0, 0] = turns[1, 1, 1] = 1
        turns[2, 1, 0] = 1
        turns[2, 0, 1] = -1
        slides = np.stack([np.eye(4), np.outer([0, 0, 1, 0], [0, 0, 0, 1])])
        self._steps = []
        """For each joint, stacked transposed matrices: [12, 4] C, A and B; for a prismatic joint [8, 4] C and
        S."""
        for offset, prismatic in zip(robot.frame_offsets, robot.prismatic, strict=True):
            self._steps.append(self.tensor(np.hstack(list(offset @ (slides if prismatic else turns))).T))
        self._last_row = self.tensor(np.array([[0.0], [0.0], [0.0], [1.0]]))

    def __call__(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch frames 4 4"]:
        """T_base_frame of all dof + 1 frames, the base (identity) first."""
        batch = q.shape[:-1]
        q = q.to(self.device, self.dtype).reshape(-1, self.robot.dof).t()
        cosines = q.cos()
        sines = q.sin()
        # the batch is the last axis here, so that every operation runs along contiguous numbers
        T = torch.eye(4, dtype=self.dtype, device=self.device)[:3, :, None].expand(3, 4, q.shape[1])
        frames = [T]
        for j in range(self.robot.dof):
            T = frames[self.robot.parents[j]]
            parts = self._steps[j] @ T
            if self.robot.prismatic[j]:
                T = torch.addcmul(parts[:, :4], q[j], parts[:, 4:])
            else:
                T = torch.addcmul(parts[:, :4], cosines[j], parts[:, 4:8])
                T = torch.addcmul(T, sines[j], parts[:, 8:])
            frames.append(T)
        top = torch.stack(frames)
        bottom = self._last_row.expand(len(frames), 1, 4, q.shape[1])
        return torch.cat([top, bottom], dim=1).permute(3, 0, 1, 2).reshape(*batch, len(frames), 4, 4)

    def tensor(self, array: ndarray) -> Tensor:
        """The array, with this dtype and on this device."""
        return torch.as_tensor(array, dtype=self.dtype, device=self.device)


POINT_UNIT = 0.1
"""Distances in L_point and L_collision are divided by this [m], to be about as large as L_joint."""
MAX_DISTANCE = 1.0
"""Larger distances of sphere centers from obstacles count as this [m]; so do distances in an empty scene."""
SAFE_DISTANCE = 0.05
"""S of the hinge h in L_collision [m]: distances below it are penalized."""
EPSILON = 1e-12
"""Added to squared lengths [m^2], so that their root has a gradient everywhere."""


@dataclass(frozen=True)
class LossSettings(Settings, name="losses"):
    joint: NotNegative = 1.0
    """The paper's lambda_joint."""
    point: NotNegative = 0.0
    """The paper's lambda_point."""
    collision: NotNegative = 0.0
    """The paper's lambda_collision."""
    begin: Share = 0.0
    """Share of the training after which L_collision begins; its weight then rises over a tenth of the
    training. Earlier predictions are too far off for a meaningful gradient."""
    points: Count = 6
    """Number of points on each link's surface in L_point."""
    waypoints: Count = 8
    """Number of waypoints, drawn anew for each batch, on which L_point and L_collision are computed."""

    def collision_weight(self, fraction: float) -> float:
        """lambda_collision when this fraction of the training is done."""
        return self.collision * float(np.clip((fraction - self.begin) / 0.1, 0.0, 1.0))


class SurfacePoints:
    """Points fixed to the surfaces of the moving links, to which L_point applies forward kinematics."""

    def __init__(self, kinematics: ForwardKinematics, per_link: int, rng: np.random.Generator) -> None:
        """Draw per_link points of each link, uniform by area on its convex meshes.

        Raises InputError if no moving link has a mesh.
        """
        robot = kinematics.robot
        self._kinematics = kinematics
        frames = []
        points = []
        for link, meshes in robot.meshes.items():
            if robot.link_frame(link) == 0 or not meshes:
                continue
            corners = np.concatenate([mesh.triangles.reshape(-1, 3) for mesh in meshes])
            triangles = Mesh(corners, np.arange(len(corners)).reshape(-1, 3))
            points.append(placed(robot.T_frame_link(link), draw(triangles, per_link, rng)))
            frames.append(np.full(per_link, robot.link_frame(link)))
        if not points:
            raise InputError(f"robot {robot.name} has no meshes on its moving links, which L_point needs")
        self._frame = torch.from_numpy(np.concatenate(frames)).to(kinematics.device)
        local = kinematics.tensor(np.concatenate(points))
        self._local = torch.nn.functional.pad(local, (0, 1), value=1.0)

    def __call__(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch points 3"]:
        """Positions of the points in the base frame [m]; q in [rad], or [m] for prismatic joints."""
        T = self._kinematics(q)[..., self._frame, :3, :]
        return (T @ self._local[..., None])[..., 0]


class ArmDistance:
    """Signed distance of the covering spheres of an arm's moving links to packed scenes, one scene for each
    trajectory."""

    def __init__(self, kinematics: ForwardKinematics) -> None:
        arrays = compile_robot(kinematics.robot)
        groups = np.repeat(arrays.frame, np.diff(arrays.first))
        spheres = kinematics.tensor(arrays.spheres[groups > 0])
        self._kinematics = kinematics
        self._frame = torch.as_tensor(groups[groups > 0], device=kinematics.device).long()
        self._centers = spheres[:, :3]
        self._radii = spheres[:, 3]

    def __call__(
        self, q: Float[Tensor, "n waypoints dof"], scenes: PackedScenes
    ) -> Float[Tensor, "n waypoints spheres"]:
        """D of the paper [m], negative inside; q in [rad], or [m] for prismatic joints. A floor counts as the
        plane of its top."""
        T = self._kinematics(q)[..., self._frame, :3, :]
        centers = (T[..., :3] * self._centers[:, None]).sum(-1) + T[..., 3]
        at = centers.movedim(-1, 0).flatten(2).contiguous()
        obstacles = _obstacles(scenes).to(at)
        with torch.no_grad():  # only the distance to the nearest obstacle has a gradient
            slot, nearest_distance = _nearest(at, obstacles, scenes.kinds > 0)
        rows = torch.arange(len(slot), device=slot.device)[:, None]
        distance = torch.where(
            nearest_distance < MAX_DISTANCE, _distance(at, obstacles[:, rows, slot]), MAX_DISTANCE
        )
        if scenes.floors is not None:
            top = torch.from_numpy(scenes.floors[:, 2] + scenes.floors[:, 5] / 2).to(at)[:, None]
            has_floor = torch.from_numpy(scenes.floors.any(1)).to(at.device)[:, None]
            distance = torch.where(has_floor, torch.minimum(distance, at[2] - top), distance)
        return distance.view(centers.shape[:-1]) - self._radii


def _obstacles(scenes: PackedScenes) -> Float[Tensor, "16 n slots"]:
    """Center, half edges, radius and rotation of the obstacles; a sphere is a box of size 0 with a radius."""
    box = (scenes.kinds == BOX)[..., None]
    sphere = (scenes.kinds == SPHERE)[..., None]
    center, size, wxyz = np.split(scenes.params, (3, 6), -1)
    rotation = rotation_from_quaternion(np.where(box, wxyz, [1, 0, 0, 0])).reshape(*scenes.kinds.shape, 9)
    parts = center, np.where(box, size / 2, 0), np.where(sphere, size[..., :1], 0), rotation
    return torch.from_numpy(np.moveaxis(np.concatenate(parts, -1), -1, 0))


def _nearest(
    at: Float[Tensor, "3 n points"], obstacles: Float[Tensor, "16 n slots"], present: Bool[ndarray, "n slots"]
) -> tuple[Int64[Tensor, "n points"], Float[Tensor, "n points"]]:
    """The slot of the obstacle nearest to each point, and its distance [m], at most MAX_DISTANCE."""
    min_distance = torch.full_like(at[0], MAX_DISTANCE)
    slot = torch.zeros_like(min_distance, dtype=torch.int64)
    for j in np.flatnonzero(present.any(0)):
        rows = torch.from_numpy(np.flatnonzero(present[:, j])).to(at.device)
        distance = _distance(at[:, rows], obstacles[:, rows, j, None])
        before = min_distance[rows]
        slot[rows] = torch.where(distance < before, int(j), slot[rows])
        min_distance[rows] = torch.minimum(distance, before)
    return slot, min_distance


def _distance(
    at: Float[Tensor, "3 n points"], obstacles: Float[Tensor, "16 n #points"]
) -> Float[Tensor, "n points"]:
    """Signed distance of each point to one obstacle [m]."""
    center, half, radius, rotation = obstacles.split((3, 3, 1, 9))
    local = ((at - center)[:, None] * rotation.unflatten(0, (3, 3))).sum(0)
    outside = local.abs() - half
    away = (outside.clamp(min=0).square().sum(0) + EPSILON).sqrt()
    return away + outside.amax(0).clamp(max=0) - radius[0]


def hinge(distance: Float[Tensor, "*shape"], safe_distance: float) -> Float[Tensor, "*shape"]:
    """h of the paper: S - D where D is at most S, else 0 [m]."""
    return (safe_distance - distance).clamp(min=0)
