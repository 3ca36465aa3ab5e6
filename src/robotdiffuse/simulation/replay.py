"""Replay of a trajectory in PyBullet with position control: tracking errors and contacts.

Each joint has a motor that PyBullet drives towards the position of the trajectory, with the velocity as feed
forward. Gravity acts. Links have uniform density (`World`) and motors are strong: masses and torque limits of
the robot file are not used. So a replay shows that the motion is smooth enough to be tracked, and free of
contacts while it is tracked. It does not show that a certain motor can execute the motion.

Bullet inflates meshes by 1 mm. A motion with less than 1 mm between a link and an obstacle, or less than 2 mm
between two links, therefore has a contact here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import pybullet

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Bound, Positive, Settings
from robotdiffuse.core.types import Configuration, Configurations, Points, Trajectory, Values
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.moving_obstacles import MovingObstacle
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.simulation.world import World

SOLVER_ITERATIONS = 500
"""Number of iterations of Bullet's constraint solver in a time step. With its default of 50, motors miss
their targets by up to 0.6 mm at the tip for any motion; with 500 by a few micrometers."""
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
    gravity: Annotated[float, Bound()] = 9.81
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

    Bullet's meshes repel each other from a distance of 2 mm, other bodies from 1 mm, so bodies may be pushed
    apart before they touch.
    """


@dataclass(frozen=True, eq=False)
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

    An obstacle that the arm hits blocks it; the simulation continues to the end. Moving obstacles move until
    the trajectory ends; obstacles of unknown motion stand still. Raises InputError for a trajectory of other
    joints.
    """
    if trajectory.joint_names != robot.joint_names:
        raise InputError(
            f"the trajectory moves {', '.join(trajectory.joint_names)}; "
            f"{robot.name} plans {', '.join(robot.joint_names)}"
        )
    count = int(np.ceil((trajectory.duration + REST_TIME) / settings.time_step))
    times = settings.time_step * np.arange(count + 1)
    reference = trajectory.at(np.minimum(times, trajectory.duration)).positions
    with World(robot, scene, moving=moving) as world:
        positions, contacts = _simulate(world, np.minimum(times, trajectory.duration), reference, settings)
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
    contacts: dict[tuple[str, str], ReplayContact] = {}
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
        states = bullet.getJointStates(body, world.joints)
        positions[k] = [state[0] for state in states]
        # a step detects contacts at its beginning
        for link, partner, distance in world.touching():
            new = ReplayContact(link, partner, float(times[k - 1]), -distance)
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
