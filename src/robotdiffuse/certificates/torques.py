"""Torques of a payload along a motion: the checker's own inverse dynamics, and bounds between samples.

Samples are the rows of the motion and places between them. Between two samples, positions are cubics or
straight lines, and velocities and accelerations their derivatives; at rows, accelerations may jump. A torque
leaves its chord by at most an eighth of its greatest second derivative times the square of the time between.
Torques are sums and products of vectors that rotate with the links, so the product rule bounds
that derivative by bounds on the motion of links and joints.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.certificates.cubics import cubics_of
from robotdiffuse.certificates.kinematics import Linkage
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.inertias import Inertia

GRAVITY = 9.81
"""Along -z of the world [m/s²]."""
MIN_MASS = 1e-9
"""Smaller masses are ignored [kg]."""


class Bound(NamedTuple):
    """Upper bounds of the norm of vectors, or the size of numbers, and of their first two derivatives."""

    size: ndarray
    first: ndarray
    second: ndarray

    def __add__(self, other: "Bound") -> "Bound":  # type: ignore[override]
        return Bound(*(a + b for a, b in zip(self, other, strict=True)))

    def __mul__(self, other: "Bound") -> "Bound":  # type: ignore[override]
        second = self.second * other.size + 2 * self.first * other.first + self.size * other.second
        return Bound(self.size * other.size, self.first * other.size + self.size * other.first, second)

    def scaled(self, by: float) -> "Bound":
        return Bound(*(by * part for part in self))


class States(NamedTuple):
    """The m stretches of a motion from each sample to the next: states at their starts and ends, and bounds
    [m, dof] with derivatives by time (of paths, by the share of the way)."""

    q: Float[ndarray, "2 m dof"]
    v: Float[ndarray, "2 m dof"]
    a: Float[ndarray, "2 m dof"]
    durations: Float[ndarray, "m"]
    """Of the stretches [s]; 1 for a path."""
    places: Bound
    """Of positions."""
    speeds: Bound
    """Of velocities; 0 for a path, whose configurations are at rest."""
    pulls: Bound
    """Of accelerations."""


def torque_bounds(
    problem: Problem, motion: Path | Trajectory, samples: Float[ndarray, "k"]
) -> Float[ndarray, "m dof"]:
    """Upper bounds of each joint's torque from each sample to the next [N m] or [N].

    Samples are the rows and, between them, `samples`: times, or for a path rows plus shares of the way to the
    next.
    """
    states = _states(motion, samples)
    torques = [np.abs(inverse_dynamics(problem, *end)) for end in zip(*states[:3], strict=True)]
    second_derivatives = _second_derivative_bounds(problem, states)
    return np.maximum(*torques) + second_derivatives * states.durations[:, None] ** 2 / 8


def _states(motion: Path | Trajectory, samples: Float[ndarray, "k"]) -> States:
    cubics = cubics_of(motion)
    if cubics is None:
        return _static_states(motion.positions, samples)
    at = np.sort(np.concatenate([motion.times, samples]))  # type: ignore[union-attr]
    row = cubics.rows(at[:-1])
    ends = [cubics.at(row, time - cubics.times[row]) for time in (at[:-1], at[1:])]
    q, v, a = (np.stack(both) for both in zip(*ends, strict=True))
    speed, pull = cubics.speeds, cubics.pulls
    jerk = np.abs(cubics.end - cubics.start) / cubics.steps
    far = np.abs(cubics.positions) + speed * cubics.steps
    places, speeds, pulls = (far, speed, pull), (speed, pull, jerk), (pull, jerk, 0 * jerk)
    bounds = (Bound(*(part[row] for part in of)) for of in (places, speeds, pulls))
    return States(q, v, a, np.diff(at), *bounds)


def _static_states(positions: Float[ndarray, "n dof"], samples: Float[ndarray, "k"]) -> States:
    rows = np.arange(len(positions))
    at = np.sort(np.concatenate([rows, samples]))
    q = np.column_stack([np.interp(at, rows, joint) for joint in positions.T])
    q = np.repeat(q, 2, axis=0) if len(q) == 1 else q
    step = np.abs(np.diff(q, axis=0))
    places = Bound(np.maximum(np.abs(q[1:]), np.abs(q[:-1])), step, 0 * step)
    none = Bound(0 * step, 0 * step, 0 * step)
    ends = np.stack([q[:-1], q[1:]])
    return States(ends, 0 * ends, 0 * ends, np.ones(len(step)), places, none, none)


def inverse_dynamics(
    problem: Problem, q: Float[ndarray, "n dof"], v: Float[ndarray, "n dof"], a: Float[ndarray, "n dof"]
) -> Float[ndarray, "n dof"]:
    """Torques [n, dof] by the Newton-Euler equations of each link, in the base frame [N m] or [N]."""
    robot, linkage = problem.robot, Linkage(problem.robot)
    postures, number = linkage.place(q), {joint.name: j for j, joint in enumerate(robot.planned_joints)}
    T = {link: postures.T[:, k] for k, link in enumerate(linkage.links)}
    up = np.eye(4)[2, :3] if problem.T_world_base is None else problem.T_world_base[2, :3]
    still = np.zeros((len(q), 3))
    turning = {robot.base: (still, still, still + GRAVITY * up)}
    for joint in robot.joints:
        w, dw, pull = turning[joint.parent]
        arm = T[joint.child][:, :3, 3] - T[joint.parent][:, :3, 3]
        pull = pull + np.cross(dw, arm) + np.cross(w, np.cross(w, arm))
        j = number.get(joint.name)
        if j is not None:
            along, bent = v[:, j, None] * postures.axes[:, j], a[:, j, None] * postures.axes[:, j]
            if linkage.slides[j]:
                pull = pull + bent + 2 * np.cross(w, along)
            else:
                w, dw = w + along, dw + bent + np.cross(w, along)
        turning[joint.child] = w, dw, pull
    carried = _masses(problem)
    force, moment = ({link: still for link in linkage.links} for _ in range(2))
    torques = np.empty_like(q)
    for joint in reversed(robot.joints):
        link, (w, dw, pull) = joint.child, turning[joint.child]
        for body in carried.get(link, ()):
            R = T[link][:, :3, :3]
            arm, inertia = R @ body.com, R @ body.moments @ R.transpose(0, 2, 1)
            own = body.mass * (pull + np.cross(dw, arm) + np.cross(w, np.cross(w, arm)))
            spin = np.einsum("nij,nj->ni", inertia, w)
            force[link] = force[link] + own
            turn = np.einsum("nij,nj->ni", inertia, dw) + np.cross(w, spin) + np.cross(arm, own)
            moment[link] = moment[link] + turn
        j = number.get(joint.name)
        if j is not None:
            of = force[link] if linkage.slides[j] else moment[link]
            torques[:, j] = (postures.axes[:, j] * of).sum(axis=1)
        arm = T[link][:, :3, 3] - T[joint.parent][:, :3, 3]
        force[joint.parent] = force[joint.parent] + force[link]
        moment[joint.parent] = moment[joint.parent] + moment[link] + np.cross(arm, force[link])
    return torques


def _second_derivative_bounds(problem: Problem, states: States) -> Float[ndarray, "m dof"]:
    """Upper bounds on the second derivatives of torques from each sample to the next: the same equations on
    bounds."""
    robot, linkage = problem.robot, Linkage(problem.robot)
    number = {joint.name: j for j, joint in enumerate(robot.planned_joints)}
    none = np.zeros(len(states.durations))
    still = Bound(none, none, none)
    turning = {robot.base: (still, still, still, Bound(none + GRAVITY, none, none))}
    axes, arms = dict[str, Bound](), dict[str, Bound]()
    for joint in robot.joints:
        seen, w, dw, pull = turning[joint.parent]
        held = joint.motion(robot.locked.get(joint.name, 0.0)) if joint.name not in number else np.eye(4)
        reach = float(np.linalg.norm((joint.T_parent_joint @ held)[:3, 3]))
        axis, arm = _rotating(1.0, seen), _rotating(reach, seen)
        j = number.get(joint.name)
        if j is None:
            pull = pull + dw * arm + w * (w * arm)
        else:
            place, speed, bent = (Bound(*(part[:, j] for part in of)) for of in states[4:])
            along, rate = speed * axis, Bound(place.first, place.second, none) * axis
            if linkage.slides[j]:
                arm = arm + place * axis
                pull = pull + dw * arm + w * (w * arm) + bent * axis + (w * along).scaled(2.0)
            else:
                pull = pull + dw * arm + w * (w * arm)
                seen, w, dw = seen + rate, w + along, dw + bent * axis + w * along
        turning[joint.child], axes[joint.child], arms[joint.child] = (seen, w, dw, pull), axis, arm
    carried = _masses(problem)
    force, moment = ({link: still for link in linkage.links} for _ in range(2))
    second_derivatives = np.empty((len(none), robot.dof))
    for joint in reversed(robot.joints):
        link, (seen, w, dw, pull) = joint.child, turning[joint.child]
        for body in carried.get(link, ()):
            arm, most = (
                _rotating(float(np.linalg.norm(body.com)), seen),
                float(np.linalg.eigvalsh(body.moments)[-1]),
            )
            inertia = Bound(none + most, 2 * most * seen.size, most * (2 * seen.first + 4 * seen.size**2))
            own = (pull + dw * arm + w * (w * arm)).scaled(body.mass)
            force[link] = force[link] + own
            moment[link] = moment[link] + inertia * dw + w * (inertia * w) + arm * own
        j = number.get(joint.name)
        if j is not None:
            second_derivatives[:, j] = (
                axes[link] * (force[link] if linkage.slides[j] else moment[link])
            ).second
        force[joint.parent] = force[joint.parent] + force[link]
        moment[joint.parent] = moment[joint.parent] + moment[link] + arms[link] * force[link]
    return second_derivatives


def _rotating(length: float, seen: Bound) -> Bound:
    """Bounds of a vector of constant length that rotates with a link whose rotation is bounded by `seen`."""
    return Bound(length + 0 * seen.size, length * seen.size, length * (seen.first + seen.size**2))


def _masses(problem: Problem) -> dict[str, list[Inertia]]:
    """The inertias of each link, with the payload's."""
    payload, found = problem.payload, {link: [of] for link, of in problem.robot.inertias.items()}
    assert payload is not None
    if payload.mass > MIN_MASS:
        link = payload.link or problem.robot.tip
        found.setdefault(link, []).append(Inertia(payload.mass, payload.com, np.diag(payload.moments)))
    return found
