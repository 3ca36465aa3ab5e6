"""Distances of covering spheres in float64, with robots and scenes: oracles of the collision kernels."""

from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy import ndarray
from scipy.spatial.transform import Rotation

from helpers.box_arm import box_arm, box_mesh
from helpers.example_robots import example_robot
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import forward_frames
from robotdiffuse.collision.kernel_arrays import robot_groups
from robotdiffuse.collision.kernels.collision_cost import CLEARANCE_CAP
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, PointCloud, Shape, Sphere

TOLERANCE = 1e-5
"""Bound on float32 rounding at distances of a few meters [m]."""


def least_clearance(checker: CollisionChecker, q: ndarray) -> ndarray:
    """Least distance of each configuration to the scene and between links [m], at most 1 m."""
    every = [checker.link_clearances(q), checker.pair_clearances(q), np.full((len(q), 1), CLEARANCE_CAP)]
    return np.concatenate(every, axis=1).min(axis=1)


def sphere_centers(robot: Robot, q: ndarray) -> tuple[list[ndarray], list[ndarray]]:
    """Centers [n, k, 3] and radii [k] of the spheres of each group, base frame."""
    frames = forward_frames(robot, q)
    centers = []
    radii = []
    for link in robot_groups(robot):
        T = frames[:, robot.link_frame(link)] @ robot.T_frame_link(link)
        spheres = robot.spheres[link]
        centers.append(np.einsum("nij,kj->nki", T[:, :3, :3], spheres[:, :3]) + T[:, None, :3, 3])
        radii.append(spheres[:, 3])
    return centers, radii


def distance(shape: Shape, points: ndarray) -> ndarray:
    """Signed distance of points [..., 3] to a shape."""
    if isinstance(shape, PointCloud):
        return np.min([np.linalg.norm(points - p, axis=-1) - shape.point_radius for p in shape.points], axis=0)
    if isinstance(shape, Sphere):
        return np.linalg.norm(points - shape.center, axis=-1) - shape.radius
    assert isinstance(shape, Box | Cylinder | Capsule)
    local = (points - shape.center) @ Rotation.from_quat(np.roll(shape.wxyz, -1)).as_matrix()
    if isinstance(shape, Capsule):
        local[..., 2] -= np.clip(local[..., 2], -shape.height / 2, shape.height / 2)
        return np.linalg.norm(local, axis=-1) - shape.radius
    if isinstance(shape, Box):
        gaps = np.abs(local) - shape.size / 2
    else:
        side = np.linalg.norm(local[..., :2], axis=-1) - shape.radius
        gaps = np.stack([side, np.abs(local[..., 2]) - shape.height / 2], axis=-1)
    return np.linalg.norm(np.maximum(gaps, 0), axis=-1) + np.minimum(gaps.max(axis=-1), 0)


def link_distances(robot: Robot, scene: Scene, q: ndarray) -> ndarray:
    """[n, moving links], at most 1 m."""
    columns = []
    for link, centers, radii in zip(robot_groups(robot), *sphere_centers(robot, q), strict=True):
        if robot.link_frame(link) > 0:
            found = [(distance(shape, centers) - radii).min(axis=1) for shape in scene.shapes]
            columns.append(np.min([np.ones(len(q)), *found], axis=0))
    return np.stack(columns, axis=1)


def pair_distances(robot: Robot, q: ndarray) -> ndarray:
    """[n, pairs], at most 1 m."""
    index = {link: i for i, link in enumerate(robot_groups(robot))}
    centers, radii = sphere_centers(robot, q)
    columns = [np.zeros((len(q), 0))]
    for a, b in ((index[a], index[b]) for a, b in robot.checked_pairs()):
        gap = np.linalg.norm(centers[a][:, :, None] - centers[b][:, None], axis=-1)
        gap -= radii[a][:, None] + radii[b]
        columns.append(np.minimum(gap.reshape(len(q), -1).min(axis=1), 1)[:, None])
    return np.concatenate(columns, axis=1)


def with_spheres(name: str) -> Robot:
    """The bundled Panda, the arm of boxes, or an example robot with a few spheres at its moving links."""
    if name == "panda":
        return load_robot("panda")
    if name == "box_arm":
        return box_arm()
    robot = example_robot(name)
    rng = np.random.default_rng(0)
    links = [link for link in robot.link_names if robot.link_frame(link) > 0 or link == robot.base]
    spheres = {link: np.column_stack([rng.uniform(-0.1, 0.1, (4, 3)), rng.uniform(0.01, 0.06, 4)]) for link in links}
    moved = {link: robot.moved_by[robot.link_frame(link)] for link in links}
    near = [pair for pair in combinations(links, 2) if (moved[pair[0]] != moved[pair[1]]).sum() < 2]
    return replace(robot, spheres=spheres, meshes={}, allowed_collisions=frozenset(map(frozenset, near)))


ROBOTS = ("panda", "box_arm", "awkward", "ur5", "two_arms")


def rows(robot: Robot, count: int, seed: int = 0) -> ndarray:
    return np.random.default_rng(seed).uniform(robot.lower, robot.upper, (count, robot.dof))


def solids() -> Scene:
    box = Box((0.0, 0.6, 0.4), (0.2, 0.3, 0.2), (0.9, 0.1, 0.3, 0.1))
    cylinder = Cylinder((0.4, -0.4, 0.3), 0.08, 0.5, (0.9, 0.3, 0.0, 0.1))
    return Scene([Sphere((0.5, 0.3, 0.6), 0.2), box, cylinder, Capsule((-0.4, -0.3, 0.5), 0.06, 0.5, (0.9, 0.3, 0.5, 0.1))])


def random_shape(kind: str, rng: np.random.Generator) -> Shape:
    wxyz = rng.normal(size=4)
    center = rng.uniform([-0.9, -0.9, -0.2], [0.9, 0.9, 1.0])
    a, b, c = rng.uniform(0.02, 0.4, 3)
    if kind == "sphere":
        return Sphere(center, a)
    if kind == "box":
        return Box(center, (a, b, c), wxyz)
    if kind == "cylinder":
        return Cylinder(center, a / 2, b, wxyz)
    if kind == "capsule":
        return Capsule(center, a / 2, b, wxyz)
    return PointCloud(center + rng.normal(0, 0.1, (30, 3)), a / 10)


def box_triangles(size: tuple[float, float, float]) -> tuple[ndarray, ndarray]:
    half = np.array(size) / 2
    mesh = box_mesh(-half, half)
    return mesh.vertices, mesh.faces


def depth_of_balls(balls: ndarray, T: ndarray, intrinsics: tuple[float, ...], size: tuple[int, int]) -> ndarray:
    """A depth image of balls (x, y, z, radius), by hand: |depth ray - center| = radius; inf elsewhere."""
    v, u = np.mgrid[: size[1], : size[0]]
    fx, fy, cx, cy = intrinsics
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], -1) @ T[:3, :3].T
    a = (rays**2).sum(-1)
    depth = np.full(u.shape, np.inf)
    for *center, radius in balls:
        away = np.array(center) - T[:3, 3]
        b = rays @ away
        under = b * b - a * (away @ away - radius**2)
        depth = np.where(under > 0, np.minimum(depth, (b - np.sqrt(np.maximum(under, 0))) / a), depth)
    return depth
