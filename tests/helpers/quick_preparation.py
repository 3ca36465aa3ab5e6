"""Preparation of robots in a fraction of a second: few samples, coarse grids, coarse hulls, fat spheres."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from robotdiffuse.robots.fitting import sphere_fitting
from robotdiffuse.robots.fitting.convex_parts import PartSettings
from robotdiffuse.robots.fitting.preparation import PreparationSettings
from robotdiffuse.robots.fitting.self_collisions import SamplingSettings

QUICK = PreparationSettings(
    parts=PartSettings(voxels=20_000, faces=60, rounding=2e-3),
    spheres=sphere_fitting.SphereSettings(first_half=0.03, second_half=0.03, candidates=200, rounds=2),
    sampling=SamplingSettings(samples=100, descents=1),
    samples=100,
    rounds=0,
)


@contextmanager
def coarse_grids() -> Iterator[None]:
    """A context in which spheres are fitted on a tenth of the grid points."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sphere_fitting, "GRID_POINTS", sphere_fitting.GRID_POINTS // 10)
        yield
