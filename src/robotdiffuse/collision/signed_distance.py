"""The collision model as a differentiable signed distance in PyTorch, for losses and for GPUs."""

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from robotdiffuse.collision.kernel_arrays import SceneArrays, compile_robot, compile_scene_for, robot_groups
from robotdiffuse.collision.kernels.point_grid import POINT_RANGE
from robotdiffuse.robots.forward_kinematics import ForwardKinematics
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

FAR = 1.0
"""Distance to an empty scene [m], and the most that is reported."""
EPSILON = 1e-12
"""Added to squared lengths [m^2], whose root then has a gradient everywhere."""


class SignedDistance:
    """Signed distances of a robot's covering spheres to a scene and between its links, by batches.

    The same spheres and shapes as `CollisionChecker`; differentiable in the configurations. For point clouds
    and meshes the distance is interpolated in a grid, exact to its spacing, and at most about 0.3 m.

    The distance of a link is that of one of its spheres. Which one it is is found without gradients; the
    gradient is that of this sphere alone.
    """

    def __init__(
        self,
        robot: Robot,
        scene: Scene,
        dtype: torch.dtype = torch.float32,
        device: str | torch.device = "cpu",
    ) -> None:
        self.robot = robot
        self._kinematics = ForwardKinematics(robot, dtype, device)
        arrays = compile_robot(robot)

        def tensor(array: ndarray) -> Tensor:
            return torch.as_tensor(np.asarray(array), dtype=dtype, device=device)

        groups = robot_groups(robot)
        self.links = tuple(link for link in groups if robot.link_frame(link) > 0)
        """The moving links with spheres: the last axis of the result."""
        self.pairs = tuple((groups[a], groups[b]) for a, b in arrays.pairs[:, :2])
        """The checked pairs of links: the last axis of `self_distance`."""
        self._frame = torch.as_tensor(arrays.frame, device=device).long()
        self._pairs = torch.as_tensor(arrays.pairs[:, :2], device=device).long()
        spheres = tensor(arrays.spheres)
        self._centres = torch.nn.functional.pad(spheres[:, :3], (0, 1), value=1.0)
        self._radii = spheres[:, 3]
        self._first = arrays.first.tolist()
        obstacles = compile_scene_for(robot, scene)
        self._spheres = tensor(obstacles.spheres)
        oriented = (obstacles.boxes, obstacles.cylinders, obstacles.capsules)
        self._oriented = [
            (tensor(rows), distance)
            for rows, distance in zip(oriented, (_box, _cylinder, _capsule), strict=True)
            if len(rows)
        ]
        self._grid: Tensor | None = None
        if len(obstacles.points):
            field = _to_points(obstacles) - obstacles.grid_frame[5]
            self._grid = tensor(np.minimum(field, POINT_RANGE + arrays.spheres[:, 3].min()))[None, None]
        self._grid_low, self._voxel = tensor(obstacles.grid_frame[:3]), float(obstacles.grid_frame[3])

    def __call__(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch links"]:
        """Least signed distance of the spheres of each moving link to the scene [m], at most 1 m."""
        frames = self._frames(q)
        groups = range(len(self._frame) - len(self.links), len(self._frame))
        if not self.links:
            return frames.new_zeros((*q.shape[:-1], 0))
        with torch.no_grad():
            parts = [_least(self._group_distances(frames, g)) + self._first[g] for g in groups]
        nearest = torch.stack(parts, dim=-1)
        at = self._placed(frames, self._frame[groups.start :], nearest)
        distance = self._scene_distance(at) - self._radii[nearest]
        return distance.clamp(max=FAR).reshape(*q.shape[:-1], len(self.links))

    def self_distance(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch pairs"]:
        """Least distance between the spheres of the two links of each checked pair [m]."""
        frames = self._frames(q)
        if not self.pairs:
            return frames.new_zeros((*q.shape[:-1], 0))
        with torch.no_grad():
            found = [self._nearest_of_pair(frames, a, b) for a, b in self._pairs.tolist()]
        first, second = (torch.stack(side, dim=-1) for side in zip(*found, strict=True))
        at = self._placed(frames, self._frame[self._pairs[:, 0]], first)
        to = self._placed(frames, self._frame[self._pairs[:, 1]], second)
        length = torch.sqrt((at - to).square().sum(-1) + EPSILON)
        return (length - self._radii[first] - self._radii[second]).reshape(*q.shape[:-1], len(self.pairs))

    def _frames(self, q: Tensor) -> Tensor:
        """[batch, frames, 3, 4]"""
        return self._kinematics(q).reshape(-1, self.robot.dof + 1, 4, 4)[:, :, :3]

    def _placed(self, frames: Tensor, frame: Tensor, sphere: Tensor) -> Tensor:
        """Centres [batch, k, 3] of spheres [batch, k] that are fixed to frames [k]."""
        return (frames[:, frame] * self._centres[sphere][:, :, None]).sum(-1)

    def _group(self, g: int) -> slice:
        return slice(self._first[g], self._first[g + 1])

    def _group_centres(self, frames: Tensor, g: int) -> Tensor:
        """[spheres, 3, batch]: the batch last, so that everything runs along contiguous numbers."""
        T = frames[:, self._frame[g]].permute(2, 1, 0).reshape(4, 3 * len(frames))
        centres = self._centres[self._group(g)]
        return (centres @ T).reshape(len(centres), 3, len(frames))

    def _nearest_of_pair(self, frames: Tensor, a: int, b: int) -> tuple[Tensor, Tensor]:
        """The spheres [batch] of two groups that are nearest to each other."""
        at, to = self._group_centres(frames, a), self._group_centres(frames, b)
        square = at.new_zeros(())
        for x, u in zip(at.unbind(1), to.unbind(1), strict=True):
            square = (x[:, None] - u).square_().add_(square)
        radii = self._radii[self._group(a)][:, None] + self._radii[self._group(b)]
        index = _least(square.sqrt_().sub_(radii[..., None]).flatten(0, 1))
        width = to.shape[0]
        return index // width + self._first[a], index % width + self._first[b]

    def _group_distances(self, frames: Tensor, g: int) -> Tensor:
        """Distances [spheres, batch] of all spheres of a group, at most 1 m of their centres."""
        spheres, count = self._group(g), len(frames)
        centres = self._group_centres(frames, g)
        best = centres.new_full((centres.shape[0], count), FAR + float(self._radii.max()))
        for x, y, z, radius in self._spheres.tolist():
            offset = centres - centres.new_tensor([x, y, z])[:, None]
            length = offset.square_().sum(1).sqrt_()
            best = torch.minimum(best, length.sub_(radius), out=best)
        T = frames[:, self._frame[g]].permute(1, 2, 0).reshape(3, 4 * count)
        for rows, distance in self._oriented:
            for row in rows:
                # straight to the frame of the obstacle: one small matrix product
                M = (row[3:12].reshape(3, 3) @ T).reshape(3, 4, count)
                M[:, 3] -= row[3:12].reshape(3, 3) @ row[:3, None]
                local = self._centres[spheres] @ M.transpose(0, 1).reshape(4, 3 * count)
                u, v, w = local.reshape(len(local), 3, count).unbind(1)
                best = torch.minimum(best, distance(u, v, w, *row[12:]), out=best)
        if self._grid is not None:
            best = torch.minimum(best, self._grid_distance(centres.transpose(1, 2)), out=best)
        return best - self._radii[spheres, None]

    def _scene_distance(self, at: Float[Tensor, "batch k 3"]) -> Float[Tensor, "batch k"]:
        """Signed distances of points."""
        # an empty scene has a gradient too: zero
        distance = 0 * at[..., 0] + FAR + float(self._radii.max())
        if len(self._spheres):
            offset = at[:, :, None] - self._spheres[:, :3]
            length = torch.sqrt(offset.square().sum(-1) + EPSILON)
            distance = torch.minimum(distance, (length - self._spheres[:, 3]).amin(-1))
        for rows, shape_distance in self._oriented:
            x, y, z = (v[..., None] - c for v, c in zip(at.unbind(-1), rows[:, :3].unbind(-1), strict=True))
            r = rows[:, 3:12].reshape(-1, 3, 3)
            local = (r[:, i, 0] * x + r[:, i, 1] * y + r[:, i, 2] * z for i in range(3))
            found = shape_distance(*local, *rows[:, 12:].unbind(-1))
            distance = torch.minimum(distance, found.amin(-1))
        if self._grid is not None:
            distance = torch.minimum(distance, self._grid_distance(at))
        return distance

    def _grid_distance(self, at: Float[Tensor, "a b 3"]) -> Float[Tensor, "a b"]:
        """Trilinear interpolation of the distance grid; beyond it the value at its border."""
        assert self._grid is not None
        shape = at.new_tensor(self._grid.shape[2:])
        # grid_sample takes the last axis first and puts -1 and 1 at the outer faces of the grid
        where = (2 * (at - self._grid_low) / (self._voxel * shape) - 1).flip(-1)[None, None]
        sampled = torch.nn.functional.grid_sample(
            self._grid, where, padding_mode="border", align_corners=False
        )
        return sampled[0, 0, 0]


def _to_points(scene: SceneArrays) -> Float[ndarray, "nx ny nz"]:
    """Distances from the grid's voxel centres to points near them, as smooth as their bounds are not."""
    frame, shape = scene.grid_frame, scene.grid_frame[8:11].astype(int)
    known = scene.nearest >= 0
    at = frame[:3] + (np.stack(np.unravel_index(np.flatnonzero(known), shape), axis=1) + 0.5) * frame[3]
    field = scene.grid.copy()
    field[known] = np.linalg.norm(at - scene.points[scene.nearest[known], :3], axis=1)
    return field.reshape(shape)


def _least(distances: Float[Tensor, "spheres batch"]) -> Int[Tensor, "batch"]:
    """The row of each column's least number; a minimum along contiguous numbers is several times faster."""
    return distances.t().contiguous().argmin(-1)


def _box(u: Tensor, v: Tensor, w: Tensor, hx: Tensor, hy: Tensor, hz: Tensor) -> Tensor:
    """Signed distance of points in the frame of the box, from its half edges."""
    a, b, c = u.abs() - hx, v.abs() - hy, w.abs() - hz
    inside = torch.maximum(torch.maximum(a, b), c).clamp(max=0)
    a, b, c = a.clamp(min=0), b.clamp(min=0), c.clamp(min=0)
    return torch.sqrt(a * a + b * b + c * c + EPSILON) + inside


def _cylinder(u: Tensor, v: Tensor, w: Tensor, radius: Tensor, half: Tensor, _: Tensor) -> Tensor:
    side, end = torch.sqrt(u * u + v * v + EPSILON) - radius, w.abs() - half
    inside = torch.maximum(side, end).clamp(max=0)
    side, end = side.clamp(min=0), end.clamp(min=0)
    return torch.sqrt(side * side + end * end + EPSILON) + inside


def _capsule(u: Tensor, v: Tensor, w: Tensor, radius: Tensor, half: Tensor, _: Tensor) -> Tensor:
    w = (w.abs() - half).clamp(min=0)
    return torch.sqrt(u * u + v * v + w * w + EPSILON) - radius
