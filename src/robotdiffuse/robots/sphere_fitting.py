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
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from robotdiffuse.errors import InputError
from robotdiffuse.robots.robot import ConvexMesh, Robot
from robotdiffuse.robots.sphere_kernels import DIRECTIONS, assign, depths_at, relax

MARGIN = 1e-5
"""Added to the radii [m]: covers rounding in files and in single-precision kernels."""


@dataclass(frozen=True)
class SphereSettings:
    """How closely spheres follow the meshes of a link."""

    first_half: float = 0.015
    """How far a sphere may stick out of a link that half of the joints (rounded up) or fewer move [m]."""
    second_half: float = 0.009
    """The same for the links beyond, which work closer to obstacles [m]."""
    relative: float = 1.0
    """Never more than this times the radius of the largest sphere inside the link."""
    finest: float = 0.004
    """Nor less than this [m]."""
    candidates: int = 1000
    """Places inside the mesh that the greedy cover chooses from."""
    rounds: int = 15
    """Rounds of the alternation for each number of spheres."""
    tries: int = 5
    """Spheres of which each is dropped for a try, before their number is final."""
    starts: int = 2
    """Fits from different starts, of which the one with the fewest spheres is kept."""

    def __post_init__(self) -> None:
        if not 0 < self.finest <= min(self.first_half, self.second_half):
            raise InputError(
                f"sphere tolerances: finest is {self.finest}; it must be positive and at most first_half "
                f"({self.first_half}) and second_half ({self.second_half})"
            )

    def tolerance(self, robot: Robot, link: str) -> float:
        """How far the spheres of a link may stick out [m]."""
        meshes = robot.meshes[link]
        first = robot.link_frame(link) <= (robot.dof + 1) // 2
        wanted = self.first_half if first else self.second_half
        size = np.ptp(np.concatenate([mesh.vertices for mesh in meshes]), axis=0).min()
        inradius = _Body(meshes).depth(_grid(meshes, size / 16)).max()
        return float(max(min(wanted, self.relative * inradius), self.finest))


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
    disc = float(np.sqrt(2 * tolerance * true_body.depth(grid).max()))
    coarse, medium, fine = (_Cells.of(meshes, disc / cut) for cut in (4, 8, 16))
    covers = []
    for _ in range(settings.starts):
        places = _inside_points(true_body, meshes, settings.candidates, rng)
        centers = _first_cover(body, coarse, places, tolerance, settings.rounds)
        for cells in (coarse, medium):
            centers = _thin_out(body, cells, centers, tolerance, settings)
        covers.append(centers)
    centers, _ = _relax(body, fine, min(covers, key=len), settings.rounds, 0.0)
    return _without_holes(true_body, grid, _with_radii(body, fine, centers), tolerance)


def stick_out(meshes: tuple[ConvexMesh, ...], spheres: Float[ndarray, "n 4"]) -> Float[ndarray, "n"]:
    """How far each sphere reaches out of the meshes [m] (an upper bound where meshes overlap)."""
    return spheres[:, 3] - _Body(meshes).depth(spheres[:, :3])


def covered(meshes: tuple[ConvexMesh, ...], spheres: Float[ndarray, "n 4"], finest: float = 2e-6) -> bool:
    """Whether the spheres provably cover the surface of the union of the meshes.

    Triangles that no one sphere holds are cut in four, until all are held, or a corner is found that is in
    no sphere, or they are smaller than `finest` [m].
    """
    triangles = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    single = [_Body((mesh,)) for mesh in meshes] if len(meshes) > 1 else []
    while len(triangles):
        corners = triangles.reshape(-1, 3)
        gaps = _distances(corners, spheres[:, :3]) - spheres[:, 3]
        is_open = (gaps.reshape(len(triangles), 3, -1).max(1) > 0).all(1)
        bare = gaps.min(1) > 0
        for body in single:
            hidden = body.depth(corners) > 1e-9
            is_open &= ~hidden.reshape(-1, 3).all(1)
            bare &= ~hidden
        if bare.any():
            return False
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
        planes = [_planes(mesh, extra) for mesh, extra in zip(meshes, allowances, strict=True)]
        self.normals = np.concatenate([normals for normals, _ in planes])
        self.offsets = np.concatenate([offsets for _, offsets in planes])
        self.starts = np.cumsum([0, *(len(offsets) for _, offsets in planes)])
        """First plane of each mesh, and the number of planes."""

    @property
    def arrays(self) -> tuple[ndarray, ndarray, ndarray]:
        return self.normals, self.offsets, self.starts

    def depth(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Distance from each point inside to the nearest face plane [m]; negative outside."""
        return depths_at(points, *self.arrays)


def _planes(
    mesh: ConvexMesh, allowance: Float[ndarray, "f"]
) -> tuple[Float[ndarray, "p 3"], Float[ndarray, "p"]]:
    """Normals and offsets of the distinct planes of a mesh."""
    normals = face_normals(mesh)
    good = np.linalg.norm(normals, axis=1) > 0.5
    normals, index = np.unique(np.round(normals[good], 9), axis=0, return_inverse=True)
    least = np.full(len(normals), np.inf)
    np.minimum.at(least, index.ravel(), allowance[good])
    # the farthest vertex, not the face's own: rounding must not put a plane inside the mesh
    return normals, (mesh.vertices @ normals.T).max(0) + least


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
        soup, vertices, cut = [], [], []
        for k, mesh in enumerate(meshes):
            triangles = _split(mesh.vertices[mesh.faces], size)
            hidden = np.zeros(len(triangles), dtype=bool)
            for other in meshes[:k] + meshes[k + 1 :]:
                inside = _Body((other,)).depth(triangles.reshape(-1, 3)) > 1e-9
                hidden |= inside.reshape(-1, 3).all(1)
            soup.append(triangles[~hidden])
            vertices.append(mesh.vertices)
            cut.append(hidden.any())
        corners = np.concatenate(soup).reshape(-1, 3)
        keys = np.round(np.concatenate([*vertices, corners]), 9) + 0.0
        _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        points = np.concatenate([*vertices, corners])[first]
        count = len(keys) - len(corners)
        sharp = np.zeros(len(points), dtype=bool)
        sharp[index.ravel()[:count]] = True
        # where triangles were left out, any point may be a corner of what is left
        sharp |= any(cut)
        return _Cells(points, index.ravel()[count:].reshape(-1, 3), sharp)

    def farthest(self, centers: Float[ndarray, "n 3"]) -> Float[ndarray, "c n"]:
        """Radius that each centre needs to hold each cell [m]."""
        distance = _distances(self.points, centers)
        a, b, c = self.corners.T
        return np.maximum(np.maximum(distance[a], distance[b]), distance[c])

    def assigned(
        self, body: _Body, centers: Float[ndarray, "n 3"]
    ) -> tuple[Int[ndarray, "c"], Float[ndarray, "c"], Float[ndarray, "c"]]:
        """For each cell the sphere that holds it with the least stick-out, that, and the next least [m]."""
        owner = np.empty(len(self.corners), np.int64)
        least, second = np.empty(len(owner)), np.empty(len(owner))
        assign(self.points, self.corners, centers, body.depth(centers), owner, least, second)
        return owner, least, second


def _relax(
    body: _Body, cells: _Cells, centers: Float[ndarray, "n 3"], rounds: int, enough: float
) -> tuple[Float[ndarray, "n 3"], float]:
    """Better centres, and how far the worst sphere sticks out [m]; ends early at `enough`."""
    return relax(cells.points, cells.corners, cells.sharp, centers, rounds, enough, *body.arrays, DIRECTIONS)


def _first_cover(
    body: _Body, cells: _Cells, places: Float[ndarray, "n 3"], tolerance: float, rounds: int
) -> Float[ndarray, "k 3"]:
    """Centres from a greedy set cover, with more until none sticks out by more than the tolerance."""
    needed = cells.farthest(places) - body.depth(places)
    open_cells = needed <= np.maximum(tolerance, needed.min(1, keepdims=True))
    chosen: list[int] = []
    while len(open_cells):
        chosen.append(int(open_cells.sum(0).argmax()))
        open_cells = open_cells[~open_cells[:, chosen[-1]]]
    centers, worst = _relax(body, cells, places[chosen], rounds, tolerance)
    while worst > tolerance:
        extra = cells.points[cells.corners[cells.assigned(body, centers)[1].argmax()]].mean(0)
        centers, worst = _relax(body, cells, np.concatenate([centers, extra[None]]), rounds, tolerance)
    return centers


def _thin_out(
    body: _Body, cells: _Cells, centers: Float[ndarray, "n 3"], tolerance: float, settings: SphereSettings
) -> Float[ndarray, "m 3"]:
    """Drop spheres, those first whose cells the others take over best, as long as the tolerance holds."""
    failures = 0
    while failures < min(settings.tries, len(centers) - 1):
        owner, _, second = cells.assigned(body, centers)
        loss = np.zeros(len(centers))
        np.maximum.at(loss, owner, second)
        fewer = np.delete(centers, np.argsort(loss)[failures], axis=0)
        fewer, worst = _relax(body, cells, fewer, settings.rounds, tolerance)
        if worst > tolerance:
            failures += 1
        else:
            centers, failures = fewer, 0
    return centers


def _with_radii(body: _Body, cells: _Cells, centers: Float[ndarray, "n 3"]) -> Float[ndarray, "n 4"]:
    """Least radii with which each sphere holds its own cells; spheres without any are dropped."""
    radius = cells.farthest(centers)
    own = np.eye(len(centers), dtype=bool)[(radius - body.depth(centers)).argmin(1)]
    radii = np.where(own, radius, 0.0).max(0) + MARGIN
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


def _split(triangles: Float[ndarray, "n 3 3"], size: float) -> Float[ndarray, "m 3 3"]:
    """Halve triangles at their longest edge until no edge is longer than `size` [m]."""
    done = []
    while len(triangles):
        edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
        longest = edges.argmax(1)
        small = edges.max(1) <= size
        done.append(triangles[small])
        triangles, longest = triangles[~small], longest[~small]
        turn = (longest[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(triangles, turn[:, :, None], axis=1), 1, 0)
        middle = (a + b) / 2
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return np.concatenate(done)


def _distances(a: ndarray, b: ndarray) -> ndarray:
    """Distances [n, m] of points [n, 3] and [m, 3]."""
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
