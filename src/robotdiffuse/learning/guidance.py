"""Guidance: steps down a sum of cost functions, on predicted trajectories (paper, Motion Guided Generation).

The same steps serve in two places: a few of them inside the sampler, on the predicted clean trajectory, and
more of them on motions that no network made (`baselines/controls.py`). The costs of waypoints q_i, with the
paper's hinge h = max(S - D, 0) of a safe distance S and a distance D:

| cost           | formula                                                             | enabled by  |
|----------------|---------------------------------------------------------------------|-------------|
| collision      | sum of h^2 / 2 over covering spheres; D: from sphere to scene       | margin (S)  |
| self_collision | sum of h^2 / 2 over pairs of spheres of two links; D: between both  | self_margin |
| length         | sum of |q_(i+1) - q_i|^2 / 2                                        | length      |

The first two costs depend on single waypoints. Each waypoint is pushed by the smallest motion that clears a
contact (a Gauss-Newton step), and a kernel spreads the pushes over the neighboring waypoints, as the metric
of CHOMP does (Zucker et al., IJRR 2013). The cost of length is CHOMP's smoothness; its
step moves each waypoint towards the middle of its two neighbors.

A problem's path constraints are one more cost: the sum of h^2 / 2 over their rows (scalar constraints) that
exceed their limits, which are lowered by (1 - `tolerance_share`) times the tolerance. Here h [m] is how far
a row's value is from the value that projection aims for, which is within the limit (`projection_kernel`). A
radian counts as `projection_kernel.ANGLE_WEIGHT` meters.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.collision_cost import CLEARANCE_CAP, cost_gradient_at, make_cost_workspace
from robotdiffuse.collision.kernels.lane_clearance import make_clearance_workspace, pair_clearances_into
from robotdiffuse.core.kernels import ONE, ZERO, allocation_free, inner_kernel, kernel
from robotdiffuse.core.settings import NotNegative, Positive, Settings, Share
from robotdiffuse.problems.compiled_constraints import PathConstraints
from robotdiffuse.problems.constraint_kernel import make_work
from robotdiffuse.problems.projection_kernel import step

OFF = -CLEARANCE_CAP
"""The margin of a cost that is not enabled: no distance is ever below it."""


@kernel(nogil=True)
def descend(robot, scene, q, lower, upper, margin, self_margin, push, spread_weights, length, rounds):
    """Moves the waypoints of trajectories q [batch, waypoints, dof], in place, except the first and the last.

    In each of the `rounds`, each waypoint within a margin is pushed out of it, the pushes are spread over the
    neighboring waypoints, and then a step shortens the trajectory. If margins are enabled, a trajectory
    without a waypoint within a margin is not changed.

    margin: to obstacles, self_margin: between links [m], or OFF. push: longest push of a waypoint [rad].
    spread_weights [waypoints, waypoints]: weights by which pushes spread over neighboring waypoints. length:
    fraction of the way to the middle of its neighbors by which a waypoint moves.
    """
    batch, n, dof = q.shape
    first = 1
    last = n - 1
    scratch = make_cost_workspace(dof)
    pushes = np.empty((n, dof), np.float32)
    active = np.empty(n, np.float32)
    gradient = np.empty(dof, np.float32)
    work = make_clearance_workspace(robot, 1)
    pairs = np.full((n, len(robot.pairs)), CLEARANCE_CAP)
    pushed = max(margin, self_margin) > OFF
    for b in range(batch):
        for _ in range(rounds):
            total = ZERO
            if self_margin > OFF:
                pair_clearances_into(robot, q[b], self_margin, work, pairs)
            for i in range(first, last):
                gradient[:] = ZERO
                cost = cost_gradient_at(
                    robot, scene, q[b, i], pairs[i], margin, self_margin, scratch, gradient
                )
                total += cost
                active[i] = _push_away(cost, gradient, push, pushes[i])
            if pushed and total <= ZERO:
                break
            _spread(q[b], first, last, pushes, active, spread_weights, lower, upper)
            _shorten(q[b], first, last, length)


@inner_kernel()
def _push_away(cost, gradient, push, out):
    """Writes to out[dof] the Gauss-Newton step -g 2c / (g.g) of the collision cost c with gradient g, at most
    `push` [rad] long.

    The step just clears a single contact, at any scale of the cost. Returns 1 if there is a contact,
    else 0.
    """
    out[:] = ZERO
    square = ZERO
    for j in range(len(gradient)):
        square += gradient[j] * gradient[j]
    if cost <= ZERO or square <= np.float32(1e-12):
        return ZERO
    scale = np.float32(2.0) * cost / square
    scale = min(scale, push / np.sqrt(square))
    for j in range(len(gradient)):
        out[j] = -scale * gradient[j]
    return ONE


@allocation_free(fastmath=True)
def _spread(q, first, last, pushes, active, spread_weights, lower, upper):
    """Moves each of the waypoints `first` to `last` - 1 by a weighted mean of its own push and those of its
    neighbors; by less if only distant neighbors are pushed."""
    dof = q.shape[1]
    for i in range(first, last):
        weight = ZERO
        for k in range(first, last):
            weight += spread_weights[i, k] * active[k]
        if weight <= np.float32(1e-4):
            continue
        weight = ONE / max(weight, ONE)
        for k in range(first, last):
            if active[k] > ZERO and spread_weights[i, k] > np.float32(1e-3):
                share = weight * spread_weights[i, k]
                for j in range(dof):
                    q[i, j] += share * pushes[k, j]
        for j in range(dof):
            q[i, j] = min(max(q[i, j], lower[j]), upper[j])


@allocation_free(fastmath=True)
def _shorten(q, first, last, share):
    """Moves each waypoint by a fraction of the way to the middle of its neighbors. The whole way would be
    Newton's step of the length cost in this waypoint alone. Every second waypoint is moved first, then the
    others, so that waypoints moved together share no segment. Waypoints: `first` to `last` - 1."""
    dof = q.shape[1]
    for parity in range(2):
        for i in range(first + parity, last, 2):
            for j in range(dof):
                q[i, j] += share * (np.float32(0.5) * (q[i - 1, j] + q[i + 1, j]) - q[i, j])


Trajectories = Float[ndarray, "count waypoints dof"]


@dataclass(frozen=True)
class GuidanceSettings(Settings, name="guidance"):
    margin: NotNegative | None = 0.04
    """Distance to obstacles below which waypoints are pushed away [m]: the paper's safe distance S. Only
    waypoints are checked; with this distance, the motion between them is mostly free too. None: obstacles
    have no cost."""
    self_margin: NotNegative | None = 0.01
    """Distance between links below which they are pushed apart [m]; None: no cost."""
    push: Positive = 0.15
    """Longest push of a waypoint in one step [rad]."""
    width: Positive = 4.0
    """Standard deviation of the kernel that spreads pushes over neighboring waypoints [waypoints]."""
    length: Share = 0.2
    """After the pushes, waypoints move by this fraction towards the middle of their neighbors; 0: the length
    has no cost."""


class CollisionGuidance:
    """Moves trajectories of one problem out of collision, and down the other costs of its settings."""

    def __init__(
        self,
        checker: CollisionChecker,
        settings: GuidanceSettings | None = None,
        constraints: PathConstraints | None = None,
        tolerance_share: float = 1.0,
    ) -> None:
        """constraints: path constraints; a step down their cost moves a waypoint by at most the setting
        `push`. tolerance_share: the fraction of their tolerances within which they should hold."""
        self.checker = checker
        self.settings = settings or GuidanceSettings()
        self._constraints = None
        if constraints is not None:
            self._constraints = constraints.rows, constraints.limits(tolerance_share)

    def __call__(self, q: Trajectories, steps: int) -> Trajectories:
        """The trajectories [rad] after `steps` steps.

        The first and the last waypoint are not moved. If margins are enabled, neither pushes nor the cost of
        length change a trajectory with no other waypoint within a margin. Path constraints still do.
        """
        settings = self.settings
        checker = self.checker
        index = np.arange(q.shape[1])
        spread = np.exp(-0.5 * ((index[:, None] - index) / settings.width) ** 2).astype(np.float32)
        moved = np.array(q, np.float32)
        lower, upper = (limits.astype(np.float32) for limits in (checker.robot.lower, checker.robot.upper))
        margin, self_margin = (
            OFF if limit is None else np.float32(limit) for limit in (settings.margin, settings.self_margin)
        )
        push, length = np.float32(settings.push), np.float32(settings.length)
        # one call for all rounds, or one call for each if steps towards the constraints follow each round
        for rounds in [steps] if self._constraints is None else [1] * steps:
            arrays = checker.robot_arrays, checker.scene_arrays
            descend(*arrays, moved, lower, upper, margin, self_margin, push, spread, length, rounds)
            if self._constraints is not None:
                projected = moved.astype(np.float64)
                _towards_constraints(*self._constraints, projected.reshape(-1, q.shape[2]), settings.push)
                moved[:, 1:-1] = np.clip(projected.astype(np.float32)[:, 1:-1], lower, upper)
        return moved


@kernel(nogil=True)
def _towards_constraints(rows, limits, q, max_step):
    """Moves each configuration of q [n, dof] whose rows exceed the limits, in place, by one damped Newton
    step towards values within them; max_step: longest step [rad]."""
    work = make_work(rows)
    for i in range(len(q)):
        step(rows, limits, q[i], max_step, work)
