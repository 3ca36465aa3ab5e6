"""Fingerprints of robots, so that data made with one robot is not used with another."""

import hashlib
import json

import numpy as np

from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.robot_folder import LIMITS

DIGITS = 9
"""Numbers are rounded to this many decimals, since rotations from quaternions differ by machine in the last
bits."""


def robot_fingerprint(robot: Robot) -> str:
    """The first 16 hexadecimal digits of a SHA-256, the same in every process.

    It covers joints, limits, spheres, meshes, locked joints and allowed collisions, but not the robot's name.
    """
    digest = hashlib.sha256()

    def add(names: object, *numbers: object) -> None:
        digest.update(json.dumps(names).encode())
        for values in numbers:
            rounded = np.round(np.asarray(values, np.float64), DIGITS) + 0.0  # no negative zeros
            digest.update(str(rounded.shape).encode() + rounded.tobytes())

    add([robot.base, *robot.tips])
    for joint in robot.joints:
        limits = [getattr(joint, name) for name in LIMITS]
        add([joint.name, joint.kind, joint.parent, joint.child], joint.T_parent_joint, joint.axis, limits)
        if joint.mimic is not None:
            add(joint.mimic.joint, joint.mimic[1:])
    for link in sorted(robot.spheres):
        add(link, robot.spheres[link])
    for link in sorted(robot.meshes):
        for mesh in robot.meshes[link]:
            add(link, mesh.vertices, mesh.faces)
    for name in sorted(robot.locked):
        add(name, robot.locked[name])
    add(sorted(sorted(pair) for pair in robot.allowed_collisions))
    return digest.hexdigest()[:16]
