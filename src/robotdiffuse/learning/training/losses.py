"""The paper's losses of a predicted motion: L_joint, L_point and L_collision, in PyTorch, differentiable.

Predictions are compared as motions of joints, as motions of points of the arm's surface, and with the scene:
by the hinge h on the signed distance of the arm to obstacles (paper, section "Optimize via Robot Feedback").
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int8
from numpy import ndarray
from torch import Tensor

from robotdiffuse.collision.arrays import compile_robot
from robotdiffuse.errors import InputError
from robotdiffuse.robots.forward_kinematics import ForwardKinematics
from robotdiffuse.scenes.packed import BOX, SPHERE, PackedScenes
from robotdiffuse.settings import Count, NotNegative, Settings, Share
from robotdiffuse.transforms import rotation_from_quaternion

POINT_UNIT = 0.1
"""[m] in L_point and L_collision, so that they are of the size of L_joint."""
FAR = 1.0
"""Distance to an empty scene [m]."""
EPSILON = 1e-12
"""Added to squared lengths [m^2], whose root then has a gradient everywhere."""


@dataclass(frozen=True)
class LossSettings(Settings, name="losses"):
    joint: NotNegative = 1.0
    """The paper's lambda_joint."""
    point: NotNegative = 0.0
    """lambda_point"""
    collision: NotNegative = 0.0
    """lambda_collision"""
    safe_distance: NotNegative = 0.05
    """S of the hinge h [m]: the arm is pushed away where it is closer."""
    begin: Share = 0.0
    """Share of the training after which L_collision sets in, rising over a tenth of it: at first predictions
    are too far off for its gradient to mean anything."""
    points: Count = 6
    """Points of each link's surface in L_point."""
    waypoints: Count = 8
    """Waypoints, drawn for each batch, that L_point and L_collision look at."""

    def collision_weight(self, fraction: float) -> float:
        """lambda_collision when this share of the training is done."""
        return self.collision * float(np.clip((fraction - self.begin) / 0.1, 0.0, 1.0))


class SurfacePoints:
    """Points fixed to the moving links: what forward kinematics is applied to in L_point."""

    def __init__(self, kinematics: ForwardKinematics, per_link: int, rng: np.random.Generator) -> None:
        """`per_link` points of each link, uniform by area on its convex meshes."""
        robot = kinematics.robot
        self._kinematics = kinematics
        frames, points = [], []
        for link, meshes in robot.meshes.items():
            if robot.link_frame(link) == 0 or not meshes:
                continue
            corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
            local = _on_triangles(corners, per_link, rng)
            T = robot.T_frame_link(link)
            points.append(local @ T[:3, :3].T + T[:3, 3])
            frames.append(np.full(per_link, robot.link_frame(link)))
        if not points:
            raise InputError(f"robot {robot.name} has no meshes on its moving links, which L_point needs")
        self._frame = torch.from_numpy(np.concatenate(frames)).to(kinematics.device)
        local = torch.from_numpy(np.concatenate(points)).to(kinematics.device, kinematics.dtype)
        self._local = torch.nn.functional.pad(local, (0, 1), value=1.0)

    def __call__(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch points 3"]:
        """Places of the points in the base frame [m]; q in [rad]."""
        T = self._kinematics(q)[..., self._frame, :3, :]
        return (T @ self._local[..., None])[..., 0]


def _on_triangles(corners: Float[ndarray, "n 3 3"], count: int, rng: np.random.Generator) -> ndarray:
    a, b, c = np.moveaxis(corners, 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    face = rng.choice(len(area), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[face] + u * (b - a)[face] + v * (c - a)[face]


class ArmDistance:
    """Signed distance of an arm's covering spheres to packed scenes, a different one for each trajectory."""

    def __init__(self, kinematics: ForwardKinematics) -> None:
        arrays = compile_robot(kinematics.robot)
        groups = np.repeat(arrays.frame, np.diff(arrays.first))
        spheres = torch.as_tensor(
            arrays.spheres[groups > 0], dtype=kinematics.dtype, device=kinematics.device
        )
        self._kinematics = kinematics
        self._frame = torch.as_tensor(groups[groups > 0], device=kinematics.device).long()
        self._centres = torch.nn.functional.pad(spheres[:, :3], (0, 1), value=1.0)
        self._radii = spheres[:, 3]

    def __call__(
        self, q: Float[Tensor, "n waypoints dof"], scenes: PackedScenes
    ) -> Float[Tensor, "n waypoints spheres"]:
        """D of the paper [m], negative inside; q in [rad]. A floor counts as the plane of its top."""
        kinds, params = scenes.kinds, scenes.params
        T = self._kinematics(q)[..., self._frame, :3, :]
        centres = (T @ self._centres[..., None])[..., 0]
        least = torch.full_like(centres[..., 0], FAR)
        if scenes.floors is not None:
            top = torch.from_numpy(scenes.floors[:, 2] + scenes.floors[:, 5] / 2).to(centres)[:, None, None]
            there = torch.from_numpy(scenes.floors.any(1)).to(centres.device)[:, None, None]
            least = torch.where(there, centres[..., 2] - top, least)
        rotation = rotation_from_quaternion(
            np.where((kinds == BOX)[..., None], params[..., 6:], [1, 0, 0, 0])
        )
        for j in range(kinds.shape[1]):
            present = kinds[:, j] > 0
            if not present.any():
                continue
            rows = torch.from_numpy(np.flatnonzero(present)).to(q.device)
            part = _distance(centres[rows], kinds[present, j], params[present, j], rotation[present, j])
            least = least.index_put((rows,), torch.minimum(least[rows], part))
        return least - self._radii


def _distance(
    at: Float[Tensor, "n waypoints spheres 3"],
    kind: Int8[ndarray, "n"],
    row: Float32[ndarray, "n 10"],
    rotation: Float[ndarray, "n 3 3"],
) -> Float[Tensor, "n waypoints spheres"]:
    """To one obstacle for each trajectory, a sphere or a box [m]."""

    def tensor(array: ndarray) -> Tensor:
        return torch.as_tensor(np.asarray(array), dtype=at.dtype, device=at.device)

    local = at - tensor(row[:, None, None, :3])
    sphere = tensor(kind == SPHERE)[:, None, None]
    # a sphere is a box without size, but for its radius
    half = tensor(np.where((kind == BOX)[:, None], row[:, 3:6] / 2, 0.0))[:, None, None]
    radius = tensor(np.where(kind == SPHERE, row[:, 3], 0.0))[:, None, None]
    outside = (local @ tensor(rotation)[:, None]).abs() - half
    away = (outside.clamp(min=0).square().sum(-1) + EPSILON).sqrt()
    return away + (1 - sphere) * outside.amax(-1).clamp(max=0) - radius


def hinge(distance: Float[Tensor, "*shape"], safe_distance: float) -> Float[Tensor, "*shape"]:
    """h of the paper: S - D where D is at most S, else 0 [m]."""
    return (safe_distance - distance).clamp(min=0)
