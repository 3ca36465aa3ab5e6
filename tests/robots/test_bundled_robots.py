"""The robots that come with the package: spheres hold their meshes, refuse little, and NOTICE names them."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact import ExactCollision
from robotdiffuse.robots import DATA, ROBOTS, load_robot
from robotdiffuse.robots.bundle import read_source
from robotdiffuse.robots.sphere_kernels import gaps, within
from robotdiffuse.robots.sphere_room import stacked_planes
from robotdiffuse.scenes.scene import Scene

NOTICE = (Path(__file__).parents[2] / "NOTICE").read_text()


@pytest.mark.parametrize("name", ROBOTS)
def test_no_sampled_point_of_the_meshes_is_outside_the_spheres(name: str) -> None:
    robot = load_robot(name)
    for link, parts in robot.meshes.items():
        for k, part in enumerate(parts):
            mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
            points = np.asarray(trimesh.sample.sample_surface(mesh, 200, seed=0)[0])
            others = parts[:k] + parts[k + 1 :]
            if others:  # what lies in another part is no surface
                points = points[~within(points, *stacked_planes(others), 1e-9)]
            assert (gaps(points, robot.spheres[link]) <= 0).all(), link


@pytest.mark.parametrize("name", ROBOTS)
def test_what_spheres_call_free_is_free_and_little_else_is(name: str) -> None:
    """Refused: 8 % is what preparation warns of; the standard error of 400 samples is one and a half."""
    robot, scene = load_robot(name), Scene()
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (400, robot.dof))
    by_spheres, by_meshes = CollisionChecker(robot, scene).free(q), ~ExactCollision(robot, scene).collides(q)
    assert not (by_spheres & ~by_meshes).any()
    assert by_meshes.mean() > 0.5 and (by_meshes & ~by_spheres).sum() < 0.12 * by_meshes.sum()


@pytest.mark.parametrize("name", ROBOTS)
def test_licences_are_named(name: str) -> None:
    assert name in NOTICE.lower() and read_source(DATA / name)["licence"]
    assert sum(file.stat().st_size for file in (DATA / name).iterdir()) < 1_000_000
