"""All contacts of a motion, not only the first."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.collision.kernels import motion_pieces
from robotdiffuse.collision.kernels.motion_pieces import Motion
from robotdiffuse.collision.motions import DEPTH_SAMPLE_TRAVEL, Contact, ContinuousCollision
from robotdiffuse.core.bounds import for_kernels
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

MAX_SWEEPS = 5000
"""Largest number of times that `contacts` checks the remaining motion for the next contact."""


def contacts(robot: Robot, scene: Scene, q: Float[ndarray, "n dof"], contact: float) -> list[Contact]:
    """All contacts along straight lines through waypoints, in order.

    A contact begins where two bodies come nearer than `contact` [m] and lasts until they separate. The motion
    certificate stops at the first place that it cannot prove free: the next contact. From there, exact
    distances are computed every 1 cm of motion until no bodies are in contact.
    """
    validator = ContinuousCollision(robot, scene, contact, 0.5)
    exact = ExactCollision(robot, scene)
    motion = Motion(for_kernels(q), motion_pieces.travel_along(q, validator.checks.motion_radii))
    end = float(motion.travel[-1])
    at = 0.0
    contacts_in_order = list[Contact]()
    for _ in range(MAX_SWEEPS):
        low = motion_pieces.segment_at(motion.travel, at)[0]
        contact_configuration = motion_pieces.configurations(motion, np.array([at]))
        remaining_q = np.concatenate([contact_configuration, q[low + 1 :]])
        first = validator.sweep(remaining_q).contact
        if first is None:
            break
        # converts the contact's place in `remaining_q`, a row plus a fraction, to the travel along the whole
        # motion
        travel = np.concatenate([[at], motion.travel[low + 1 :]])
        at = float(np.interp(first.at, np.arange(len(travel)), travel))
        at = _follow(exact, motion, at, contact, first, contacts_in_order)
        if at >= end:
            break
    return contacts_in_order


def _follow(
    exact: ExactCollision,
    motion: Motion,
    at: float,
    contact: float,
    first: Contact,
    contact_list: list[Contact],
) -> float:
    """Appends to `contact_list` the contact `first` at travel `at`, and the contacts that begin before the
    arm is free again. Returns the travel at which the arm is free, or the end of the motion."""
    open_contacts = {(first.check, first.other): len(contact_list)}
    contact_list.append(first._replace(at=_place(motion, at)))
    count = len(exact.checks)
    end = float(motion.travel[-1])
    while at < end:
        at = min(at + DEPTH_SAMPLE_TRAVEL, end)
        q = motion_pieces.configurations(motion, np.full(count, at))
        distances, names = exact.nearest(q, np.arange(count), np.full(count, np.inf))
        touching = {(exact.checks[i], str(names[i])): i for i in np.flatnonzero(distances <= contact)}
        open_contacts = {key: k for key, k in open_contacts.items() if key in touching}
        for key, i in touching.items():
            depth = max(0.0, -float(distances[i]))
            if key in open_contacts:
                k = open_contacts[key]
                contact_list[k] = contact_list[k]._replace(depth=max(contact_list[k].depth, depth))
            else:
                open_contacts[key] = len(contact_list)
                contact_list.append(Contact(*key, _place(motion, at), depth))
        if not touching:
            return at
    return end


def _place(motion: Motion, at: float) -> float:
    """The waypoint index plus the fraction of the segment at travel `at`."""
    low, share = motion_pieces.segment_at(motion.travel, at)
    return low + share
