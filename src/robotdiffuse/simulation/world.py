"""World: a robot and obstacles in a PyBullet simulation without a window."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pybullet
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.robots.robot import MOVING_KINDS, Robot
from robotdiffuse.scenes.mesh import Mesh, Triangulated
from robotdiffuse.scenes.moving_obstacles import MovingObstacle
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import IDENTITY, Box, Capsule, Cylinder, PointCloud, Shape, Sphere
from robotdiffuse.simulation.model import write_obj, write_points_urdf, write_shaded, write_urdf

COLLISION_MARGIN = 0.001
"""Margin that Bullet adds around each convex mesh [m]; Bullet's call to change it has no effect."""
DENSITY = 1000.0
"""Density of all links [kg/m^3]; the masses of a robot's file are not used. A Panda gets 19.7 kg; a real one
has 18."""
OTHER, LINK, OTHER_LINK, DISTANCE, FORCE = 2, 3, 4, 8, 9
"""Columns of PyBullet's contact points: second body, link of each body, distance, normal force."""
OBSTACLE_COLORS = ((0xD9, 0x7B, 0x5C), (0xE0, 0x9A, 0x5F), (0xC9, 0x6A, 0x6A), (0xD8, 0xAE, 0x63))
FURNITURE_COLOR = (0xCD, 0xC0, 0xAC)
FURNITURE_SIZE = 0.7
"""Obstacles with a longer side than this count as furniture, with its own colour [m]."""


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
        density: float = DENSITY,
        moving: Sequence[MovingObstacle] = (),
    ) -> None:
        """visuals: add coloured surfaces for cameras and pictures, which takes longer to load. density: of
        all links [kg/m^3]. moving: further obstacles, where they are at time 0 until `move`."""
        self.robot = robot
        self.visuals = visuals
        self._moving = tuple(moving)
        scene = scene.with_shapes([*scene.shapes, *(one.shape for one in moving)]) if moving else scene
        self.client = pybullet.connect(pybullet.DIRECT)
        self._folder = TemporaryDirectory()
        try:
            self._load(scene, density)
        except BaseException:
            self.close()
            raise

    def _load(self, scene: Scene, density: float) -> None:
        robot = self.robot
        # otherwise Bullet takes a file of the same name for the same mesh
        pybullet.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=self.client)
        flags = pybullet.URDF_USE_SELF_COLLISION | pybullet.URDF_USE_SELF_COLLISION_INCLUDE_PARENT
        urdf = write_urdf(robot, Path(self._folder.name), density, self.visuals)
        self.body: int = pybullet.loadURDF(
            str(urdf), useFixedBase=True, flags=flags, physicsClientId=self.client
        )
        self.links: dict[str, int] = {robot.base: -1}
        """PyBullet's index of each link, which is also that of the joint above it."""
        indices: dict[str, int] = {}
        for index in range(pybullet.getNumJoints(self.body, physicsClientId=self.client)):
            info = pybullet.getJointInfo(self.body, index, physicsClientId=self.client)
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
        self.pairs: list[tuple[str, str]] = [
            (a, b)
            for i, a in enumerate(solid)
            for b in solid[i + 1 :]
            if robot.link_frame(a) != robot.link_frame(b)
            and frozenset((a, b)) not in robot.allowed_collisions
        ]
        """Pairs of links that are checked against each other."""
        self._filter_links(solid)
        for index, value in self.held.items():
            pybullet.resetJointState(self.body, index, value, physicsClientId=self.client)
        self.scene = scene
        self.obstacles: dict[str, int] = {}
        """PyBullet's body index of each obstacle, by name."""
        self.mesh_shapes: dict[tuple[bytes, bytes], int] = {}
        """PyBullet's collision shape of each mesh; reused because PyBullet never frees the memory of a
        mesh."""
        self.set_scene(scene)

    def __enter__(self) -> "World":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the simulation and delete its files."""
        if pybullet.isConnected(self.client):
            pybullet.disconnect(self.client)
            self._folder.cleanup()

    def set_scene(self, scene: Scene) -> None:
        """Replace all obstacles; the robot stays loaded."""
        for body in self.obstacles.values():
            pybullet.removeBody(body, physicsClientId=self.client)
        self.scene, self.obstacles = scene, {}
        unmoved = [index for link, index in self.links.items() if self.robot.link_frame(link) == 0]
        for i, shape in enumerate(scene.shapes):
            body = self._add(shape, OBSTACLE_COLORS[i % len(OBSTACLE_COLORS)])
            self.obstacles[shape.name] = body
            allowed = [index for link, index in self.links.items() if scene.may_touch(link, shape.name)]
            for index in {*unmoved, *allowed}:
                pybullet.setCollisionFilterPair(self.body, body, index, -1, 0, physicsClientId=self.client)

    def place(self, q: Float[ndarray, "dof"]) -> None:
        """Place the arm in a configuration, at rest."""
        pybullet.resetJointStatesMultiDof(
            self.body, self.joints, q[:, None].tolist(), physicsClientId=self.client
        )

    def move(self, time: float) -> None:
        """Place the moving obstacles where they are at a time [s]; one of unknown motion stays."""
        for one in self._moving:
            xyz, wxyz = _pose(one.at(time))
            pybullet.resetBasePositionAndOrientation(
                self.obstacles[one.name], xyz.tolist(), [*wxyz[1:], wxyz[0]], physicsClientId=self.client
            )

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
            for point in pybullet.getContactPoints(self.body, physicsClientId=self.client)
            if point[FORCE] > 0 or self.gap(point) < 0
        ]

    def gap(self, point: tuple) -> float:
        """Signed distance [m] of a PyBullet contact point, corrected for the margins of meshes."""
        return float(
            point[DISTANCE] + (2 * COLLISION_MARGIN if point[OTHER] == self.body else COLLISION_MARGIN)
        )

    def _filter_links(self, solid: list[str]) -> None:
        checked = {frozenset(pair) for pair in self.pairs}
        for i, a in enumerate(solid):
            for b in solid[i + 1 :]:
                if frozenset((a, b)) not in checked:
                    indices = self.links[a], self.links[b]
                    pybullet.setCollisionFilterPair(
                        self.body, self.body, *indices, 0, physicsClientId=self.client
                    )

    def _add(self, shape: Shape, color: tuple[int, int, int]) -> int:
        if isinstance(shape, PointCloud):
            return self._add_points(shape, color)
        what: dict[str, object] = {}
        if isinstance(shape, Sphere):
            what = {"shapeType": pybullet.GEOM_SPHERE, "radius": shape.radius}
        elif isinstance(shape, Box):
            what = {"shapeType": pybullet.GEOM_BOX, "halfExtents": (shape.size / 2).tolist()}
        elif isinstance(shape, Cylinder | Capsule):
            kind = pybullet.GEOM_CYLINDER if isinstance(shape, Cylinder) else pybullet.GEOM_CAPSULE
            what = {"shapeType": kind, "radius": shape.radius, "height": shape.height}
        xyz, wxyz = _pose(shape)
        visual = -1
        if self.visuals:
            # PyBullet's own spheres and cylinders are too coarse
            vertices, faces = _surface(shape)
            large = np.ptp(vertices, axis=0).max() > FURNITURE_SIZE
            visual = self._add_visual(vertices, faces, FURNITURE_COLOR if large else color)
        solid = (
            self._mesh(shape.mesh)
            if isinstance(shape, Triangulated)
            else pybullet.createCollisionShape(**what, physicsClientId=self.client)
        )
        return pybullet.createMultiBody(
            baseCollisionShapeIndex=solid,
            baseVisualShapeIndex=visual,
            basePosition=xyz.tolist(),
            baseOrientation=[*wxyz[1:], wxyz[0]],
            physicsClientId=self.client,
        )

    def _mesh(self, mesh: Mesh) -> int:
        """PyBullet's collision shape of a mesh, which may be hollow, at the origin."""
        key = mesh.vertices.tobytes(), mesh.faces.tobytes()
        if key not in self.mesh_shapes:
            file = Path(self._folder.name) / "obstacle.obj"
            write_obj(file, mesh.vertices, mesh.faces)
            self.mesh_shapes[key] = pybullet.createCollisionShape(
                pybullet.GEOM_MESH,
                fileName=str(file),
                flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
                physicsClientId=self.client,
            )
        return self.mesh_shapes[key]

    def _add_points(self, cloud: PointCloud, color: tuple[int, int, int]) -> int:
        """One body with a sphere for each point, loaded from a URDF because PyBullet otherwise allows only
        16."""
        file = write_points_urdf(
            cloud.points, cloud.point_radius, color if self.visuals else None, Path(self._folder.name)
        )
        return pybullet.loadURDF(str(file), useFixedBase=True, physicsClientId=self.client)

    def add_surface(
        self,
        vertices: Float[ndarray, "v 3"],
        faces: Int[ndarray, "f 3"],
        color: tuple[int, int, int],
        xyz: Float[ndarray, "3"],
    ) -> None:
        """Add a surface without collision, which stays until the world is closed; `color` in sRGB, 0 to
        255."""
        visual = self._add_visual(vertices, faces, color)
        pybullet.createMultiBody(
            baseVisualShapeIndex=visual, basePosition=xyz.tolist(), physicsClientId=self.client
        )

    def _add_visual(
        self, vertices: Float[ndarray, "v 3"], faces: Int[ndarray, "f 3"], color: tuple[int, int, int]
    ) -> int:
        file = Path(self._folder.name) / "visual.obj"  # PyBullet reads it when a body is created
        write_shaded(file, vertices, faces)
        return pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            fileName=str(file),
            rgbaColor=[*(channel / 255 for channel in color), 1.0],
            physicsClientId=self.client,
        )


def _pose(shape: Shape) -> tuple[Float[ndarray, "3"], Float[ndarray, "4"]]:
    """Position and quaternion of the body of a shape that is no point cloud."""
    if isinstance(shape, Triangulated):
        return shape.mesh.xyz, shape.mesh.wxyz
    if isinstance(shape, Sphere):
        return shape.center, np.array(IDENTITY)
    assert isinstance(shape, Box | Cylinder | Capsule)
    return shape.center, shape.wxyz


def _surface(shape: Shape) -> tuple[Float[ndarray, "v 3"], Int[ndarray, "f 3"]]:
    """Vertices and faces in the shape's own frame, accurate to 0.2 mm for a round shape of radius 0.25 m."""
    import trimesh

    match shape:
        case Sphere():
            solid = trimesh.creation.icosphere(subdivisions=5, radius=shape.radius)
        case Box():
            solid = trimesh.creation.box(shape.size)
        case Cylinder():
            solid = trimesh.creation.cylinder(shape.radius, shape.height, sections=96)
        case Capsule():
            solid = trimesh.creation.capsule(shape.height, shape.radius, count=(64, 64))
            solid.apply_translation([0, 0, -solid.bounds.mean(axis=0)[2]])
        case _:
            assert isinstance(shape, Triangulated)
            return shape.mesh.vertices, shape.mesh.faces
    return np.array(solid.vertices, np.float64), np.array(solid.faces, np.int64)
