"""Every contact of a motion, not only the first: for people who ask what all is wrong with it."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.convex_geometry import checks_of
from robotdiffuse.collision.exact_meshes import Distance, ExactCollision
from robotdiffuse.collision.kernels import motion_certificate as kernel
from robotdiffuse.collision.kernels.motion_certificate import Motion
from robotdiffuse.collision.motions import EPISODE_TRAVEL, Contact, ContinuousCollision
from robotdiffuse.core.bounds import for_kernels
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

MOST_LOOKS = 5000
"""Configurations at which contacts are followed."""


def contacts(robot: Robot, scene: Scene, q: Float[ndarray, "n dof"], contact: float) -> list[Contact]:
    """All contacts along straight lines through waypoints, in order, each from where two bodies come nearer
    than `contact` [m] until they part.

    Where nothing touches the certificate says so; while something does, all else is looked at every 1 cm of
    motion.
    """
    validator, exact = ContinuousCollision(robot, scene, contact, 0.5), ExactCollision(robot, scene)
    motion = Motion(for_kernels(q), kernel.way_along(q, validator.checks.levers))
    end, at, found = float(motion.way[-1]), 0.0, list[Contact]()
    for _ in range(MOST_LOOKS):
        low = kernel.segment_at(motion.way, at)[0]
        here = kernel.configurations(motion, np.array([at]))
        rest = np.concatenate([here, q[low + 1 :]])
        first = validator.sweep(rest).contact
        if first is None:
            break
        # places in the rest, as rows and shares, to places on the way
        row, part = int(first.at), first.at - int(first.at)
        ways = np.concatenate([[at], motion.way[low + 1 :]])
        at = float(ways[row] + part * (ways[min(row + 1, len(ways) - 1)] - ways[row]))
        at = _follow(exact, motion, at, contact, first, found)
        if at >= end:
            break
    return found


def _follow(
    exact: ExactCollision, motion: Motion, at: float, contact: float, first: Contact, found: list[Contact]
) -> float:
    """Adds the contacts from one on until the arm is free; where that is."""
    checks = {(check.link, check.other): check for check in checks_of(exact.robot)}
    open_ones: dict[tuple[str, str | None, str], int] = {}
    begun = _place(motion, at)
    open_ones[first.check.link, first.check.other, first.other] = len(found)
    found.append(first._replace(at=begun))
    end = float(motion.way[-1])
    while at < end:
        at = min(at + EPISODE_TRAVEL, end)
        q = kernel.configurations(motion, np.array([at]))[0]
        near = [d for d in (*exact.link_distances(q), *exact.pair_distances(q)) if d.distance <= contact]
        now = {_key(d, checks): d for d in near}
        for key in [key for key in open_ones if key not in now]:
            del open_ones[key]
        for key, distance in now.items():
            depth = max(0.0, -distance.distance)
            if key in open_ones:
                k = open_ones[key]
                found[k] = found[k]._replace(depth=max(found[k].depth, depth))
            else:
                open_ones[key] = len(found)
                found.append(Contact(checks[key[:2]], key[2], _place(motion, at), depth))
        if not now:
            return at
    return end


def _key(distance: Distance, checks: dict) -> tuple[str, str | None, str]:
    pair = (distance.link, distance.other)
    return (*pair, str(distance.other)) if pair in checks else (distance.link, None, str(distance.other))


def _place(motion: Motion, at: float) -> float:
    low, share = kernel.segment_at(motion.way, at)
    return low + share
