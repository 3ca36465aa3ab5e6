"""A timed motion under PyBullet's position control: how well it is tracked, and whether it touches anything.

Each joint has a motor that PyBullet drives towards the position of the trajectory, with its velocity as feed
forward. Gravity acts; links are of uniform density (`World`), as the robot's file keeps no masses; motors are
strong, since it keeps no torque limits either. What a replay shows is therefore that the motion is smooth
enough to be tracked and stays free while it is, not that a certain motor can do it.

Contact is what pushes. Bullet's meshes are 1 mm too large, so a motion that passes an obstacle closer than
that (for two links, 2 mm) touches it here.
"""

from dataclasses import dataclass, replace

import numpy as np
import pybullet
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Trajectory
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.simulation.world import DENSITY, World


@dataclass(frozen=True)
class ReplaySettings:
    time_step: float = 1 / 240
    """Of the simulation [s]; the default is PyBullet's own."""
    position_gain: float = 0.3
    """Share of a position error that a motor takes back in one time step, in (0, 1]."""
    velocity_gain: float = 1.0
    """Share of a velocity error that a motor takes back in one time step, in (0, 1]."""
    force: float = 500.0
    """Most that a motor gives [N m], [N] for a prismatic joint."""
    gravity: float = 9.81
    """Along -z of the base [m/s^2]."""
    density: float = DENSITY
    """Of all links [kg/m^3]."""
    settle: float = 0.25
    """Time that the motors hold the last configuration after the motion [s]."""

    def __post_init__(self) -> None:
        if not 1e-5 <= self.time_step <= 1 / 240:
            raise InputError(f"replay.time_step is {self.time_step}; it must lie in [0.00001, 1/240] s")
        for name in ("position_gain", "velocity_gain"):
            if not 0 < getattr(self, name) <= 1:
                raise InputError(f"replay.{name} is {getattr(self, name)}; it must lie in (0, 1]")
        for name in ("force", "density"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"replay.{name} is {getattr(self, name)}; it must be positive")
        if not 0 <= self.settle < np.inf:
            raise InputError(f"replay.settle is {self.settle}; it must not be negative [s]")


DEFAULT = ReplaySettings()


@dataclass(frozen=True)
class ReplayContact:
    """Two things that touched during a replay."""

    link: str
    other: str
    """An obstacle or another link."""
    time: float
    """When they first did [s]."""
    depth: float
    """The deepest that they went into each other, ever [m]; negative where something was left between them.

    Bullet's meshes push from 1 mm off, and what it pushes away may never come nearer.
    """


@dataclass(frozen=True, eq=False)
class Replay:
    """What the simulator did with a trajectory."""

    joint_names: tuple[str, ...]
    times: Float[ndarray, "n"]
    """After each time step, first 0 [s]."""
    positions: Float[ndarray, "n dof"]
    """As simulated [rad], [m] for prismatic joints."""
    reference: Float[ndarray, "n dof"]
    """As asked for, at the same times."""
    tip_errors: Float[ndarray, "n"]
    """Distance of the robot's tip from where the reference puts it [m]."""
    contacts: tuple[ReplayContact, ...]
    """By the time at which they began."""

    @property
    def free(self) -> bool:
        """Whether nothing touched."""
        return not self.contacts

    @property
    def max_errors(self) -> Float[ndarray, "dof"]:
        """The greatest tracking error of each joint [rad]."""
        return np.abs(self.positions - self.reference).max(axis=0)

    @property
    def rms_errors(self) -> Float[ndarray, "dof"]:
        """The root mean square of each joint's tracking error [rad]."""
        return np.sqrt(((self.positions - self.reference) ** 2).mean(axis=0))


def replay(robot: Robot, scene: Scene, trajectory: Trajectory, settings: ReplaySettings = DEFAULT) -> Replay:
    """Simulate a trajectory from its first row to the last, and then `settings.settle` seconds of rest.

    An arm that hits an obstacle is held back by it; the simulation goes on to the end. Raises InputError for
    a trajectory of other joints.
    """
    if trajectory.joint_names != robot.joint_names:
        raise InputError(
            f"the trajectory moves {', '.join(trajectory.joint_names)}; "
            f"{robot.name} plans {', '.join(robot.joint_names)}"
        )
    count = int(np.ceil((trajectory.duration + settings.settle) / settings.time_step))
    times = settings.time_step * np.arange(count + 1)
    reference = sample(trajectory, times)
    with World(robot, scene, density=settings.density) as world:
        positions, contacts = _simulate(world, times, reference, settings)
        tip_errors = np.linalg.norm(_tips(world, positions) - _tips(world, reference), axis=1)
    return Replay(robot.joint_names, times, positions, reference, tip_errors, contacts)


def sample(trajectory: Trajectory, times: Float[ndarray, "n"]) -> Float[ndarray, "n dof"]:
    """Positions at times [s]: cubic between the rows, with their velocities; the last row after the end."""
    t = np.clip(times, 0.0, trajectory.duration)
    i = np.clip(np.searchsorted(trajectory.times, t, side="right") - 1, 0, len(trajectory.times) - 2)
    h = (trajectory.times[i + 1] - trajectory.times[i])[:, None]
    u = (t - trajectory.times[i])[:, None] / h
    p, v = trajectory.positions, trajectory.velocities
    a, b, va, vb = p[i], p[i + 1], h * v[i], h * v[i + 1]
    return a + u * (va + u * (3 * (b - a) - 2 * va - vb + u * (2 * (a - b) + va + vb)))


def _simulate(
    world: World,
    times: Float[ndarray, "n"],
    reference: Float[ndarray, "n dof"],
    settings: ReplaySettings,
) -> tuple[Float[ndarray, "n dof"], tuple[ReplayContact, ...]]:
    client, body, dof = world.client, world.body, len(world.joints)
    pybullet.setPhysicsEngineParameter(fixedTimeStep=settings.time_step, physicsClientId=client)
    pybullet.setGravity(0, 0, -settings.gravity, physicsClientId=client)
    world.place(reference[0])
    for index, value in world.held.items():
        pybullet.setJointMotorControl2(
            body,
            index,
            pybullet.POSITION_CONTROL,
            targetPosition=value,
            force=settings.force,
            physicsClientId=client,
        )
    gains = {
        "forces": [settings.force] * dof,
        "positionGains": [settings.position_gain] * dof,
        "velocityGains": [settings.velocity_gain] * dof,
        "physicsClientId": client,
    }
    contacts: dict[tuple[str, str], ReplayContact] = {}
    velocities = np.diff(reference, axis=0) / settings.time_step
    positions = np.empty_like(reference)
    positions[0] = reference[0]
    for k in range(1, len(times)):
        pybullet.setJointMotorControlArray(
            body,
            world.joints,
            pybullet.POSITION_CONTROL,
            # where the arm should be now, and the speed that takes it to where it should be next
            targetPositions=reference[k - 1].tolist(),
            targetVelocities=velocities[k - 1].tolist(),
            **gains,
        )
        pybullet.stepSimulation(physicsClientId=client)
        states = pybullet.getJointStates(body, world.joints, physicsClientId=client)
        positions[k] = [state[0] for state in states]
        # a step looks for contacts where it begins
        for link, other, distance in world.touching():
            new = ReplayContact(link, other, float(times[k - 1]), -distance)
            known = contacts.get((link, other), new)
            contacts[link, other] = replace(known, depth=max(known.depth, new.depth))
    return positions, tuple(contacts.values())


def _tips(world: World, positions: Float[ndarray, "n dof"]) -> Float[ndarray, "n 3"]:
    """Where the tip link is [m]."""
    tip, at = world.links[world.robot.tip], []
    for q in positions:
        world.place(q)
        state = pybullet.getLinkState(
            world.body, tip, computeForwardKinematics=1, physicsClientId=world.client
        )
        at.append(state[4])
    return np.array(at)
