"""Reads obstacles from MuJoCo models: the geoms that collide and are no part of the robot."""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, unknown_name
from robotdiffuse.core.transforms import inverse, quaternion_from_rotation, transform
from robotdiffuse.robots.parsing.mjcf import ellipsoid, imported_mujoco, kind_of, mesh_of, robot_bodies
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Mesh, Shape, Sphere

PLANE_SIZE = 10.0
"""Edge of the box that stands for an infinite plane [m]."""
PLANE_DEPTH = 0.1
"""Thickness of the boxes that stand for planes [m]."""


def shapes_in(model: Any, data: Any, base: str) -> list[Shape]:
    """The obstacles of a model; see `Scene.from_mujoco`."""
    mujoco = imported_mujoco()
    placed = mujoco.MjData(model)
    if data is not None:
        placed.qpos[:] = data.qpos
        placed.mocap_pos[:] = data.mocap_pos
        placed.mocap_quat[:] = data.mocap_quat
    mujoco.mj_kinematics(model, placed)
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, base)
    if body < 0:
        raise unknown_name("body", base, [model.body(k).name for k in range(model.nbody)])
    T_base_world = inverse(transform(placed.xpos[body], placed.xmat[body].reshape(3, 3)))
    robot = set(robot_bodies(model))
    rotations = placed.geom_xmat.reshape(-1, 3, 3)
    return [
        _shape(model, geom, T_base_world @ transform(placed.geom_xpos[geom], rotations[geom]))
        for geom in range(model.ngeom)
        if model.geom_bodyid[geom] not in robot and model.geom_contype[geom] | model.geom_conaffinity[geom]
    ]


def _shape(model: Any, geom: int, T: Float[ndarray, "4 4"]) -> Shape:
    """The obstacle of a geom at a pose."""
    body = int(model.geom_bodyid[geom])
    name = model.geom(geom).name or model.body(body).name
    center = T[:3, 3]
    wxyz = quaternion_from_rotation(T[:3, :3])
    size = model.geom_size[geom]
    match kind_of("Geom", model.geom_type[geom]):
        case "plane":
            halves = np.where(size[:2] > 0, size[:2], PLANE_SIZE / 2)
            below = center - T[:3, 2] * PLANE_DEPTH / 2
            return Box(below, [*2 * halves, PLANE_DEPTH], wxyz, name)
        case "sphere":
            return Sphere(center, float(size[0]), name)
        case "box":
            return Box(center, 2 * size, wxyz, name)
        case "capsule":
            return Capsule(center, float(size[0]), float(2 * size[1]), wxyz, name)
        case "cylinder":
            return Cylinder(center, float(size[0]), float(2 * size[1]), wxyz, name)
        case "ellipsoid":
            surface = ellipsoid(size)
        case "mesh":
            surface = mesh_of(model, int(model.geom_dataid[geom])).convex_hull  # with which MuJoCo collides
        case kind:
            raise InputError(
                f"geom {name} is of type {kind}; obstacles may be planes, spheres, capsules, ellipsoids, "
                f"cylinders, boxes and meshes"
            )
    return Mesh(surface.vertices, surface.faces, center, wxyz, name=name)
