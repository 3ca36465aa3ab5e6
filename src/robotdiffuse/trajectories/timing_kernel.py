"""Compiled timing: evaluates rounded polylines, finds the fastest speeds along them, and samples
trajectories.

The path is q(s), with the derivatives q' and q'' by s, where s is the arc length of the polyline in joint
space. A joint moves with q' ṡ and accelerates with q' s̈ + q'' ṡ².

Speeds are found by time-optimal path parameterization by reachability analysis (TOPP-RA; H. Pham and Q.-C.
Pham, "A new approach to time-optimal path parameterization based on reachability analysis", T-RO 2018). Its
symbols are x = ṡ² and u = s̈; u is constant in each interval of a grid over s. A backward pass finds the
greatest x at each grid point from which the end can be reached within all limits. A forward pass then takes
the greatest u in each interval. Limits are applied at both ends of each interval.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.core.types import Configurations, JointRows, Values

SLOWDOWN_CHECKS_PER_INTERVAL = 16
"""Number of equal parts of a grid interval at the ends of which `slowdown` checks limits. With 4 parts, one
joint exceeded its limit by 1.8 % where it reversed its direction."""
# Factors on velocities before `slowdown` compares them with limits; accelerations get the square of a factor.
# CURVE_MARGIN is for rounded corners, where rates between the checked values of s are slightly greater;
# ROUNDING_MARGIN is for straight lines.
CURVE_MARGIN = 1.0002
ROUNDING_MARGIN = 1 + 1e-9
START_SLACK = 1e-7
"""Fraction by which ṡ² at the start may exceed the greatest from which the end can be reached."""
NEGLIGIBLE_SHARE = 1e-8
"""The next ṡ² is ignored in a limit if it contributes less than this fraction of an acceleration limit."""
BLEND_DEVIATION = 3.0 / 16.0
"""b(0) of `RoundedLine`: the distance from the corner to the middle of its blend, divided by the half
width times the norm of the change of direction."""
# Numbers of grid intervals of `estimated_time`; see `TimingSettings`.
CORNER_INTERVALS = 8
LINE_INTERVALS = 32
MIN_SPEED_RATIO = 0.01
"""From the greatest ṡ² at a grid point, the next ṡ² can be at least this fraction of the smaller one of the
greatest ṡ² at both points. Where a joint's q' changes sign, the limits would otherwise allow a speed after
which the motion must stop."""


class RoundedLine(NamedTuple):
    """Straight lines between waypoints, with each corner rounded (blended) from a half width before it to a
    half width after it. The line is twice continuously differentiable, and within a known distance of the
    polyline.

    The parameter s is the arc length of the polyline. Corner i is the waypoint w_i at s_i, with the half
    width d_i and the unit directions e before and f after it. The blend is w_i + d_i (e u + (f - e) b(u)),
    with u = (s - s_i) / d_i in [-1, 1]. Here b(u) is a C2 replacement of max(u, 0) with the second derivative
    3/4 (1 - u²). The blend leaves the polyline by at most 3/16 d_i |f - e|, at u = 0.
    """

    waypoints: Configurations
    """At least two rows [n, dof]."""
    knots: Values
    """[n] s at the waypoints."""
    directions: JointRows
    """[n - 1, dof] unit directions of the straight lines."""
    half_widths: Values
    """[n - 2] one for each inner waypoint. Rounded corners do not overlap or reach beyond the path's ends."""

    @property
    def length(self) -> float:
        """Arc length of the polyline: the end of the parameter s."""
        return float(self.knots[-1])

    def __call__(self, s: Values, order: int) -> JointRows:
        """The path (order 0) or its first or second derivative with respect to s, at each s."""
        return evaluate(self, s, order)


@inner_kernel()
def evaluate_at(line, s, order, out):
    """Writes q (order 0), q' (1) or q'' (2) of a `RoundedLine` at s to out[dof]. Symbols are those of
    `RoundedLine`."""
    waypoints, knots, directions, half_widths = line
    # the segment that contains s, by bisection
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
    # the rounded corner that contains s; -1: s is on a straight part
    corner = -1
    if segment > 0 and s - knots[segment] < half_widths[segment - 1]:
        corner = segment - 1
    elif segment < len(half_widths) and knots[segment + 1] - s < half_widths[segment]:
        corner = segment
    if corner >= 0:
        d = half_widths[corner]
        u = (s - knots[corner + 1]) / d
        if order == 0:  # b(u) or its derivative
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
    """q, q' or q'' (order 0, 1, 2) of a `RoundedLine` at m values of s, as an array [m, dof]. At the line's
    end, q is exactly the last waypoint."""
    out = np.empty((len(s), line.waypoints.shape[1]))
    for i in range(len(s)):
        evaluate_at(line, s[i], order, out[i])
        if order == 0 and s[i] == line.knots[-1]:
            out[i] = line.waypoints[-1]
    return out


@kernel()
def rounded_line(waypoints, deviations):
    """The `RoundedLine` through waypoints [n, dof]. Its corners have the widest blends that leave the
    polyline by at most the deviations [n - 2] [rad, joint-space L2] and do not overlap."""
    n, dof = waypoints.shape
    lengths = np.empty(n - 1)
    knots = np.zeros(n)
    directions = np.empty((n - 1, dof))
    for i in range(n - 1):
        directions[i] = waypoints[i + 1] - waypoints[i]
        lengths[i] = np.sqrt((directions[i] ** 2).sum())
        directions[i] /= max(lengths[i], 1e-300)  # 0 between equal waypoints
        knots[i + 1] = knots[i] + lengths[i]
    blend_widths = np.empty(n - 2)
    widths = np.empty(n - 2)
    for i in range(n - 2):
        turn = np.sqrt(((directions[i + 1] - directions[i]) ** 2).sum())
        blend_widths[i] = deviations[i] / max(BLEND_DEVIATION * turn, 1e-12)
    # Two corners share the segment between them. Each corner gets half of the segment, or what the other
    # corner does not need if that is more. The first and the last segment belong to one corner each.
    for i in range(n - 2):
        before = lengths[i]
        after = lengths[i + 1]
        if i > 0:
            before = max(0.5 * before, before - blend_widths[i - 1])
        if i < n - 3:
            after = max(0.5 * after, after - blend_widths[i + 1])
        widths[i] = min(min(before, after), blend_widths[i])
    return RoundedLine(waypoints, knots, directions, widths)


def line_with_widths(waypoints: Configurations, half_widths: Values) -> RoundedLine:
    """The `RoundedLine` through waypoints with known half widths, for a part of another line."""
    straight = rounded_line(waypoints, np.zeros(len(waypoints) - 2))
    return straight._replace(half_widths=half_widths)


@kernel()
def timing_grid(knots, half_widths, corner_intervals, line_intervals):
    """Grid of increasing values of s, with equal intervals in every straight part and every rounded corner.

    A part has its share, by length, of `line_intervals` intervals; but a straight part has at least 2, and a
    corner at least `corner_intervals`. Corners need more because the limits on ṡ change along them. On a
    straight part, s̈ is piecewise constant, which any grid represents exactly except at the switching points.
    """
    length = knots[-1]
    corners = len(half_widths)
    # a part has at most its least number of intervals plus its share, rounded
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
def estimated_time(line, velocity, acceleration):
    """Estimate of the duration of the fastest motion along a line from rest to rest, without jerk limits [s],
    with a tenth of the work of `speed_limits.least_time`. On random lines, the estimate is 0.7 % too long on
    average, with a standard deviation of 0.5 %.

    A backward pass and a forward pass limit s̈ in each interval by the acceleration limits at one end only,
    the end from which the pass comes. If the limits at either end are exceeded then, the interval's duration
    is scaled up.
    """
    grid = timing_grid(line.knots, line.half_widths, CORNER_INTERVALS, LINE_INTERVALS)
    first = evaluate(line, grid, 1)
    second = evaluate(line, grid, 2)
    n, dof = first.shape
    # greatest x at each grid point by the velocity limits, and by the acceleration limits with s̈ = 0
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
    # x grows by 2 width s̈ in an interval; the backward pass limits braking, the forward pass speeding up
    for i in range(n - 1, 0, -1):
        limit = x[i] + 2 * (grid[i] - grid[i - 1]) * _greatest_u(first, second, i, x[i], -1.0, acceleration)
        x[i - 1] = min(x[i - 1], limit)
    for i in range(n - 1):
        limit = x[i] + 2 * (grid[i + 1] - grid[i]) * _greatest_u(first, second, i, x[i], 1.0, acceleration)
        x[i + 1] = min(x[i + 1], limit)
    duration = 0.0
    for i in range(n - 1):
        width = grid[i + 1] - grid[i]
        u = (x[i + 1] - x[i]) / (2 * width)
        worst_ratio = 1.0  # largest ratio of a joint's acceleration to its limit
        for j in range(dof):
            for k in range(2):
                joint_acceleration = abs(first[i + k, j] * u + second[i + k, j] * x[i + k])
                worst_ratio = max(worst_ratio, joint_acceleration / acceleration[j])
        duration += 2 * width / (np.sqrt(x[i]) + np.sqrt(x[i + 1])) * np.sqrt(worst_ratio)
    return duration


@inner_kernel()
def _greatest_u(first, second, i, x, sign, acceleration):
    """The greatest |s̈|, for s̈ of this sign, with which all joints keep their acceleration limits at grid
    point i, where ṡ² is x."""
    max_u = np.inf
    for j in range(first.shape[1]):
        if first[i, j] != 0:
            by_u = sign * first[i, j]  # the joint's acceleration is by_u |s̈| + by_x
            by_x = second[i, j] * x
            max_u = min(max_u, (acceleration[j] - (by_x if by_u > 0 else -by_x)) / abs(by_u))
    return max_u


@inner_kernel()
def _bounds_of_next(first, second, i, width, x, max_next, lowest, highest):
    """Bounds of y, the ṡ² at the end of grid interval i, if ṡ² is x at its beginning.

    The acceleration of a joint at either end of the interval is alpha x + beta y, since u = (y - x) / (2
    width). So each limit bounds y by a linear function of x; the tightest lower and upper bound at x count.

    first, second, lowest, highest: as in `controllable`. width: of the interval. max_next: greatest y.

    Returns intercept and slope of the lower bound, intercept and slope of the upper bound, and the greatest
    x by those limits that y does not influence. Intercept and slope are separate, since in a bound's value at
    x, the intercept and slope * x may cancel.
    """
    high = max_next
    high_slope = 0.0
    low, low_slope = (0.0, MIN_SPEED_RATIO) if x < max_next else (MIN_SPEED_RATIO * max_next, 0.0)
    max_x = np.inf
    for j in range(first.shape[1]):
        for k in range(2):  # the beginning and the end of the interval
            by_u = first[i + k, j] / (2 * width)
            curve = second[i + k, j]
            alpha, beta = (-by_u, by_u + curve) if k else (curve - by_u, by_u)
            low_limit = lowest[i + k, j]
            high_limit = highest[i + k, j]
            if abs(beta) * max_next <= NEGLIGIBLE_SHARE * min(high_limit, -low_limit):
                if alpha != 0:
                    max_x = min(max_x, (high_limit if alpha > 0 else low_limit) / alpha)
                continue
            up = high_limit / beta
            down = low_limit / beta
            slope = -alpha / beta
            if beta < 0:
                up, down = down, up
            if up + slope * x < high + high_slope * x:
                high = up
                high_slope = slope
            if down + slope * x > low + low_slope * x:
                low = down
                low_slope = slope
    return low, low_slope, high, high_slope, max_x


@kernel()
def controllable(first, second, grid, velocity, lowest, highest):
    """TOPP-RA's backward pass: the greatest ṡ² at each grid point from which the motion can reach the end, at
    rest there and without a stop before.

    first, second: q' and q'' at the m grid points [m, dof]. grid: m values of s. velocity: limits [dof].
    lowest, highest: limits of accelerations at the grid points [m, dof]. The m results are positive except at
    the end.
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
        # Lower x[i] until the lower bound of the next x is not above the upper bound: to the x where the two
        # tightest bounds at x[i] meet, as in Newton's method.
        for _ in range(64):
            low, low_slope, high, high_slope, max_x = _bounds_of_next(
                first, second, i, width, x[i], x[i + 1], lowest, highest
            )
            if x[i] > max_x:
                x[i] = max_x
                continue
            if low + low_slope * x[i] <= high + high_slope * x[i] or low_slope <= high_slope:
                break
            x[i] = min((high - low) / (low_slope - high_slope), x[i])
    return x


@kernel()
def fastest_speeds(first, second, grid, velocity, lowest, highest, start_speed=0.0):
    """TOPP-RA: ṡ at each grid point of the fastest motion; `start_speed` at the first, 0 at the last,
    positive between. All NaN if the end cannot be reached from the start speed. The other arguments are those
    of `controllable`."""
    n = len(grid)
    max_x = controllable(first, second, grid, velocity, lowest, highest)
    speeds = np.zeros(n)
    x = start_speed * start_speed
    if x > max_x[0] * (1 + START_SLACK):
        speeds[:] = np.nan
        return speeds
    for i in range(n - 1):
        speeds[i] = np.sqrt(x)
        width = grid[i + 1] - grid[i]
        high, slope = _bounds_of_next(first, second, i, width, x, max_x[i + 1], lowest, highest)[2:4]
        # Rounding errors must not stop the motion. The backward pass ensures that from max_x[i], a next x of
        # MIN_SPEED_RATIO times the smaller of max_x[i] and max_x[i + 1] is possible; from a smaller x,
        # x / max_x[i] times that next x is possible.
        min_next = MIN_SPEED_RATIO * x * min(1.0, max_x[i + 1] / max_x[i])
        x = min(max(high + slope * x, min_next), max_x[i + 1])
    return speeds


@kernel()
def slowdown(line, grid, speeds, velocity, acceleration):
    """The factor, at least 1, by which the motion's duration must grow so that velocity and acceleration
    limits [dof] hold between grid points as well. `speeds`: ṡ at the grid points."""
    dof = line.waypoints.shape[1]
    factor = 1.0
    first = np.empty(dof)
    second = np.empty(dof)
    for i in range(len(grid) - 1):
        width = grid[i + 1] - grid[i]
        u = (speeds[i + 1] ** 2 - speeds[i] ** 2) / (2 * width)
        # on a straight part, velocities and accelerations are greatest at the interval's ends
        evaluate_at(line, grid[i] + 0.5 * width, 2, second)
        curved = np.abs(second).max() > 0
        margin = CURVE_MARGIN if curved else ROUNDING_MARGIN
        for k in range(0, SLOWDOWN_CHECKS_PER_INTERVAL + 1, 1 if curved else SLOWDOWN_CHECKS_PER_INTERVAL):
            ds = k / SLOWDOWN_CHECKS_PER_INTERVAL * width
            evaluate_at(line, grid[i] + ds, 1, first)
            evaluate_at(line, grid[i] + ds, 2, second)
            x = max(speeds[i] ** 2 + 2 * u * ds, 0.0)
            speed = np.sqrt(x)
            for j in range(dof):
                factor = max(factor, margin * abs(first[j]) * speed / velocity[j])
                joint_acceleration = abs(first[j] * u + second[j] * x)
                factor = max(factor, margin * np.sqrt(joint_acceleration / acceleration[j]))
    return factor


@kernel()
def states_at(grid, speeds, times):
    """s and ṡ of a motion at n increasing times from 0 on [s]; after the motion's end, the last s, and ṡ = 0.

    grid, speeds: m values of s, and ṡ at each of them; s̈ is constant in between.
    """
    s = np.full(len(times), grid[-1])
    rates = np.zeros(len(times))
    last = len(grid) - 1
    i = 0
    begins = 0.0  # time at grid point i [s]
    duration = 0.0
    for k in range(len(times)):
        while i < last:
            speed_sum = speeds[i] + speeds[i + 1]
            duration = 2 * (grid[i + 1] - grid[i]) / speed_sum if speed_sum > 0 else 0.0
            if times[k] < begins + duration:
                break
            begins += duration
            i += 1
        if i == last:
            break
        dt = times[k] - begins
        u = (speeds[i + 1] - speeds[i]) / duration
        s[k] = min(grid[i] + (speeds[i] + 0.5 * u * dt) * dt, grid[i + 1])
        rates[k] = speeds[i] + u * dt
    return s, rates
