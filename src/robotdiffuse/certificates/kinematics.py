"""Where links are, and how far they can go from there: the checker's own kinematics, in NumPy.

It reads a robot's joints and nothing that searches or the judge make of them.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from robotdiffuse.robots.robot import Robot


class Postures(NamedTuple):
    """An arm at n configurations, in the frame of its base."""

    T: Float[ndarray, "n links 4 4"]
    """Of `Linkage.links`."""
    origins: Float[ndarray, "n dof 3"]
    """A point on the axis of each planned joint [m], ..."""
    axes: Float[ndarray, "n dof 3"]
    """... and its direction."""


class Linkage:
    """A robot as joints and links."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.links = (robot.base, *(joint.child for joint in robot.joints))
        self.slides = np.array([joint.kind == "prismatic" for joint in robot.planned_joints], bool)
        self._planned = {joint.name: j for j, joint in enumerate(robot.planned_joints)}

    @cached_property
    def moved(self) -> Bool[ndarray, "links dof"]:
        """Which planned joints move each link."""
        moved = {self.robot.base: np.zeros(len(self._planned), bool)}
        for joint in self.robot.joints:
            moved[joint.child] = moved[joint.parent].copy()
            if joint.name in self._planned:
                moved[joint.child][self._planned[joint.name]] = True
        return np.stack([moved[link] for link in self.links])

    def place(self, q: Float[ndarray, "n dof"]) -> Postures:
        """The arm at configurations."""
        n, dof = len(q), len(self._planned)
        at = {self.robot.base: np.broadcast_to(np.eye(4), (n, 4, 4))}
        origins, axes = np.zeros((n, dof, 3)), np.zeros((n, dof, 3))
        for joint in self.robot.joints:
            T = at[joint.parent] @ joint.T_parent_joint
            if joint.name in self._planned:
                j = self._planned[joint.name]
                origins[:, j], axes[:, j] = T[:, :3, 3], T[:, :3, :3] @ joint.axis
                T = T @ _motion(joint.kind, joint.axis, q[:, j])
            elif joint.kind != "fixed":
                held = np.array([self.robot.locked.get(joint.name, 0.0)])
                T = T @ _motion(joint.kind, joint.axis, held)
            at[joint.child] = T
        return Postures(np.stack([at[link] for link in self.links], axis=1), origins, axes)

    def displacement(
        self,
        postures: Postures,
        rows: Int[ndarray, "m"],
        centers: Float[ndarray, "m 3"],
        radii: Float[ndarray, "m"],
        moved: Bool[ndarray, "m dof"],
        spans: Float[ndarray, "n dof"],
    ) -> Float[ndarray, "m"]:
        """How far any point of balls can go at most [m] when joints leave their postures by up to `spans`.

        Balls are given where they are in the postures of `rows`, and `moved` are the joints that move them,
        seen from a body before these. The last joint is turned first: joint j turns a ball, which the later
        ones have taken d away, on a circle of at most its distance from the axis plus d, so by at most
        spans_j times that. Axes of earlier joints are still where they are in the posture.
        """
        went = np.zeros(len(rows))
        for j in reversed(range(len(self.slides))):
            arm = 1.0
            if not self.slides[j]:
                across = np.cross(centers - postures.origins[rows, j], postures.axes[rows, j])
                arm = np.sqrt((across**2).sum(axis=1)) + radii + went
            went += np.where(moved[:, j], spans[rows, j] * arm, 0.0)
        return went

    def approach(
        self,
        origins: Float[ndarray, "dof 3"],
        axes: Float[ndarray, "dof 3"],
        points: Float[ndarray, "v 3"],
        moved_by: Int[ndarray, "joints"],
        steps: Float[ndarray, "rows dof"],
        normals: Float[ndarray, "k 3"],
    ) -> Float[ndarray, "k v"]:
        """How far points go against unit vectors at most [m], when joints leave their posture for anything on
        the straight lines through `steps` from it; only the joints `moved_by`, each behind the one before,
        count.

        To first order a point goes along the normal as a linear function of the joints, whose least value is
        at one of the steps. The rest is at most sum_k L_k D_k (D_k / 2 + sum_{j<k} D_j), where the joints'
        second derivatives of the point, by j <= k, are at most its greatest distance L_k from axis k.
        """
        which, spans = moved_by.tolist(), np.abs(steps).max(axis=0)
        rates = np.cross(axes[which, None], points[None] - origins[which, None])
        rates[self.slides[which]] = axes[which, None][self.slides[which]]
        lengths = np.sqrt((rates**2).sum(axis=2))
        along = np.moveaxis(rates @ normals.T, 2, 1).reshape(len(which), -1)
        towards = -(steps[:, which] @ along).min(axis=0).reshape(len(normals), len(points))
        went, rest = np.zeros(len(points)), np.zeros(len(points))
        for i in reversed(range(len(which))):
            j = which[i]
            arm = lengths[i] if self.slides[j] else lengths[i] + went
            went = went + spans[j] * arm
            rest += spans[j] * arm * (spans[j] / 2 + spans[which[:i]].sum())
        return np.minimum(np.maximum(towards, 0.0) + rest, went)


def _motion(kind: str, axis: Float[ndarray, "3"], q: Float[ndarray, "n"]) -> Float[ndarray, "n 4 4"]:
    T = np.tile(np.eye(4), (len(q), 1, 1))
    if kind == "prismatic":
        T[:, :3, 3] = q[:, None] * axis
        return T
    x, y, z = axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    T[:, :3, :3] += np.sin(q)[:, None, None] * K + (1 - np.cos(q))[:, None, None] * (K @ K)
    return T
