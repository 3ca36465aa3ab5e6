"""Compiled local search for a faster motion near a path: random changes of its waypoints and corners.

The time of a candidate is that of the fastest motion along its rounded polyline, without limits of jerk.
"""

import numpy as np

from robotdiffuse.collision.kernels.compiled import random
from robotdiffuse.collision.kernels.lane_collision import make_workspace
from robotdiffuse.collision.kernels.motions import motion_free
from robotdiffuse.collision.kernels.simd import W
from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.trajectories.timing_kernel import estimated_time, evaluate_at, rounded_line

REMOVE_SHARE, ADD_SHARE, WIDEN_SHARE = 0.02, 0.05, 0.12
"""Of all attempts, the part up to REMOVE_SHARE removes a waypoint unless it is the only one, that up to
ADD_SHARE adds one in the middle of a segment and moves it, and that up to WIDEN_SHARE changes a corner's
deviation. All others move a waypoint, and half of them change its deviation too."""
WIDENING, MAX_DEVIATION = 1.5, 1.0
"""Factor by which the deviation of a corner changes, and the most it may reach [rad, joint-space L2]."""
MAX_MOVE, MOVE_LOG_RANGE = 0.4, 5.0
"""Longest move of a waypoint in each joint [rad], and the natural logarithm of its ratio to the shortest."""
REPEAT_FACTOR = 2.0
"""Length of the move that follows a successful one, in its direction."""
MIN_DEVIATION = 0.002
"""Corners are rounded with at least this deviation [rad]; the timing may round them less."""
MIN_SEGMENT = 0.005
"""Shortest segment [rad]."""
MAX_CHORD, MAX_CHORDS = 0.05, 16
"""A rounded corner is checked along chords of this length [rad], of which there are at most MAX_CHORDS."""


@kernel(nogil=True)
def reduce_time(space, path, deviations, time, velocity, acceleration, longest, tries, state):
    """A faster rounded polyline: its waypoints [m, dof], its deviations [m - 2] and its estimated time [s].

    path: waypoints [n, dof], n >= 3, whose polyline is free, as are its rounded corners; time: its estimated
    time; longest: bound on its length [rad, joint-space L2]. After a move that made it faster, the same
    waypoint moves on in the same direction.
    """
    dof = path.shape[1]
    work, block = make_workspace(space.robot, space.scene), np.empty((dof, W), np.float32)
    a, b = np.empty(dof, np.float32), np.empty(dof, np.float32)
    step, moved = np.zeros(dof), np.int64(0)  # a literal 0 would be compiled separately
    for _ in range(tries):
        new, wider, first, last = _candidate(space, path, deviations, step, moved, state)
        moved = 0
        if len(new) == 0:
            continue
        line = rounded_line(new, wider)
        if line[1][-1] > longest:
            continue
        new_time = estimated_time(line, velocity, acceleration)
        if new_time < time and _is_free(space, line, first, last, a, b, block, work):
            if len(new) == len(path):
                step[:] = new[last] - path[last]
                moved = last if np.abs(step).max() > 0 else 0
            path, deviations, time = new, wider, new_time
    return path, deviations, time


@inner_kernel(inline="always")
def _candidate(space, path, deviations, step, again, state):
    """A change of the path or of its corners, and the first and the last segment that it touches; no
    waypoints if one of these is too short. Waypoint `again`, unless it is 0, moves on by `step`."""
    n, dof = path.shape
    kind = np.float32(1.0) if again else random(state)
    i = again if again else 1 + min(int(random(state) * (n - 2)), n - 3)
    if kind < REMOVE_SHARE and n > 3:
        new, wider = np.empty((n - 1, dof)), np.empty(n - 3)
        new[:i], new[i:] = path[:i], path[i + 1 :]
        wider[: i - 1], wider[i - 1 :] = deviations[: i - 1], deviations[i:]
        return new, wider, i - 1, i - 1
    if kind < ADD_SHARE:
        i = 1 + min(int(random(state) * (n - 1)), n - 2)
        new, wider = np.empty((n + 1, dof)), np.empty(n - 1)
        new[:i], new[i + 1 :] = path[:i], path[i:]
        new[i] = 0.5 * (path[i - 1] + path[i])
        wider[: i - 1], wider[i:] = deviations[: i - 1], deviations[i - 1 :]
        wider[i - 1] = deviations[min(i - 1, n - 3)]
    else:
        new, wider = path.copy(), deviations.copy()
    if again:
        new[i] += REPEAT_FACTOR * step
    elif kind < ADD_SHARE or kind >= WIDEN_SHARE:
        size, share = MAX_MOVE * np.exp(-MOVE_LOG_RANGE * random(state)), random(state)
        for j in range(dof):
            if random(state) < share:
                new[i, j] += size * (2.0 * random(state) - 1.0)
    for j in range(dof):
        new[i, j] = min(max(new[i, j], space.lower[j]), space.upper[j])
    if not again and kind >= ADD_SHARE and (kind < WIDEN_SHARE or random(state) < 0.5):
        change = WIDENING if random(state) < 0.75 else 1.0 / WIDENING
        wider[i - 1] = min(change * wider[i - 1], MAX_DEVIATION)
    for k in range(i - 1, i + 1):
        if ((new[k + 1] - new[k]) ** 2).sum() < MIN_SEGMENT**2:
            return np.empty((0, dof)), wider, 0, 0
    return new, wider, i - 1, i


@inner_kernel(inline="always")
def _is_free(space, line, first, last, a, b, block, work):
    """Whether segments `first` to `last` of the polyline are free, and the rounded corners at their ends and
    next to them."""
    waypoints, widths = line[0], line[3]
    for i in range(first, last + 1):
        a[:], b[:] = waypoints[i], waypoints[i + 1]
        if not motion_free(space, a, b, block, work):
            return False
    for corner in range(max(first - 2, 0), min(last + 2, len(widths))):
        if not _corner_is_free(space, line, corner, a, b, block, work):
            return False
    return True


@inner_kernel()
def _corner_is_free(space, line, corner, a, b, block, work):
    waypoints, knots, directions, widths = line
    width = widths[corner]
    chords = min(max(int(np.ceil(2 * width / MAX_CHORD)), 2), MAX_CHORDS)
    for k in range(chords + 1):
        s = knots[corner + 1] + width * (2 * k / chords - 1)
        evaluate_at(waypoints, knots, directions, widths, s, 0, b)
        if k > 0 and not motion_free(space, a, b, block, work):
            return False
        a[:] = b
    return True


@kernel(nogil=True)
def free_deviations(space, path, deviation):
    """For each corner of a free polyline [n, dof], the largest of `deviation` and its halves for which the
    rounded corner is free [n - 2], and at least MIN_DEVIATION."""
    dof = path.shape[1]
    work, block = make_workspace(space.robot, space.scene), np.empty((dof, W), np.float32)
    a, b = np.empty(dof, np.float32), np.empty(dof, np.float32)
    out = np.full(len(path) - 2, deviation)
    for i in range(len(out)):
        while out[i] > MIN_DEVIATION:
            line = rounded_line(path, out)
            if _corner_is_free(space, line, i, a, b, block, work):
                break
            out[i] *= 0.5
    return out
