"""Space that no view saw, and the part of it that a motion passes through."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.core.types import Path
from robotdiffuse.perception.assumptions import (
    CARVING_MARGIN,
    FINE,
    VoxelGrid,
    voxels_in,
)
from robotdiffuse.perception.sampled_worlds import free_share
from robotdiffuse.perception.swept_voxels_kernel import heaviest_part, summed, sweep
from robotdiffuse.robots.kinematics import placed_spheres
from robotdiffuse.robots.robot import Robot

Box = tuple[tuple[float, ...], tuple[float, ...]]
"""Low and high corner [m]."""


class UnknownSpace:
    """The voxels that no view saw, without those that the arm occupies at given configurations, and the
    predicted probabilities there."""

    def __init__(
        self,
        robot: Robot,
        occupied_by_arm: Float[ndarray, "n dof"],
        unknown: Bool[ndarray, "nx ny nz"],
        predicted: Float32[ndarray, "nx ny nz"] | None,
        margin: float = CARVING_MARGIN,
        grid: VoxelGrid = FINE,
    ) -> None:
        """
        occupied_by_arm: configurations at which the arm is known to be free: the start and the goals.
        unknown: the voxels of the grid that no view saw.
        predicted: the probability that each voxel is occupied; None without a prediction.
        margin: voxels nearer than this to the arm at those configurations count as occupied by it [m].
        """
        self._robot, self._grid = compile_robot(robot), grid
        spheres = [placed_spheres(robot, q).astype(np.float32) for q in occupied_by_arm]
        self.unknown = unknown & ~voxels_in(np.concatenate(spheres), margin, grid)
        self.probability = None if predicted is None else np.where(self.unknown, predicted, np.float32(0))

    def crossed(self, path: Path) -> "CrossedSpace":
        """The unknown voxels that the arm passes through on a path."""
        swept, positions = np.zeros(self._grid.shape, np.bool_), path.positions.astype(np.float32)
        sweep(self._robot, positions, np.float32(0.0), *self._grid.frame, swept)
        return CrossedSpace(swept & self.unknown, self.probability, self._grid)


@dataclass(frozen=True, eq=False)
class CrossedSpace:
    """The unknown space that a motion passes through."""

    voxels: Bool[ndarray, "nx ny nz"]
    probability: Float32[ndarray, "nx ny nz"] | None
    """That each voxel is occupied."""
    grid: VoxelGrid = FINE

    @cached_property
    def risk(self) -> float | None:
        """The summed probability of the voxels; None without a prediction."""
        return None if self.probability is None else float(summed(self.probability, self.voxels))

    @cached_property
    def free_share(self) -> float | None:
        """The part of the sampled worlds in which all of the voxels are free; None without a prediction."""
        return None if self.probability is None else free_share(self.probability, self.voxels)

    @property
    def region(self) -> Box | None:
        """The bounding box of the connected part with the largest summed probability, or of the largest part
        without a prediction; None if there are no voxels."""
        if not self.voxels.any():
            return None
        weights = np.ones(self.grid.shape, np.float32) if self.probability is None else self.probability
        corners = heaviest_part(self.voxels, weights) * self.grid.edge + np.array(self.grid.low)
        low, high = corners.round(3).tolist()
        return tuple(low), tuple(high)
