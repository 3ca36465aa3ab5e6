"""Convex parts contain their mesh, follow it closely, and are few and simple."""

import tracemalloc
from functools import cache

import numpy as np
import pytest
import trimesh

from helpers.box_arm import boxes, surface
from robotdiffuse.robots.bodies import ConvexMesh
from robotdiffuse.robots.fitting import convex_parts
from robotdiffuse.robots.fitting.triangles import split

L = boxes(((0, 0, 0), (0.3, 0.1, 0.1)), ((0, 0, 0.1), (0.1, 0.1, 0.4)))
FRAME = boxes(
    ((0, 0, 0), (0.4, 0.1, 0.05)),
    ((0, 0, 0.35), (0.4, 0.1, 0.4)),
    ((0, 0, 0.05), (0.05, 0.1, 0.35)),
    ((0.35, 0, 0.05), (0.4, 0.1, 0.35)),
)
BOWL = trimesh.creation.icosphere(3, 0.1).slice_plane([0, 0, 0], [0, 0, -1])  # open
MESHES = {"L": L, "frame": FRAME, "tube": trimesh.creation.annulus(0.08, 0.1, 0.3, sections=48), "bowl": BOWL}


@cache
def parts_of(name: str) -> tuple[ConvexMesh, ...]:
    return convex_parts.convex_parts((surface(MESHES[name]),))


def beyond(parts: tuple, points: np.ndarray) -> np.ndarray:
    """Largest distance of points from the nearest part."""
    return np.min([(points @ n.T - o).max(1) for n, o in map(convex_parts.planes_of, parts)], axis=0)


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in ("bowl", "tube"))) for name in MESHES])
def test_parts_hold_all_of_the_mesh(name: str) -> None:
    parts = parts_of(name)
    assert beyond(parts, trimesh.sample.sample_surface(MESHES[name], 20_000, seed=1)[0]).max() < 1e-9
    for part in parts:
        solid = trimesh.Trimesh(part.vertices, part.faces, process=False)
        assert solid.is_convex and solid.is_watertight and solid.volume > 0


def test_an_l_is_two_parts_of_its_own_volume_and_a_frame_stays_open() -> None:
    parts = parts_of("L")
    assert len(parts) <= 4
    assert sum(trimesh.Trimesh(part.vertices, part.faces).volume for part in parts) == pytest.approx(0.1 * 0.1 * 0.6, rel=0.1)
    # No single cut reduces the volume of the hull; cutting must continue nevertheless.
    parts = parts_of("frame")
    assert 4 <= len(parts) <= 6 and beyond(parts, np.array([[0.2, 0.05, 0.2]]))[0] > 0.1


def test_parts_stick_out_little_about_tight_places() -> None:
    """Parts may fill a wide hole within the tolerance, but not a hole near a tight place."""
    coarse = convex_parts.PartSettings(concavity=0.2, voxels=20_000)
    tight = np.array([[0.06, 0.05, 0.06]])
    whole = convex_parts.convex_parts((surface(FRAME),), coarse)
    parts = convex_parts.convex_parts((surface(FRAME),), coarse, tight)
    assert len(whole) == 1 < len(parts)
    # an eighth of the tolerance, and a voxel: 0.034 m, from the frame's bars, which end at 0.05 m
    assert beyond(whole, tight + 0.03)[0] < 0 < beyond(parts, tight + 0.03)[0]
    assert beyond(parts, np.asarray(trimesh.sample.sample_surface(FRAME, 5000, seed=1)[0])).max() < 1e-6


def test_simplified_hulls_hold_the_hull() -> None:
    points = np.random.default_rng(0).normal(size=(4000, 3))
    points *= np.array([0.1, 0.06, 0.08]) / np.linalg.norm(points, axis=1, keepdims=True)
    hull = convex_parts.convex_hull(points)
    few = convex_parts.simplified(hull)
    assert len(hull.faces) > 5000 and len(few.faces) <= 480
    assert beyond((few,), points).max() < 0 and beyond((hull,), few.vertices).max() < 0.004


def test_most_parts_are_a_bound() -> None:
    comb = boxes(*(((0.04 * i, 0, 0), (0.04 * i + 0.01, 0.05, 0.1)) for i in range(12)))
    parts = convex_parts.convex_parts((surface(comb),), convex_parts.PartSettings(most=5))
    assert len(parts) <= 5 and beyond(parts, trimesh.sample.sample_surface(comb, 5000, seed=1)[0]).max() < 1e-9


def test_the_order_of_triangles_does_not_matter() -> None:
    """Regression: with another order, a UR5 needed a second round of refinement."""
    bowl = surface(BOWL)
    shuffled = convex_parts.Surface(bowl.vertices, np.random.default_rng(0).permutation(bowl.faces))
    coarse = convex_parts.PartSettings(concavity=0.02, voxels=20_000)
    found, other = (
        sorted(tuple(part.vertices.min(axis=0).round(9)) for part in convex_parts.convex_parts((shape,), coarse))
        for shape in (bowl, shuffled)
    )
    assert len(found) > 1 and np.allclose(found, other, atol=1e-6)


def test_a_needle_is_split_into_as_many_pieces_as_it_is_long() -> None:
    """Regression: halves of halves; a CAD mesh of 17,653 long triangles became 58 million pieces, which took 4 GB and 40 s."""
    needle = np.array([[[0, 0, 0], [100.0, 0, 0], [100.0, 0.01, 0]]])
    pieces = split(np.concatenate([needle, needle[:, [2, 0, 1]] + 1, needle[:, [0, 2, 1]] - 1]), 1.0)
    assert len(pieces) < 3 * 210
    assert np.linalg.norm(pieces - np.roll(pieces, 1, axis=1), axis=2).max() <= 1 + 1e-12
    areas = np.linalg.norm(np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]), axis=1) / 2
    assert areas.sum() == pytest.approx(3 * 0.5, rel=1e-9)


def test_a_hull_of_many_corners_is_simplified_in_little_memory() -> None:
    """Regression: a table of corners by planes took 5 GB for a dome of 1.3 million triangles."""
    ball = trimesh.creation.icosphere(subdivisions=6)
    hull = ConvexMesh(np.array(ball.vertices), np.array(ball.faces))
    tracemalloc.start()
    simple = convex_parts.simplified(hull)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(simple.faces) < 1000 and peak < 100e6
