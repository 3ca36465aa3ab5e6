"""Joint torques by Pinocchio's inverse dynamics, and bounds on their second derivatives along a motion. The
bounds show that torque limits hold between samples.

Between two samples, a torque deviates from linear interpolation by at most an eighth of its largest second
derivative times the square of the interval. To bound this derivative, the Newton-Euler recursion is run on
bounds: inverse dynamics consists of sums and products of vectors, and each vector is replaced by upper bounds
on its length and on the lengths of its first two derivatives. A vector that is fixed in a body rotates with
the body and keeps its length.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, distinct, needs
from robotdiffuse.core.types import Configuration, Configurations
from robotdiffuse.robots.bodies import Inertia, Payload
from robotdiffuse.robots.robot import Robot

Jet = Float[ndarray, "3 n"]
"""Upper bounds on the length of a vector (or the absolute value of a number) and of its first two
derivatives, on n stretches of a motion."""


class Stretches(NamedTuple):
    """Bounds for n stretches (intervals) of a motion, on each of which the motion is smooth. Derivatives are
    by the fraction of the stretch that has passed, from 0 to 1; velocities and accelerations are by time."""

    q: Configurations
    """Largest absolute values of the joint positions [rad] or [m]."""
    v: Float[ndarray, "3 n dof"]
    """Largest absolute values of the first three derivatives of the joint positions, by the fraction of the
    stretch."""
    speed: Float[ndarray, "3 n dof"]
    """Largest absolute values of the joint velocities and of the velocities' first two derivatives. For a
    path without times they are zero."""
    acceleration: Float[ndarray, "3 n dof"]
    """Largest absolute values of the joint accelerations and of the accelerations' first two derivatives;
    zero for a path without times."""


class Body(NamedTuple):
    """The body that moves with a joint, in the joint's frame."""

    offset: float
    """Distance between the origins of the joint's frame and of the parent's frame, with a prismatic joint at
    zero [m]."""
    mass: float
    """Mass of all links that are fixed to the frame [kg]."""
    lever: float
    """Distance of the center of mass from the frame's origin [m]."""
    inertia: float
    """Largest principal moment of inertia about the center of mass [kg m²]."""


def product(a: Jet, b: Jet) -> Jet:
    """Bounds for a product of two vectors or numbers, such as a cross product, by the product rule. The
    length of the product must be at most the product of the lengths."""
    return np.stack([a[0] * b[0], a[1] * b[0] + a[0] * b[1], a[2] * b[0] + 2 * a[1] * b[1] + a[0] * b[2]])


def _fixed(length: float, turn: Jet) -> Jet:
    """Bounds for a vector of constant length that is fixed in a body with the rate of rotation `turn`."""
    return length * np.stack([np.ones_like(turn[0]), turn[0], turn[1] + turn[0] ** 2])


GRAVITY = 9.81
"""Gravitational acceleration along -z of the world [m/s²]."""
MIN_MASS = 1e-9
"""Payloads up to this mass are ignored [kg]."""


class Dynamics:
    """Inverse dynamics of a robot with a payload, without joint friction and motor inertia."""

    def __init__(self, robot: Robot, payload: Payload, T_world_base: ndarray | None = None) -> None:
        """Build the model. Without T_world_base, the z axis of the base points up.

        Raises InputError for a robot without inertias or effort limits, for an unknown link, and if Pinocchio
        is not installed.
        """
        with needs("Pinocchio (for the payload)", "dynamics"):
            import pinocchio as installed
        pinocchio: Any = installed  # compiled, without types
        check_dynamics(robot)
        self.robot = robot
        self.limits = robot.effort
        self._rnea, model = pinocchio.rnea, pinocchio.Model()
        for j, T in enumerate(robot.frame_offsets):
            kind = pinocchio.JointModelPZ() if robot.prismatic[j] else pinocchio.JointModelRZ()
            parent = int(robot.parents[j])
            model.addJoint(parent, kind, pinocchio.SE3(T[:3, :3], T[:3, 3]), robot.joint_names[j])
        load = Inertia(payload.mass, payload.com, np.diag(payload.moments))
        carried = [(payload.link or robot.tip, load)] if payload.mass > MIN_MASS else []
        for name, inertia in (*robot.inertias.items(), *carried):
            T = robot.T_frame_link(name)
            frame = robot.link_frame(name)
            body = pinocchio.Inertia(inertia.mass, inertia.com, inertia.moments)
            model.appendBodyToJoint(frame, body, pinocchio.SE3(T[:3, :3], T[:3, 3]))
        T_world_base = np.eye(4) if T_world_base is None else T_world_base
        model.gravity.linear = -GRAVITY * T_world_base[2, :3]
        self._model, self._data = model, model.createData()
        self._bodies = [
            Body(
                float(np.linalg.norm(T[:3, 3])),
                float(inertia.mass),
                float(np.linalg.norm(inertia.lever)),
                float(np.linalg.eigvalsh(inertia.inertia)[-1]),
            )
            for T, inertia in zip(robot.frame_offsets, model.inertias.tolist()[1:], strict=True)
        ]

    def torques(self, q: Configurations, v: Configurations, a: Configurations) -> Configurations:
        """Joint torques at configurations with velocities and accelerations, row by row [N m] or [N]."""
        out = np.empty(q.shape)
        for i in range(len(q)):
            out[i] = self._rnea(self._model, self._data, q[i], v[i], a[i])
        return out

    def second_derivatives(self, along: Stretches) -> Configurations:
        """Bounds on the second derivatives of torques with respect to the fraction of the stretch, for each
        stretch and joint."""
        parents = self.robot.parents
        slides = self.robot.prismatic
        still = np.zeros((3, len(along.q)))
        weight = still.copy()
        weight[0] = GRAVITY
        # From the base to the tips, for each frame: its rate of rotation (by the fraction of the stretch),
        # its angular velocity omega and angular acceleration alpha (by time), and the acceleration of its
        # origin. The base accelerates upwards in place of gravity.
        frames = [(still, still, still, weight)]
        axes = list[Jet]()
        arms = list[Jet]()
        for j, body in enumerate(self._bodies):
            rotation, omega, alpha, linear = frames[parents[j]]
            axis = _fixed(1.0, rotation)
            arm = _fixed(body.offset, rotation)
            v = along.v[:, :, j]
            speed = along.speed[:, :, j]
            joint_acceleration = along.acceleration[:, :, j]
            along_axis = product(speed, axis)
            if slides[j]:
                arm = arm + product(np.stack([along.q[:, j], v[0], v[1]]), axis)
            linear = linear + product(alpha, arm) + product(omega, product(omega, arm))
            if slides[j]:
                linear = linear + product(joint_acceleration, axis) + 2 * product(omega, along_axis)
            else:
                alpha = alpha + product(joint_acceleration, axis) + product(omega, along_axis)
                omega = omega + along_axis
                rotation = rotation + product(v, axis)
            frames.append((rotation, omega, alpha, linear))
            axes.append(axis)
            arms.append(arm)
        # from the tips to the base: the force and moment that move each body and all bodies after it, and
        # their components along the joints; `forces` and `moments` sum those of the bodies after a frame
        forces = [still] * len(frames)
        moments = [still] * len(frames)
        bounds = np.empty(along.q.shape)
        for j in reversed(range(len(axes))):
            body, parent, (rotation, omega, alpha, linear) = self._bodies[j], parents[j], frames[j + 1]
            lever = _fixed(body.lever, rotation)
            body_force = body.mass * (linear + product(alpha, lever) + product(omega, product(omega, lever)))
            # bounds on R I R^T and its first two derivatives; R occurs twice, hence the factors 2 and 4
            inertia = body.inertia * np.stack(
                [np.ones_like(rotation[0]), 2 * rotation[0], 2 * rotation[1] + 4 * rotation[0] ** 2]
            )
            body_moment = (
                product(inertia, alpha) + product(omega, product(inertia, omega)) + product(lever, body_force)
            )
            force = forces[j + 1] + body_force
            moment = moments[j + 1] + body_moment
            bounds[:, j] = product(axes[j], force if slides[j] else moment)[2]
            forces[parent] = forces[parent] + force
            moments[parent] = moments[parent] + moment + product(arms[j], force)
        return bounds

    def holding_torques(self, q: Configurations) -> Configurations:
        """Torques at rest [N m] or [N]."""
        still = np.zeros_like(q)
        return self.torques(q, still, still)

    def overload_message(self, q: Configuration) -> str | None:
        """A message about the joint with the largest torque at rest relative to its limit; None if all
        torques are within their limits."""
        torques = np.abs(self.holding_torques(q[None])[0])
        j = int((torques / self.limits).argmax())
        return None if torques[j] <= self.limits[j] else self.torque_message(j, torques[j])

    def torque_message(self, j: int, torque: float) -> str:
        """A message about a torque above its limit."""
        unit = "N" if self.robot.prismatic[j] else "N m"
        needed, limit = distinct(torque, self.limits[j], digits=3)
        return f"{self.robot.joint_names[j]} needs {needed} {unit}, its effort limit is {limit} {unit}"


def check_dynamics(robot: Robot) -> None:
    """Raise InputError if a planned joint of the robot has no effort limit, or if links with geometry are
    fixed to its frame, but none with an inertia. Frames without geometry, as in a mobile base, need no
    inertia."""
    solid, heavy = ({robot.link_frame(link) for link in links} for links in (robot.meshes, robot.inertias))
    for j, name in enumerate(robot.joint_names):
        weightless = j + 1 in solid - heavy
        missing = "link with an inertia" if weightless else "effort limit"
        if weightless or not robot.effort[j] > 0:
            raise InputError(
                f"payload: joint {name} of {robot.name} has no {missing}; its URDF must give inertias and "
                f"effort limits; then create the robot again with: robotdiffuse robot add"
            )
