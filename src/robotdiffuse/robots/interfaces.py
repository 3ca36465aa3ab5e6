"""Where links meet: faces of a link that its neighbours hide, at any angle of the joint between them."""

# Coal's Python module has no type information.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass

import coal
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.robots.robot import MOVING_KINDS, ConvexMesh, Robot
from robotdiffuse.robots.sphere_fitting import face_normals
from robotdiffuse.transforms import inverse

ANGLES = 9
"""Values of the joint between two links at which hiding is tested."""
DEPTHS = np.linspace(0.004, 0.04, 10)
"""How far a sphere may reach into the neighbour [m]."""
COVER = 0.5
"""A point is hidden if it is nearer to the neighbour than this share of the tolerance: it then sticks out of
the arm by less than the tolerance."""


@dataclass(frozen=True, eq=False)
class Neighbour:
    """A link next to another one."""

    link: str
    T_link_neighbour: Float[ndarray, "n 4 4"]
    """At values of the joint between them over its range; one if they are fixed to each other."""


def neighbours(robot: Robot, link: str) -> tuple[Neighbour, ...]:
    """Links with geometry that a joint connects to this one; fixed links without geometry are passed."""
    found = []
    for joint in robot.joints:
        above, T_above_parent = joint.parent, np.eye(4)
        while above not in robot.meshes and above != robot.base:
            through = next(j for j in robot.joints if j.child == above)
            if through.kind in MOVING_KINDS:
                break
            above, T_above_parent = through.parent, through.T_parent_joint @ T_above_parent
        if link not in (above, joint.child) or not {above, joint.child} <= set(robot.meshes):
            continue
        turn = joint.kind == "continuous"
        ends = (-np.pi, np.pi) if turn else (joint.lower, joint.upper)
        values = np.linspace(*ends, ANGLES) if joint.kind in MOVING_KINDS else [0.0]
        T = np.stack([T_above_parent @ joint.T_parent_joint @ joint.motion(float(q)) for q in values])
        other = joint.child if link == above else above
        found.append(Neighbour(other, T if link == above else np.stack([inverse(t) for t in T])))
    return tuple(found)


def face_allowances(robot: Robot, link: str, tolerance: float) -> tuple[Float[ndarray, "f"], ...]:
    """For each face of the link's meshes, how much deeper than the tolerance a sphere may reach over it [m].

    That is as far as the face, moved outwards, stays in the same neighbour or within half of the tolerance of
    it, at all values of the joint between them.
    """
    beside = neighbours(robot, link)
    return tuple(_allowance(robot, mesh, beside, tolerance) for mesh in robot.meshes[link])


def stick_out_of_arm(robot: Robot, link: str, spheres: Float[ndarray, "n 4"], points: int = 300) -> float:
    """How far spheres of a link reach out of the link and its neighbours, at any value of the joints [m].

    Measured on points spread over each sphere. Joints are taken one at a time.
    """
    k = np.arange(points) + 0.5
    height, turn = 1 - 2 * k / points, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - height**2)
    unit = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
    surface = (spheres[:, None, :3] + spheres[:, None, 3:] * unit).reshape(-1, 3)
    distance = _distance(robot, link, surface, np.inf)
    worst = 0.0
    for i in np.argsort(-distance):
        if distance[i] <= worst:
            break
        best = distance[i]
        for other in neighbours(robot, link):
            p = surface[i] - other.T_link_neighbour[:, :3, 3]
            local = np.einsum("nji,nj->ni", other.T_link_neighbour[:, :3, :3], p)
            best = min(best, float(_distance(robot, other.link, local, best).max()))
        worst = max(worst, best)
    return float(worst)


def _allowance(
    robot: Robot, mesh: ConvexMesh, beside: tuple[Neighbour, ...], tolerance: float
) -> Float[ndarray, "f"]:
    corners = mesh.vertices[mesh.faces]
    normals = face_normals(mesh)
    probes = np.concatenate(
        [corners, corners.mean(1, keepdims=True), (corners + np.roll(corners, 1, 1)) / 2], 1
    )
    allowance = np.zeros(len(mesh.faces))
    for other in beside:
        T = other.T_link_neighbour
        good = np.ones(len(mesh.faces), dtype=bool)
        for depth in DEPTHS:
            if not good.any():
                break
            moved = (probes + depth * normals[:, None])[good]
            flat = moved.reshape(-1, 1, 3) - T[:, :3, 3]
            local = np.einsum("nji,pnj->pni", T[:, :3, :3], flat)
            far = _plane_distance(robot.meshes[other.link], local.reshape(-1, 3))
            hidden = (far.reshape(len(moved), -1) < COVER * tolerance).all(1)
            good[good] = hidden
            allowance[good] = np.maximum(allowance[good], depth - tolerance)
    return allowance


def _plane_distance(meshes: tuple[ConvexMesh, ...], points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
    """Largest distance beyond a face plane of the nearest mesh [m]: at most the distance to it."""
    beyond = []
    for mesh in meshes:
        normals = face_normals(mesh)
        offsets = np.einsum("fd,fd->f", normals, mesh.vertices[mesh.faces[:, 0]])
        beyond.append((points @ normals.T - offsets).max(1))
    return np.min(beyond, axis=0)


def _distance(robot: Robot, link: str, points: Float[ndarray, "n 3"], cutoff: float) -> Float[ndarray, "n"]:
    """Distance of points from the meshes of a link [m], zero or less inside; larger than `cutoff` inexact."""
    lower = _plane_distance(robot.meshes[link], points)
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    dot, still = coal.Sphere(1e-7), coal.Transform3s.Identity()
    hulls = [coal_hull(mesh) for mesh in robot.meshes[link]]
    for i in np.flatnonzero((lower > 0) & (lower < cutoff)):
        place = coal.Transform3s(np.eye(3), points[i])
        lower[i] = min(coal.distance(hull, still, dot, place, request, result) for hull in hulls)
    return lower


def coal_hull(mesh: ConvexMesh) -> "coal.Convex":
    """Coal's copy of a convex mesh."""
    points, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for vertex in mesh.vertices:
        points.append(vertex)
    for face in mesh.faces:
        triangles.append(coal.Triangle(*map(int, face)))
    return coal.Convex(points, triangles)
