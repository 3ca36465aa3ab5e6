"""Robots and scenes as flat float32 arrays, the arguments of the compiled kernels.

The arrays of all scenes have the same types, so that no kind of obstacle causes another compilation.
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy import ndarray

from robotdiffuse.collision.convex_geometry import Solid, allowed_contacts, solids_of
from robotdiffuse.collision.kernels.simd import W, by_sixteen
from robotdiffuse.collision.point_cloud_grid import (
    NO_SPHERES,
    build_grid,
    cover_triangles,
    join_to_few,
    thin_points,
)
from robotdiffuse.collision.sphere_pair_tables import NO_TABLES, build_pair_tables
from robotdiffuse.core.deadline import check_time
from robotdiffuse.core.transforms import transform
from robotdiffuse.robots.kinematic_tree import once_per_robot
from robotdiffuse.robots.motion_bounds import radii_of
from robotdiffuse.robots.robot import LinkPairTable, Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import PointCloud, Triangulated

FLOAT32_ROUNDING = 4e-7
"""Obstacles are enlarged by this fraction of their coordinates, more than the rounding errors of float32."""

BOX_SLACK = 1e-6
"""Boxes around obstacles are enlarged by this length [m] plus this fraction of their coordinates, more than
rounding errors."""

EMPTY_BOX = np.repeat([[1e18, -1e18]], 3, axis=1)
"""Corners [m] of an empty box: the lower corner is above the upper one."""


class RobotArrays(NamedTuple):
    """Frames, spheres and pairs of a robot. A group is a link with spheres; links fixed to the base come
    first."""

    offsets: ndarray
    """[dof, 13] rotation (row-major) and translation of `Robot.frame_offsets`; the last column is 1 for a
    prismatic joint, else 0."""
    spheres: ndarray
    """[n, 4] x y z radius in the frame of the group."""
    first: ndarray
    """[groups + 1] first sphere of each group."""
    rows: ndarray
    """[rows, 4 * 16] the spheres of each group in rows of sixteen spheres: 16 times x, then y, z and radius.
    The last sphere is repeated to fill a row."""
    row_bounds: ndarray
    """[rows, 4] a sphere around all spheres of the row."""
    row_sizes: ndarray
    """[rows] number of spheres in the row, without repetitions."""
    first_row: ndarray
    """[groups + 1] first row of each group."""
    frame: ndarray
    """[groups] frame index, 0 for the fixed base."""
    bounds: ndarray
    """[groups, 4] a sphere around all spheres of the group."""
    pairs: ndarray
    """[pairs, 4] two groups that are checked against each other; the table in `pair_tables` for this pair, -1
    if there is none; and the bit of this pair in the cells of that table, as a power of two."""
    pair_tables: ndarray
    """[tables, ...] joint values at which pairs may touch: see `sphere_pair_tables.py`."""
    parents: ndarray | None
    """[dof] `Robot.parents`; None for a chain, for which the kernels are compiled separately."""


class SceneArrays(NamedTuple):
    """Obstacles: solids, and points in a grid."""

    solids: ndarray
    """[n, 17] center; base-to-shape rotation (row-major); half edges of a box; radius of a ball; 1 for a
    cylinder, else 0. A solid is the box, widened by the ball (Minkowski sum). For a cylinder, the first two
    half edges are the radius of a disc that replaces the rectangle. Point clouds and meshes that links may
    touch are covered by balls, which are solids here."""
    solid_boxes: ndarray
    """[rows, 6 * 16] axis-aligned boxes around the solids in rows of sixteen boxes: 16 times the lower x,
    then lower y, lower z, upper x, upper y and upper z."""
    points: ndarray
    """[n, 4] center, radius; sorted by cell."""
    point_rows: ndarray
    """[rows, 4 * 16] the points in rows of sixteen points: 16 times x, then y, z and radius. The last point
    is repeated to fill the last row."""
    cell_first: ndarray
    """[cells + 1] first point of each cell."""
    grid: ndarray
    """[nx * ny * nz] distance from each voxel's center to the nearest point's center [m]. Values beyond the
    band (see `grid_frame`) are lower bounds."""
    nearest: ndarray
    """[nx * ny * nz] index of the point that is nearest to each voxel's center. Beyond the band it is a point
    near the nearest one; far beyond, it is -1."""
    grid_frame: ndarray
    """[14] origin x y z; edge lengths of a voxel and of a cell; largest and smallest radius of a point; the
    band, within which distances are exact; numbers of voxels nx, ny, nz; numbers of cells along x, y, z."""
    may_touch: ndarray
    """[groups, solids] whether a group of the robot may touch a solid; shape [0, 0] without allowed
    contacts."""


def robot_groups(robot: Robot) -> tuple[str, ...]:
    """Links with spheres: fixed ones first, then in the order of the tree."""
    links = [link for link in robot.link_names if len(robot.spheres.get(link, ()))]
    return tuple(sorted(links, key=lambda link: robot.link_frame(link) > 0))


@once_per_robot
def compile_robot(robot: Robot) -> RobotArrays:
    """The arrays of a robot, with its locked joints at their values."""
    groups = robot_groups(robot)
    placed_groups = [_placed_groups(robot)[link] for link in groups]
    spheres = [group.spheres for group in placed_groups]
    clusters = [group.rows for group in placed_groups]
    rows = [row for of_group in clusters for row in of_group]
    index = {link: i for i, link in enumerate(groups)}
    T = robot.frame_offsets
    slides = np.array(robot.prismatic, np.float64)
    offsets = np.column_stack([T[:, :3, :3].reshape(-1, 9), T[:, :3, 3], slides])
    pairs = [(index[a], index[b]) for a, b in robot.checked_pairs() if a in index and b in index]
    arrays = RobotArrays(
        offsets=np.ascontiguousarray(offsets, np.float32),
        spheres=np.concatenate([NO_SPHERES, *spheres]).astype(np.float32),
        first=np.cumsum([0, *map(len, spheres)]).astype(np.int32),
        # NO_SPHERES adds no row; it gives concatenate a part even if the robot has no spheres
        rows=np.concatenate([by_sixteen(row, row[-1:]) for row in [NO_SPHERES, *rows]]),
        row_bounds=np.array(
            [row for link_rows in placed_groups for row in link_rows.row_bounds], np.float32
        ).reshape(-1, 4),
        row_sizes=np.array([*map(len, rows)], np.int64),
        first_row=np.cumsum([0, *map(len, clusters)]).astype(np.int32),
        frame=np.array([robot.link_frame(link) for link in groups], np.int32),
        bounds=np.array([group.bounds for group in placed_groups], np.float32).reshape(-1, 4),
        pairs=np.array([(a, b, -1, 0) for a, b in pairs], np.int32).reshape(-1, 4),
        pair_tables=NO_TABLES,
        parents=robot.kernel_parents,
    )
    if not pairs:
        return arrays
    known_tables = _known_tables(robot, pairs, groups)
    pair_indices, tables = build_pair_tables(arrays, robot, radii_of(robot, groups), known_tables)
    return arrays._replace(pairs=pair_indices, pair_tables=tables)


def _known_tables(
    robot: Robot, pairs: list[tuple[int, int]], groups: tuple[str, ...]
) -> dict[int, LinkPairTable]:
    """The tables of `Robot.tables` by index of the pair. Tables are left out if the joints between the pair's
    links are not exactly those of the table, as after locking a joint."""
    pair_index = {frozenset((groups[a], groups[b])): p for p, (a, b) in enumerate(pairs)}
    tables_by_pair = {}
    for table in robot.tables:
        between = tuple(robot.joint_names[joint] for joint in robot.joints_between(*table.links))
        if frozenset(table.links) in pair_index and between == table.joints:
            tables_by_pair[pair_index[frozenset(table.links)]] = table
    return tables_by_pair


class _Group(NamedTuple):
    """The spheres [x, y, z, radius] of a link, in the frame that it is fixed to."""

    spheres: ndarray
    rows: list[ndarray]
    """The spheres in rows of at most sixteen."""
    bounds: ndarray
    """A sphere around all spheres."""
    row_bounds: list[ndarray]
    """A sphere around each row."""


@once_per_robot
def _placed_groups(robot: Robot) -> dict[str, _Group]:
    """The groups by link. A robot with an attached object reuses the groups of the bare arm."""
    group_of_link = {} if robot.bare is None else dict(_placed_groups(robot.bare))
    links = [link for link in robot_groups(robot) if link not in group_of_link]
    link_spheres = []
    parts = []  # the rows of each link
    for link in links:
        link_spheres.append(robot.frame_spheres(link))
        parts.append(_clusters(link_spheres[-1]))
    bounds = bounding_spheres([*link_spheres, *(part for group in parts for part in group)])
    # the bounds of the links come first, then those of all their rows
    part_bounds = iter(bounds[len(link_spheres) :])
    for link, spheres, rows, bound in zip(links, link_spheres, parts, bounds, strict=False):
        group_of_link[link] = _Group(spheres, rows, bound, list(islice(part_bounds, len(rows))))
    return group_of_link


@once_per_robot
def reach_bound(robot: Robot) -> float:
    """Upper bound on the distance of any sphere's surface from the base's origin [m]."""
    lengths = np.linalg.norm(robot.frame_offsets[:, :3, 3], axis=1)
    slides = np.where(robot.prismatic, np.maximum(np.abs(robot.lower), np.abs(robot.upper)), 0.0)
    arrays = compile_robot(robot)
    extent = np.linalg.norm(arrays.bounds[:, :3], axis=1) + arrays.bounds[:, 3]
    farthest = (robot.moved_by @ (lengths + slides)).max()
    return float(farthest + extent.max(initial=0.0))


@once_per_robot
def reach_ball(robot: Robot) -> tuple[ndarray, float]:
    """Center [3] and radius of a ball around all spheres of moving links [m]. If the first joint moves all
    these links, the center is at this joint, which makes the ball smaller; else it is at the base's
    origin."""
    first = robot.frame_offsets[0, :3, 3]
    reach = reach_bound(robot)
    return (
        (first, reach - float(np.linalg.norm(first))) if robot.moved_by[1:, 0].all() else (0 * first, reach)
    )


def _clusters(spheres: ndarray) -> list[ndarray]:
    """Divides spheres into sets of at most sixteen, by halving along the direction of largest extent."""
    if len(spheres) <= W:
        return [spheres]
    centered = spheres[:, :3] - spheres[:, :3].mean(axis=0)
    order = np.argsort(centered @ np.linalg.svd(centered, full_matrices=False)[2][0], kind="stable")
    half = len(spheres) // 2
    return _clusters(spheres[order[:half]]) + _clusters(spheres[order[half:]])


def bounding_spheres(sets: Sequence[ndarray]) -> list[ndarray]:
    """A nearly minimal sphere around each set of spheres. The center repeatedly moves towards the farthest
    sphere of the set (Badoiu and Clarkson)."""
    if not sets:
        return []
    max_count = max(map(len, sets))
    each = np.arange(len(sets))
    spheres = np.full((len(sets), max_count, 4), -np.inf)
    for padded, real in zip(spheres, sets, strict=True):
        padded[: len(real)] = real
        padded[len(real) :, :3] = 0.0
    centers = np.array([real[:, :3].mean(axis=0) for real in sets])
    for i in range(1, 200):
        reach = np.linalg.norm(spheres[..., :3] - centers[:, None], axis=-1) + spheres[..., 3]
        centers = centers + (spheres[each, reach.argmax(axis=1), :3] - centers) / (i + 1)
    reach = np.linalg.norm(spheres[..., :3] - centers[:, None], axis=-1) + spheres[..., 3]
    return list(np.column_stack([centers, reach.max(axis=1) + 1e-6]))


GRID_SECONDS_PER_POINT = 7e-7
"""Approximate time to build the grid, per covering sphere of the meshes and clouds [s]."""


@lru_cache(maxsize=8)
def compile_scene_for(robot: Robot, scene: Scene) -> SceneArrays:
    """The arrays of the part of a scene that the robot can come near. They are cached, since a search and the
    validator use the same arrays."""
    largest = float(compile_robot(robot).spheres[:, 3].max(initial=0.0))
    return compile_scene(scene, reach_bound(robot), largest, robot_groups(robot))


def compile_scene(
    scene: Scene, reach: float = np.inf, radius: float = 0.0, groups: tuple[str, ...] = ()
) -> SceneArrays:
    """The arrays of a scene for a robot that stays within `reach` of its base's origin [m].

    Points well beyond the reach are left out. `radius` is the radius of the robot's largest sphere [m];
    `groups` are its links with spheres, for allowed contacts.
    """
    touchable = {name for name, _ in scene.allowed_contacts}
    solids = list[Solid]()
    points = list[PointCloud | Triangulated]()
    for solid in solids_of(scene):
        shape = solid.shape
        if not isinstance(shape, PointCloud | Triangulated):
            solids.append(solid)
        elif shape.name in touchable:
            for ball in join_to_few(_cover(shape, reach)):
                solids.append(Solid(shape, transform(ball[:3]), np.zeros(3), 0.0, ball[3], False))
        else:
            points.append(shape)
    rows = _rows(solids, reach)
    grid = _grid_around(tuple(points), reach, radius)
    return SceneArrays(rows, _boxes_around(rows), *grid, may_touch=allowed_contacts(scene, groups, solids))


def _rows(solids: Sequence[Solid], reach: float) -> ndarray:
    """`SceneArrays.solids`: each solid is cropped along its straight edges to the part that the robot can
    come near, then enlarged by more than the rounding to float32.

    Cropping does not change the distance to points within reach. It keeps float32 precise for a floor that is
    1 km wide.
    """
    T = np.array([solid.T_base_box for solid in solids]).reshape(-1, 4, 4)
    sizes = np.array([[*solid.half, solid.disc, solid.rounding] for solid in solids]).reshape(-1, 5)
    R = T[:, :3, :3]
    half = sizes[:, :3]  # a view: what changes `half` changes `sizes`, and the other way round
    # crop each box to coordinates within `far` of the base's origin
    far = 2 * reach + 1
    base = -np.einsum("nij,ni->nj", R, T[:, :3, 3])
    low = np.maximum(-half, base - far)
    high = np.minimum(half, base + far)
    nonempty = low < high
    half[nonempty] = ((high - low) / 2)[nonempty]
    center = T[:, :3, 3] + np.einsum("nij,nj->ni", R, np.where(nonempty, (low + high) / 2, 0.0))
    growth = FLOAT32_ROUNDING * (np.abs(center).max(axis=1) + sizes.max(axis=1))
    sizes += growth[:, None] * (sizes > 0)
    half[:, :2] += sizes[:, 3:4]
    R_box_base = R.transpose(0, 2, 1).reshape(-1, 9)
    return np.concatenate([center, R_box_base, half, sizes[:, 4:], sizes[:, 3:4] > 0], axis=1).astype(
        np.float32
    )


def _boxes_around(rows: ndarray) -> ndarray:
    """`SceneArrays.solid_boxes`."""
    middle = rows[:, :3]
    rotation = np.abs(rows[:, 3:12].reshape(-1, 3, 3))
    half = rows[:, 12:15]
    extent = np.einsum("nij,ni->nj", rotation, half) + rows[:, 15:16]
    extent += BOX_SLACK * (1 + np.abs(middle) + extent)
    return by_sixteen(np.concatenate([middle - extent, middle + extent], axis=1), EMPTY_BOX)


def _cover(shape: PointCloud | Triangulated, reach: float) -> ndarray:
    """Spheres [n, 4] that contain the points or triangles that the robot can come near."""
    if isinstance(shape, PointCloud):
        return thin_points(shape.points, shape.point_radius, reach)
    return cover_triangles(shape.mesh.world_vertices[shape.mesh.faces], reach)


@lru_cache(maxsize=8)
def _grid_around(
    shapes: tuple[PointCloud | Triangulated, ...], reach: float, radius: float
) -> tuple[ndarray, ...]:
    """The grid of point clouds and meshes, cached, so that scenes with the same clouds and meshes share
    it."""
    clouds = [NO_SPHERES]
    for i, shape in enumerate(shapes):
        points = sum(map(len, clouds))
        check_time(f"{len(shapes) - i} of {len(shapes)} meshes and clouds ({points:,} points are ready)")
        clouds.append(_cover(shape, reach))
    cloud = np.concatenate(clouds)
    check_time(f"the grid of {len(cloud):,} points", GRID_SECONDS_PER_POINT * len(cloud))
    return build_grid(cloud, radius)
