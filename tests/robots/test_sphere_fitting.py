"""Covering spheres: every surface point inside, little sticking out; on shapes with sharp and round edges."""

import numpy as np
import pytest
import trimesh

from robotdiffuse.errors import InputError
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.interfaces import face_allowances, neighbours, stick_out_of_arm
from robotdiffuse.robots.robot import ConvexMesh, Joint, Robot
from robotdiffuse.robots.sphere_fitting import SphereSettings, covered, fit_spheres, stick_out
from robotdiffuse.robots.urdf import convex_hull
from robotdiffuse.transforms import transform

QUICK = SphereSettings(candidates=500, rounds=6, tries=1, starts=1)
TOLERANCE = 0.015

SHAPES = {
    "box": (convex_hull(np.array(trimesh.creation.box((0.1, 0.06, 0.2)).vertices)),),
    "cylinder": (convex_hull(np.array(trimesh.creation.cylinder(0.05, 0.25, sections=24).vertices)),),
    "two boxes": (
        convex_hull(np.array(trimesh.creation.box((0.1, 0.05, 0.05)).vertices)),
        convex_hull(np.array(trimesh.creation.box((0.05, 0.05, 0.15)).vertices) + np.array([0.04, 0, 0.05])),
    ),
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
    meshes = SHAPES[name]
    spheres = fit_spheres(meshes, TOLERANCE, np.random.default_rng(0), settings=QUICK)
    assert covered(meshes, spheres)
    assert gaps(surface_samples(meshes, 20_000, 1), spheres).max() <= 1e-9
    assert stick_out(meshes, spheres).max() <= TOLERANCE + 5e-5
    # by an independent way: points of the spheres against the solid
    rng = np.random.default_rng(2)
    unit = rng.normal(size=(200, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    outer = (spheres[:, None, :3] + spheres[:, None, 3:] * unit).reshape(-1, 3)
    hulls = [trimesh.Trimesh(mesh.vertices, mesh.faces, process=False) for mesh in meshes]
    outside = np.min([-trimesh.proximity.signed_distance(hull, outer) for hull in hulls], axis=0)
    assert outside.max() <= TOLERANCE + 5e-5


def test_a_ball_needs_one_sphere() -> None:
    ball = (convex_hull(np.array(trimesh.creation.icosphere(2, 0.05).vertices)),)
    spheres = fit_spheres(ball, 0.01, np.random.default_rng(0), settings=QUICK)
    assert len(spheres) == 1
    assert np.linalg.norm(spheres[0, :3]) < 2e-3
    assert spheres[0, 3] == pytest.approx(0.05, abs=2e-3)


def test_same_seed_same_spheres() -> None:
    fits = [fit_spheres(SHAPES["box"], 0.025, np.random.default_rng(3), settings=QUICK) for _ in range(2)]
    np.testing.assert_array_equal(fits[0], fits[1])


def test_covered_finds_a_small_gap() -> None:
    meshes = SHAPES["box"]
    spheres = fit_spheres(meshes, TOLERANCE, np.random.default_rng(0), settings=QUICK)
    for i in range(len(spheres)):
        assert not covered(meshes, np.delete(spheres, i, axis=0)), "a sphere that nothing needs"
    smaller = spheres - np.array([0, 0, 0, 2e-4])
    assert not covered(meshes, smaller)


def two_cylinders() -> Robot:
    """Two upright cylinders, the upper one turning on the lower one."""
    can = convex_hull(
        np.array(trimesh.creation.cylinder(0.05, 0.2, sections=48).vertices) + np.array([0, 0, 0.1])
    )
    turn = Joint(
        "turn", "revolute", "low", "high", transform(np.array([0, 0, 0.2])), np.array([0, 0, 1.0]), -3.0, 3.0
    )
    return Robot("cans", "low", "high", (turn,), meshes={"low": (can,), "high": (can,)})


def test_faces_between_links_may_be_reached_over() -> None:
    robot, tolerance = two_cylinders(), TOLERANCE
    (beside,) = neighbours(robot, "low")
    assert beside.link == "high" and len(beside.T_link_neighbour) > 1
    (allowance,) = face_allowances(robot, "low", tolerance)
    mesh = robot.meshes["low"][0]
    top = (mesh.vertices[mesh.faces][:, :, 2] > 0.2 - 1e-9).all(1)
    assert (allowance[top] > 0.02).all()
    assert (allowance[~top] == 0).all()
    spheres = fit_spheres(robot.meshes["low"], tolerance, np.random.default_rng(0), (allowance,), QUICK)
    plain = fit_spheres(robot.meshes["low"], tolerance, np.random.default_rng(0), settings=QUICK)
    assert len(spheres) < len(plain)
    assert covered(robot.meshes["low"], spheres)
    assert stick_out_of_arm(robot, "low", spheres) <= tolerance + 5e-5
    assert stick_out(robot.meshes["low"], spheres).max() > tolerance


def test_nothing_is_hidden_by_a_neighbour_that_turns_away() -> None:
    robot = two_cylinders()
    swing = Joint(
        "turn", "revolute", "low", "high", transform(np.array([0, 0, 0.2])), np.array([0, 1.0, 0]), -1.0, 1.0
    )
    robot = Robot("cans", "low", "high", (swing,), meshes=robot.meshes)
    assert face_allowances(robot, "low", 0.012)[0].max() < 0.02


def test_bundled_panda_is_covered() -> None:
    robot = load_robot("panda")
    assert set(robot.spheres) == set(robot.meshes)
    for link, meshes in robot.meshes.items():
        spheres = robot.spheres[link]
        assert gaps(surface_samples(meshes, 3000, 4), spheres).max() <= 1e-9, link
        assert covered(meshes, spheres), link
        assert stick_out_of_arm(robot, link, spheres, points=60) <= 0.0155, link
    assert sum(map(len, robot.spheres.values())) <= 145


@pytest.mark.parametrize("bad", [{"finest": 0.0}, {"second_half": 0.002}, {"finest": 0.01}])
def test_contradictory_settings(bad: dict) -> None:
    with pytest.raises(InputError, match="tolerances"):
        SphereSettings(**bad)
