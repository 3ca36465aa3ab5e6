"""Compiled timing: evaluates rounded polylines, finds the fastest speeds along them, and samples
trajectories.

The speeds are those of time-optimal path parameterization by reachability analysis (H. Pham and Q.-C. Pham,
"A new approach to time-optimal path parameterization based on reachability analysis", T-RO 2018). With x = ṡ²
and u = s̈ constant in each grid interval, a backward pass finds the greatest x from which the end can be
reached within all limits; a forward pass then takes the greatest u in each interval. Limits hold at both ends
of an interval.
"""

import numpy as np

from robotdiffuse.core.kernels import inner_kernel, kernel

SLOWDOWN_CHECKS_PER_INTERVAL = 16
"""Number of parts of a grid interval at whose ends `slowdown` checks limits; with 4, a reversal was 1.8 % too
fast."""
# Factors on rates before they are compared with limits: on curves, where rates between the checked places
# were up to 0.025 % greater, and on straight lines.
CURVE_MARGIN = 1.0002
ROUNDING_MARGIN = 1 + 1e-9
NEGLIGIBLE_DERIVATIVE = 1e-7
"""Smaller components of the first derivative by s, whose norm is one on straight lines, count as zero."""
NEGLIGIBLE_SHARE = 1e-8
"""If the next speed contributes less than this fraction of an acceleration limit, its contribution is
ignored."""
BLEND_DEVIATION = 3.0 / 16.0
"""b(0) of `BlendedPolyline`: the distance from corner to blend, divided by the half width times the change of
direction."""
# The grid of `estimated_time`.
CORNER_INTERVALS = 8
LINE_INTERVALS = 32
MIN_SPEED_RATIO = 0.01
"""Each ṡ² is at least this fraction of the previous one and of the greatest possible one. Where a joint's q'
changes sign, the limits would otherwise allow a speed that only a stop can follow."""


@inner_kernel()
def evaluate_at(waypoints, knots, directions, half_widths, s, order, out):
    """Writes the path (order 0) or its first or second derivative at s to out[dof]; see `BlendedPolyline`."""
    segments = len(directions)
    low = 0
    high = segments
    while high - low > 1:
        middle = (low + high) // 2
        if knots[middle] <= s:
            low = middle
        else:
            high = middle
    segment = low
    dof = waypoints.shape[1]
    corner = -1
    if segment > 0 and s - knots[segment] < half_widths[segment - 1]:
        corner = segment - 1
    elif segment < len(half_widths) and knots[segment + 1] - s < half_widths[segment]:
        corner = segment
    if corner >= 0:
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


@kernel()
def evaluate(line, s, order):
    """`evaluate_at` for every value of s, [m, dof]; `line` is (waypoints, knots, directions, half_widths)."""
    waypoints, knots, directions, half_widths = line
    out = np.empty((len(s), waypoints.shape[1]))
    for i in range(len(s)):
        evaluate_at(waypoints, knots, directions, half_widths, s[i], order, out[i])
    return out


@kernel()
def rounded_line(waypoints, deviations):
    """The polyline through waypoints [n, dof] with the widest blends that leave it by at most the deviations
    [n - 2] and do not overlap, as the arguments of `evaluate`."""
    n, dof = waypoints.shape
    lengths = np.empty(n - 1)
    knots = np.zeros(n)
    directions = np.empty((n - 1, dof))
    for i in range(n - 1):
        directions[i] = waypoints[i + 1] - waypoints[i]
        lengths[i] = np.sqrt((directions[i] ** 2).sum())
        directions[i] /= lengths[i]
        knots[i + 1] = knots[i] + lengths[i]
    blend_widths = np.empty(n - 2)
    widths = np.empty(n - 2)
    for i in range(n - 2):
        turn = np.sqrt(((directions[i + 1] - directions[i]) ** 2).sum())
        blend_widths[i] = deviations[i] / max(BLEND_DEVIATION * turn, 1e-12)
    # Two corners share the segment between them: each gets half of it, or more if the other needs less. A
    # segment at an end belongs to its only corner.
    for i in range(n - 2):
        before = lengths[i]
        after = lengths[i + 1]
        if i > 0:
            before = max(0.5 * before, before - blend_widths[i - 1])
        if i < n - 3:
            after = max(0.5 * after, after - blend_widths[i + 1])
        widths[i] = min(min(before, after), blend_widths[i])
    return waypoints, knots, directions, widths


@kernel()
def timing_grid(knots, half_widths, corner_intervals, line_intervals):
    """Values of s: equal parts of every rounded corner, and parts of the straight lines by their lengths.

    Along a straight line s̈ is piecewise constant, which any grid represents exactly except at the switching
    points. Rounded corners need points of their own because the limits on ṡ change along them.
    """
    length = knots[-1]
    corners = len(half_widths)
    grid = np.zeros(1 + line_intervals + (2 + corner_intervals) * (corners + 1) + corners + 1)
    count = 0
    s = 0.0
    for i in range(corners + 1):
        low = knots[i + 1] - half_widths[i] if i < corners else length
        high = knots[i + 1] + half_widths[i] if i < corners else length
        for end, min_intervals, negligible in ((low, 2, 1e-12), (high, corner_intervals, 0.0)):
            if end - s > negligible:
                intervals = max(min_intervals, int(np.round(line_intervals * (end - s) / length)))
                step = (end - s) / intervals
                for k in range(1, intervals):
                    grid[count + k] = s + k * step
                count += intervals
                grid[count] = end
            s = end
    grid[count] = length
    return grid[: count + 1].copy()


@kernel()
def least_time(line, velocity, acceleration, corner_intervals, line_intervals):
    """Duration of the fastest motion along a line from rest to rest, without limits of jerk [s]."""
    grid = timing_grid(line[1], line[3], corner_intervals, line_intervals)
    first = evaluate(line, grid, 1)
    second = evaluate(line, grid, 2)
    highest = np.empty_like(first)
    highest[:] = acceleration
    speeds = fastest_speeds(first, second, grid, velocity, -highest, highest)
    duration = 0.0
    for i in range(len(grid) - 1):
        duration += 2 * (grid[i + 1] - grid[i]) / (speeds[i] + speeds[i + 1])
    return duration * slowdown(line, grid, speeds, velocity, acceleration)


@kernel()
def estimated_time(line, velocity, acceleration):
    """About the least duration of a motion along a line from rest to rest, without limits of jerk [s]: on
    random lines 0.7 % more, with a standard deviation of 0.5 %.

    In each interval the greatest s̈ is that at its slower end, in one backward and one forward pass. Where
    that exceeds a limit at the other end, the interval takes longer. That is a tenth of the work of
    `fastest_speeds`.
    """
    grid = timing_grid(line[1], line[3], CORNER_INTERVALS, LINE_INTERVALS)
    first = evaluate(line, grid, 1)
    second = evaluate(line, grid, 2)
    n, dof = first.shape
    x = np.empty(n)
    for i in range(n):
        limit = np.inf
        for j in range(dof):
            if first[i, j] != 0:
                limit = min(limit, (velocity[j] / first[i, j]) ** 2)
            if second[i, j] != 0:
                limit = min(limit, acceleration[j] / abs(second[i, j]))
        x[i] = limit
    x[0] = x[n - 1] = 0.0
    for i in range(n - 1, 0, -1):
        limit = x[i] + 2 * (grid[i] - grid[i - 1]) * _greatest_pull(
            first, second, i, x[i], -1.0, acceleration
        )
        x[i - 1] = min(x[i - 1], limit)
    for i in range(n - 1):
        limit = x[i] + 2 * (grid[i + 1] - grid[i]) * _greatest_pull(first, second, i, x[i], 1.0, acceleration)
        x[i + 1] = min(x[i + 1], limit)
    duration = 0.0
    for i in range(n - 1):
        width = grid[i + 1] - grid[i]
        pull = (x[i + 1] - x[i]) / (2 * width)
        worst_excess = 1.0
        for j in range(dof):
            for k in range(2):
                rate = abs(first[i + k, j] * pull + second[i + k, j] * x[i + k])
                worst_excess = max(worst_excess, rate / acceleration[j])
        duration += 2 * width / (np.sqrt(x[i]) + np.sqrt(x[i + 1])) * np.sqrt(worst_excess)
    return duration


@inner_kernel()
def _greatest_pull(first, second, i, x, sign, acceleration):
    """The greatest |s̈| of a sign with which accelerations are within their limits at grid point i."""
    max_pull = np.inf
    for j in range(first.shape[1]):
        if first[i, j] != 0:
            pull = sign * first[i, j]
            curve = second[i, j] * x
            max_pull = min(max_pull, (acceleration[j] - (curve if pull > 0 else -curve)) / abs(pull))
    return max_pull


@inner_kernel()
def _bounds_of_next(first, second, i, width, x, most, weakest, strongest):
    """Bounds of the next x after x in interval i, as linear functions of x; `most` is the greatest next x.

    Returns the value at 0 and the slope of the lower bound, then of the upper bound (at x itself the two
    parts may cancel), and the greatest x that those limits allow which do not depend on the next x. With u =
    (y - x) / (2 width), the acceleration of a joint is alpha x + beta y at both ends of the interval.
    """
    high = most
    high_slope = 0.0
    low, low_slope = (0.0, MIN_SPEED_RATIO) if x < most else (MIN_SPEED_RATIO * most, 0.0)
    greatest = np.inf
    for j in range(first.shape[1]):
        for k in range(2):
            pull = first[i + k, j] / (2 * width)
            curve = second[i + k, j]
            alpha, beta = (-pull, pull + curve) if k else (curve - pull, pull)
            weak = weakest[i + k, j]
            strong = strongest[i + k, j]
            if abs(beta) * most <= NEGLIGIBLE_SHARE * min(strong, -weak):
                if alpha != 0:
                    greatest = min(greatest, (strong if alpha > 0 else weak) / alpha)
                continue
            up = strong / beta
            down = weak / beta
            slope = -alpha / beta
            if beta < 0:
                up, down = down, up
            if up + slope * x < high + high_slope * x:
                high = up
                high_slope = slope
            if down + slope * x > low + low_slope * x:
                low = down
                low_slope = slope
    return low, low_slope, high, high_slope, greatest


@kernel()
def controllable(first, second, grid, velocity, weakest, strongest):
    """The greatest ṡ² at each grid point from which the end can be reached at rest without a stop before it.

    first, second: q' and q'' at the grid points, [m, dof]; grid: values of s, [m]; velocity: limits [dof];
    weakest, strongest: lowest and highest accelerations [m, dof]. The result is positive except at the end.
    """
    n, dof = first.shape
    x = np.empty(n)
    for i in range(n):  # velocity limits
        limit = np.inf
        for j in range(dof):
            if first[i, j] != 0:
                limit = min(limit, (velocity[j] / abs(first[i, j])) ** 2)
        x[i] = limit
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


@kernel()
def fastest_speeds(first, second, grid, velocity, weakest, strongest, start_speed=0.0):
    """ṡ at each grid point: `start_speed` at the first, 0 at the last, positive between; arguments as of
    `controllable`. All NaN if the end cannot be reached from the start speed."""
    n = len(grid)
    x = controllable(first, second, grid, velocity, weakest, strongest)
    speeds = np.zeros(n)
    now = start_speed * start_speed
    if now > x[0] * (1 + NEGLIGIBLE_DERIVATIVE):
        speeds[:] = np.nan
        return speeds
    for i in range(n - 1):
        speeds[i] = np.sqrt(now)
        width = grid[i + 1] - grid[i]
        high, slope = _bounds_of_next(first, second, i, width, now, x[i + 1], weakest, strongest)[2:4]
        # from x[i] at least this speed is possible, and proportionally less from a smaller x
        floor_speed = MIN_SPEED_RATIO * now * min(1.0, x[i + 1] / x[i])
        now = min(max(high + slope * now, floor_speed), x[i + 1])
    return speeds


@kernel()
def slowdown(line, grid, speeds, velocity, acceleration):
    """The factor, at least 1, by which the motion must be slowed to keep the limits between grid points
    too."""
    waypoints, knots, directions, half_widths = line
    dof = waypoints.shape[1]
    factor = 1.0
    first = np.empty(dof)
    second = np.empty(dof)
    for i in range(len(grid) - 1):
        width = grid[i + 1] - grid[i]
        pull = (speeds[i + 1] ** 2 - speeds[i] ** 2) / (2 * width)
        # on a straight part, rates are greatest at its ends
        evaluate_at(waypoints, knots, directions, half_widths, grid[i] + 0.5 * width, 2, second)
        curved = np.abs(second).max() > 0
        spare = CURVE_MARGIN if curved else ROUNDING_MARGIN
        for part in range(0, SLOWDOWN_CHECKS_PER_INTERVAL + 1, 1 if curved else SLOWDOWN_CHECKS_PER_INTERVAL):
            at = part / SLOWDOWN_CHECKS_PER_INTERVAL * width
            evaluate_at(waypoints, knots, directions, half_widths, grid[i] + at, 1, first)
            evaluate_at(waypoints, knots, directions, half_widths, grid[i] + at, 2, second)
            squared = max(speeds[i] ** 2 + 2 * pull * at, 0.0)
            speed = np.sqrt(squared)
            for j in range(dof):
                factor = max(factor, spare * abs(first[j]) * speed / velocity[j])
                rate = abs(first[j] * pull + second[j] * squared)
                factor = max(factor, spare * np.sqrt(rate / acceleration[j]))
    return factor


@kernel()
def sample_positions(line, grid, speeds, times):
    """Positions [n, dof] at increasing times of the motion with these speeds, which rests after its end.

    grid, speeds: values of s [m] and ṡ at each, between which s̈ is constant; times [n]: from 0 on [s].
    """
    waypoints, knots, directions, half_widths = line
    ends = np.zeros(len(grid))
    for i in range(len(grid) - 1):
        both = speeds[i] + speeds[i + 1]
        ends[i + 1] = ends[i] + (2 * (grid[i + 1] - grid[i]) / both if both > 0 else 0.0)
    q = np.empty((len(times), waypoints.shape[1]))
    i = 0
    for k in range(len(times)):
        time = min(times[k], ends[-1])
        while i < len(grid) - 2 and ends[i + 1] <= time:
            i += 1
        lasts = ends[i + 1] - ends[i]
        ago = time - ends[i]
        pull = (speeds[i + 1] - speeds[i]) / lasts if lasts > 0 else 0.0
        s = min(grid[i] + (speeds[i] + 0.5 * pull * ago) * ago, grid[i + 1])
        if times[k] >= ends[-1]:
            s = grid[-1]
        evaluate_at(waypoints, knots, directions, half_widths, s, 0, q[k])
        if s == knots[-1]:
            q[k] = waypoints[-1]
    return q
