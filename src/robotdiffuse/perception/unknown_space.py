"""Space that no view saw, and what motions cross of it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.core.types import Path
from robotdiffuse.perception.assumptions import CARVED, FINE, FINE_SHAPE, fine, voxels_in
from robotdiffuse.perception.observed_volume import LOW, ObservedVolume
from robotdiffuse.perception.swept_voxels_kernel import heaviest_part, summed, sweep
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots.kinematics import placed_spheres

Box = tuple[tuple[float, ...], tuple[float, ...]]
"""Low and high corner [m]."""


class UnknownSpace:
    """What no view of a problem saw, less what the arm fills at its ends, and what is predicted there."""

    def __init__(
        self, problem: Problem, volume: ObservedVolume, predicted: Float32[ndarray, "nx ny nz"] | None
    ) -> None:
        """`predicted`: the probability that each fine voxel is occupied; None where nothing says so."""
        self._robot = compile_robot(problem.robot)
        goals = problem.goal.positions if isinstance(problem.goal, JointGoal) else ()
        ends = [placed_spheres(problem.robot, q).astype(np.float32) for q in (problem.start, *goals)]
        self.unknown = fine(volume.unknown)
        self.unknown &= ~voxels_in(np.concatenate(ends), CARVED)
        self.probability = None if predicted is None else np.where(self.unknown, predicted, np.float32(0))

    def crossed(self, path: Path) -> "Crossed":
        """The unknown voxels that the arm passes through."""
        swept = np.zeros(FINE_SHAPE, np.bool_)
        positions = path.positions.astype(np.float32)
        sweep(self._robot, positions, np.array(LOW, np.float32), np.float32(FINE), swept)
        return Crossed(swept & self.unknown, self.probability)


@dataclass(frozen=True, eq=False)
class Crossed:
    """What a motion crosses of unknown space."""

    voxels: Bool[ndarray, "nx ny nz"]
    probability: Float32[ndarray, "nx ny nz"] | None

    @cached_property
    def risk(self) -> float | None:
        """The voxels' summed probability; None where none is predicted."""
        return None if self.probability is None else float(summed(self.probability, self.voxels))

    @property
    def region(self) -> Box | None:
        """The corners of a box around that connected part of them which is likeliest to be occupied; around
        the largest where nothing is predicted."""
        if not self.voxels.any():
            return None
        weights = np.ones(FINE_SHAPE, np.float32) if self.probability is None else self.probability
        corners = heaviest_part(self.voxels, weights) * FINE + np.array(LOW)
        low, high = corners.round(3).tolist()
        return tuple(low), tuple(high)
