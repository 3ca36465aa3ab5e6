"""Covering spheres contain every surface point and stick out little, on shapes with sharp and round edges."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from robotdiffuse.core.transforms import transform
from robotdiffuse.robots.fitting.convex_parts import convex_hull
from robotdiffuse.robots.fitting.preparation import hidden_by_neighbors, neighbors
from robotdiffuse.robots.fitting.sphere_fitting import Bounds, Cells, Solid, SphereSettings, covered, fit_spheres, stick_out
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.robots.robot import ConvexMesh, Robot

QUICK = SphereSettings(candidates=200, rounds=6, tries=1)
TOLERANCE = 0.015


def box(size: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0)) -> ConvexMesh:
    return convex_hull(np.array(trimesh.creation.box(size).vertices) + np.array(at))


SHAPES = {
    "box": (box((0.1, 0.06, 0.2)),),
    "cylinder": (convex_hull(np.array(trimesh.creation.cylinder(0.05, 0.25, sections=24).vertices)),),
    "two boxes": (box((0.1, 0.05, 0.05)), box((0.05, 0.05, 0.15), (0.04, 0, 0.05))),
}


def surface_samples(meshes: tuple[ConvexMesh, ...], count: int, seed: int) -> np.ndarray:
    """Points on the surface of each mesh, independent of the cells that the fit uses."""
    parts = [trimesh.Trimesh(mesh.vertices, mesh.faces, process=False) for mesh in meshes]
    return np.concatenate([trimesh.sample.sample_surface(part, count, seed=seed)[0] for part in parts])


def gaps(points: np.ndarray, spheres: np.ndarray) -> np.ndarray:
    """Signed distance of points from the union of spheres (upper bound inside)."""
    return (np.linalg.norm(points[:, None] - spheres[None, :, :3], axis=2) - spheres[:, 3]).min(1)


@pytest.mark.parametrize("name", SHAPES)
def test_spheres_cover_and_hardly_stick_out(name: str) -> None:
    """The spheres also cover the inside: otherwise a point of a cloud could be missed in a hole."""
    meshes = SHAPES[name]
    solid = Solid.of(meshes, TOLERANCE)
    spheres = fit_spheres(solid, Bounds(TOLERANCE), np.random.default_rng(0), QUICK)
    assert covered(meshes, spheres) and gaps(surface_samples(meshes, 20_000, 1), spheres).max() <= 1e-9
    assert stick_out(solid, spheres).max() <= TOLERANCE + solid.spacing
    # independent check: points on the spheres against the solid
    unit = np.random.default_rng(2).normal(size=(200, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    outer = (spheres[:, None, :3] + spheres[:, None, 3:] * unit).reshape(-1, 3)
    hulls = [trimesh.Trimesh(mesh.vertices, mesh.faces, process=False) for mesh in meshes]
    outside = np.min([-trimesh.proximity.signed_distance(hull, outer) for hull in hulls], axis=0)
    assert outside.max() <= TOLERANCE + solid.spacing / 3
    corners = np.concatenate([mesh.vertices for mesh in meshes])
    points = np.random.default_rng(3).uniform(corners.min(0), corners.max(0), (20_000, 3))
    inside = np.any([hull.contains(points) for hull in hulls], axis=0)
    assert gaps(points[inside], spheres).max() <= solid.spacing


@pytest.mark.parametrize("size", [(0.002, 0.002, 0.002), (0.03, 0.02, 0.0005)])
def test_what_is_finer_than_the_grid_is_covered_too(size: tuple[float, float, float]) -> None:
    """Baxter's sonar ring is a ball of 1 mm, which contains no grid point."""
    meshes = (box(size),)
    spheres = fit_spheres(Solid.of(meshes, 0.009), Bounds(0.004), np.random.default_rng(0), QUICK)
    assert covered(meshes, spheres) and len(spheres) <= 210


def test_what_neighbors_hide_wholly_is_covered_too() -> None:
    """Regression: Baxter's sonar ring is inside its torso, and unlimited sizes of spheres gave NaN."""
    solid = Solid.of((box((0.01, 0.01, 0.01)),), TOLERANCE)
    hidden = Bounds(TOLERANCE, lambda points: np.ones(len(points), dtype=bool))
    assert np.isfinite(solid.sphere_sizes(hidden).grid).all()
    spheres = fit_spheres(solid, hidden, np.random.default_rng(0), QUICK)
    assert covered(solid.meshes, spheres) and len(spheres) == 1


def test_tight_places_are_kept_free() -> None:
    solid = Solid.of(SHAPES["box"], TOLERANCE)
    side = np.array([[0.05, 0.0, 0.0]])
    spheres = fit_spheres(solid, Bounds(TOLERANCE, tight=np.column_stack([side, [0.002]])), np.random.default_rng(0), QUICK)
    assert covered(SHAPES["box"], spheres)
    about = np.array([0.05, 0, 0]) + np.random.default_rng(1).uniform(-0.01, 0.01, (5000, 3))
    assert about[gaps(about, spheres) < 0, 0].max() < 0.05 + 0.002 + 0.6 * solid.spacing


def test_nothing_reaches_below_the_floor() -> None:
    meshes = (box((0.1, 0.06, 0.2), (0, 0, 0.105)),)
    solid = Solid.of(meshes, TOLERANCE)
    free = fit_spheres(solid, Bounds(TOLERANCE), np.random.default_rng(0), QUICK)
    assert (free[:, 2] - free[:, 3]).min() < -0.003
    spheres = fit_spheres(solid, Bounds(TOLERANCE, floor=(np.array([0, 0, 1.0]), 0.0)), np.random.default_rng(0), QUICK)
    assert covered(meshes, spheres) and (spheres[:, 2] - spheres[:, 3]).min() > -1e-3


def test_a_ball_needs_one_sphere_and_a_small_gap_is_found() -> None:
    ball = (convex_hull(np.array(trimesh.creation.icosphere(2, 0.05).vertices)),)
    spheres = fit_spheres(Solid.of(ball, 0.01), Bounds(0.01), np.random.default_rng(0), QUICK)
    assert len(spheres) == 1 and np.linalg.norm(spheres[0, :3]) < 3e-3 and spheres[0, 3] == pytest.approx(0.05, abs=3e-3)
    meshes = (box((0.1, 0.1, 0.1)),)
    spheres = np.array([[0, 0, 0, 0.05 * 3**0.5 + 1e-5]])
    assert covered(meshes, spheres) and not covered(meshes, spheres - np.array([0, 0, 0, 2e-4]))


def test_spheres_may_reach_into_a_neighbor_unless_it_turns_away() -> None:
    """Of two upright cylinders, the upper one rotates on the lower one."""
    can = convex_hull(np.array(trimesh.creation.cylinder(0.05, 0.2, sections=48).vertices) + np.array([0, 0, 0.1]))
    turn = Joint("turn", "revolute", "low", "high", transform(np.array([0, 0, 0.2])), np.array([0, 0, 1.0]), -3.0, 3.0)
    robot = Robot("cans", "low", "high", (turn,), meshes={"low": (can,), "high": (can,)})
    (beside,) = neighbors(robot, "low")
    assert beside.link == "high" and len(beside.T_link_neighbor) > 1
    hidden = hidden_by_neighbors(robot, "low")
    assert hidden(np.array([[0, 0, 0.21], [0.03, 0, 0.25]])).all()
    assert not hidden(np.array([[0, 0, -0.02], [0.07, 0, 0.25]])).any()
    solid = Solid.of(robot.meshes["low"], TOLERANCE)
    spheres = fit_spheres(solid, Bounds(TOLERANCE, hidden), np.random.default_rng(0), QUICK)
    assert len(spheres) < len(fit_spheres(solid, Bounds(TOLERANCE), np.random.default_rng(0), QUICK))
    assert covered(robot.meshes["low"], spheres) and stick_out(solid, spheres).max() > TOLERANCE
    swing = replace(robot.joints[0], axis=np.array([0, 1.0, 0]), lower=-1.0, upper=1.0)
    assert not hidden_by_neighbors(replace(robot, joints=(swing,)), "low")(np.array([[0.04, 0, 0.23]])).any()


def test_a_large_thin_plate_does_not_fill_the_memory() -> None:
    """Regression: a plate of 1 m, 1 mm thick, was cut into 20 million cells before their number was checked."""
    plate = convex_hull(np.array(trimesh.creation.box([3.0, 3.0, 1e-3]).vertices))
    assert 500 < len(Cells.of(Solid.of((plate,), 1e-3), Bounds(1e-3), 8.0, 5_000).corners) <= 5_000
