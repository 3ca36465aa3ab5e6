"""Spheres that cover the convex collision meshes of a link, sticking out little.

The surface is cut into small triangles. A sphere is convex, so it covers a triangle if and only if it holds
its three corners: a set of spheres in which every small triangle lies within one sphere provably covers the
surface, not just samples of it.

A sphere with centre p and radius r sticks out of a convex mesh by exactly r - depth(p), where depth is the
distance from p to the nearest face plane. For the cells given to one sphere, the centre that makes it stick
out least is the minimum of max |corner - p| - depth(p), a convex function of p. Like Lloyd's algorithm, the
fit alternates between giving each cell to the sphere that holds it with the least stick-out and moving each
sphere to its best centre. It starts from a greedy set cover and drops spheres as long as the tolerance holds.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from robotdiffuse.errors import InputError
from robotdiffuse.robots.robot import ConvexMesh, Robot


@dataclass(frozen=True)
class SphereSettings:
    """How closely spheres follow the meshes of a link."""

    coarsest: float = 0.015
    """How far a sphere may stick out of a link in the first half of the arm [m]."""
    at_tip: float = 0.007
    """The same behind the last joint, where the arm works close to obstacles; between them, linear [m]."""
    relative: float = 0.7
    """Never more than this times the radius of the largest sphere inside the link."""
    finest: float = 0.004
    """Nor less than this [m]."""
    candidates: int = 1000
    """Places inside the mesh that the greedy cover chooses from."""
    rounds: int = 8
    """Rounds of the alternation for each number of spheres."""
    tries: int = 3
    """Spheres of which each is dropped for a try, before their number is final."""

    def __post_init__(self) -> None:
        if not 0 < self.finest <= self.at_tip <= self.coarsest:
            raise InputError(
                f"sphere tolerances: finest {self.finest}, at_tip {self.at_tip}, coarsest {self.coarsest}; "
                "each must be positive and at most the next"
            )

    def tolerance(self, robot: Robot, link: str) -> float:
        """How far the spheres of a link may stick out [m]."""
        meshes = robot.meshes[link]
        along = max(0.0, 2 * robot.link_frame(link) / robot.dof - 1)
        wanted = self.coarsest + along * (self.at_tip - self.coarsest)
        size = np.ptp(np.concatenate([mesh.vertices for mesh in meshes]), axis=0).min()
        inradius = _Body(meshes).depth(_grid(meshes, size / 16)).max()
        return float(np.clip(min(wanted, self.relative * inradius), self.finest, self.coarsest))


def fit_spheres(
    meshes: tuple[ConvexMesh, ...],
    tolerance: float,
    rng: np.random.Generator,
    allowances: tuple[Float[ndarray, "f"], ...] | None = None,
    settings: SphereSettings = SphereSettings(),
) -> Float[ndarray, "n 4"]:
    """Spheres [x y z radius, m] that cover the union of convex meshes and stick out by `tolerance` [m].

    Over the faces of each mesh they may stick out by `allowances` [m] more, where the next link hides it.
    """
    body, true_body = _Body(meshes, allowances), _Body(meshes)
    grid = _grid(meshes, tolerance / 2)
    # sticking out of a flat face by e, a sphere covers a disc of radius sqrt(2 r e); cells are much smaller
    disc = np.sqrt(2 * tolerance * true_body.depth(grid).max())
    cells = _Cells.of(meshes, disc / 5)
    places = _inside_points(true_body, meshes, settings.candidates, rng)
    needed = cells.stick_out(body, places)
    centers = places[_greedy_cover(needed <= np.maximum(tolerance, needed.min(1, keepdims=True)))]
    centers = _relax(body, cells, centers, settings.rounds, tolerance)
    while (needed := cells.stick_out(body, centers).min(1)).max() > tolerance:
        extra = cells.points[cells.corners[needed.argmax()]].mean(0)
        centers = _relax(body, cells, np.concatenate([centers, extra[None]]), settings.rounds, tolerance)
    for finer in (1, 2):
        if finer == 2:
            cells = _Cells.of(meshes, disc / 10)
        failures = 0
        while len(centers) > 1 and failures < settings.tries:
            fewer = _without_one(body, cells, centers, failures)
            fewer = _relax(body, cells, fewer, settings.rounds, tolerance)
            if cells.stick_out(body, fewer).min(1).max() > tolerance:
                failures += 1
            else:
                centers, failures = fewer, 0
    cells = _Cells.of(meshes, disc / 20)
    spheres = _with_radii(body, cells, _relax(body, cells, centers, settings.rounds // 2, 0.0))
    return _without_holes(true_body, grid, spheres, tolerance)


def stick_out(meshes: tuple[ConvexMesh, ...], spheres: Float[ndarray, "n 4"]) -> Float[ndarray, "n"]:
    """How far each sphere reaches out of the meshes [m] (an upper bound where meshes overlap)."""
    return spheres[:, 3] - _Body(meshes).depth(spheres[:, :3])


def covered(meshes: tuple[ConvexMesh, ...], spheres: Float[ndarray, "n 4"], finest: float = 2e-5) -> bool:
    """Whether the spheres provably cover the surface of the union of the meshes.

    Triangles that no one sphere holds are cut in four, until they are held or smaller than `finest` [m].
    """
    triangles = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    single = [_Body((mesh,)) for mesh in meshes]
    while len(triangles):
        corners = triangles.reshape(-1, 3)
        gaps = _distances(corners, spheres[:, :3]) - spheres[:, 3]
        is_open = (gaps.reshape(len(triangles), 3, -1).max(1) > 0).all(1)
        if len(meshes) > 1:
            hidden = [(body.depth(corners).reshape(-1, 3) > 1e-9).all(1) for body in single]
            is_open &= ~np.any(hidden, axis=0)
        triangles = triangles[is_open]
        if len(triangles) and np.linalg.norm(np.ptp(triangles, axis=1), axis=1).min() < finest:
            return False
        a, b, c = np.moveaxis(triangles, 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        triangles = np.concatenate([np.stack(quarter, axis=1) for quarter in quarters])
    return True


class _Body:
    """A union of convex meshes as face planes, each moved outwards by its allowance."""

    def __init__(
        self, meshes: tuple[ConvexMesh, ...], allowances: tuple[Float[ndarray, "f"], ...] | None = None
    ) -> None:
        allowances = allowances or tuple(np.zeros(len(mesh.faces)) for mesh in meshes)
        self.planes = [_planes(mesh, extra) for mesh, extra in zip(meshes, allowances, strict=True)]

    def depth(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Distance from each point inside to the nearest face plane [m]; negative outside."""
        depths = [-(points @ normals - offsets).max(1) for normals, offsets in self.planes]
        return depths[0] if len(depths) == 1 else np.max(depths, axis=0)


def _planes(
    mesh: ConvexMesh, allowance: Float[ndarray, "f"]
) -> tuple[Float[ndarray, "3 p"], Float[ndarray, "p"]]:
    """Normals and offsets of the distinct planes of a mesh."""
    normals = face_normals(mesh)
    good = np.linalg.norm(normals, axis=1) > 0.5
    normals, index = np.unique(np.round(normals[good], 9), axis=0, return_inverse=True)
    least = np.full(len(normals), np.inf)
    np.minimum.at(least, index.ravel(), allowance[good])
    # the farthest vertex, not the face's own: rounding must not put a plane inside the mesh
    return np.ascontiguousarray(normals.T), (mesh.vertices @ normals.T).max(0) + least


def face_normals(mesh: ConvexMesh) -> Float[ndarray, "f 3"]:
    """Outward unit normals; zero for a face without area."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    size = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(size > 1e-14, normals / np.maximum(size, 1e-14), 0.0)


@dataclass(frozen=True, eq=False)
class _Cells:
    """Small triangles of the surface of the union of meshes."""

    points: Float[ndarray, "p 3"]
    corners: Int[ndarray, "c 3"]
    """Indices into points."""
    sharp: Bool[ndarray, "p"]
    """Vertices of the meshes; all other points lie between neighbours on a face or an edge."""

    @staticmethod
    def of(meshes: tuple[ConvexMesh, ...], size: float) -> "_Cells":
        """Triangles with edges of at most this size [m], without those inside another mesh."""
        points, corners, sharp, count = [], [], [], 0
        for k, mesh in enumerate(meshes):
            p, f = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, size, max_iter=30)
            p, f = np.asarray(p), np.asarray(f)
            hidden = np.zeros(len(f), dtype=bool)
            for other in meshes[:k] + meshes[k + 1 :]:
                hidden |= (_Body((other,)).depth(p) > 1e-9)[f].all(1)
            used, index = np.unique(f[~hidden], return_inverse=True)
            p, f = p[used], index.reshape(-1, 3)
            is_vertex = (_distances(p, mesh.vertices) < 1e-9).any(1)
            # where triangles were left out, any point may be a corner of what is left
            sharp.append(is_vertex | hidden.any())
            points.append(p)
            corners.append(f + count)
            count += len(p)
        return _Cells(np.concatenate(points), np.concatenate(corners), np.concatenate(sharp))

    def outlines(self, owner: Int[ndarray, "c"], count: int) -> list[Float[ndarray, "k 3"]]:
        """For each owner, points whose convex hull holds all its cells."""
        # a point between cells of one owner is needed only if it is a vertex of the mesh
        first = np.full(len(self.points), count)
        last = np.full(len(self.points), -1)
        np.minimum.at(first, self.corners.ravel(), np.repeat(owner, 3))
        np.maximum.at(last, self.corners.ravel(), np.repeat(owner, 3))
        rim = (first != last) | self.sharp
        lines = []
        for i in range(count):
            corners = self.corners[owner == i].ravel()
            lines.append(self.points[np.unique(corners[rim[corners]])])
        return lines

    def farthest(self, centers: Float[ndarray, "n 3"]) -> Float[ndarray, "c n"]:
        """Radius that each centre needs to hold each cell [m]."""
        distance = _distances(self.points, centers)
        a, b, c = self.corners.T
        return np.maximum(np.maximum(distance[a], distance[b]), distance[c])

    def stick_out(self, body: _Body, centers: Float[ndarray, "n 3"]) -> Float[ndarray, "c n"]:
        """How far a sphere at each centre would reach out of the meshes to hold each cell [m]."""
        return self.farthest(centers) - body.depth(centers)


def _greedy_cover(holds: Bool[ndarray, "c n"]) -> Int[ndarray, "k"]:
    left = holds
    chosen: list[int] = []
    while len(left):
        chosen.append(int(left.sum(0).argmax()))
        left = left[~left[:, chosen[-1]]]
    return np.array(chosen)


def _relax(
    body: _Body, cells: _Cells, centers: Float[ndarray, "n 3"], rounds: int, enough: float
) -> Float[ndarray, "n 3"]:
    """Alternate between giving cells to spheres and moving the spheres; the best centres met.

    Ends early when all spheres stick out by `enough` [m] or less.
    """
    step, best, best_value = 0.004, centers, np.inf
    for i in range(rounds + 1):
        needed = cells.stick_out(body, centers)
        value = float(needed.min(1).max())
        if value < best_value:
            best, best_value = centers, value
        if value <= enough or i == rounds:
            break
        outlines = cells.outlines(needed.argmin(1), len(centers))
        centers = np.stack(
            [_best_center(body, own, p, step) for own, p in zip(outlines, centers, strict=True)]
        )
        step = max(0.8 * step, 0.0005)
    return best


def _best_center(
    body: _Body, own: Float[ndarray, "k 3"], center: Float[ndarray, "3"], step: float
) -> Float[ndarray, "3"]:
    """Centre of least stick-out for a sphere that holds these points, by pattern search."""
    if not len(own):
        return center

    def value(centers: ndarray) -> ndarray:
        return _distances(centers, own).max(1) - body.depth(centers)

    least = value(center[None])[0]
    while step > 2e-4:
        around = center + step * DIRECTIONS
        values = value(around)
        i = int(values.argmin())
        if values[i] < least - 1e-7:
            center, least = around[i], values[i]
        else:
            step /= 2
    return center


def _without_one(
    body: _Body, cells: _Cells, centers: Float[ndarray, "n 3"], rank: int
) -> Float[ndarray, "m 3"]:
    """Drop the sphere whose cells the others take over with the least stick-out, or the next by rank."""
    needed = cells.stick_out(body, centers)
    second = np.partition(needed, 1, axis=1)[:, 1]
    owner = needed.argmin(1)
    loss = [second[owner == i].max(initial=0.0) for i in range(len(centers))]
    return np.delete(centers, int(np.argsort(loss)[min(rank, len(loss) - 1)]), axis=0)


def _with_radii(body: _Body, cells: _Cells, centers: Float[ndarray, "n 3"]) -> Float[ndarray, "n 4"]:
    """Least radii with which each sphere holds its own cells; spheres without any are dropped."""
    radius = cells.farthest(centers)
    own = np.eye(len(centers), dtype=bool)[(radius - body.depth(centers)).argmin(1)]
    radii = np.where(own, radius, 0.0).max(0) + 3e-6
    return np.concatenate([centers, radii[:, None]], axis=1)[own.any(0)]


def _without_holes(
    body: _Body, grid: Float[ndarray, "g 3"], spheres: Float[ndarray, "n 4"], hole: float
) -> Float[ndarray, "m 4"]:
    """Fill holes inside the meshes, where a small obstacle could hide, from the emptiest grid point on."""
    inside = body.depth(grid)
    grid, inside = grid[inside > 0], inside[inside > 0]
    while len(grid):
        gap = (_distances(grid, spheres[:, :3]) - spheres[:, 3]).min(1)
        worst = int(gap.argmax())
        if gap[worst] < hole:
            break
        spheres = np.concatenate([spheres, np.append(grid[worst], inside[worst])[None]])
    return spheres


def _distances(a: Float[ndarray, "n 3"], b: Float[ndarray, "m 3"]) -> Float[ndarray, "n m"]:
    squares = (a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T
    return np.sqrt(np.maximum(squares, 0.0))


def _grid(meshes: tuple[ConvexMesh, ...], spacing: float) -> Float[ndarray, "n 3"]:
    corners = np.concatenate([mesh.vertices for mesh in meshes])
    axes = [
        np.arange(lo, hi, spacing) + spacing / 2
        for lo, hi in zip(corners.min(0), corners.max(0), strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _inside_points(
    body: _Body, meshes: tuple[ConvexMesh, ...], count: int, rng: np.random.Generator
) -> Float[ndarray, "n 3"]:
    corners = np.concatenate([mesh.vertices for mesh in meshes])
    points = rng.uniform(corners.min(0), corners.max(0), (20 * count, 3))
    return points[body.depth(points) > 0][:count]


DIRECTIONS = np.array(
    [[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], dtype=float
)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
