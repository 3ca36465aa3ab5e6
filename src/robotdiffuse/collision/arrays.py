"""Robot and scene as flat float32 arrays: the one form that both compiled kernels read.

The arrays of a scene have the same types whatever the scene holds, so that no obstacle causes a compilation.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy import ndarray
from scipy.spatial import KDTree

from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Mesh, PointCloud, Sphere, pose

MESH_SPACING = 0.02
"""Triangles of mesh obstacles are divided until no edge is longer [m]; each piece becomes a point."""
THINNING = 0.5
"""Edge of the thinning voxels of a point cloud, as a multiple of its point radius."""
MAX_POINTS = 400_000
"""Mesh obstacles are divided more coarsely rather than into more points than this."""
GRID_BAND = 0.2
"""Distances to points are exact up to this [m]; farther ones count as this, a lower bound."""


class RobotArrays(NamedTuple):
    """Frames, spheres and pairs of a robot; groups are links with spheres, those of the fixed base first."""

    offsets: ndarray
    """[dof, 12] rotation (row-major) and translation of `Robot.frame_offsets`."""
    prismatic: ndarray
    """[dof] 1 where the joint slides."""
    spheres: ndarray
    """[n, 4] x y z radius in the frame of the group."""
    first: ndarray
    """[groups + 1] first sphere of each group."""
    frame: ndarray
    """[groups] frame index, 0 for the fixed base."""
    bounds: ndarray
    """[groups, 4] a sphere around all spheres of the group."""
    pairs: ndarray
    """[pairs, 2] groups that are checked against each other."""


class SceneArrays(NamedTuple):
    """Obstacles by type. Oriented shapes: centre, world-to-shape rotation (row-major), three dimensions."""

    spheres: ndarray
    """[n, 4] centre, radius."""
    boxes: ndarray
    """[n, 15] ..., half edges."""
    cylinders: ndarray
    """[n, 15] ..., radius, half height, 0."""
    capsules: ndarray
    """[n, 15] ..., radius, half height, 0."""
    points: ndarray
    """[n, 4] centre, radius; sorted by cell."""
    cell_first: ndarray
    """[cells + 1] first point of each cell."""
    grid: ndarray
    """[nx, ny, nz] lower bound of the distance from the voxel centre to the spheres of all points."""
    grid_frame: ndarray
    """[8] origin x y z, voxel edge, cell edge, largest point radius, number of cells in y, in z."""


def robot_groups(robot: Robot) -> tuple[str, ...]:
    """Links with spheres: fixed ones first, then in tree order."""
    links = [link for link in robot.link_names if len(robot.spheres.get(link, ()))]
    return tuple(sorted(links, key=lambda link: robot.link_frame(link) > 0))


@lru_cache(maxsize=16)
def compile_robot(robot: Robot) -> RobotArrays:
    """The arrays of a robot with its joints locked as they are."""
    groups = robot_groups(robot)
    spheres, bounds = [], []
    for link in groups:
        T, local = robot.T_frame_link(link), np.asarray(robot.spheres[link], np.float64)
        centres = local[:, :3] @ T[:3, :3].T + T[:3, 3]
        spheres.append(np.column_stack([centres, local[:, 3]]))
        bounds.append(_bounding_sphere(spheres[-1]))
    index = {link: i for i, link in enumerate(groups)}
    offsets = np.concatenate(
        [robot.frame_offsets[:, :3, :3].reshape(-1, 9), robot.frame_offsets[:, :3, 3]], axis=1
    )
    pairs = [(index[a], index[b]) for a, b in robot.checked_pairs()]
    return RobotArrays(
        offsets=np.ascontiguousarray(offsets, np.float32),
        prismatic=np.array(robot.prismatic, np.int32),
        spheres=np.concatenate(spheres).astype(np.float32) if spheres else np.zeros((0, 4), np.float32),
        first=np.cumsum([0] + [len(s) for s in spheres]).astype(np.int32),
        frame=np.array([robot.link_frame(link) for link in groups], np.int32),
        bounds=np.array(bounds, np.float32).reshape(-1, 4),
        pairs=np.array(pairs, np.int32).reshape(-1, 2),
    )


@lru_cache(maxsize=16)
def reach(robot: Robot) -> float:
    """An upper bound of the distance of any sphere's surface from the base's origin [m]."""
    lengths = np.linalg.norm(robot.frame_offsets[:, :3, 3], axis=1)
    slides = np.where(robot.prismatic, np.maximum(np.abs(robot.lower), np.abs(robot.upper)), 0.0)
    arrays = compile_robot(robot)
    extent = np.linalg.norm(arrays.bounds[:, :3], axis=1) + arrays.bounds[:, 3]
    return float(lengths.sum() + slides.sum() + extent.max(initial=0.0))


def _bounding_sphere(spheres: ndarray) -> ndarray:
    """A small sphere around spheres: the centre moves towards the farthest one (Badoiu and Clarkson)."""
    centre = spheres[:, :3].mean(axis=0)
    for i in range(1, 200):
        reach = np.linalg.norm(spheres[:, :3] - centre, axis=1) + spheres[:, 3]
        farthest = spheres[reach.argmax()]
        centre = centre + (farthest[:3] - centre) / (i + 1)
    reach = np.linalg.norm(spheres[:, :3] - centre, axis=1) + spheres[:, 3]
    return np.append(centre, reach.max() + 1e-6)


def compile_scene(scene: Scene, reach: float = np.inf) -> SceneArrays:
    """The arrays of a scene; points farther than `reach` [m] from the base's origin are left out."""
    spheres, boxes, cylinders, capsules, points = [], [], [], [], []
    for shape in scene.shapes:
        match shape:
            case Sphere():
                spheres.append([*shape.center, shape.radius])
            case Box():
                boxes.append([*_frame(shape), *(shape.size / 2)])
            case Cylinder():
                cylinders.append([*_frame(shape), shape.radius, shape.height / 2, 0.0])
            case Capsule():
                capsules.append([*_frame(shape), shape.radius, shape.height / 2, 0.0])
            case PointCloud():
                points.append(_thin(shape.points, shape.point_radius, reach))
            case Mesh():
                points.append(_cover(shape.world_vertices[shape.faces], reach))
    cloud = np.concatenate(points) if points else np.zeros((0, 4))
    return SceneArrays(
        np.array(spheres, np.float32).reshape(-1, 4),
        np.array(boxes, np.float32).reshape(-1, 15),
        np.array(cylinders, np.float32).reshape(-1, 15),
        np.array(capsules, np.float32).reshape(-1, 15),
        *_grid(cloud.astype(np.float32)),
    )


def _frame(shape: Box | Cylinder | Capsule) -> list[float]:
    T = pose(shape)
    return [*T[:3, 3], *T[:3, :3].T.ravel()]


def _thin(points: ndarray, radius: float, reach: float) -> ndarray:
    """One sphere per occupied voxel, large enough to hold the spheres of all points of the voxel."""
    points = points[np.linalg.norm(points, axis=1) <= reach + radius]
    if not len(points):
        return np.zeros((0, 4))
    keys = np.floor(points / (THINNING * radius)).astype(np.int64)
    keys -= keys.min(axis=0)
    _, which, counts = np.unique(
        np.ravel_multi_index(tuple(keys.T), tuple(keys.max(axis=0) + 1)),
        return_inverse=True,
        return_counts=True,
    )
    centres = np.stack([np.bincount(which, points[:, i]) / counts for i in range(3)], axis=1)
    extra = np.zeros(len(centres))
    np.maximum.at(extra, which, np.linalg.norm(points - centres[which], axis=1))
    return np.column_stack([centres, radius + extra])


def _cover(triangles: ndarray, reach: float) -> ndarray:
    """Spheres at the centroids of pieces of the triangles that together hold the whole surface."""
    spacing = max(MESH_SPACING, float(np.sqrt(_area(triangles) / MAX_POINTS)))
    done = []
    while len(triangles):
        edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2)
        near = np.linalg.norm(triangles.mean(axis=1), axis=1) <= reach + edges.max(axis=1)
        triangles, edges = triangles[near], edges[near]
        small = edges.max(axis=1) <= spacing
        done.append(triangles[small])
        triangles, edges = triangles[~small], edges[~small]
        # edge i joins corners i - 1 and i; split the longest one
        longest = edges.argmax(axis=1)
        rows = np.arange(len(triangles))
        a, b = triangles[rows, longest - 1], triangles[rows, longest]
        c = triangles[rows, (longest + 1) % 3]
        middle = (a + b) / 2
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    pieces = np.concatenate(done) if done else np.zeros((0, 3, 3))
    centres = pieces.mean(axis=1)
    radii = np.linalg.norm(pieces - centres[:, None], axis=2).max(axis=1, initial=0.0)
    return np.column_stack([centres, radii + 1e-4])


def _area(triangles: ndarray) -> float:
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return float(np.linalg.norm(normals, axis=1).sum() / 2)


def _grid(cloud: ndarray) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Points sorted by cell, first point of each cell, distance grid and its frame (see SceneArrays)."""
    if not len(cloud):
        return (
            cloud.reshape(0, 4),
            np.zeros(2, np.int32),
            np.zeros((0, 0, 0), np.float32),
            np.ones(8, np.float32),
        )
    radius = float(cloud[:, 3].max())
    low = cloud[:, :3].min(axis=0) - radius - GRID_BAND
    extent = cloud[:, :3].max(axis=0) + radius + GRID_BAND - low
    # about two million voxels at most keep the grid within a cache-friendly 8 MB
    voxel = max(0.02, float((extent.prod() / 2e6) ** (1 / 3)))
    shape = np.ceil(extent / voxel).astype(int)
    axes = [low[i] + voxel * (np.arange(shape[i]) + 0.5) for i in range(3)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    tree = KDTree(cloud[:, :3])
    bound = GRID_BAND + radius + voxel
    nearest, _ = tree.query(centres, distance_upper_bound=bound, workers=1)
    grid = (np.minimum(nearest, bound) - radius).astype(np.float32).reshape(shape)
    cell = 2 * voxel
    cells = np.ceil(extent / cell).astype(int)
    where = np.ravel_multi_index(tuple(((cloud[:, :3] - low) / cell).astype(int).T), tuple(cells))
    order = np.argsort(where, kind="stable")
    edges = np.arange(int(np.prod(cells)) + 1)
    first = np.asarray(np.searchsorted(where[order], edges), np.int32)
    frame = np.array([*low, voxel, cell, radius, cells[1], cells[2]], np.float32)
    return np.ascontiguousarray(cloud[order]), first, grid, frame
