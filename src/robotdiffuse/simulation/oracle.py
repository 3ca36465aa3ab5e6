"""PyBullet as a second, independent judge of collision (extra `sim`).

It shares nothing with our kinematics and collision code but the data: the robot goes to PyBullet as a URDF,
with its own forward kinematics, and closest points by its GJK. Bullet blows convex meshes up by 1 mm; that is
taken off here, and what remains of the difference to exact distances is below 1 mm (measured: 0.6 mm).
"""

from dataclasses import dataclass
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from xml.etree import ElementTree as Xml

import numpy as np
import pybullet
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.errors import InputError
from robotdiffuse.robots.robot import MOVING_KINDS, ConvexMesh, Joint, Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Mesh, Shape, Sphere
from robotdiffuse.types import Path

FAR = 10.0
"""Distances are looked for up to this [m]."""
MARGIN = 0.001
"""What Bullet adds around each convex mesh [m]; its own call to set this has no effect."""


@dataclass(frozen=True)
class OracleContact:
    """The nearest thing that PyBullet found at one configuration."""

    link: str
    other: str
    """An obstacle or another link."""
    distance: float
    """[m], negative inside."""
    at: float = 0.0
    """Waypoint index plus fraction, along a path."""


class PyBulletOracle:
    """A robot and a scene in a PyBullet world of its own, without a window.

    Links that no planned joint moves are checked against moving links only. Close it, or use it in a `with`.
    """

    def __init__(self, robot: Robot, scene: Scene) -> None:
        """Raises InputError for a shape that PyBullet lacks (point clouds)."""
        self.robot = robot
        self._client = pybullet.connect(pybullet.DIRECT)
        with TemporaryDirectory() as folder:
            urdf = _write_urdf(robot, FilePath(folder))
            self._body = pybullet.loadURDF(str(urdf), useFixedBase=True, physicsClientId=self._client)
            try:
                self._obstacles = {shape.name: self._add(shape, FilePath(folder)) for shape in scene.shapes}
            except InputError:
                self.close()
                raise
        self._links, self._joints = {robot.base: -1}, {}
        for index in range(pybullet.getNumJoints(self._body, physicsClientId=self._client)):
            info = pybullet.getJointInfo(self._body, index, physicsClientId=self._client)
            self._joints[info[1].decode()] = index
            self._links[info[12].decode()] = index
        for joint in robot.joints:
            if joint.kind in MOVING_KINDS and joint.name not in robot.joint_names:
                self._set(joint.name, robot.locked.get(joint.name, 0.0))
        solid = [link for link in robot.link_names if robot.meshes.get(link)]
        self._moving = [link for link in solid if robot.link_frame(link) > 0]
        self._pairs = [
            (a, b)
            for i, a in enumerate(solid)
            for b in solid[i + 1 :]
            if robot.link_frame(a) != robot.link_frame(b)
            and frozenset((a, b)) not in robot.allowed_collisions
        ]

    def __enter__(self) -> "PyBulletOracle":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End PyBullet's world."""
        if pybullet.isConnected(self._client):
            pybullet.disconnect(self._client)

    def nearest(self, q: Float[ndarray, "dof"], within: float = FAR) -> OracleContact | None:
        """The least signed distance to the scene or between links; None if it exceeds `within` [m]."""
        for name, value in zip(self.robot.joint_names, q.tolist(), strict=True):
            self._set(name, value)
        best: OracleContact | None = None
        for link in self._moving:
            for name, body in self._obstacles.items():
                best = self._nearer(best, within, link, name, body, -1)
        for a, b in self._pairs:
            best = self._nearer(best, within, a, b, self._body, self._links[b])
        return best

    def distance(self, q: Float[ndarray, "dof"]) -> float:
        """The least signed distance to the scene or between links [m], at most 10."""
        nearest = self.nearest(q)
        return FAR if nearest is None else nearest.distance

    def collides(self, q: Float[ndarray, "dof"], tolerance: float = 0.0) -> bool:
        """Whether anything is deeper than the tolerance [m]."""
        return self.nearest(q, -tolerance) is not None

    def check_path(self, path: Path, step: float = 0.01, tolerance: float = 0.001) -> OracleContact | None:
        """The first contact deeper than the tolerance [m] among configurations `step` apart, or None.

        `step` [rad, joint-space L2]. The default tolerance is that of Bullet itself.
        """
        q = path.positions
        for i in range(max(len(q) - 1, 1)):
            end = q[min(i + 1, len(q) - 1)]
            count = max(1, int(np.ceil(np.linalg.norm(end - q[i]) / step)))
            for k in range(count + (i >= len(q) - 2)):
                found = self.nearest(q[i] + k / count * (end - q[i]), -tolerance)
                if found is not None:
                    return OracleContact(found.link, found.other, found.distance, i + k / count)
        return None

    def _set(self, joint: str, value: float) -> None:
        pybullet.resetJointState(self._body, self._joints[joint], value, physicsClientId=self._client)

    def _nearer(
        self, best: OracleContact | None, within: float, link: str, other: str, body: int, index: int
    ) -> OracleContact | None:
        reach = within if best is None else best.distance
        points = pybullet.getClosestPoints(
            self._body, body, max(reach, 0.0), self._links[link], index, physicsClientId=self._client
        )
        margin = 2 * MARGIN if body == self._body else MARGIN
        distance = min((point[8] for point in points), default=np.inf) + margin
        return OracleContact(link, other, float(distance)) if distance <= reach else best

    def _add(self, shape: Shape, folder: FilePath) -> int:
        xyz, wxyz = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
        match shape:
            case Sphere():
                what = {"shapeType": pybullet.GEOM_SPHERE, "radius": shape.radius}
                xyz = shape.center
            case Box():
                what = {"shapeType": pybullet.GEOM_BOX, "halfExtents": (shape.size / 2).tolist()}
                xyz, wxyz = shape.center, shape.wxyz
            case Cylinder() | Capsule():
                kind = pybullet.GEOM_CYLINDER if isinstance(shape, Cylinder) else pybullet.GEOM_CAPSULE
                what = {"shapeType": kind, "radius": shape.radius, "height": shape.height}
                xyz, wxyz = shape.center, shape.wxyz
            case Mesh():
                file = folder / f"obstacle_{len(list(folder.iterdir()))}.obj"
                _write_obj(file, shape.vertices, shape.faces)
                flags = pybullet.GEOM_FORCE_CONCAVE_TRIMESH
                what = {"shapeType": pybullet.GEOM_MESH, "fileName": str(file), "flags": flags}
                xyz, wxyz = shape.xyz, shape.wxyz
            case _:
                raise InputError(
                    f"{shape.name} is a {shape.kind}; PyBullet has no such shape, only solids and meshes"
                )
        collision = pybullet.createCollisionShape(**what, physicsClientId=self._client)
        return pybullet.createMultiBody(
            baseCollisionShapeIndex=collision,
            basePosition=xyz.tolist(),
            baseOrientation=[*wxyz[1:], wxyz[0]],
            physicsClientId=self._client,
        )


def _write_obj(file: FilePath, vertices: ndarray, faces: ndarray) -> None:
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices.tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces.tolist()]
    file.write_text("\n".join(lines) + "\n")


def _rpy(rotation: Float[ndarray, "3 3"]) -> tuple[float, float, float]:
    """URDF's roll, pitch, yaw of a rotation matrix; in gimbal lock with roll 0."""
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    if np.hypot(rotation[0, 0], rotation[1, 0]) < 1e-9:
        return 0.0, float(pitch), float(np.arctan2(-rotation[0, 1], rotation[1, 1]))
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    return float(roll), float(pitch), float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _numbers(values: object) -> str:
    return " ".join(f"{value:.17g}" for value in np.asarray(values, float))


def _write_urdf(robot: Robot, folder: FilePath) -> FilePath:
    """The robot's tree with its convex meshes, as PyBullet reads it."""
    root = Xml.Element("robot", name="robot")
    for link in robot.link_names:
        _add_link(root, link, robot.meshes.get(link, ()), folder)
    for joint in robot.joints:
        _add_joint(root, joint)
    file = folder / "robot.urdf"
    Xml.ElementTree(root).write(file)
    return file


def _add_link(root: Xml.Element, link: str, meshes: tuple[ConvexMesh, ...], folder: FilePath) -> None:
    element = Xml.SubElement(root, "link", name=link)
    inertial = Xml.SubElement(element, "inertial")  # its absence only makes PyBullet print warnings
    Xml.SubElement(inertial, "mass", value="1")
    Xml.SubElement(inertial, "inertia", ixx="1", ixy="0", ixz="0", iyy="1", iyz="0", izz="1")
    for i, mesh in enumerate(meshes):
        file = folder / f"{link}_{i}.obj"
        _write_obj(file, mesh.vertices, mesh.faces)
        geometry = Xml.SubElement(Xml.SubElement(element, "collision"), "geometry")
        Xml.SubElement(geometry, "mesh", filename=str(file))


def _add_joint(root: Xml.Element, joint: Joint) -> None:
    element = Xml.SubElement(root, "joint", name=joint.name, type=joint.kind)
    Xml.SubElement(element, "parent", link=joint.parent)
    Xml.SubElement(element, "child", link=joint.child)
    T = joint.T_parent_joint
    Xml.SubElement(element, "origin", xyz=_numbers(T[:3, 3]), rpy=_numbers(_rpy(T[:3, :3])))
    if joint.kind in MOVING_KINDS:
        Xml.SubElement(element, "axis", xyz=_numbers(joint.axis))
        limits = {"lower": joint.lower, "upper": joint.upper, "velocity": 1.0, "effort": 1.0}
        Xml.SubElement(element, "limit", {key: _numbers([value]) for key, value in limits.items()})
