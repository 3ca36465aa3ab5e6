"""Replay of a trajectory in PyBullet with position control: tracking errors and contacts.

Each joint has a motor that PyBullet drives towards the position of the trajectory, with the velocity as feed
forward. Gravity acts. Links have uniform density (`World`) and motors are strong, because the robot file has
neither masses nor torque limits. So a replay shows that the motion is smooth enough to track and free of
contacts while tracked, not that a certain motor can execute it.

Bullet's meshes are 1 mm too large. A motion that passes an obstacle at less than that (2 mm between two
links) has a contact here.
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

SOLVER_ITERATIONS = 500
"""Iterations of Bullet's constraint solver in a time step. With its default of 50, motors miss their targets
by up to 0.6 mm at the tip, whatever the motion; with 500 by a few micrometres."""


@dataclass(frozen=True)
class ReplaySettings:
    """Settings of the simulation and of its motors."""

    time_step: float = 1 / 240
    """Time step of the simulation [s]; the default is PyBullet's own."""
    position_gain: float = 0.3
    """Fraction of a position error that a motor corrects in one time step, in (0, 1]."""
    velocity_gain: float = 1.0
    """Fraction of a velocity error that a motor corrects in one time step, in (0, 1]."""
    force: float = 500.0
    """Largest motor torque [N m], or force [N] for a prismatic joint."""
    gravity: float = 9.81
    """Gravity along -z of the base [m/s^2]."""
    density: float = DENSITY
    """Density of all links [kg/m^3]."""
    settle: float = 0.25
    """Time for which the motors hold the last configuration after the motion [s]."""

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
    """A contact between two bodies during a replay."""

    link: str
    other: str
    """An obstacle or another link."""
    time: float
    """Time of the first contact [s]."""
    depth: float
    """Largest penetration depth [m]; negative if a gap remained.

    Bullet's meshes push from a distance of 1 mm, so that bodies may be pushed apart before they meet.
    """


@dataclass(frozen=True, eq=False)
class Replay:
    """The result of a replay."""

    joint_names: tuple[str, ...]
    times: Float[ndarray, "n"]
    """Simulated times, from 0 [s]."""
    positions: Float[ndarray, "n dof"]
    """Simulated positions [rad], [m] for prismatic joints."""
    reference: Float[ndarray, "n dof"]
    """Positions of the trajectory at the same times."""
    tip_errors: Float[ndarray, "n"]
    """Distance of the robot's tip from its reference position [m]."""
    contacts: tuple[ReplayContact, ...]
    """Contacts in order of their first time."""

    @property
    def free(self) -> bool:
        """Whether there were no contacts."""
        return not self.contacts

    @property
    def max_errors(self) -> Float[ndarray, "dof"]:
        """Largest tracking error of each joint [rad]."""
        return np.abs(self.positions - self.reference).max(axis=0)

    @property
    def rms_errors(self) -> Float[ndarray, "dof"]:
        """Root mean square tracking error of each joint [rad]."""
        return np.sqrt(((self.positions - self.reference) ** 2).mean(axis=0))


def replay(robot: Robot, scene: Scene, trajectory: Trajectory, settings: ReplaySettings = DEFAULT) -> Replay:
    """Simulate a trajectory, and then `settings.settle` seconds of rest.

    An obstacle that the arm hits blocks it; the simulation continues to the end. Raises InputError for a
    trajectory of other joints.
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
    """Positions at times [s], by cubic interpolation with the rows' velocities; the last row after the
    end."""
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
    pybullet.setPhysicsEngineParameter(
        fixedTimeStep=settings.time_step, numSolverIterations=SOLVER_ITERATIONS, physicsClientId=client
    )
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
            # the position for now, and the velocity that leads to the next position
            targetPositions=reference[k - 1].tolist(),
            targetVelocities=velocities[k - 1].tolist(),
            **gains,
        )
        pybullet.stepSimulation(physicsClientId=client)
        states = pybullet.getJointStates(body, world.joints, physicsClientId=client)
        positions[k] = [state[0] for state in states]
        # a step detects contacts at its beginning
        for link, other, distance in world.touching():
            new = ReplayContact(link, other, float(times[k - 1]), -distance)
            known = contacts.get((link, other), new)
            contacts[link, other] = replace(known, depth=max(known.depth, new.depth))
    return positions, tuple(contacts.values())


def _tips(world: World, positions: Float[ndarray, "n dof"]) -> Float[ndarray, "n 3"]:
    """Positions of the tip link [m]."""
    tip, at = world.links[world.robot.tip], []
    for q in positions:
        world.place(q)
        state = pybullet.getLinkState(
            world.body, tip, computeForwardKinematics=1, physicsClientId=world.client
        )
        at.append(state[4])
    return np.array(at)
