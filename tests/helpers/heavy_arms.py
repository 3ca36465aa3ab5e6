"""Robots with inertias, and motions that swing them."""

import numpy as np

import robotdiffuse as rd
from robotdiffuse.core.transforms import rotation_about, transform
from robotdiffuse.robots.bodies import inertia_of
from robotdiffuse.robots.kinematic_tree import Joint

TURNED = transform(np.array([0.1, 0.0, 0.3]), rotation_about(np.array([0.6, 0.0, 0.8]), 0.7))


def pendulum(effort: float = 10.0) -> rd.Robot:
    """A rod of 2 kg and 1 m that rotates about y and hangs down at 0."""
    y = np.array([0.0, 1.0, 0.0])
    hinge = Joint("hinge", "revolute", "base", "rod", np.eye(4), y, -3.0, 3.0, 2.0, 8.0, 80.0, effort=effort)
    rod = inertia_of([2.0, 0.0, 0.0, -0.5, 2 / 12, 0, 0, 2 / 12, 0, 0])
    return rd.Robot("pendulum", "base", "rod", (hinge,), inertias={"rod": rod})


def sliding() -> rd.Robot:
    """An arm with two revolute and two prismatic joints in turn, with axes in various directions."""
    axes = np.eye(3)[[2, 0, 1, 2]]
    joints = []
    inertias = {}
    for k, (kind, axis) in enumerate(zip(("revolute", "prismatic", "revolute", "prismatic"), axes, strict=True)):
        limits = (-1.0, 1.0, 2.0, 8.0, 80.0)
        offset = transform(np.array([0.1, 0.2, 0.1 * k]), rotation_about(axes[(k + 1) % 4], 0.5 * k))
        joints.append(Joint(f"j{k}", kind, "base" if k == 0 else f"l{k}", f"l{k + 1}", offset, axis, *limits, effort=50.0))
        inertias[f"l{k + 1}"] = inertia_of([2.0 - 0.4 * k, 0.05, -0.1, 0.1, 0.02, 0.001, 0, 0.01, 0, 0.03])
    return rd.Robot("sliding", "base", "l4", tuple(joints), inertias=inertias)


ROBOTS = {"panda": lambda: rd.load_robot("panda"), "ur5": lambda: rd.load_robot("ur5"), "sliding": sliding}


def wild(robot: rd.Robot, rng: np.random.Generator, step: float) -> rd.Trajectory:
    """Random rows. Positions differ by as much as the velocities imply; the accelerations are arbitrary."""
    v, a = rng.uniform(-1, 1, (2, 6, robot.dof)) * np.stack([robot.velocity, robot.acceleration])[:, None]
    q = rng.uniform(-1, 1, robot.dof) + np.concatenate([np.zeros((1, robot.dof)), np.cumsum((v[1:] + v[:-1]) / 2, 0)]) * step
    return rd.Trajectory(robot.joint_names, step * np.arange(6.0), q, v, a)
