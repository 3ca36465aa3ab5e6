"""Joint torques by Pinocchio's inverse dynamics, from the inertias in `inertias.py`."""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, distinct
from robotdiffuse.robots.inertias import Inertia, Payload
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.torque_bounds import Body, Stretches, second_derivative_bounds

GRAVITY = 9.81
"""Gravitational acceleration along -z of the world [m/s²]."""
MIN_MASS = 1e-9
"""Payloads up to this mass are ignored [kg]."""


class Dynamics:
    """Inverse dynamics of a robot with a payload, without joint friction and motor inertia."""

    def __init__(self, robot: Robot, payload: Payload, T_world_base: ndarray | None = None) -> None:
        """Build the model; the base is upright unless T_world_base is given.

        Raises InputError for a robot without inertias or effort limits, for an unknown link, and if Pinocchio
        is not installed.
        """
        try:
            import pinocchio as installed
        except ImportError:
            raise InputError(
                "payload needs Pinocchio, which is not installed: pip install robotdiffuse[dynamics]"
            ) from None
        pinocchio: Any = installed  # compiled, without types
        check_dynamics(robot)
        link = payload.link or robot.tip
        self.robot = robot
        self.limits = robot.effort
        self._rnea, model = pinocchio.rnea, pinocchio.Model()
        for j, T in enumerate(robot.frame_offsets):
            kind = pinocchio.JointModelPZ() if robot.prismatic[j] else pinocchio.JointModelRZ()
            parent = int(robot.parents[j])
            model.addJoint(parent, kind, pinocchio.SE3(T[:3, :3], T[:3, 3]), robot.joint_names[j])
        moments = np.diag(payload.moments)
        carried = [(link, Inertia(payload.mass, payload.com, moments))] if payload.mass > MIN_MASS else []
        for name, inertia in (*robot.inertias.items(), *carried):
            T = robot.T_frame_link(name)
            frame = robot.link_frame(name)
            body = pinocchio.Inertia(inertia.mass, inertia.com, inertia.moments)
            model.appendBodyToJoint(frame, body, pinocchio.SE3(T[:3, :3], T[:3, 3]))
        up = np.array([0.0, 0.0, 1.0]) if T_world_base is None else T_world_base[2, :3]
        model.gravity.linear = -GRAVITY * up
        self._model, self._data = model, model.createData()
        inner = model.inertias.tolist()[1:]
        self._bodies = [
            Body(
                int(robot.parents[j]) - 1,
                bool(robot.prismatic[j]),
                float(np.linalg.norm(T[:3, 3])),
                float(inner[j].mass),
                float(np.linalg.norm(inner[j].lever)),
                float(np.linalg.eigvalsh(inner[j].inertia)[-1]),
            )
            for j, T in enumerate(robot.frame_offsets)
        ]

    def torques(
        self, q: Float[ndarray, "n dof"], v: Float[ndarray, "n dof"], a: Float[ndarray, "n dof"]
    ) -> Float[ndarray, "n dof"]:
        """Joint torques at configurations with velocities and accelerations, row by row [N m] or [N]."""
        out = np.empty(q.shape)
        for i in range(len(q)):
            out[i] = self._rnea(self._model, self._data, q[i], v[i], a[i])
        return out

    def second_derivatives(self, along: Stretches) -> Float[ndarray, "n dof"]:
        """Bounds on the second derivatives of torques along stretches, by the parameter of the stretches."""
        return second_derivative_bounds(self._bodies, GRAVITY, along)

    def holding_torques(self, q: Float[ndarray, "n dof"]) -> Float[ndarray, "n dof"]:
        """Torques at rest [N m] or [N]."""
        still = np.zeros_like(q)
        return self.torques(q, still, still)

    def overload_message(self, q: Float[ndarray, "dof"]) -> str | None:
        """A message about the joint whose torque at rest exceeds its limit most; None if none does."""
        torques = np.abs(self.holding_torques(q[None])[0])
        j = int((torques / self.limits).argmax())
        return None if torques[j] <= self.limits[j] else self.torque_message(j, torques[j])

    def torque_message(self, j: int, torque: float) -> str:
        """A message about a torque above its limit."""
        unit = "N" if self.robot.prismatic[j] else "N m"
        needed, limit = distinct(torque, self.limits[j], digits=3)
        return f"{self.robot.joint_names[j]} needs {needed} {unit}, its effort limit is {limit} {unit}"


def check_dynamics(robot: Robot) -> None:
    """Raise InputError for a robot whose URDF gives no inertias or effort limits."""
    heavy = {robot.link_frame(link) for link in robot.inertias}
    for j, name in enumerate(robot.joint_names):
        lacks = "inertia of what moves with" if j + 1 not in heavy else "effort limit of"
        if not robot.effort[j] > 0 or j + 1 not in heavy:
            raise InputError(
                f"payload: {robot.name} has no {lacks} joint {name}; its URDF must give inertias and "
                f"effort limits; then create the robot again with: robotdiffuse robot add"
            )
