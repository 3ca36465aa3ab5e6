"""Forward kinematics and geometric Jacobians, batched and differentiable."""

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from robotdiffuse.core.errors import InputError
from robotdiffuse.robots.robot import Robot


class ForwardKinematics:
    """Poses of a robot's frames and links at batches of configurations; differentiable any number of times.

    Configurations `q` [rad], or [m] for prismatic joints, have any batch shape. They are converted to the
    dtype and device given here, which the results have too. Calls raise InputError if the last axis of q does
    not have the number of planned joints, or if the link is unknown.

    Each step is T[j + 1] = T[parents[j]] @ (C + cos(q) A + sin(q) B) with constant A, B and C, so it takes
    one small matrix product and two multiply-adds over the batch.
    """

    def __init__(
        self, robot: Robot, dtype: torch.dtype = torch.float32, device: str | torch.device = "cpu"
    ) -> None:
        self.robot = robot
        self.dtype = dtype
        self.device = torch.device(device)
        frames = [robot.link_frame(link) for link in robot.link_names]
        self._frames = torch.tensor(frames, device=self.device)
        self._T_frame_link = self._tensor(np.stack([robot.T_frame_link(link) for link in robot.link_names]))
        turns = np.zeros((3, 4, 4))
        turns[0, 2, 2] = turns[0, 3, 3] = 1
        turns[1, 0, 0] = turns[1, 1, 1] = 1
        turns[2, 1, 0], turns[2, 0, 1] = 1, -1
        slides = np.stack([np.eye(4), np.outer([0, 0, 1, 0], [0, 0, 0, 1])])
        self._steps = []
        """By joint, [12, 4]: C, A and B transposed, stacked; [8, 4]: C and the slide of a prismatic joint."""
        for offset, prismatic in zip(robot.frame_offsets, robot.prismatic, strict=True):
            self._steps.append(self._tensor(np.hstack(list(offset @ (slides if prismatic else turns))).T))
        self._last_row = self._tensor(np.array([[0.0], [0.0], [0.0], [1.0]]))

    def __call__(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch frames 4 4"]:
        """T_base_frame of all dof + 1 frames, the base (identity) first."""
        return self._frames_up_to(q, self.robot.dof)

    def link(self, q: Float[Tensor, "*batch dof"], link: str) -> Float[Tensor, "*batch 4 4"]:
        """T_base_link of one link."""
        frame = self.robot.link_frame(link)
        T_frame_link = self._T_frame_link[self.robot.link_names.index(link)]
        return self._frames_up_to(q, frame)[..., frame, :, :] @ T_frame_link

    def links(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch links 4 4"]:
        """T_base_link of every link, in the order of `robot.link_names`."""
        return self(q)[..., self._frames, :, :] @ self._T_frame_link

    def jacobian(self, q: Float[Tensor, "*batch dof"], link: str) -> Float[Tensor, "*batch 6 dof"]:
        """Geometric Jacobian of a link: linear [m/rad], then angular velocity per unit of joint velocity.

        Both in the axes of the base frame; the linear one is of the origin of the link.
        """
        frame = self.robot.link_frame(link)
        T = self._frames_up_to(q, frame)
        p_base_link = T[..., frame, :3, :] @ self._T_frame_link[self.robot.link_names.index(link), :, 3]
        columns = []
        for j in range(self.robot.dof):
            if not self.robot.moved_by[frame, j]:
                columns.append(torch.zeros((*T.shape[:-3], 6), dtype=self.dtype, device=self.device))
                continue
            axis = T[..., j + 1, :3, 2]
            if self.robot.prismatic[j]:
                columns.append(torch.cat([axis, torch.zeros_like(axis)], dim=-1))
            else:
                lever = p_base_link - T[..., j + 1, :3, 3]
                columns.append(torch.cat([torch.linalg.cross(axis, lever), axis], dim=-1))
        return torch.stack(columns, dim=-1)

    def _frames_up_to(self, q: Tensor, last: int) -> Tensor:
        if q.shape[-1:] != (self.robot.dof,):
            raise InputError(
                f"q has shape {tuple(q.shape)}; its last axis must have the {self.robot.dof} planned joints"
            )
        batch = q.shape[:-1]
        q = q.to(self.device, self.dtype).reshape(-1, self.robot.dof).t()
        cosines, sines = q.cos(), q.sin()
        # the batch is the last axis here, so that every operation runs along contiguous numbers
        T = torch.eye(4, dtype=self.dtype, device=self.device)[:3, :, None].expand(3, 4, q.shape[1])
        frames = [T]
        for j in range(last):
            T = frames[self.robot.parents[j]]
            parts = self._steps[j] @ T
            if self.robot.prismatic[j]:
                T = torch.addcmul(parts[:, :4], q[j], parts[:, 4:])
            else:
                T = torch.addcmul(parts[:, :4], cosines[j], parts[:, 4:8])
                T = torch.addcmul(T, sines[j], parts[:, 8:])
            frames.append(T)
        top = torch.stack(frames)
        bottom = self._last_row.expand(last + 1, 1, 4, q.shape[1])
        return torch.cat([top, bottom], dim=1).permute(3, 0, 1, 2).reshape(*batch, last + 1, 4, 4)

    def _tensor(self, array: ndarray) -> Tensor:
        return torch.as_tensor(array, dtype=self.dtype, device=self.device)
