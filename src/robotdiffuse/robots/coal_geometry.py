"""Converts poses, solids and meshes to Coal's types."""

# Coal's Python module has no type information.
# pyright: reportAttributeAccessIssue=false

import coal
import numpy as np
from jaxtyping import Integer
from numpy import ndarray

from robotdiffuse.core.types import Points, Pose, Vector


def coal_pose(T: Pose) -> coal.Transform3s:
    """A pose as a Coal transform."""
    return coal.Transform3s(T[:3, :3], T[:3, 3])


def coal_rounded(half: Vector, disc: float, rounding: float) -> coal.CollisionGeometry:
    """A sphere, box, cylinder or capsule, given as the Minkowski sum of a box with half edges `half`, a disc
    of radius `disc` around its z axis, and a ball of radius `rounding` [m]."""
    x, y, z = (2 * half).tolist()
    if disc > 0:
        return coal.Cylinder(disc, z)
    if rounding > 0:
        return coal.Capsule(rounding, z) if z > 0 else coal.Sphere(rounding)
    return coal.Box(x, y, z)


def coal_convex(vertices: Points, faces: Integer[ndarray, "f 3"]) -> coal.Convex:
    """A convex solid from the vertices and triangles of its hull."""
    points = coal.StdVec_Vec3s()
    triangles = coal.StdVec_Triangle()
    for vertex in vertices:
        points.append(vertex)
    for a, b, c in faces.tolist():
        triangles.append(coal.Triangle(a, b, c))
    return coal.Convex(points, triangles)


def coal_surface(vertices: Points, faces: Integer[ndarray, "f 3"]) -> coal.BVHModelOBBRSS:
    """A triangle mesh, possibly open, in a bounding volume hierarchy."""
    model = coal.BVHModelOBBRSS()
    model.beginModel(len(faces), len(vertices))
    model.addVertices(np.ascontiguousarray(vertices))
    model.addTriangles(np.ascontiguousarray(faces, np.int32))
    model.endModel()
    return model
