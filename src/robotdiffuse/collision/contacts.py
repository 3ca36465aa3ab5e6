"""All contacts of a motion, not only the first."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.convex_geometry import checks_of
from robotdiffuse.collision.exact_meshes import Distance, ExactCollision
from robotdiffuse.collision.kernels import motion_pieces
from robotdiffuse.collision.kernels.motion_pieces import Motion
from robotdiffuse.collision.motions import DEPTH_SAMPLE_TRAVEL, Contact, ContinuousCollision
from robotdiffuse.core.bounds import for_kernels
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

MAX_CONFIGURATIONS = 5000
"""Largest number of motion certificates in a search for contacts."""


def contacts(robot: Robot, scene: Scene, q: Float[ndarray, "n dof"], contact: float) -> list[Contact]:
    """All contacts along straight lines through waypoints, in order.

    A contact begins where two bodies come nearer than `contact` [m] and lasts until they separate. The motion
    certificate finds the next contact; while there is one, distances are computed every 1 cm of motion.
    """
    validator = ContinuousCollision(robot, scene, contact, 0.5)
    exact = ExactCollision(robot, scene)
    motion = Motion(for_kernels(q), motion_pieces.travel_along(q, validator.checks.motion_radii))
    end = float(motion.travel[-1])
    at = 0.0
    contacts_in_order = list[Contact]()
    for _ in range(MAX_CONFIGURATIONS):
        low = motion_pieces.segment_at(motion.travel, at)[0]
        contact_configuration = motion_pieces.configurations(motion, np.array([at]))
        rest = np.concatenate([contact_configuration, q[low + 1 :]])
        first = validator.sweep(rest).contact
        if first is None:
            break
        # converts the place in `rest`, a row plus a share, to a place on the whole motion
        row = int(first.at)
        part = first.at - int(first.at)
        travel = np.concatenate([[at], motion.travel[low + 1 :]])
        at = float(travel[row] + part * (travel[min(row + 1, len(travel) - 1)] - travel[row]))
        at = _follow(exact, motion, at, contact, first, contacts_in_order)
        if at >= end:
            break
    return contacts_in_order


def _follow(
    exact: ExactCollision, motion: Motion, at: float, contact: float, first: Contact, found: list[Contact]
) -> float:
    """Appends to `found` the contacts from the given one until the arm is free; returns the place where it is
    free."""
    checks = {(check.link, check.other): check for check in checks_of(exact.robot)}
    open_ones: dict[tuple[str, str | None, str], int] = {}
    begun = _place(motion, at)
    open_ones[first.check.link, first.check.other, first.other] = len(found)
    found.append(first._replace(at=begun))
    end = float(motion.travel[-1])
    while at < end:
        at = min(at + DEPTH_SAMPLE_TRAVEL, end)
        q = motion_pieces.configurations(motion, np.array([at]))[0]
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
    """Waypoint index plus fraction of the segment."""
    low, share = motion_pieces.segment_at(motion.travel, at)
    return low + share
