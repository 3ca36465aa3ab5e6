"""The motion certificate's bounds along short motions against dense sampling."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
from hypothesis import given, strategies as st
from numpy import ndarray

import robotdiffuse as rd
from helpers.box_arm import box_mesh
from helpers.example_robots import example_robot
from helpers.sphere_oracles import random_shape
from robotdiffuse.collision.convex_geometry import hulls_of, solid_arrays
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.collision.kernels import convex_bounds
from robotdiffuse.collision.motions import ContinuousCollision

LINKS = {
    "awkward": (("turret", "arm", "wrist", "flange", "tool"),),
    "two_arms": (("torso", "left_upper", "left_lower", "left_hand"), ("torso", "right_upper", "right_lower", "right_hand")),
}
"""The links of each arm."""


@cache
def clad_arm(name: str) -> rd.Robot:
    """An arm with skew joints, one of them prismatic. Each link is two boxes side by side, covered by spheres."""
    rng = np.random.default_rng(0)
    robot = example_robot(name)
    meshes = {}
    spheres = {}
    for link in dict.fromkeys(link for arm in LINKS[name] for link in arm):
        low = rng.uniform(-0.06, 0.0, 3)
        parts = []
        covers = []
        for _ in range(2):
            size = rng.uniform(0.02, 0.1, 3)
            parts.append(box_mesh(low, low + size))
            covers.append([*(low + size / 2), 0.5 * float(np.linalg.norm(size)) + 1e-6])
            low = low + np.array([size[0], 0.0, 0.0])
        meshes[link], spheres[link] = tuple(parts), np.array(covers)
    near = frozenset(frozenset(pair) for arm in LINKS[name] for pair in pairwise(arm))
    return replace(robot, meshes=meshes, spheres=spheres, allowed_collisions=near)


def scene_of(rng: np.random.Generator, cloud: bool) -> rd.Scene:
    """One shape of each kind at random places, and sometimes points."""
    shapes = [random_shape(kind, rng) for kind in ("sphere", "box", "cylinder", "capsule")]
    if cloud:
        shapes.append(rd.PointCloud(rng.uniform([-0.6, -0.6, -0.2], [0.6, 0.6, 0.9]) + rng.normal(0, 0.1, (40, 3)), 0.01))
    return rd.Scene(shapes)


def curve(rng: np.random.Generator, robot: rd.Robot, width: float) -> ndarray:
    """Waypoints along a bent path of about this length; some waypoints are repeated."""
    t = np.linspace(-1, 1, 9)[:, None]
    middle = rng.uniform(robot.lower, robot.upper)
    bend = np.abs(t) if rng.random() < 0.3 else t**2
    rows = middle + width * (t * rng.normal(size=robot.dof) + 0.3 * bend * rng.normal(size=robot.dof))
    return np.repeat(np.clip(rows, robot.lower, robot.upper), rng.integers(1, 3, 9), axis=0)


seeds = st.integers(0, 2**31)
robots = st.sampled_from(list(LINKS))


@given(robots, seeds)
def test_planes_part_as_far_as_coal_says(name: str, seed: int) -> None:
    """From any first guess, the separating plane has Coal's distance within the 2 % at which the search ends."""
    rng = np.random.default_rng(seed)
    robot = clad_arm(name)
    scene = scene_of(rng, False)
    q = rng.uniform(robot.lower, robot.upper)
    exact, arrays, (arm, parts) = (ExactCollision(robot, scene), solid_arrays(robot, scene), hulls_of(robot))
    posture = convex_bounds.make_posture(arm, arrays, robot.dof)
    slides = np.array(robot.prismatic, np.bool_)
    convex_bounds.pose(robot.frame_offsets.copy(), robot.kernel_parents, slides, q, np.zeros(robot.dof), posture)
    for found in exact.distances(q)[: sum(check.other is None for check in exact.checks)]:
        guess = rng.normal(size=3)
        guess /= np.linalg.norm(guess)
        pairs = [(part, obstacle) for part in parts[found.link] for obstacle in range(len(scene.shapes))]
        planes = [convex_bounds.best_plane(arm, p, arrays, o, 0, np.inf, guess, posture) for p, o in pairs]
        least = min(middle for middle, _, _ in planes)
        assert all(middle == along or middle == -np.inf for middle, along, _ in planes)
        assert least <= found.distance + 1e-6
        assert least >= 0.98 * found.distance - 1e-6 if found.distance > 1e-5 else least <= 2e-5


@given(robots, seeds, st.booleans())
def test_the_certificate_of_curved_motions(name: str, seed: int, cloud: bool) -> None:
    """Regression: bounds were taken from the first convex part, so pieces in which another part collides were certified."""
    rng = np.random.default_rng(seed)
    robot = clad_arm(name)
    scene = scene_of(rng, cloud)
    q = np.concatenate([curve(rng, robot, 0.15), curve(rng, robot, 0.02)])
    found = ContinuousCollision(robot, scene, 1e-4, 0.5).sweep(q)
    exact = ExactCollision(robot, scene)
    at = np.linspace(0, len(q) - 1, 30 * len(q))
    dense = np.stack([np.interp(at, np.arange(len(q)), column) for column in q.T], axis=1)
    if found.contact is None:
        assert not exact.collides(dense).any()
        rows = dense[::40]
        links = min(d.distance for row in rows for d in exact.distances(row) if d.other not in robot.link_names)
        pairs = min(d.distance for row in rows for d in exact.distances(row) if d.other in robot.link_names)
        assert 0 < found.scene_clearance <= links + 1e-6 and 0 < found.self_clearance <= pairs + 1e-6
        return
    here = np.stack([np.interp(found.contact.at, np.arange(len(q)), column) for column in q.T])
    distances = exact.distances(here)
    assert min(d.distance for d in distances if d.link == found.contact.check.link) <= 1.01e-4
    # located to 1 mm of motion: nothing deeper lies well before it
    assert not exact.collides(dense[at < found.contact.at - 0.3]).any()
