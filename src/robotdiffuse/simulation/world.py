"""A robot and obstacles in a PyBullet simulation without a window, and depth cameras that see them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any
from xml.etree import ElementTree as Xml

import numpy as np
import pybullet
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.bounds import vector
from robotdiffuse.core.errors import InputError, unknown_name
from robotdiffuse.core.settings import Bound, NotNegative, Positive, Settings
from robotdiffuse.core.transforms import inverse, quaternion_from_rotation, rpy_from_rotation
from robotdiffuse.core.types import Configuration, Pose, Rotation, Vector
from robotdiffuse.drawables import Drawable, Surface, drawables, link_surfaces
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.robots.robot import MOVING_KINDS, ConvexMesh, Robot
from robotdiffuse.scenes.moving_obstacles import MovingObstacle
from robotdiffuse.scenes.point_cloud import voxel_thin
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Mesh, PointCloud, Sphere, Triangulated

COLLISION_MARGIN = 0.001
"""Margin that Bullet adds around each convex mesh [m]; Bullet's call to change it has no effect."""
DENSITY = 1000.0
"""Density of all links [kg/m^3]; the masses of a robot's file are not used. A Panda gets 19.7 kg; a real one
has 18."""
# Columns of PyBullet's contact points: second body, link of each body, distance, normal force.
OTHER = 2
LINK = 3
OTHER_LINK = 4
DISTANCE = 8
FORCE = 9
# Smallest mass and inertia of a link [kg], [kg m^2]; PyBullet cannot move a link without mass.
MIN_MASS = 0.01
MIN_INERTIA = 1e-4
SAMPLE_OFFSET = (0.0, 1.0)
"""Position within a pixel, in columns and rows from its upper left corner, that PyBullet's renderer samples.

Measured by rendering a sphere: its points then lie on it within 0.1 mm; half a pixel off, within 2 mm.
"""


class _Simulation:
    """PyBullet's functions for a simulation of its own."""

    def __init__(self) -> None:
        self._client = pybullet.connect(pybullet.DIRECT)

    def __getattr__(self, name: str) -> Any:
        return partial(getattr(pybullet, name), physicsClientId=self._client)


class World:
    """A robot on a fixed base, and replaceable obstacles. Call `close`, or use it in a `with` statement.

    Collisions are enabled for exactly the pairs that RobotDiffuse checks: links that a planned joint moves
    against obstacles that they may not touch, and links on different frames unless they may touch.
    """

    def __init__(
        self,
        robot: Robot,
        scene: Scene,
        visuals: bool = False,
        moving: Sequence[MovingObstacle] = (),
    ) -> None:
        """visuals: add colored surfaces for cameras, which takes longer to load. moving: further
        obstacles, where they are at time 0 until `move`."""
        self.robot = robot
        self.visuals = visuals
        self.bullet = _Simulation()
        """PyBullet's functions for this simulation."""
        self._folder = TemporaryDirectory()
        try:
            self._load()
            self.set_scene(scene, moving)
        except BaseException:
            self.close()
            raise

    def _load(self) -> None:
        robot = self.robot
        bullet = self.bullet
        # otherwise Bullet takes a file of the same name for the same mesh
        bullet.setPhysicsEngineParameter(enableFileCaching=0)
        flags = pybullet.URDF_USE_SELF_COLLISION | pybullet.URDF_USE_SELF_COLLISION_INCLUDE_PARENT
        urdf = write_urdf(robot, Path(self._folder.name), self.visuals)
        self.body: int = bullet.loadURDF(str(urdf), useFixedBase=True, flags=flags)
        self.links: dict[str, int] = {robot.base: -1}
        """PyBullet's index of each link, which is also that of the joint above it."""
        indices: dict[str, int] = {}
        for index in range(bullet.getNumJoints(self.body)):
            info = bullet.getJointInfo(self.body, index)
            indices[info[1].decode()] = index
            self.links[info[12].decode()] = index
        self.joints: list[int] = [indices[name] for name in robot.joint_names]
        self.held: dict[int, float] = {
            indices[joint.name]: robot.locked.get(joint.name, 0.0)
            for joint in robot.joints
            if joint.kind in MOVING_KINDS and joint.name not in robot.joint_names
        }
        """Values of the joints that planning does not move, by PyBullet's index."""
        solid = [link for link in robot.link_names if robot.meshes.get(link)]
        self.moving: list[str] = [link for link in solid if robot.link_frame(link) > 0]
        """Links with geometry that a planned joint moves."""
        self.pairs: list[tuple[str, str]] = []
        """Pairs of links that are checked against each other."""
        for i, a in enumerate(solid):
            for b in solid[i + 1 :]:
                separate_frames = robot.link_frame(a) != robot.link_frame(b)
                if separate_frames and frozenset((a, b)) not in robot.allowed_collisions:
                    self.pairs.append((a, b))
                else:
                    bullet.setCollisionFilterPair(self.body, self.body, self.links[a], self.links[b], 0)
        for index, value in self.held.items():
            bullet.resetJointState(self.body, index, value)
        self.obstacles: dict[str, int] = {}
        """PyBullet's body index of each obstacle, by name."""
        self.mesh_shapes: dict[tuple[bytes, bytes], int] = {}
        """PyBullet's collision shape of each mesh; reused because PyBullet never frees the memory of a
        mesh."""

    def __enter__(self) -> "World":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the simulation and delete its files."""
        if self.bullet.isConnected():
            self.bullet.disconnect()
            self._folder.cleanup()

    def set_scene(self, scene: Scene, moving: Sequence[MovingObstacle] = ()) -> None:
        """Replace all obstacles; the robot stays loaded."""
        for body in self.obstacles.values():
            self.bullet.removeBody(body)
        self.scene = scene
        scene_drawables = drawables(scene, moving)
        self._moving = [one for one in scene_drawables if one.moving is not None]
        self.obstacles = {one.name: self._add(one) for one in scene_drawables}
        for link, index in self.links.items():
            for name, body in self.obstacles.items():
                if self.robot.link_frame(link) == 0 or scene.may_touch(link, name):
                    self.bullet.setCollisionFilterPair(self.body, body, index, -1, 0)

    def place(self, q: Configuration) -> None:
        """Place the arm in a configuration, at rest."""
        self.bullet.resetJointStatesMultiDof(self.body, self.joints, q[:, None].tolist())

    def move(self, time: float) -> None:
        """Place the moving obstacles where they are at a time [s]; one of unknown motion stays."""
        for one in self._moving:
            self.bullet.resetBasePositionAndOrientation(self.obstacles[one.name], *_pose(one.frame(time)))

    def touching(self) -> list[tuple[str, str, float]]:
        """Contacts of the last step: link, obstacle or other link, signed distance [m]."""
        links = {index: link for link, index in self.links.items()}
        obstacles = {body: name for name, body in self.obstacles.items()}
        return [
            (
                links[point[LINK]],
                links[point[OTHER_LINK]] if point[OTHER] == self.body else obstacles[point[OTHER]],
                self.gap(point),
            )
            for point in self.bullet.getContactPoints(self.body)
            if point[FORCE] > 0 or self.gap(point) < 0
        ]

    def gap(self, point: tuple) -> float:
        """Signed distance [m] of a PyBullet contact point, corrected for the margins of meshes."""
        margins = 2 if point[OTHER] == self.body else 1
        return float(point[DISTANCE] + margins * COLLISION_MARGIN)

    def _add(self, drawn: Drawable) -> int:
        """PyBullet's body of an obstacle."""
        shape = drawn.shape
        folder = Path(self._folder.name)
        bullet = self.bullet
        if isinstance(shape, PointCloud):
            # loaded from a URDF because PyBullet otherwise allows only 16 spheres
            urdf = write_points_urdf(shape, drawn.surface if self.visuals else None, folder)
            return bullet.loadURDF(str(urdf), useFixedBase=True)
        match shape:
            case Sphere():
                solid = bullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=shape.radius)
            case Box():
                half = (shape.size / 2).tolist()
                solid = bullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half)
            case Cylinder() | Capsule():
                kind = pybullet.GEOM_CYLINDER if isinstance(shape, Cylinder) else pybullet.GEOM_CAPSULE
                solid = bullet.createCollisionShape(kind, radius=shape.radius, height=shape.height)
            case _:
                assert isinstance(shape, Triangulated)
                solid = self._mesh(shape.mesh)
        visual = -1
        if self.visuals:
            file = folder / "visual.obj"  # PyBullet reads it when a body is created
            write_obj(file, drawn.surface.moved(inverse(drawn.frame())))
            color = [*(channel / 255 for channel in drawn.color), 1.0]
            visual = bullet.createVisualShape(pybullet.GEOM_MESH, fileName=str(file), rgbaColor=color)
        xyz, xyzw = _pose(drawn.frame())
        return bullet.createMultiBody(0.0, solid, visual, basePosition=xyz, baseOrientation=xyzw)

    def _mesh(self, mesh: Mesh) -> int:
        """PyBullet's collision shape of a mesh, which may be hollow, at the origin."""
        key = mesh.vertices.tobytes(), mesh.faces.tobytes()
        if key not in self.mesh_shapes:
            file = Path(self._folder.name) / "obstacle.obj"
            write_obj(file, mesh)
            self.mesh_shapes[key] = self.bullet.createCollisionShape(
                pybullet.GEOM_MESH, fileName=str(file), flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH
            )
        return self.mesh_shapes[key]


def _pose(T: Pose) -> tuple[list[float], list[float]]:
    """Position and quaternion xyzw."""
    w, *xyz = quaternion_from_rotation(T[:3, :3]).tolist()
    return T[:3, 3].tolist(), [*xyz, w]


def write_urdf(robot: Robot, folder: Path, visuals: bool) -> Path:
    """Write the robot as a URDF with its convex meshes and masses by DENSITY; returns the file in `folder`.

    With `visuals`, links also get the surfaces that are drawn elsewhere. Joints that planning does not move
    keep their kind but lose their limits, because published problems open grippers wider than their URDF
    allows.
    """
    root = Xml.Element("robot", name="robot")
    surfaces = link_surfaces(robot) if visuals else {}
    for link in robot.link_names:
        element = Xml.SubElement(root, "link", name=link)
        meshes = robot.meshes.get(link, ())
        _add_inertia(element, meshes)
        for i, mesh in enumerate(meshes):
            file = folder / f"{link}_{i}.obj"
            write_obj(file, mesh)
            _add_mesh(element, "collision", file)
        if link in surfaces:
            _add_visual(element, surfaces[link], folder / link)
    for joint in robot.joints:
        _add_joint(root, joint, joint.name in robot.joint_names)
    return _write_tree(root, folder / "robot.urdf")


def write_points_urdf(cloud: PointCloud, surface: Surface | None, folder: Path) -> Path:
    """Write one link with a sphere for each point, and the surface for cameras if it is given. Returns the
    file."""
    root = Xml.Element("robot", name="points")
    element = Xml.SubElement(root, "link", name="points")
    _add_inertia(element, ())
    for point in cloud.points:
        collision = Xml.SubElement(element, "collision")
        Xml.SubElement(collision, "origin", xyz=_numbers(point))
        Xml.SubElement(Xml.SubElement(collision, "geometry"), "sphere", radius=_numbers([cloud.point_radius]))
    if surface is not None:
        _add_visual(element, surface, folder / "points")
    return _write_tree(root, folder / "points.urdf")


def write_obj(file: Path, mesh: Surface | ConvexMesh | Mesh) -> None:
    """Write triangles as a Wavefront file; the normals of a surface shade it smoothly."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    corner = "{0}"
    if isinstance(mesh, Surface):
        lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in mesh.normals.tolist()]
        corner = "{0}//{0}"
    corners = [corner.format(i) for i in range(1, len(mesh.vertices) + 1)]
    lines += [f"f {corners[a]} {corners[b]} {corners[c]}" for a, b, c in mesh.faces.tolist()]
    file.write_text("\n".join(lines) + "\n")


def mass_properties(meshes: tuple[ConvexMesh, ...], density: float) -> tuple[float, Vector, Rotation]:
    """Mass [kg], center of mass [m] and inertia about it [kg m^2] of solids in the link frame.

    Overlapping solids count twice where they overlap.
    """
    import trimesh

    parts = []
    for mesh in meshes:
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).mass_properties
        sign = np.sign(solid.volume)  # negative if the faces point inwards
        parts.append((sign * density * solid.volume, solid.center_mass, sign * density * solid.inertia))
    total = float(sum(mass for mass, _, _ in parts))
    if total < MIN_MASS:
        return MIN_MASS, np.zeros(3), MIN_INERTIA * np.eye(3)
    center = sum((mass * at for mass, at, _ in parts), np.zeros(3)) / total
    inertia = MIN_INERTIA * np.eye(3)
    for mass, at, own_inertia in parts:
        arm = at - center
        inertia = inertia + own_inertia + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return total, center, inertia


def _add_inertia(element: Xml.Element, meshes: tuple[ConvexMesh, ...]) -> None:
    mass, center, inertia = mass_properties(meshes, DENSITY)
    inertial = Xml.SubElement(element, "inertial")
    Xml.SubElement(inertial, "origin", xyz=_numbers(center))
    Xml.SubElement(inertial, "mass", value=_numbers([mass]))
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    entries = zip(names, inertia[np.triu_indices(3)], strict=True)
    Xml.SubElement(inertial, "inertia", {name: _numbers([value]) for name, value in entries})


def _add_mesh(element: Xml.Element, use: str, file: Path) -> Xml.Element:
    parent = Xml.SubElement(element, use)
    Xml.SubElement(Xml.SubElement(parent, "geometry"), "mesh", filename=str(file))
    return parent


def _add_visual(element: Xml.Element, surface: Surface, stem: Path) -> None:
    """Add one visual for each color, because PyBullet's renderer has no face colors."""
    for i, (rgb, part) in enumerate(surface.by_color):
        file = stem.with_name(f"{stem.name}_visual_{i}.obj")
        write_obj(file, part)
        name = "color_{}_{}_{}".format(*rgb)
        material = Xml.SubElement(_add_mesh(element, "visual", file), "material", name=name)
        Xml.SubElement(material, "color", rgba=_numbers([*(channel / 255 for channel in rgb), 1.0]))


def _write_tree(root: Xml.Element, file: Path) -> Path:
    Xml.indent(root)  # PyBullet misreads lines of more than 8 kB
    Xml.ElementTree(root).write(file)
    return file


def _add_joint(root: Xml.Element, joint: Joint, planned: bool) -> None:
    element = Xml.SubElement(root, "joint", name=joint.name, type=joint.kind)
    Xml.SubElement(element, "parent", link=joint.parent)
    Xml.SubElement(element, "child", link=joint.child)
    T = joint.T_parent_joint
    Xml.SubElement(element, "origin", xyz=_numbers(T[:3, 3]), rpy=_numbers(rpy_from_rotation(T[:3, :3])))
    if joint.kind in MOVING_KINDS:
        Xml.SubElement(element, "axis", xyz=_numbers(joint.axis))
        # in Bullet, a lower limit above the upper one means no limits
        lower, upper = (joint.lower, joint.upper) if planned else (1.0, -1.0)
        limits = {"lower": lower, "upper": upper, "velocity": 1.0, "effort": 1.0}
        Xml.SubElement(element, "limit", {key: _numbers([value]) for key, value in limits.items()})


def _numbers(values: object) -> str:
    return " ".join(f"{value:.17g}" for value in np.asarray(values, float))


@dataclass(frozen=True)
class DepthCamera(Settings, name="camera"):
    """A pinhole camera with the noise of a depth sensor, in the base frame of the robot."""

    position: tuple[float, ...]
    """x y z [m]"""
    target: tuple[float, ...]
    """The point at the center of the image [m]."""
    up: tuple[float, ...] = (0.0, 0.0, 1.0)
    """Upward direction in the image; not along the line of sight."""
    width: Annotated[int, Bound(least=1.0, most=4096.0)] = 320
    """[pixels]"""
    height: Annotated[int, Bound(least=1.0, most=4096.0)] = 240
    """[pixels]"""
    field_of_view: Annotated[float, Bound(above=0.0, below=np.pi)] = 0.96
    """Vertical angle [rad]; the default is about that of common stereo depth cameras."""
    near: Positive = 0.1
    """Near clipping distance [m]."""
    far: Positive = 4.0
    """Far clipping distance [m]."""
    noise: NotNegative = 0.0
    """Standard deviation of the distance along the ray [m]."""
    dropout: Annotated[float, Bound(least=0.0, below=1.0)] = 0.0
    """Fraction of pixels without a measurement."""

    def __post_init__(self) -> None:
        super().__post_init__()
        position, target, up = (
            vector("camera", name, getattr(self, name), 3) for name in ("position", "target", "up")
        )
        sight = target - position
        if np.linalg.norm(np.cross(sight, up)) <= 1e-6 * np.linalg.norm(sight):
            raise InputError(
                f"camera.up is {self.up}; it must not lie along the line of sight {tuple(sight)}"
            )
        if self.near >= self.far:
            raise InputError(f"camera.near is {self.near} and far {self.far}; it must be 0 < near < far")

    @property
    def rotation(self) -> Rotation:
        """Unit vectors to the right, upwards and forwards in the base frame, as columns."""
        forward = np.subtract(self.target, self.position)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, self.up)
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward], axis=1)

    def rays(self) -> Float[ndarray, "height width 3"]:
        """Vectors from the camera through each pixel, in the base frame, 1 m long along the optical axis."""
        slope = np.tan(self.field_of_view / 2)
        half_width = slope * self.width / self.height
        x = (2 * (np.arange(self.width) + SAMPLE_OFFSET[0]) / self.width - 1) * half_width
        y = (1 - 2 * (np.arange(self.height) + SAMPLE_OFFSET[1]) / self.height) * slope
        return np.stack([*np.meshgrid(x, y), np.ones((self.height, self.width))], axis=-1) @ self.rotation.T


def _capture(
    world: World, camera: DepthCamera
) -> tuple[Float[ndarray, "height width"], Int[ndarray, "height width"]]:
    """Depth along the optical axis [m], infinite where nothing is visible, and PyBullet's body at each pixel,
    -1 where there is none; by PyBullet's software renderer, without noise.

    Raises InputError for a world that was made without visuals.
    """
    if not world.visuals:
        raise InputError("this world has no visuals for cameras; create it with World(..., visuals=True)")
    view = pybullet.computeViewMatrix(camera.position, camera.target, camera.up)
    near = camera.near
    far = camera.far
    projection = pybullet.computeProjectionMatrixFOV(
        np.degrees(camera.field_of_view), camera.width / camera.height, near, far
    )
    *_, buffer, bodies = world.bullet.getCameraImage(
        camera.width, camera.height, view, projection, shadow=0, renderer=pybullet.ER_TINY_RENDERER
    )
    shape = (camera.height, camera.width)
    bodies = np.asarray(bodies, np.int64).reshape(shape)
    buffer = np.asarray(buffer, np.float64).reshape(shape)
    return np.where(bodies >= 0, far * near / (far - (far - near) * buffer), np.inf), bodies


@dataclass(frozen=True, eq=False)
class DepthImage:
    """A depth image without noise."""

    depth: Float[ndarray, "height width"]
    """Along the optical axis [m]; infinite where nothing is visible."""
    labels: Int[ndarray, "height width"]
    """Index into `names`; -1 where nothing is visible."""
    names: tuple[str, ...]
    """Name of the robot, then of the obstacles."""


def render(world: World, camera: DepthCamera) -> DepthImage:
    """The depth image and the label of each pixel. The world must have visuals."""
    depth, bodies = _capture(world, camera)
    labels = np.full(bodies.shape, -1)
    for label, body in enumerate((world.body, *world.obstacles.values())):
        labels[bodies == body] = label
    return DepthImage(depth, labels, (world.robot.name, *world.obstacles))


def point_cloud(
    world: World,
    cameras: Sequence[DepthCamera],
    rng: np.random.Generator,
    voxel: float = 0.01,
    point_radius: float = 0.01,
    without: Sequence[str] = (),
) -> PointCloud:
    """A point cloud of the obstacles as the cameras see them, in the base frame, to plan with.

    The arm stays in its last configuration. Its pixels and those of the obstacles in `without` (such as the
    floor) are removed, but they still hide what is behind them. Each ray gets the noise and dropout of its
    camera; then one point is kept per voxel of edge length `voxel` [m]. `point_radius` [m] becomes that of
    the cloud.

    The world must have visuals. Raises InputError for a name in `without` that is not an obstacle.
    """
    for name in without:
        if name not in world.obstacles:
            raise unknown_name("obstacle in without:", name, world.obstacles)
    visible_bodies = [body for name, body in world.obstacles.items() if name not in without]
    clouds = [np.zeros((0, 3))]
    for camera in cameras:
        depth, bodies = _capture(world, camera)
        seen = np.isin(bodies, visible_bodies) & (rng.random(bodies.shape) >= camera.dropout)
        rays = camera.rays()[seen]
        lengths = np.linalg.norm(rays, axis=1)
        distances = depth[seen] * lengths + camera.noise * rng.standard_normal(len(rays))
        clouds.append(np.array(camera.position) + rays * (distances / lengths)[:, None])
    return PointCloud(voxel_thin(np.concatenate(clouds), voxel), point_radius)
