"""Assumptions of the policies for unknown space: obstacles beside what was seen, with the ends carved free."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_scene_for, reach_bound
from robotdiffuse.perception.depth_view import AssumedPoints, SeenPoints
from robotdiffuse.perception.observed_volume import LOW, SHAPE, VOXEL, ObservedVolume
from robotdiffuse.perception.seen_points_kernel import near_scene, sphere_distances
from robotdiffuse.perception.swept_voxels_kernel import mark, surface
from robotdiffuse.problems.problem import OCCUPIED, PADDED, PREDICTED, Problem
from robotdiffuse.scenes.point_cloud import voxel_thin

PADDINGS = (0.09, 0.06, 0.04)
"""[m]"""
PADDED_SHARE, PADDED_MORE = 1.3, 0.01
"""Points nearer to an end's covering spheres than 1.3 times their padding and 1 cm are not padded: thinning
lets them grow."""
THIRD = 1 / 3
"""Cells that one point is kept of, as a share of its padding."""
THRESHOLDS = (0.1, 0.2, 0.35, 0.5)
"""Probabilities above which a voxel is an obstacle."""
CARVED = 0.02
"""Voxels nearer to an end's covering spheres than this are none [m]."""
FINE = VOXEL / 2
"""Edge of an predicted voxel [m]."""
FINE_SHAPE = (2 * SHAPE[0], 2 * SHAPE[1], 2 * SHAPE[2])


class Assumption(ABC):
    """Obstacles beside what was seen."""

    name: str

    @abstractmethod
    def _touched(self, spheres: Float32[ndarray, "n 4"]) -> Bool[ndarray, "..."]:
        """Those that have to be carved out for the arm's covering spheres, x y z radius [m]."""

    def touched(self, spheres: Float32[ndarray, "n 4"]) -> int:
        """How many have to be carved out for these spheres."""
        return int(self._touched(spheres).sum())

    @abstractmethod
    def obstacles(self, spheres: Float32[ndarray, "n 4"]) -> AssumedPoints:
        """What is left of them then."""


@dataclass(frozen=True, eq=False)
class Padded(Assumption):
    """Points that are larger than they were seen."""

    points: Float[ndarray, "points 3"]
    padding: float
    """[m]"""

    @property
    def name(self) -> str:  # type: ignore[override]
        return f"points padded by {100 * self.padding:.0f} cm"

    def _touched(self, spheres: Float32[ndarray, "n 4"]) -> Bool[ndarray, "points"]:
        return sphere_distances(self.points, spheres) < PADDED_SHARE * self.padding + PADDED_MORE

    def obstacles(self, spheres: Float32[ndarray, "n 4"]) -> AssumedPoints:
        return AssumedPoints(self.points[~self._touched(spheres)], self.padding, name="padded")


@dataclass(frozen=True, eq=False)
class Voxels(Assumption):
    """Voxels of the observed volume, or their eighths."""

    name: str
    occupied: Bool[ndarray, "nx ny nz"]
    problem: Problem

    @property
    def edge(self) -> float:
        return VOXEL * SHAPE[0] / len(self.occupied)

    def _touched(self, spheres: Float32[ndarray, "n 4"]) -> Bool[ndarray, "nx ny nz"]:
        return self.occupied & voxels_in(spheres, CARVED + self.edge / 2, self.edge)

    def obstacles(self, spheres: Float32[ndarray, "n 4"]) -> AssumedPoints:
        """Those at the surface, for the arm, which starts outside, cannot get within; without those that it
        cannot reach and those in shapes that are known."""
        points = (surface(self.occupied & ~self._touched(spheres)) + 0.5) * self.edge + LOW
        robot, known = self.problem.robot, self.problem.known_scene
        points = points[np.linalg.norm(points, axis=1) < reach_bound(robot) + self.edge]
        if known.shapes:
            inside = np.float32(self.edge / 2 - 1e-3)
            points = points[~near_scene(compile_scene_for(robot, known), points.astype(np.float32), inside)]
        return AssumedPoints(points, self.edge / 2, name="unknown")


def fine(voxels: Bool[ndarray, "mx my mz"]) -> Bool[ndarray, "nx ny nz"]:
    """Voxels of the observed volume as their eighths."""
    return voxels.repeat(2, 0).repeat(2, 1).repeat(2, 2)


def voxels_in(
    spheres: Float32[ndarray, "n 4"], more: float = 0.0, edge: float = FINE
) -> Bool[ndarray, "nx ny nz"]:
    """Voxels of the volume whose centres are in spheres that are larger by `more` [m]."""
    out = np.zeros([round(n * VOXEL / edge) for n in SHAPE], np.bool_)
    larger = spheres + np.array([0, 0, 0, more], np.float32)
    mark(larger, np.array(LOW, np.float32), np.float32(edge), out)
    return out


def assumptions(
    problem: Problem, volume: ObservedVolume, predicted: Float32[ndarray, "nx ny nz"] | None
) -> Iterator[Assumption]:
    """Those of the problem's policy, the most careful first.

    `predicted`: the probability that each fine voxel is occupied, for the policy of that name.
    """
    if problem.unknown == PADDED:
        seen = [shape.points for shape in problem.scene.shapes if isinstance(shape, SeenPoints)]
        points = np.concatenate([np.zeros((0, 3)), *seen])
        for padding in PADDINGS:
            yield Padded(voxel_thin(points, padding * THIRD), padding)
    elif problem.unknown == PREDICTED:
        assert predicted is not None
        for threshold in THRESHOLDS:
            yield Voxels(f"predicted, p > {threshold:g}", predicted > threshold, problem)
    elif problem.unknown == OCCUPIED:
        yield Voxels("unknown is occupied", volume.unknown, problem)
