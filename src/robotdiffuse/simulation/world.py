"""A robot and obstacles in a PyBullet simulation without a window, and replays of trajectories with position
control: tracking errors and contacts.

In a replay, each joint has a motor that PyBullet drives towards the position of the trajectory, with the
velocity as feed forward. Gravity acts. Links have uniform density (`DENSITY`) and motors are strong: masses
and torque limits of the robot file are not used. So a replay shows that the motion is smooth enough to be
tracked, and free of contacts while it is tracked. It does not show that a certain motor can execute the
motion.

Bullet inflates meshes by 1 mm. A motion with less than 1 mm between a link and an obstacle, or less than 2 mm
between two links, therefore has a contact here.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, TypeVar
from xml.etree import ElementTree as Xml

import numpy as np
import pybullet
import trimesh
from pybullet_utils.bullet_client import BulletClient

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.files import writing
from robotdiffuse.core.settings import Bound, Number, Positive, Settings
from robotdiffuse.core.transforms import rpy_from_rotation, xyzw_of
from robotdiffuse.core.types import (
    Configuration,
    Configurations,
    Points,
    Pose,
    Trajectory,
    Values,
    Vector,
    frozen_dataclass,
)
from robotdiffuse.drawables import Drawable, drawables
from robotdiffuse.problems.problem import moving_obstacles
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.robots.robot import ConvexMesh, Robot, pairs_to_check
from robotdiffuse.scenes.scene import MovingObstacle, Scene
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
MIN_MASS = 0.01
"""Smallest mass of a link [kg]; PyBullet cannot move links without mass."""


W = TypeVar("W", bound="World")


class _Bullet(BulletClient):
    """PyBullet's functions for a simulation of its own. `BulletClient` itself connects with options, which
    PyBullet prints."""

    def __init__(self) -> None:
        self._pid = os.getpid()
        self._client = pybullet.connect(pybullet.DIRECT)


class World:
    """A robot on a fixed base, and replaceable obstacles. Call `close`, or use it in a `with` statement.

    Collisions are enabled for exactly the pairs that RobotDiffuse checks: a link that a planned joint moves
    and an obstacle that the link may not touch, or two links that may not touch, with a planned joint between
    them.
    """

    def __init__(self, robot: Robot, scene: Scene, moving: Sequence[MovingObstacle] = ()) -> None:
        """moving: further obstacles, at their poses of time 0 until `move` is called."""
        self.robot = robot
        self.bullet = _Bullet()
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
        # with caching, Bullet would take two files of the same name for the same mesh
        bullet.setPhysicsEngineParameter(enableFileCaching=0)
        flags = pybullet.URDF_USE_SELF_COLLISION | pybullet.URDF_USE_SELF_COLLISION_INCLUDE_PARENT
        folder = Path(self._folder.name)
        with writing(folder):
            urdf = write_urdf(robot, folder)
        self.body: int = bullet.loadURDF(str(urdf), useFixedBase=True, flags=flags)
        self.links: dict[str, int] = {robot.base: -1}
        """PyBullet's index of each link, which is also the index of the joint that moves the link."""
        indices = dict[str, int]()
        for index in range(bullet.getNumJoints(self.body)):
            info = bullet.getJointInfo(self.body, index)
            indices[info[1].decode()] = index
            self.links[info[12].decode()] = index
        self.joints = [indices[name] for name in robot.joint_names]
        self.held = {
            indices[joint.name]: robot.locked.get(joint.name, 0.0)
            for joint in robot.joints
            if joint.movable and joint.name not in robot.joint_names
        }
        """Values of the joints that planning does not move, by PyBullet's index."""
        solid = [link for link in robot.link_names if robot.meshes.get(link)]
        self.moving_links = [link for link in solid if robot.link_frame(link) > 0]
        """Links with geometry that a planned joint moves."""
        self.pairs = pairs_to_check(robot, solid)
        """Pairs of links that are checked against each other."""
        for a, b in combinations(solid, 2):
            if (a, b) not in self.pairs:
                bullet.setCollisionFilterPair(self.body, self.body, self.links[a], self.links[b], 0)
        for index, value in self.held.items():
            bullet.resetJointState(self.body, index, value)
        self.obstacles = dict[str, int]()
        """PyBullet's body index of each obstacle, by name."""
        self.mesh_shapes = dict[tuple[bytes, bytes], int]()
        """PyBullet's collision shape of each mesh, by its vertices and faces. Shapes are reused, because
        PyBullet never frees the memory of a mesh."""

    def __enter__(self: W) -> W:
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
        # as in a problem, obstacles of equal names are numbered
        scene_drawables = drawables(scene, moving_obstacles(moving, scene))
        self._moving_obstacles = [drawable for drawable in scene_drawables if drawable.moving is not None]
        self.obstacles = {drawable.name: self._add(drawable) for drawable in scene_drawables}
        for link, index in self.links.items():
            for name, body in self.obstacles.items():
                if self.robot.link_frame(link) == 0 or scene.may_touch(link, name):
                    self.bullet.setCollisionFilterPair(self.body, body, index, -1, 0)

    def place(self, q: Configuration) -> None:
        """Place the arm in a configuration, at rest."""
        self.bullet.resetJointStatesMultiDof(self.body, self.joints, q[:, None].tolist())

    def move(self, time: float) -> None:
        """Place the moving obstacles at their poses of a time [s]; obstacles of unknown motion stay."""
        for obstacle in self._moving_obstacles:
            self.bullet.resetBasePositionAndOrientation(
                self.obstacles[obstacle.name], *_pose(obstacle.frame(time))
            )

    def touching(self) -> list[tuple[str, str, float]]:
        """Contacts of the last step, each as (link, obstacle or other link, signed distance [m])."""
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
        """Signed distance [m] of a PyBullet contact point, corrected for the margins of links' meshes."""
        margins = 2 if point[OTHER] == self.body else 1
        return float(point[DISTANCE] + margins * COLLISION_MARGIN)

    def _add(self, drawn: Drawable) -> int:
        """Add an obstacle; returns PyBullet's index of its body."""
        shape = drawn.shape
        bullet = self.bullet
        if isinstance(shape, PointCloud):
            # loaded from a URDF because PyBullet otherwise allows only 16 spheres
            urdf = write_points_urdf(shape, Path(self._folder.name))
            return bullet.loadURDF(str(urdf), useFixedBase=True)
        match shape:
            case Sphere():
                solid = bullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=shape.radius)
            case Box():
                solid = bullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=(shape.size / 2).tolist())
            case Cylinder() | Capsule():
                kind = pybullet.GEOM_CYLINDER if isinstance(shape, Cylinder) else pybullet.GEOM_CAPSULE
                solid = bullet.createCollisionShape(kind, radius=shape.radius, height=shape.height)
            case _:
                assert isinstance(shape, Triangulated)
                solid = self._mesh(shape.mesh)
        xyz, xyzw = _pose(drawn.frame())
        return bullet.createMultiBody(0.0, solid, -1, basePosition=xyz, baseOrientation=xyzw)

    def _mesh(self, mesh: Mesh) -> int:
        """PyBullet's collision shape of a mesh, in the mesh's coordinates. The mesh need not be convex."""
        key = mesh.vertices.tobytes(), mesh.faces.tobytes()
        if key not in self.mesh_shapes:
            file = Path(self._folder.name) / "obstacle.obj"
            _solid(mesh).export(file)
            self.mesh_shapes[key] = self.bullet.createCollisionShape(
                pybullet.GEOM_MESH, fileName=str(file), flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH
            )
        return self.mesh_shapes[key]


def _pose(T: Pose) -> tuple[list[float], list[float]]:
    """Position and quaternion xyzw."""
    return T[:3, 3].tolist(), xyzw_of(T).tolist()


def write_urdf(robot: Robot, folder: Path) -> Path:
    """Write the robot as a URDF with its convex meshes and masses from DENSITY; returns the file in `folder`.

    Joints that planning does not move keep their kind but lose their limits, because published problems open
    grippers wider than their URDF allows.
    """
    root = Xml.Element("robot", name="robot")
    for number, link in enumerate(robot.link_names):
        element = Xml.SubElement(root, "link", name=link)
        meshes = robot.meshes.get(link, ())
        _add_inertia(element, meshes)
        for i, mesh in enumerate(meshes):
            file = folder / f"{number}_{i}.obj"  # a link's name may have slashes
            _solid(mesh).export(file)
            _add_geometry(element, "mesh", filename=str(file))
    for joint in robot.joints:
        _add_joint(root, joint, joint.name in robot.joint_names)
    return _write_tree(root, folder / "robot.urdf")


def write_points_urdf(cloud: PointCloud, folder: Path) -> Path:
    """Write one link with a sphere for each point; returns the file."""
    root = Xml.Element("robot", name="points")
    element = Xml.SubElement(root, "link", name="points")
    _add_inertia(element, ())
    for point in cloud.points:
        collision = _add_geometry(element, "sphere", radius=_numbers([cloud.point_radius]))
        Xml.SubElement(collision, "origin", xyz=_numbers(point))
    return _write_tree(root, folder / "points.urdf")


def _solid(mesh: ConvexMesh | Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def mass_and_center(meshes: tuple[ConvexMesh, ...]) -> tuple[float, Vector]:
    """Mass [kg] of solids of DENSITY, and their center of mass in the link frame [m]. Space where two solids
    overlap counts twice.

    A mass below MIN_MASS is raised to MIN_MASS, with the center at the link's origin.
    """
    solids = list(map(_solid, meshes))
    # a solid's `volume` is negative if its faces point inwards
    masses = [DENSITY * abs(solid.volume) for solid in solids]
    total = float(sum(masses))
    if total < MIN_MASS:
        return MIN_MASS, np.zeros(3)
    return total, np.average([solid.center_mass for solid in solids], axis=0, weights=masses)


def _add_inertia(element: Xml.Element, meshes: tuple[ConvexMesh, ...]) -> None:
    """Add mass and center of mass. Bullet computes the inertia itself and ignores the zeros written here."""
    mass, center = mass_and_center(meshes)
    inertial = Xml.SubElement(element, "inertial")
    Xml.SubElement(inertial, "origin", xyz=_numbers(center))
    Xml.SubElement(inertial, "mass", value=_numbers([mass]))
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    Xml.SubElement(inertial, "inertia", dict.fromkeys(names, "0"))


def _add_geometry(element: Xml.Element, kind: str, **about: str) -> Xml.Element:
    """Add a solid to a link; returns its element."""
    collision = Xml.SubElement(element, "collision")
    Xml.SubElement(Xml.SubElement(collision, "geometry"), kind, about)
    return collision


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
    if joint.movable:
        Xml.SubElement(element, "axis", xyz=_numbers(joint.axis))
        # in Bullet, a lower limit above the upper one means no limits
        bounded = planned and joint.kind != "continuous"
        lower, upper = (joint.lower, joint.upper) if bounded else (1.0, -1.0)
        limits = {"lower": lower, "upper": upper, "velocity": 1.0, "effort": 1.0}
        Xml.SubElement(element, "limit", {key: _numbers([value]) for key, value in limits.items()})


def _numbers(values: object) -> str:
    return " ".join(f"{value:.17g}" for value in np.asarray(values, float))


SOLVER_ITERATIONS = 500
"""Number of iterations of Bullet's constraint solver in a time step. With its default of 50, motors miss
their targets by up to 0.6 mm at the tip, in every motion. With 500, they miss by a few micrometers."""
# Fractions of a position and a velocity error that a motor corrects in one time step.
POSITION_GAIN = 0.3
VELOCITY_GAIN = 1.0
REST_TIME = 0.25
"""Time for which the motors hold the last configuration after the motion [s]."""


@dataclass(frozen=True)
class ReplaySettings(Settings, name="replay"):
    """Settings of the simulation and of its motors."""

    time_step: Annotated[float, Bound(least=1e-5, most=1 / 240)] = 1 / 240
    """Time step of the simulation [s]; the default is PyBullet's own."""
    force: Positive = 500.0
    """Largest motor torque [N m], or force [N] for a prismatic joint."""
    gravity: Number = 9.81
    """Gravity along -z of the base [m/s^2]."""


@dataclass(frozen=True)
class ReplayContact:
    """A contact between two bodies during a replay."""

    link: str
    other: str
    """An obstacle or another link."""
    time: float
    """Time of the first contact [s]."""
    depth: float
    """Largest penetration depth [m]; negative if a gap remained.

    Bullet pushes two links apart if they are nearer than 2 mm, a link and an obstacle if nearer than 1 mm. So
    bodies may be pushed apart before they touch.
    """


@frozen_dataclass
class Replay:
    """The result of a replay."""

    joint_names: tuple[str, ...]
    times: Values
    """Simulated times, from 0 [s]."""
    positions: Configurations
    """Simulated positions [rad], [m] for prismatic joints."""
    reference: Configurations
    """Positions of the trajectory at the same times."""
    tip_errors: Values
    """Distance of the robot's tip from its reference position [m]."""
    contacts: tuple[ReplayContact, ...]
    """Contacts in order of their first time."""

    @property
    def free(self) -> bool:
        """Whether there were no contacts."""
        return not self.contacts

    @property
    def max_errors(self) -> Configuration:
        """Largest tracking error of each joint [rad], [m] for prismatic joints."""
        return np.abs(self.positions - self.reference).max(axis=0)

    @property
    def rms_errors(self) -> Configuration:
        """Root mean square tracking error of each joint [rad], [m] for prismatic joints."""
        return np.sqrt(((self.positions - self.reference) ** 2).mean(axis=0))


def replay(
    robot: Robot,
    scene: Scene,
    trajectory: Trajectory,
    settings: ReplaySettings = ReplaySettings(),
    moving: Sequence[MovingObstacle] = (),
) -> Replay:
    """Simulate a trajectory, and then REST_TIME of rest.

    If the arm hits an obstacle, the obstacle blocks it; the simulation continues to the end. Moving obstacles
    move until the trajectory ends; obstacles of unknown motion stand still. Raises InputError for a
    trajectory of other joints.
    """
    if trajectory.joint_names != robot.joint_names:
        raise InputError(
            f"the trajectory moves {', '.join(trajectory.joint_names)}; "
            f"{robot.name} plans {', '.join(robot.joint_names)}"
        )
    count = int(np.ceil((trajectory.duration + REST_TIME) / settings.time_step))
    times = settings.time_step * np.arange(count + 1)
    motion_times = np.minimum(times, trajectory.duration)
    reference = trajectory.at(motion_times).positions
    with World(robot, scene, moving=moving) as world:
        positions, contacts = _simulate(world, motion_times, reference, settings)
        tip_errors = np.linalg.norm(_tips(world, positions) - _tips(world, reference), axis=1)
    return Replay(robot.joint_names, times, positions, reference, tip_errors, contacts)


def _simulate(
    world: World,
    times: Values,
    reference: Configurations,
    settings: ReplaySettings,
) -> tuple[Configurations, tuple[ReplayContact, ...]]:
    bullet = world.bullet
    body = world.body
    dof = len(world.joints)
    bullet.setPhysicsEngineParameter(fixedTimeStep=settings.time_step, numSolverIterations=SOLVER_ITERATIONS)
    bullet.setGravity(0, 0, -settings.gravity)
    world.place(reference[0])
    for index, value in world.held.items():
        bullet.setJointMotorControl2(
            body, index, pybullet.POSITION_CONTROL, targetPosition=value, force=settings.force
        )
    contacts = dict[tuple[str, str], ReplayContact]()
    velocities = np.diff(reference, axis=0) / settings.time_step
    positions = np.empty_like(reference)
    positions[0] = reference[0]
    for k in range(1, len(times)):
        bullet.setJointMotorControlArray(
            body,
            world.joints,
            pybullet.POSITION_CONTROL,
            # the position at the beginning of the step, and the velocity that leads to the next position
            targetPositions=reference[k - 1].tolist(),
            targetVelocities=velocities[k - 1].tolist(),
            forces=[settings.force] * dof,
            positionGains=[POSITION_GAIN] * dof,
            velocityGains=[VELOCITY_GAIN] * dof,
        )
        world.move(times[k - 1])
        bullet.stepSimulation()
        positions[k] = [state[0] for state in bullet.getJointStates(body, world.joints)]
        # a step detects contacts at its beginning
        for link, partner, distance in world.touching():
            new = ReplayContact(link, partner, (k - 1) * settings.time_step, -distance)
            previous = contacts.get((link, partner), new)
            contacts[link, partner] = replace(previous, depth=max(previous.depth, new.depth))
    return positions, tuple(contacts.values())


def _tips(world: World, positions: Configurations) -> Points:
    """Positions of the tip link [m]."""
    tip = world.links[world.robot.tip]
    at = []
    for q in positions:
        world.place(q)
        at.append(world.bullet.getLinkState(world.body, tip, computeForwardKinematics=1)[4])
    return np.array(at)
