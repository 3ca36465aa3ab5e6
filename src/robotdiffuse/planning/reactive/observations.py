"""Moving obstacles as observed: their poses and velocities, and where they may be next."""

from copy import copy
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.collision.moving_obstacles import MovingCollision
from robotdiffuse.core.bounds import numbers, rigid_transform, within
from robotdiffuse.core.errors import InputError, distinct
from robotdiffuse.core.transforms import inverse, rotation_angle, transform
from robotdiffuse.core.types import Trajectory
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.moving_obstacles import MovingObstacle
from robotdiffuse.scenes.shapes import Shape

OBSERVATION_ERROR = 1e-3
"""Tolerance for an obstacle that seems to move faster than its maximum speed, for inexact observations
[m]."""


@dataclass(frozen=True, eq=False)
class ObservedObstacle:
    """An obstacle as it was last seen."""

    obstacle: MovingObstacle
    """As in the problem, or static where it was last seen."""
    time: float = np.nan
    """When it was last seen [s]; NaN: never."""
    velocity: Float[ndarray, "3"] | None = None
    """[m/s]; None: unknown."""

    def again(self, value: ArrayLike, now: float) -> "ObservedObstacle":
        """The obstacle after a new observation."""
        name, T_before = self.obstacle.name, self.obstacle.shape.T_base_shape
        xyz = numbers(value)
        if xyz is not None and xyz.shape == (3,) and within(xyz):
            T = transform(xyz, T_before[:3, :3])
        else:
            T = rigid_transform(f"observation[{name!r}]", value)
        most = self.obstacle.top_speed
        velocity = self.obstacle.velocity
        if np.isfinite(self.time):
            passed = now - self.time
            moved = np.linalg.norm(T[:3, 3] - T_before[:3, 3])
            moved += self.obstacle.radius * rotation_angle(T_before[:3, :3].T @ T[:3, :3])
            if moved > most * passed + OBSERVATION_ERROR:
                way, allowed = distinct(float(moved), most * passed, digits=3)
                raise InputError(
                    f"observation[{name!r}] is {way} m from where it was {passed:.3g} s ago; its "
                    f"maximum speed {most:g} m/s allows {allowed} m"
                )
            velocity = (T[:3, 3] - T_before[:3, 3]) / passed
        shape = self.obstacle.shape.moved(T @ inverse(T_before))
        return ObservedObstacle(MovingObstacle(shape, max_speed=most), now, velocity)

    def anywhere(self) -> MovingObstacle:
        """The obstacle moving in any way from when it was last seen."""
        return MovingObstacle(self.obstacle.shape, max_speed=self.obstacle.top_speed)

    def straight_on(self, now: float) -> MovingObstacle:
        """The obstacle keeping the velocity last seen, from now on."""
        velocity = np.zeros(3) if self.velocity is None else self.velocity
        passed = transform((now - self.time) * velocity)
        return MovingObstacle(self.obstacle.shape.moved(passed), velocity=velocity)


class PredictedObstacles:
    """Moving obstacles from a time on, grown or predicted, for checks of motions in time."""

    def __init__(self, robot: Robot, moving: list[MovingObstacle], since: float) -> None:
        self._moving, self._since = moving, since
        self._collision = MovingCollision(robot, moving, 0.0, 0.0)
        self.margin = np.zeros(len(moving))

    def wider(self, margin: Float[ndarray, "obstacles"]) -> "PredictedObstacles":
        """The same obstacles, each inflated by a margin [m]."""
        other = copy(self)
        other.margin = self.margin + margin
        other._collision = self._collision.inflated(margin)
        return other

    def shapes(self, time: float) -> list[Shape]:
        """The obstacles at a time [s]."""
        return [one.at(time - self._since) for one in self._moving]

    def near(self, motion: Trajectory, begins: float, clearance: float) -> float | None:
        """When an obstacle first comes nearer to the motion than the clearance [s]; None if none does."""
        times = motion.times + (begins - self._since)
        first = self._collision.first_unproved_time(times, motion.positions, clearance)
        return None if first is None else first + self._since

    def comes_to(
        self, q: Float[ndarray, "n dof"], times: Float[ndarray, "n"], rest_time: float
    ) -> float | None:
        """When an obstacle first touches the arm on its way, or while it then rests for `rest_time` [s]; None
        if none."""
        times = np.append(times, times[-1] + rest_time) - self._since
        first = self._collision.first_unproved_time(times, np.concatenate([q, q[-1:]]), 0.0)
        return None if first is None else first + self._since

    def comes(self, q: Float[ndarray, "dof"], time: float, rest_time: float) -> float | None:
        """When an obstacle first touches the arm at rest [s]; None if none does."""
        return self.comes_to(q[None], np.array([time]), rest_time)

    def free(
        self,
        times: Float[ndarray, "n"],
        q: Float[ndarray, "n dof"],
        begins: float,
        horizon: float,
        rest_time: float,
    ) -> bool:
        """Whether no obstacle touches the arm on its way for `horizon` [s], or until it has rested at the end
        for `rest_time` [s]."""
        soon = max(int(np.searchsorted(times, horizon)), 1)
        rest_time = rest_time if soon == len(times) else 0.0
        return self.comes_to(q[:soon], times[:soon] + begins, rest_time + 1e-3) is None
