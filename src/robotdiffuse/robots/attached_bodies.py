"""Collision geometry of tools and held objects.

`Robot.attach` and `Robot.with_tool` add a body as one more link: with convex meshes for the validator,
spheres that cover them for planning, and pairs of links to check. The joints stay the same, so weights
trained for the bare arm apply.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.transforms import inverse
from robotdiffuse.robots.bodies import AttachedBody, ConvexMesh
from robotdiffuse.robots.fitting.covering_spheres import cover


def body_geometry(body: AttachedBody) -> tuple[tuple[ConvexMesh, ...], Float[ndarray, "n 4"]]:
    """Convex meshes of a body and spheres [x y z radius, m] that cover them, in the body's frame."""
    T_body_link = inverse(body.T_link_body)
    meshes: list[ConvexMesh] = []
    spheres: list[ndarray] = [np.zeros((0, 4))]
    for shape in body.shapes:
        T_link_shape, parts = shape.solid()
        T = T_body_link @ T_link_shape
        for part in parts:
            meshes.append(ConvexMesh(part.vertices @ T[:3, :3].T + T[:3, 3], part.faces))
            around = cover(part)
            spheres.append(np.column_stack([around[:, :3] @ T[:3, :3].T + T[:3, 3], around[:, 3]]))
    return tuple(meshes), np.concatenate(spheres)
