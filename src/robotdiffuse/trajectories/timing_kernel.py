"""Compiled timing: places of a blended polyline, the fastest speeds along it, and the rows of a trajectory.

The speeds are those of time-optimal path parameterization by reachability analysis (H. Pham and Q.-C. Pham,
"A new approach to time-optimal path parameterization based on reachability analysis", T-RO 2018): with x = ṡ²
and u = s̈ constant in each grid interval, a backward pass finds the greatest x from which the end can be
reached within all limits, a forward pass then takes the greatest u each time. Limits hold at both ends of an
interval.
"""

import numpy as np
from numba import njit

PARTS = 16
"""Places in a grid interval where rates are looked at; at 4, a reversal was 1.8 % too fast between them."""
BETWEEN, ROUNDING = 1.0002, 1 + 1e-9
"""Spared of limits on curves, since rates between those places were up to 0.025 % greater, and elsewhere."""
TINY = 1e-7
"""Derivatives by s, which are of length one on lines, count as zero below this."""
NEGLIGIBLE = 1e-8
"""Share of an acceleration limit below which the next speed has no part in an acceleration."""
LEAST_SHARE = 0.01
"""What ṡ² at a grid point has at least of the one before and of the most that is possible there: where q' of
a joint changes its sign, the limits would let a motion be so fast that only a stop can follow."""


@njit(cache=True)
def place(waypoints, knots, directions, half_widths, s, order, out):
    """The path (order 0) or its first or second derivative at s, to out[dof]; see `blending`."""
    segments = len(directions)
    low, high = 0, segments
    while high - low > 1:
        middle = (low + high) // 2
        if knots[middle] <= s:
            low = middle
        else:
            high = middle
    segment, dof = low, waypoints.shape[1]
    corner = segment - 1 if s < 0.5 * (knots[segment] + knots[segment + 1]) else segment
    corner = min(max(corner, 0), len(half_widths) - 1)
    if corner >= 0 and abs(s - knots[corner + 1]) < half_widths[corner]:
        d = half_widths[corner]
        u = (s - knots[corner + 1]) / d
        if order == 0:
            b = 3 / 16 + u / 2 + 3 / 8 * u**2 - u**4 / 16
        elif order == 1:
            b = 1 / 2 + 3 / 4 * u - u**3 / 4
        else:
            b = 3 / 4 * (1 - u**2)
        for j in range(dof):
            e = directions[corner, j]
            turn = directions[corner + 1, j] - e
            if order == 0:
                out[j] = waypoints[corner + 1, j] + d * (u * e + turn * b)
            elif order == 1:
                out[j] = e + turn * b
            else:
                out[j] = turn * b / d
        return
    for j in range(dof):
        if order == 0:
            out[j] = waypoints[segment, j] + (s - knots[segment]) * directions[segment, j]
        elif order == 1:
            out[j] = directions[segment, j]
        else:
            out[j] = 0.0


@njit(cache=True)
def places(line, s, order):
    """[m, dof] for the rows of s; `line` is (waypoints, knots, directions, half_widths)."""
    waypoints, knots, directions, half_widths = line
    out = np.empty((len(s), waypoints.shape[1]))
    for i in range(len(s)):
        place(waypoints, knots, directions, half_widths, s[i], order, out[i])
    return out


@njit(cache=True)
def _bounds_of_next(first, second, i, width, x, most, weakest, strongest):
    """The least and greatest next x from x in interval i, as lines over x: values at 0 and slopes, since x
    may be so large that the values there cancel. Last, the greatest x within the limits that do not depend
    on the next x. `most` is the greatest next x.

    With u = (y - x) / (2 width), the acceleration of a joint is alpha x + beta y at both ends.
    """
    high, high_slope = most, 0.0
    low, low_slope = (0.0, LEAST_SHARE) if x < most else (LEAST_SHARE * most, 0.0)
    greatest = np.inf
    for j in range(first.shape[1]):
        for k in range(2):
            pull, curve = first[i + k, j] / (2 * width), second[i + k, j]
            alpha, beta = (-pull, pull + curve) if k else (curve - pull, pull)
            weak, strong = weakest[i + k, j], strongest[i + k, j]
            if abs(beta) * most <= NEGLIGIBLE * min(strong, -weak):
                if alpha != 0:
                    greatest = min(greatest, (strong if alpha > 0 else weak) / alpha)
                continue
            up, down, slope = strong / beta, weak / beta, -alpha / beta
            if beta < 0:
                up, down = down, up
            if up + slope * x < high + high_slope * x:
                high, high_slope = up, slope
            if down + slope * x > low + low_slope * x:
                low, low_slope = down, slope
    return low, low_slope, high, high_slope, greatest


@njit(cache=True)
def controllable(first, second, grid, velocity, weakest, strongest):
    """The greatest ṡ² at each value of the grid s[m] from which the end can be reached at rest within the
    limits, without a stop before it, from q'[m, dof] and q''[m, dof] there: velocities [dof], least and
    greatest accelerations [m, dof]. It is above 0 but at the end."""
    n, dof = first.shape
    x = np.empty(n)
    for i in range(n):  # what limits of velocity allow
        most = np.inf
        for j in range(dof):
            if first[i, j] != 0:
                most = min(most, (velocity[j] / abs(first[i, j])) ** 2)
        x[i] = most
    x[n - 1] = 0.0
    for i in range(n - 2, -1, -1):
        width = grid[i + 1] - grid[i]
        for _ in range(64):
            low, low_slope, high, high_slope, greatest = _bounds_of_next(
                first, second, i, width, x[i], x[i + 1], weakest, strongest
            )
            if x[i] > greatest:
                x[i] = greatest
                continue
            if low + low_slope * x[i] <= high + high_slope * x[i] or low_slope <= high_slope:
                break
            x[i] = min((high - low) / (low_slope - high_slope), x[i])
    return x


@njit(cache=True)
def fastest(first, second, grid, velocity, weakest, strongest, begins=0.0):
    """ṡ [m] at each value of the grid s[m], `begins` at the first and 0 at the last, from what `controllable`
    takes; above 0 between them. NaN where the end cannot be reached from so fast a beginning."""
    n = len(grid)
    x = controllable(first, second, grid, velocity, weakest, strongest)
    speeds = np.zeros(n)
    now = begins * begins
    if now > x[0] * (1 + TINY):
        speeds[:] = np.nan
        return speeds
    for i in range(n - 1):
        speeds[i] = np.sqrt(now)
        width = grid[i + 1] - grid[i]
        high, slope = _bounds_of_next(first, second, i, width, now, x[i + 1], weakest, strongest)[2:4]
        # from x[i] at least so much is possible, and in proportion from less
        least = LEAST_SHARE * now * min(1.0, x[i + 1] / x[i])
        now = min(max(high + slope * now, least), x[i + 1])
    return speeds


@njit(cache=True)
def slowdown(line, grid, speeds, velocity, acceleration):
    """How many times slower the motion must be (at least 1) to keep the limits between grid points too."""
    waypoints, knots, directions, half_widths = line
    dof, worst = waypoints.shape[1], 1.0
    first, second = np.empty(dof), np.empty(dof)
    for i in range(len(grid) - 1):
        width = grid[i + 1] - grid[i]
        pull = (speeds[i + 1] ** 2 - speeds[i] ** 2) / (2 * width)
        # along a straight part, rates are greatest at its ends
        place(waypoints, knots, directions, half_widths, grid[i] + 0.5 * width, 2, second)
        curved = np.abs(second).max() > 0
        spare = BETWEEN if curved else ROUNDING
        for part in range(0, PARTS + 1, 1 if curved else PARTS):
            at = part / PARTS * width
            place(waypoints, knots, directions, half_widths, grid[i] + at, 1, first)
            place(waypoints, knots, directions, half_widths, grid[i] + at, 2, second)
            squared = max(speeds[i] ** 2 + 2 * pull * at, 0.0)
            speed = np.sqrt(squared)
            for j in range(dof):
                worst = max(worst, spare * abs(first[j]) * speed / velocity[j])
                rate = abs(first[j] * pull + second[j] * squared)
                worst = max(worst, spare * np.sqrt(rate / acceleration[j]))
    return worst


@njit(cache=True)
def sampled(line, grid, speeds, sample_time):
    """Times [n], positions, velocities and accelerations [n, dof] of the motion with these speeds.

    Times are multiples of the sample time, then the duration, no nearer than a tenth of the sample time.
    """
    waypoints, knots, directions, half_widths = line
    ends = np.zeros(len(grid))
    for i in range(len(grid) - 1):
        ends[i + 1] = ends[i] + 2 * (grid[i + 1] - grid[i]) / (speeds[i] + speeds[i + 1])
    count = max(1, int(np.ceil(ends[-1] / sample_time - 0.1)))
    dof = waypoints.shape[1]
    times, q = np.empty(count + 1), np.empty((count + 1, dof))
    velocities, accelerations = np.zeros((count + 1, dof)), np.zeros((count + 1, dof))
    first, second = np.empty(dof), np.empty(dof)
    i = 0
    for k in range(count + 1):
        times[k] = k * sample_time if k < count else ends[-1]
        while i < len(grid) - 2 and ends[i + 1] <= times[k]:
            i += 1
        pull = (speeds[i + 1] - speeds[i]) / (ends[i + 1] - ends[i])
        ago = times[k] - ends[i]
        s = min(grid[i] + (speeds[i] + 0.5 * pull * ago) * ago, knots[-1])
        speed = speeds[i] + pull * ago
        place(waypoints, knots, directions, half_widths, s, 0, q[k])
        place(waypoints, knots, directions, half_widths, s, 1, first)
        place(waypoints, knots, directions, half_widths, s, 2, second)
        for j in range(dof):
            velocities[k, j] = first[j] * speed
            accelerations[k, j] = first[j] * pull + second[j] * speed * speed
    if grid[0] == 0:
        q[0] = waypoints[0]
    if grid[-1] == knots[-1]:
        q[count] = waypoints[-1]
    velocities[count] = 0.0
    if speeds[0] == 0:
        velocities[0] = 0.0
    return times, q, velocities, accelerations
