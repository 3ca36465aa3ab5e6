"""The compiled part of the motion certificate among moving obstacles; see `collision/moving_obstacles.py`.

A task is an interval of a timed motion, with the pairs of a link and an obstacle that are undecided there.
The clearance of a pair in the middle of the interval is computed from the covering spheres. The distances
that points of the link and of the obstacle can move from the middle to either end are subtracted. The pair
is settled if the result is at least the required clearance; otherwise the interval is halved. A pair is left
to the exact meshes if its clearance in the middle is at most `least` (see `settle_tasks`), or if the interval
has been halved MAX_HALVINGS times.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.frames import base_frames, point_to_solid, pose_arm, write_rotation
from robotdiffuse.collision.kernels.motion_pieces import Motion, configuration
from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.robots.frame_kernel import placed, plus, rotated_back, write

CLEARANCE_CAP = 1.0
"""Larger clearances are capped at this value [m]."""
MAX_HALVINGS = 48
"""Largest number of halvings of an interval."""


class Links(NamedTuple):
    """The moving links of a robot and the spheres that cover them."""

    offsets: np.ndarray
    """[dof, 4, 4] `Robot.frame_offsets`"""
    parents: np.ndarray | None
    """[dof] `Robot.parents`; None for a chain."""
    slides: np.ndarray
    """[dof] whether the joint is prismatic."""
    frame: np.ndarray
    """[links] index of the frame that each link is fixed to."""
    bounds: np.ndarray
    """[links, 4] a ball around all spheres of the link, in its frame."""
    first: np.ndarray
    """[links + 1] first sphere of each link."""
    spheres: np.ndarray
    """[n, 4] x y z radius in the frame of the link."""
    motion_radii: np.ndarray
    """[links, dof] bound on the motion of any point of the link per unit of joint motion."""


class Tracks(NamedTuple):
    """Moving obstacles, each the Minkowski sum of a box, a disc about its z axis and a ball, as in
    `convex_bounds.Solids`."""

    first: np.ndarray
    """[obstacles + 1] index of the first pose of each obstacle."""
    times: np.ndarray
    """[k] times of the poses [s]."""
    xyz: np.ndarray
    """[k, 3] origins of the obstacle's frame in the base frame at these times [m]."""
    wxyz: np.ndarray
    """[k, 4] orientations at these times, as quaternions. The dot product of each quaternion with the one
    before is not negative."""
    speeds: np.ndarray
    """[k] bound on the speed of the obstacle's points until the next pose [m/s]; 0 at its last pose."""
    growth: np.ndarray
    """[obstacles] inflation per second since time 0 [m/s], for obstacles with a known maximum speed."""
    center: np.ndarray
    """[obstacles, 3] center of the box in the obstacle's frame."""
    half: np.ndarray
    """[obstacles, 3] half edges of the box."""
    disc: np.ndarray
    """[obstacles] radius of the disc."""
    rounding: np.ndarray
    """[obstacles] radius of the ball."""


class Tasks(NamedTuple):
    """Intervals of a timed motion with their undecided pairs."""

    start: np.ndarray
    """[n] start of each interval [s]."""
    stop: np.ndarray
    """[n] end of each interval [s]."""
    pairs: np.ndarray
    """[n, links, obstacles] whether the pair is undecided."""


@inner_kernel()
def pose_at(tracks, o, time, rotation, box_center):
    """Writes the pose of obstacle o at a time [s]: R_obstacle_base [3, 3] and the center of its box [3].
    Positions of its frame are interpolated linearly, orientations by slerp."""
    low = tracks.first[o]
    high = tracks.first[o + 1] - 1
    share = 0.0
    if time >= tracks.times[high]:
        low = high
    elif time > tracks.times[low]:
        low += np.searchsorted(tracks.times[low : high + 1], time, side="right") - 1
        share = (time - tracks.times[low]) / (tracks.times[low + 1] - tracks.times[low])
    high = min(low + 1, high)
    wxyz = tracks.wxyz
    dot = 0.0
    for k in range(3):
        box_center[k] = tracks.xyz[low, k] + share * (tracks.xyz[high, k] - tracks.xyz[low, k])
    for k in range(4):
        dot += wxyz[low, k] * wxyz[high, k]
    angle = np.arccos(min(max(dot, -1.0), 1.0))
    a = 1.0 - share
    b = share
    if angle > 1e-7:
        a = np.sin((1.0 - share) * angle) / np.sin(angle)
        b = np.sin(share * angle) / np.sin(angle)
    w = a * wxyz[low, 0] + b * wxyz[high, 0]
    x = a * wxyz[low, 1] + b * wxyz[high, 1]
    y = a * wxyz[low, 2] + b * wxyz[high, 2]
    z = a * wxyz[low, 3] + b * wxyz[high, 3]
    scale = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
    write_rotation(w * scale, -x * scale, -y * scale, -z * scale, rotation)
    write(plus(rotated_back(rotation, tracks.center[o]), box_center), box_center)


@inner_kernel()
def speed_between(tracks, o, start, stop):
    """Upper bound on the speed of any point of obstacle o between two times [m/s], without its growth."""
    max_speed = 0.0
    for k in range(tracks.first[o], tracks.first[o + 1] - 1):
        if tracks.times[k] < stop and tracks.times[k + 1] > start:
            max_speed = max(max_speed, tracks.speeds[k])
    return max_speed


@inner_kernel()
def _ball_clearance(T, ball, tracks, o, rotation, box_center):
    """Signed distance of a ball of a link to obstacle o, without the obstacle's growth [m]; inside, a lower
    bound."""
    gap = point_to_solid(placed(T, ball), rotation, box_center, tracks.half[o], tracks.disc[o])
    return gap - tracks.rounding[o] - ball[3]


@inner_kernel()
def _clearance(links, frames, link, tracks, o, rotation, box_center, enough):
    """Clearance of the spheres of a link to obstacle o [m]. If it exceeds `enough`, the result may be a lower
    bound that also exceeds `enough`."""
    T = frames[links.frame[link]]
    clearance = _ball_clearance(T, links.bounds[link], tracks, o, rotation, box_center)
    if clearance > enough:
        return clearance
    clearance = np.inf
    for s in range(links.first[link], links.first[link + 1]):
        clearance = min(clearance, _ball_clearance(T, links.spheres[s], tracks, o, rotation, box_center))
    return clearance


@inner_kernel()
def cumulative_motion(q):
    """Total motion of each joint from the first row to each row [n, dof]; motion in both directions adds
    up."""
    travel = np.zeros_like(q)
    for i in range(1, len(q)):
        for j in range(q.shape[1]):
            travel[i, j] = travel[i - 1, j] + abs(q[i, j] - q[i - 1, j])
    return travel


@kernel(nogil=True)
def settle_tasks(links, tracks, times, q, tasks, least, tightness, best):
    """Settles the tasks, in order, as far as the covering spheres can.

    The motion is on straight lines between the rows q[n, dof] at times[n], at rest before and after. A pair
    is settled if its bound is at least `least` [m] and at least the fraction `tightness` of the smallest
    clearance measured so far. This smallest clearance is best[0], which this function updates.

    Returns:
        The smallest bound that settled a pair, at most CLEARANCE_CAP [m]. The tasks that are left to the
        exact meshes, one pair each, as (start, stop, link, obstacle, loss): `loss` bounds how much clearance
        is lost from the middle of the interval to either end [m]. In the middle, the link's spheres are at
        most `least` from the obstacle, or the interval was halved MAX_HALVINGS times.
    """
    dof = q.shape[1]
    count = len(links.frame)
    obstacles = len(tracks.growth)
    # the motion and the travel of its joints, both over time
    motion = Motion(q, times)
    joint_travel = Motion(cumulative_motion(q), times)
    frames = base_frames(dof)
    middle = np.empty(dof)
    travel_at_start = np.empty(dof)
    travel_in_middle = np.empty(dof)
    travel_at_stop = np.empty(dof)
    rotation = np.empty((3, 3))
    box_center = np.empty(3)
    travel = np.empty(count)
    starts = np.empty(MAX_HALVINGS + 2)
    stops = np.empty(MAX_HALVINGS + 2)
    depths = np.empty(MAX_HALVINGS + 2, np.int64)
    pairs = np.empty((MAX_HALVINGS + 2, count, obstacles), np.bool_)
    remaining = [(0.0, 0.0, 0, 0, 0.0) for _ in range(0)]  # empty; tells Numba the type of the entries
    certified = CLEARANCE_CAP
    for task in range(len(tasks.start)):
        starts[0] = tasks.start[task]
        stops[0] = tasks.stop[task]
        depths[0] = 0
        size = 1
        pairs[0] = tasks.pairs[task]
        while size > 0:
            size -= 1
            start = starts[size]
            stop = stops[size]
            depth = depths[size]
            time = 0.5 * (start + stop)
            half_duration = 0.5 * (stop - start)
            configuration(motion, time, middle)
            configuration(joint_travel, start, travel_at_start)
            configuration(joint_travel, time, travel_in_middle)
            configuration(joint_travel, stop, travel_at_stop)
            pose_arm(links.offsets, links.parents, links.slides, middle, frames)
            # largest motion of each link from the middle to either end
            travel[:] = 0.0
            for j in range(dof):
                before = travel_in_middle[j] - travel_at_start[j]
                joint_motion = max(before, travel_at_stop[j] - travel_in_middle[j])
                for link in range(count):
                    travel[link] += links.motion_radii[link, j] * joint_motion
            split_needed = False
            for o in range(obstacles):
                is_posed = False
                obstacle_travel = 0.0
                for link in range(count):
                    if not pairs[size, link, o]:
                        continue
                    if not is_posed:
                        pose_at(tracks, o, time, rotation, box_center)
                        obstacle_travel = speed_between(tracks, o, start, stop) * half_duration
                        is_posed = True
                    inflation = tracks.growth[o] * max(time, 0.0)
                    clearance_loss = travel[link] + obstacle_travel + tracks.growth[o] * half_duration
                    required = max(least, tightness * best[0])
                    # above cutoff, a lower bound is enough: it settles the pair without changing best[0],
                    # unless tightness is 0
                    cutoff = inflation + clearance_loss + max(required, best[0] if tightness > 0 else 0.0)
                    clearance = (
                        _clearance(links, frames, link, tracks, o, rotation, box_center, cutoff) - inflation
                    )
                    clearance = min(clearance, CLEARANCE_CAP + clearance_loss)
                    if clearance <= least or depth == MAX_HALVINGS:
                        remaining.append((start, stop, link, o, clearance_loss))
                        pairs[size, link, o] = False
                        continue
                    best[0] = min(best[0], clearance)
                    if clearance - clearance_loss >= max(least, tightness * best[0]):
                        certified = min(certified, clearance - clearance_loss)
                        pairs[size, link, o] = False
                    else:
                        split_needed = True
            # the first half is put on top of the stack, so that intervals are processed in order
            if split_needed:
                pairs[size + 1] = pairs[size]
                starts[size + 1] = start
                stops[size + 1] = time
                starts[size] = time
                stops[size] = stop
                depths[size] = depths[size + 1] = depth + 1
                size += 2
    return certified, remaining


@kernel(nogil=True)
def free_at_times(links, tracks, q, times, least):
    """For each configuration of q[n, dof] and each of the increasing times[k], whether the covering spheres
    keep `least` [m] from all obstacles: bool[n, k]."""
    dof = q.shape[1]
    count = len(links.frame)
    obstacles = len(tracks.growth)
    frames = base_frames(dof)
    out = np.ones((len(q), len(times)), np.bool_)
    rotations = np.empty((obstacles, len(times), 3, 3))
    centers = np.empty((obstacles, len(times), 3))
    speeds = np.empty(obstacles)
    for o in range(obstacles):
        speeds[o] = speed_between(tracks, o, times[0], times[-1]) + tracks.growth[o]
        for k in range(len(times)):
            pose_at(tracks, o, times[k], rotations[o, k], centers[o, k])
    for i in range(len(q)):
        pose_arm(links.offsets, links.parents, links.slides, q[i], frames)
        for link in range(count):
            for o in range(obstacles):
                k = 0
                while k < len(times):
                    if not out[i, k]:
                        k += 1
                        continue
                    required = least + tracks.growth[o] * max(times[k], 0.0)
                    spare = (
                        _clearance(links, frames, link, tracks, o, rotations[o, k], centers[o, k], required)
                        - required
                    )
                    out[i, k] = spare >= 0
                    until = times[k] + max(spare, 0.0) / max(speeds[o], 1e-9)
                    k += 1  # the obstacle cannot be too near before it has covered the spare distance
                    while k < len(times) and times[k] < until:
                        k += 1
    return out
