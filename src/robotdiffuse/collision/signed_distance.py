"""The collision model as a differentiable signed distance in PyTorch, for losses and for GPUs."""

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from robotdiffuse.collision.arrays import GRID_BAND, compile_robot, compile_scene, reach, robot_groups
from robotdiffuse.robots.kinematics import ForwardKinematics
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

FAR = 1.0
"""Distance to an empty scene [m], and the most that is reported."""


class SignedDistance:
    """Signed distances of a robot's covering spheres to a scene and between its links, by batches.

    The same spheres and shapes as `CollisionChecker`; differentiable in the configurations. For point clouds
    and meshes the distance is interpolated in a grid that reaches 0.2 m, and exact to the grid's spacing.
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
        counts = np.diff(arrays.first)
        moving = arrays.frame > 0
        self.links = tuple(link for link in groups if robot.link_frame(link) > 0)
        """The moving links with spheres: the last axis of the result."""
        self.pairs = tuple((groups[a], groups[b]) for a, b in arrays.pairs)
        """The checked pairs of links: the last axis of `self_distance`."""
        self._frame_of_sphere = torch.as_tensor(np.repeat(arrays.frame, counts), device=device).long()
        self._centres, self._radii = tensor(arrays.spheres[:, :3]), tensor(arrays.spheres[:, 3])
        self._first_moving = int(counts[~moving].sum())
        self._sizes = [int(n) for n in counts[moving]]
        self._spans = [(int(arrays.first[a]), int(arrays.first[a + 1])) for a in range(len(groups))]
        self._pair_index = [(int(a), int(b)) for a, b in arrays.pairs]
        obstacles = compile_scene(scene, reach(robot))
        self._spheres = tensor(obstacles.spheres)
        oriented = (obstacles.boxes, obstacles.cylinders, obstacles.capsules)
        self._boxes, self._cylinders, self._capsules = (_Oriented(tensor(rows)) for rows in oriented)
        self._grid = tensor(obstacles.grid) if len(obstacles.points) else None
        self._grid_low = tensor(obstacles.grid_frame[:3])
        self._voxel = float(obstacles.grid_frame[3])

    def __call__(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch links"]:
        """Least signed distance of the spheres of each moving link to the scene [m], at most 1 m."""
        at = self._sphere_centres(q, self._first_moving)
        x, y, z = at
        distance = torch.full_like(x, FAR)
        if len(self._spheres):
            dx, dy, dz = (at[i][..., None] - self._spheres[:, i] for i in range(3))
            length = torch.sqrt(dx * dx + dy * dy + dz * dz + 1e-12)
            distance = torch.minimum(distance, (length - self._spheres[:, 3]).amin(-1))
        if len(self._boxes.dims):
            distance = torch.minimum(distance, self._boxes.box_distance(x, y, z))
        if len(self._cylinders.dims):
            distance = torch.minimum(distance, self._cylinders.cylinder_distance(x, y, z))
        if len(self._capsules.dims):
            distance = torch.minimum(distance, self._capsules.capsule_distance(x, y, z))
        if self._grid is not None:
            distance = torch.minimum(distance, self._grid_distance(at))
        distance = distance - self._radii[self._first_moving :]
        links = [part.amin(-1) for part in distance.split(self._sizes, dim=-1)]
        return torch.stack(links, dim=-1).reshape(*q.shape[:-1], len(self.links))

    def self_distance(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch pairs"]:
        """Least distance between the spheres of the two links of each checked pair [m]."""
        at = self._sphere_centres(q, 0)
        found = []
        for a, b in self._pair_index:
            (a0, a1), (b0, b1) = self._spans[a], self._spans[b]
            gap = at[:, :, a0:a1, None] - at[:, :, None, b0:b1]
            length = torch.sqrt((gap * gap).sum(0) + 1e-12)
            found.append((length - self._radii[a0:a1, None] - self._radii[b0:b1]).flatten(1).amin(-1))
        if not found:
            return q.new_zeros((*q.shape[:-1], 0))
        return torch.stack(found, dim=-1).reshape(*q.shape[:-1], len(found))

    def _sphere_centres(self, q: Tensor, first: int) -> Tensor:
        """[3, batch, spheres from `first` on]"""
        frames = self._kinematics(q).reshape(-1, self.robot.dof + 1, 4, 4)
        T = frames[:, self._frame_of_sphere[first:], :3]
        return (T[..., :3] @ self._centres[first:, :, None] + T[..., 3:]).squeeze(-1).permute(2, 0, 1)

    def _grid_distance(self, at: Tensor) -> Tensor:
        """Trilinear interpolation of the distance grid; 0.2 m outside."""
        assert self._grid is not None
        where = (at - self._grid_low[:, None, None]) / self._voxel
        shape = where.new_tensor(self._grid.shape)[:, None, None]
        # grid_sample takes the last axis first and puts -1 and 1 at the outer faces of the grid
        normalised = (2 * where / shape - 1).flip(0).permute(1, 2, 0)[None, None]
        offset = GRID_BAND
        sampled = torch.nn.functional.grid_sample(
            self._grid[None, None] - offset, normalised, padding_mode="zeros", align_corners=False
        )
        return sampled[0, 0, 0] + offset


class _Oriented:
    """Boxes, cylinders or capsules: rows of SceneArrays as tensors."""

    def __init__(self, rows: Float[Tensor, "n 15"]) -> None:
        self.centres, self.rotations, self.dims = rows[:, :3], rows[:, 3:12], rows[:, 12:]

    def _local(self, x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
        dx, dy, dz = (v[..., None] - self.centres[:, i] for i, v in enumerate((x, y, z)))
        r = self.rotations
        return [r[:, 3 * i] * dx + r[:, 3 * i + 1] * dy + r[:, 3 * i + 2] * dz for i in range(3)]

    def box_distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        gaps = [v.abs() - self.dims[:, i] for i, v in enumerate(self._local(x, y, z))]
        u, v, w = (gap.clamp(min=0) for gap in gaps)
        inside = torch.maximum(torch.maximum(gaps[0], gaps[1]), gaps[2]).clamp(max=0)
        return (torch.sqrt(u * u + v * v + w * w + 1e-12) + inside).amin(-1)

    def cylinder_distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        u, v, w = self._local(x, y, z)
        side = torch.sqrt(u * u + v * v + 1e-12) - self.dims[:, 0]
        end = w.abs() - self.dims[:, 1]
        a, b = side.clamp(min=0), end.clamp(min=0)
        return (torch.sqrt(a * a + b * b + 1e-12) + torch.maximum(side, end).clamp(max=0)).amin(-1)

    def capsule_distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        u, v, w = self._local(x, y, z)
        w = (w.abs() - self.dims[:, 1]).clamp(min=0)
        return (torch.sqrt(u * u + v * v + w * w + 1e-12) - self.dims[:, 0]).amin(-1)
