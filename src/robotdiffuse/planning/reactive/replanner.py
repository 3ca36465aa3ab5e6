"""Replanning at 50 Hz among obstacles with a known current position and maximum speed, but unknown motion.

**Guarantee.** Every motion that `Replanner.step` returns ends at rest and is certified until then. No point
of the arm comes near any place that an obstacle can reach, at its maximum speed, from where it was last seen
(`collision/moving_obstacles.py`). The validator has certified the path against the static scene and the arm
itself. If no new motion can be certified, the arm continues its last motion, which is certified. An obstacle
may still hit an arm at rest. The replanner evades if it predicts this, but obstacles can corner any arm.

**Limits.** Velocity, acceleration and jerk are within the robot's limits at every time, also while the arm
stops (`JerkFilter`). A joint for which neither the robot nor `ReplannerSettings.jerk` gives a jerk
limit has none.

**Prediction.** The replanner chooses its way by a prediction: each obstacle keeps the velocity that was last
observed. The guarantee does not depend on the prediction.

**The filter for jerk limits** takes a motion within velocity and acceleration limits. It samples the motion
on a grid of times, averages the samples over a window, and uses the means as control points of a uniform
cubic B-spline. The spline at any time depends only on samples up to that time, so replanning does not change
what lies before. Its velocities and accelerations are weighted means of the motion's. Its jerk is at most
twice the acceleration limit divided by the duration of the window.
"""

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Annotated, NamedTuple

import numpy as np
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import Space, motions_free
from robotdiffuse.collision.motions import search_space
from robotdiffuse.collision.moving_obstacles import MovingCollision
from robotdiffuse.core.errors import (
    InputError,
    check_name,
    check_type,
    distinct,
    numbers,
    rigid_transform,
    shown,
    within,
)
from robotdiffuse.core.locked import locked
from robotdiffuse.core.settings import Bound, NotNegative, Settings
from robotdiffuse.core.transforms import inverse, rotation_angle, transform
from robotdiffuse.core.types import (
    Configuration,
    Configurations,
    Path,
    PlanResult,
    Trajectory,
    Values,
    Vector,
    frozen_dataclass,
    running_means,
    spline_states,
)
from robotdiffuse.planning.context import PlanningContext, PlanRequest
from robotdiffuse.planning.search.rrt import AnytimeSearch, SearchSettings
from robotdiffuse.planning.start_goal import StartGoal, usable_start_goal
from robotdiffuse.problems.problem import MAX_CLEARANCE, Goal, Problem, check_problem
from robotdiffuse.robots.motion_bounds import motion_radii
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import MovingObstacle, added
from robotdiffuse.scenes.shapes import Shape
from robotdiffuse.trajectories import braking_kernel
from robotdiffuse.trajectories.speed_limits import (
    Jerk,
    TimingSettings,
    jerk_limits,
    symmetric_bounds,
    timing_grid,
)
from robotdiffuse.trajectories.timing import time_parameterize
from robotdiffuse.trajectories.timing_kernel import (
    RoundedLine,
    controllable,
    line_with_widths,
    rounded_line,
    states_at,
)
from robotdiffuse.validation.tolerances import DEFAULT
from robotdiffuse.validation.validator import verifier

# Fractions of the velocity and acceleration limits that are used; the remainder is a margin for the motion
# between grid points.
VELOCITY_FRACTION = 0.99
ACCELERATION_FRACTION = 0.96
CORNER_SAMPLES = 65
"""Number of configurations of a rounded corner at which distances are checked."""
MIN_LENGTH = 1e-4
"""Smallest length of a path [rad, joint-space L2]."""
LINE_INTERVAL = 0.03
"""Approximate length of the grid intervals on straight pieces [rad, joint-space L2]."""
CORNER_INTERVALS = 16
"""Number of grid intervals in a rounded corner."""


class SpeedProfile(NamedTuple):
    """A motion along a path: values of the path parameter s, and ṡ at each; s̈ is constant between them."""

    s: Values
    speeds: Values

    def after(self, time: float) -> "SpeedProfile":
        """What remains of the motion at a time [s] after its beginning."""
        s, speed = states_at(self.s, self.speeds, np.array([time]))
        later = self.s > s + 1e-12
        # if nothing remains, the arm rests, even if rounding leaves a speed
        return SpeedProfile(np.append(s, self.s[later]), np.append(speed * later.any(), self.speeds[later]))

    @property
    def duration(self) -> float:
        """Time until the arm rests [s]."""
        speed_sums = self.speeds[1:] + self.speeds[:-1]
        return float((2 * np.diff(self.s)[speed_sums > 0] / speed_sums[speed_sums > 0]).sum())


@frozen_dataclass
class TimedPath:
    """A polyline with rounded corners that passed the validator; the arm need not stop before its end."""

    robot: Robot
    acceleration: Configuration
    """Acceleration limits of motions along the path [dof]."""
    line: RoundedLine
    to_goal: bool
    """Whether this path, or the last path that follows it, ends at the goal."""
    then: "TimedPath | None" = None
    """The path that follows after a stop at this path's end; None if this is the last path."""

    @cached_property
    def _grid(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """The path's first and second derivatives on the grid, the grid of s, and the largest ṡ² on it."""
        count = max(int(self.line.length / LINE_INTERVAL), 8)
        grid = timing_grid(self.line, TimingSettings(line_intervals=count, corner_intervals=CORNER_INTERVALS))
        # s̈ is constant in an interval, and ṡ is 0 at the path's end, so an arm at rest in the last interval
        # could not start. This interval is divided until its last part is within END_TOLERANCE of the end;
        # shorter parts would coincide in rounding.
        parts = (grid[-1] - grid[-2]) * 0.5 ** np.arange(1, 26)
        grid = np.concatenate([grid[:-1], grid[-1] - parts[parts > 0.4 * END_TOLERANCE], grid[-1:]])
        path = self.line(grid, 1), self.line(grid, 2), grid
        bounds = symmetric_bounds(self.acceleration, len(grid))
        return *path, controllable(*path, VELOCITY_FRACTION * self.robot.velocity, *bounds)

    def advance_then_brake(self, s: float, speed: float, time: float = np.inf) -> SpeedProfile:
        """The motion from s, with the speed ṡ, that is as fast as possible for `time` [s], then brakes to
        rest, at the latest at the end of the path."""
        return SpeedProfile(
            *braking_kernel.advance_then_brake(*self._grid, s, speed, time, self.acceleration)
        )

    @property
    def end(self) -> float:
        """A motion that reaches this s counts as being at the end of the path."""
        return self.line.length - END_TOLERANCE

    def at(self, s: float) -> Configuration:
        """The configuration at s."""
        return self.line(np.array([s]), 0)[0]

    def remaining(self, s: float) -> Configurations:
        """The configuration at s and the waypoints after it, including those of the paths that follow."""
        waypoints = self.line.waypoints[self.line.knots > s + MIN_LENGTH]
        after = self.then.remaining(0.0)[1:] if self.then is not None else waypoints[:0]
        return np.vstack([self.at(s), waypoints, after])

    def positions(self, motion: SpeedProfile, times: Values) -> Configurations:
        """Configurations [n, dof] at times [s] after the beginning of a motion; at its end, the arm rests."""
        return self.line(states_at(*motion, times)[0], 0)


MAX_DISPLACEMENT = 0.005
"""Largest distance by which the filter may move a point of the arm off the path, where the path bends [m]."""
SHARE_FACTOR = 0.9
"""Factor by which accelerations are reduced, repeatedly, until MAX_DISPLACEMENT is kept."""
GRID_TOLERANCE = 1e-4
"""A time counts as the next grid time if it is earlier by at most this fraction of a step."""
END_TOLERANCE = 1e-9
"""An arm that is this near to the end of its path counts as being there [rad]."""
STILL = 1e-9
"""The arm rests if its last samples differ by less than this in each joint [rad]."""
B_SPLINE = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6
"""Coefficients of the uniform cubic B-spline: a row for each power of u, and a column for each control
point. u is the fraction of a step that has passed."""


class JerkFilter:
    """The filter for jerk limits: turns a motion within velocity and acceleration limits, which may be
    replanned on the way, into one within jerk limits; see the docstring of the module."""

    def __init__(self, robot: Robot, jerk: Configuration, step: float, q: Configuration) -> None:
        """A filter that is at rest at q. step: time between two times of the grid [s]."""
        reach = float((motion_radii(robot) @ robot.acceleration).max())
        self.joint_names = robot.joint_names
        self.step = step
        share = ACCELERATION_FRACTION
        # The window of the averages, in samples, follows from the jerk limits. Window and spline smooth the
        # motion in time. This moves the arm off the path by half the variance of their weights [s²] times
        # the acceleration. With lower accelerations, a shorter window is enough.
        while True:
            window = max(int(np.ceil(2 * share * (robot.acceleration / jerk).max() / step)), 1)
            variance = step**2 * ((window**2 - 1) / 12 + 1 / 3)
            displacement = 0.5 * variance * share * reach
            if displacement <= MAX_DISPLACEMENT:
                break
            share *= SHARE_FACTOR
        self.acceleration = share * robot.acceleration
        """Acceleration limits that motions to be filtered must keep [dof]."""
        self.displacement = displacement
        """Upper bound on how far the filter moves any point of the arm off the path [m]. Where the path is
        straight in joint space, the filtered motion stays on it."""
        self._window = window
        self._samples = np.repeat(q[None], window + 3, axis=0)
        """Configurations at the last times of the grid, up to the time with index `_index`."""
        self._origin = -np.inf
        """Time of the grid with index 0 [s]."""
        self._index = 0
        self._ago = 0.0
        """Time since the last time of the grid [s]."""

    @property
    def lag(self) -> float:
        """Largest delay with which the filtered motion comes to rest after the motion that is filtered
        [s]."""
        return (self._window + 3) * self.step

    @property
    def at_rest(self) -> bool:
        """Whether the filtered motion rests, provided that the motion that is filtered continues to rest."""
        return bool(np.ptp(self._samples, axis=0).max() < STILL)

    def advance(self, path: TimedPath, motion: SpeedProfile, since: float, now: float) -> None:
        """Sample a motion that began at the time `since` [s], up to the time `now` [s]."""
        if not np.isfinite(self._origin):
            self._origin = now
            return
        index = int(np.floor((now - self._origin) / self.step + GRID_TOLERANCE))
        steps = np.arange(max(self._index + 1, index + 1 - len(self._samples)), index + 1)
        new = path.positions(motion, np.maximum(self._origin + steps * self.step - since, 0.0))
        self._samples = np.concatenate([self._samples, new])[-len(self._samples) :]
        self._index = index
        self._ago = max(now - self._origin - index * self.step, 0.0)

    def follow(self, path: TimedPath, motion: SpeedProfile) -> Trajectory:
        """The filtered motion from now until it rests, if `motion` begins now; two rows if the arm rests
        already."""
        step = self.step
        window = self._window
        u = self._ago / step
        resting = self.at_rest and motion.duration == 0
        count = 1 if resting else int(np.ceil((motion.duration + self._ago) / step)) + window + 2
        times = step * np.arange(1, count + 1) - self._ago
        raw = np.concatenate([self._samples, path.positions(motion, times)])
        # averages of the differences from the last sample, so that rounding does not move the motion's end;
        # `running_means` begins at the second row, after the row of zeros
        points = running_means(np.concatenate([0 * raw[:1], raw - raw[-1]]), window)
        # The first row is a fraction u of a step after a time of the grid. Rows of `powers`: powers of u, and
        # their first and second derivatives.
        powers = np.array([[1, u, u**2, u**3], [0, 1, 2 * u, 3 * u**2], [0, 0, 2, 6 * u]])
        first_q, first_v, first_a = powers @ B_SPLINE @ points[:4]
        q, v, a = spline_states(points[1:-1], step)
        return Trajectory(
            self.joint_names,
            np.append(0.0, times),
            raw[-1] + np.vstack([first_q, q]),
            np.vstack([first_v / step, v]),
            np.vstack([first_a / step**2, a]),
        )


FARTHEST = 1000.0
"""An obstacle is predicted to travel at most this far along each axis, out of reach of any arm [m]."""
OBSERVATION_ERROR = 1e-3
"""An obstacle may seem to move this much further than its maximum speed allows, for inexact observations
[m]."""


@frozen_dataclass
class ObservedObstacle:
    """An obstacle as it was last seen."""

    obstacle: MovingObstacle
    """The obstacle, which may move in any way up to its maximum speed, at the pose where it was last seen.
    Until the first observation, this is its pose in the problem."""
    time: float = np.nan
    """Time of the last observation [s]. An obstacle that the first step does not observe counts as observed
    then, at its pose in the problem; NaN: before the first step."""
    velocity: Vector | None = None
    """Velocity of its origin, from the last two observations [m/s]. Until there are two, it is the velocity
    in the problem; None: unknown."""

    def again(self, value: ArrayLike, now: float) -> "ObservedObstacle":
        """The obstacle after a new observation at the time `now` [s]. value: T_base_obstacle [4, 4], or the
        origin of its frame [3].

        Raises InputError for an invalid pose, and if the obstacle was faster than its maximum speed.
        """
        name = self.obstacle.name
        T_before = self.obstacle.shape.T_base_shape
        xyz = numbers(value)
        if xyz is not None and xyz.shape == (3,) and within(xyz):
            T = transform(xyz, T_before[:3, :3])
        else:
            T = rigid_transform(f"observation[{name!r}]", value)
        shape = self.obstacle.shape.moved(T @ inverse(T_before))
        T = shape.T_base_shape  # a sphere's frame does not turn with it
        max_speed = self.obstacle.top_speed
        velocity = self.velocity
        if np.isfinite(self.time):
            passed = now - self.time
            moved = np.linalg.norm(T[:3, 3] - T_before[:3, 3])
            moved += self.obstacle.radius * rotation_angle(T_before[:3, :3].T @ T[:3, :3])
            if moved > max_speed * passed + OBSERVATION_ERROR:
                distance, allowed = distinct(float(moved), max_speed * passed, digits=3)
                raise InputError(
                    f"observation[{name!r}]: a point of it can have moved {distance} m in {passed:.3g} s; "
                    f"its maximum speed {max_speed:g} m/s allows {allowed} m"
                )
            velocity = (T[:3, 3] - T_before[:3, 3]) / passed
        return ObservedObstacle(MovingObstacle(shape, max_speed=max_speed), now, velocity)

    def straight_on(self, now: float) -> MovingObstacle:
        """The obstacle as one that keeps its last observed velocity, from the time `now` [s] on."""
        velocity = np.zeros(3) if self.velocity is None else self.velocity
        travel = np.clip((now - self.time) * velocity, -FARTHEST, FARTHEST)
        return MovingObstacle(self.obstacle.shape.moved(transform(travel)), velocity=velocity)


class PredictedObstacles:
    """Moving obstacles from the time `since` [s] on, for checks of timed motions. They are predicted
    (`straight_on`), or grown, so that each fills all space that it can have reached."""

    def __init__(self, robot: Robot, moving: list[MovingObstacle], since: float) -> None:
        self._moving = moving
        self._since = since
        self._collision = MovingCollision(robot, moving, 0.0, 0.0)
        self.margin = np.zeros(len(moving))

    def wider(self, margin: Values) -> "PredictedObstacles":
        """These obstacles, each inflated by its margin [m]."""
        inflated = copy(self)
        inflated.margin = self.margin + margin
        inflated._collision = self._collision.inflated(margin)
        return inflated

    def shapes(self, time: float) -> list[Shape]:
        """The obstacles at a time [s]."""
        return [obstacle.at(time - self._since) for obstacle in self._moving]

    def clear_of(self, motion: Trajectory, begins: float, clearance: float) -> bool:
        """Whether no obstacle comes closer to the arm than the clearance [m], during a motion that begins at
        `begins` [s]."""
        times = motion.times + (begins - self._since)
        return self._collision.first_unproved_time(times, motion.positions, clearance) is None

    def comes(
        self, q: Configuration | Configurations, times: float | Values, rest_time: float
    ) -> float | None:
        """Time from which the covering spheres do not prove the arm free of the obstacles [s]; None if they
        always do. The arm moves through the configurations q at `times` [s] and then rests for `rest_time`
        [s]. With a single configuration and time, it only rests, from this time on."""
        times = np.append(times, np.max(times) + rest_time) - self._since
        q = np.atleast_2d(q)
        first = self._collision.first_unproved_time(times, np.concatenate([q, q[-1:]]), 0.0)
        return None if first is None else first + self._since


SEARCH_TIME_LIMIT = 10.0
"""Time limit for the first path [s]."""
# Checks that use predictions: resolution of motion checks [m], and time between two rows of a motion [s].
COARSE_RESOLUTION = 0.05
COARSE_SAMPLE_TIME = 0.04
MARGIN_FRACTIONS = 1.0, 0.6, 0.3
"""Fractions of SAFETY_MARGIN that are tried in turn."""
DRIVING_PERIODS = 1, 6
"""Numbers of periods for which the arm accelerates before it brakes, tried in turn. The larger number lets it
leave the neighborhood of an obstacle."""
PREDICTION_DELAYS = 0.3, 0.0, 0.8
"""Successive searches for a path use, in turn, the obstacles as predicted this long after the arm comes to
rest [s]."""
EVASION_OVERHEAD = 0.2
"""Time that an evasion takes in addition to its duration at full speed [s]."""
HORIZON = 2.5
"""How far ahead the obstacles are predicted [s]."""
REST_TIME = 1.0
"""Time for which no obstacle may be predicted to hit the arm where it stops [s]."""
SAFETY_MARGIN = 0.2
"""Predicted obstacles are inflated by what they can travel in this time at their maximum speed [s], if
possible. Closer to an obstacle, hardly any motion can be certified to stop in time."""
ITERATIONS = 600
"""Largest number of iterations of a search for a path; there is at most one search per step."""
EVASIONS = 24
"""Number of random directions that are tried for an evasion: a short move away, if an obstacle is predicted
to hit the arm at rest."""
EVASION_RADIUS = 0.8
"""Length of evasions [rad, joint-space L2]."""
AT_REST = SpeedProfile(np.zeros(2), np.zeros(2))


@dataclass(frozen=True)
class ReplannerSettings(Settings, name="replanner"):
    period: Annotated[float, Bound(least=1e-3, most=1.0)] = 0.02
    """Time between two steps [s]; the motion of a step begins one period after its observation."""
    clearance: NotNegative = 0.005
    """Distance of the covering spheres to every place that the obstacles can reach [m]."""
    sample_time: Annotated[float, Bound(least=1e-3, most=0.1)] = 0.005
    """Time between the rows of the motion that a step returns [s]. The filter makes the arm come to rest
    later, by up to `JerkFilter.lag`, which is at least four times this, also without jerk limits."""
    jerk: Jerk | None = None
    """Jerk limit of every joint [rad/s³] or [m/s³]; None: each joint's own limit, and no limit for a joint
    without one. The default of `rd.plan` for such joints, 10 s⁻¹ times the acceleration limit, would make
    stops much longer."""


@frozen_dataclass
class Command:
    """The motion that the arm shall execute."""

    begins: float
    """When the motion begins [s], on the clock of `now`: one period after the step."""
    motion: Trajectory
    """A motion that ends at rest and is certified until then. Its times count from `begins`."""
    renewed: bool
    """True: the motion was planned in this step; False: it is the remainder of the last motion."""
    arrived: bool
    """Whether the arm rests at a goal."""


class Replanner:
    """Takes an arm to a goal among obstacles that move freely up to a maximum speed.

    The obstacles are `problem.moving`; the maximum speed of each is its `max_speed`, or the largest speed of
    its known motion. The other obstacles are static, and the arm is at rest at the start. Threads may share a
    Replanner: calls wait for each other.
    """

    def __init__(
        self, problem: Problem, settings: ReplannerSettings = ReplannerSettings(), seed: int = 0
    ) -> None:
        """Find the first path, which takes up to 10 s.

        Args:
            problem: The problem, with moving obstacles.
            settings: Period, clearance and limits of the motions.
            seed: Seed of all random numbers, at least 0.

        Raises:
            InputError: For arguments of the wrong type, a negative seed, and a problem without moving
                obstacles, with waypoints, constraints or a payload, with an unusable start or goal, or
                without a path in the static scene.
        """
        check_problem(problem)
        check_type("settings", settings, ReplannerSettings, "ReplannerSettings")
        self._request = PlanRequest(SEARCH_TIME_LIMIT, seed)
        if not problem.moving:
            raise InputError("problem.moving is empty; a Replanner needs moving obstacles")
        for field in ("waypoints", "constraints", "payload"):
            if getattr(problem, field):
                raise InputError(f"Replanner does not support problem.{field}; use rd.plan")
        self.problem = problem
        self.settings = settings
        self.seed = seed
        self._robot = problem.robot
        self._still = replace(problem, moving=())
        self._validator = verifier(self._still)
        self._rng = np.random.default_rng(seed)
        self._seen = {
            obstacle.name: ObservedObstacle(
                MovingObstacle(obstacle.at(0.0), max_speed=obstacle.top_speed), velocity=obstacle.velocity
            )
            for obstacle in problem.moving
        }
        self._now = -np.inf
        self._searches = 0
        self._next: TimedPath | None = None
        jerk = jerk_limits(problem.robot, TimingSettings(jerk=settings.jerk), np.inf)
        self._filter = JerkFilter(problem.robot, jerk, settings.sample_time, problem.start)
        self._path, self._goals, self._space = self._first_path()
        # The current motion along the path, before the filter, and the time when it begins [s].
        self._since = -np.inf
        self._motion = AT_REST
        self._path_obsolete = self._is_goal(problem.start)
        """Whether the arm must not follow the path beyond the end of its current motion: the goal has
        changed, or the arm was at the goal from the start."""
        self._rehearse()

    def _rehearse(self) -> None:
        """Make two steps on a copy, so that the compiled code is loaded before the first step is due."""
        rehearsal = copy(self)
        rehearsal._seen = dict(self._seen)
        rehearsal._rng = np.random.default_rng(self.seed)
        rehearsal._filter = copy(self._filter)
        for k in range(2):
            rehearsal.step({}, k * self.settings.period)

    @locked
    def set_goal(self, goal: ArrayLike | Goal) -> None:
        """Take the arm to another goal, from where its current motion ends. The next steps search for the
        path.

        Args:
            goal: A goal as in `rd.Problem`.

        Raises:
            InputError: For a goal that is not usable in the static scene; the goal is then unchanged.
        """
        rest = self._path.at(self._motion.s[-1])
        problem = replace(self.problem, goal=goal)  # type: ignore[arg-type]
        start_goal = usable_start_goal(
            PlanningContext("replanner", replace(problem, start=rest, moving=()), self._request)
        )
        if isinstance(start_goal, PlanResult):
            raise InputError(f"the replanner cannot take this goal: {start_goal.reason}")
        self.problem = problem
        self._goals = np.array(start_goal.goals)
        self._next = None
        self._path_obsolete = True

    @locked
    def step(self, observation: Mapping[str, ArrayLike], now: float) -> Command:
        """Find the motion that begins one period after `now`, given the obstacles as observed at `now`.

        Args:
            observation: For each observed obstacle, by name, T_base_obstacle [4, 4] or only the origin of its
                frame [3]. An obstacle that is missing may be anywhere that it can have reached since it was
                last seen. One that was never observed counts as seen at the first step, at its pose in the
                problem.
            now: Time of the observation [s]; it must grow from step to step.

        Returns:
            The motion to execute, which ends at rest, and the time at which it begins.

        Raises:
            InputError: For an observation that is no mapping, unknown names, invalid poses, time that is not
                finite or does not grow, and obstacles that were faster than their maximum speed, which voids
                the guarantee.
        """
        clock = numbers(now)
        if clock is None or clock.ndim != 0 or not np.isfinite(clock):
            raise InputError(f"now is {shown(now)}; it must be a finite number of seconds")
        if now <= self._now:
            time, last = distinct(float(clock), self._now)
            raise InputError(
                f"now is {time} s, but the last step was at {last} s; it must grow from step to step"
            )
        self._observe(observation, float(now))
        begins = self._now + self.settings.period
        self._filter.advance(self._path, self._motion, self._since, begins)
        if np.isfinite(self._since):
            self._motion = self._motion.after(begins - self._since)
        self._since = begins
        predicted = self._predict()
        seen = [(observed.obstacle, self._now - observed.time) for observed in self._seen.values()]
        # each obstacle may have moved since it was last seen
        grown = PredictedObstacles(self._robot, [obstacle for obstacle, _ in seen], self._now).wider(
            np.array([obstacle.top_speed * age for obstacle, age in seen])
        )
        clear = self._choose_path(predicted)
        self._change_path()
        renewed = self._next is None and self._extend(predicted, grown, clear)
        motion = self._filter.follow(self._path, self._motion)
        return Command(begins, motion, renewed, self._rests and self._at_goal())

    @property
    def _rests(self) -> bool:
        return bool(self._motion.speeds[0] == 0) and self._filter.at_rest

    @property
    def _rest_time(self) -> float:
        """When the arm comes to rest [s]."""
        return self._since + (0.0 if self._rests else self._motion.duration + self._filter.lag)

    def _is_goal(self, q: Configuration) -> bool:
        off = self._goals - q
        return bool(np.linalg.norm(off - self._robot.whole_turns(off), axis=1).min() < MIN_LENGTH)

    def _at_goal(self) -> bool:
        path = self._path
        s = self._motion.s[0]
        if self._path_obsolete:
            return self._is_goal(path.at(s))
        return bool(path.to_goal and path.then is None and s >= path.end)

    def _first_path(self) -> tuple[TimedPath, Configurations, Space]:
        """The first path, the goal configurations, and the space in which motions are checked."""
        context = PlanningContext("replanner", self._still, self._request)
        start_goal = usable_start_goal(context)
        if isinstance(start_goal, PlanResult):
            raise InputError(f"the replanner cannot begin: {start_goal.reason}")
        search = AnytimeSearch.of(context, start_goal, SearchSettings(), "replanner", bounded=False)
        while search.first() and search.best is not None:
            path = self._certified(start_goal.complete(search.best))
            if path is not None:
                return path, np.array(start_goal.goals), search_space(start_goal.checker, COARSE_RESOLUTION)
            search.refuse(None)
        raise InputError("the replanner cannot begin: no path was found in the static scene")

    def _certified(self, waypoints: Configurations, to_goal: bool = True) -> TimedPath | None:
        """The path through waypoints; None if the validator refuses it, or if its length is below MIN_LENGTH.

        A corner is rounded only if the rounded corner has a clearance of the filter's displacement, since the
        filter moves the arm off the path by up to this distance. At other corners, the arm stops.
        """
        robot = self._robot
        free = self._validator.collision_free
        path = Path(robot.joint_names, waypoints)
        if path.length < MIN_LENGTH or not free(path):
            return None

        contact = max(self._filter.displacement, DEFAULT.contact)
        with_clearance = verifier(self._still, replace(DEFAULT, contact=contact))

        def free_around(q: Configurations) -> bool:
            return with_clearance.collision_free(Path(robot.joint_names, q))

        rows, deviations, _ = time_parameterize(robot, path, free, free, keeps=free_around)
        line = rounded_line(rows, deviations)
        for i in np.flatnonzero(deviations):
            if not free_around(
                line(line.knots[i + 1] + line.half_widths[i] * np.linspace(-1, 1, CORNER_SAMPLES), 0)
            ):
                deviations[i] = 0.0
        stops = [0, *(np.flatnonzero(deviations == 0) + 1).tolist(), len(rows) - 1]
        timed = None
        for first, last in reversed(list(pairwise(stops))):
            part = line_with_widths(rows[first : last + 1], line.half_widths[first : last - 1])
            timed = TimedPath(robot, self._filter.acceleration, part, to_goal, timed)
        return timed

    def _observe(self, observation: Mapping[str, ArrayLike], now: float) -> None:
        if not isinstance(observation, Mapping):
            raise InputError(f"observation is {shown(observation)}; it must map names of obstacles to poses")
        for name in observation:
            check_name("obstacle in observation:", name, self._seen)
        self._seen |= {name: self._seen[name].again(value, now) for name, value in observation.items()}
        self._now = now
        for name, observed in self._seen.items():
            if not np.isfinite(observed.time):
                # never observed: it is now where the problem says
                self._seen[name] = replace(observed, time=now)

    def _predict(self) -> PredictedObstacles:
        """The predicted obstacles, inflated by the largest of MARGIN_FRACTIONS with which none is predicted
        to touch the arm where it is now; not inflated if each of them is too large."""
        moving = [observed.straight_on(self._now) for observed in self._seen.values()]
        speeds = np.array([observed.obstacle.top_speed for observed in self._seen.values()])
        position = self._path.at(self._motion.s[0])
        predicted = PredictedObstacles(self._robot, moving, self._now)
        for share in MARGIN_FRACTIONS:
            inflated = predicted.wider(share * SAFETY_MARGIN * speeds)
            if inflated.comes(position, self._now, self.settings.period) is None:
                return inflated
        return predicted

    def _choose_path(self, predicted: PredictedObstacles) -> bool:
        """Search for another path if the goal has changed, if the chosen path is predicted to be blocked, or
        if the arm rests and the path does not lead to the goal. If none is found and an obstacle is predicted
        to hit the resting arm, choose an evasion. Returns whether the path that was chosen before is
        predicted to be free."""
        rest_time = self._rest_time
        rest = self._path.at(self._motion.s[-1])
        next_path = self._next or self._path
        clear = self._path_clear(predicted, next_path, self._next is None)
        moving = not self._rests or self._motion.duration > 0
        leaves = self._path_obsolete and self._next is None and not self._is_goal(rest)
        if clear and (next_path.to_goal or moving) and not leaves:
            return clear
        candidate = self._search(predicted, rest, rest_time)
        if candidate is not None and self._path_clear(predicted, candidate, False):
            self._next = candidate
        elif not moving and predicted.comes(rest, rest_time, REST_TIME) is not None:
            self._next = self._evasion(predicted, rest, rest_time) or self._next
        return clear

    def _path_clear(self, predicted: PredictedObstacles, path: TimedPath, under_way: bool) -> bool:
        """Whether the arm is predicted to meet no obstacle on a path: within HORIZON, or until it has rested
        at the end for REST_TIME if the motion is shorter. under_way: whether the arm is on this path now;
        if not, it begins the path once it rests."""
        s, speed = (self._motion.s[0], self._motion.speeds[0]) if under_way else (0.0, 0.0)
        begins = self._since if under_way else self._rest_time
        motion = path.advance_then_brake(s, speed)
        times = COARSE_SAMPLE_TIME * np.arange(int(np.ceil(motion.duration / COARSE_SAMPLE_TIME)) + 2)
        soon = times[: max(int(np.searchsorted(times, HORIZON)), 1)]
        rest_time = REST_TIME if len(soon) == len(times) else 0.0
        return predicted.comes(path.positions(motion, soon), soon + begins, rest_time + 1e-3) is None

    def _search(self, predicted: PredictedObstacles, start: Configuration, time: float) -> TimedPath | None:
        """A path from `start`, where the arm rests at `time`, to a goal, around the predicted obstacles. It
        may lead back to a waypoint of the current path from which that path is free to its end. None if no
        path was found."""
        self._searches += 1
        later = time + PREDICTION_DELAYS[self._searches % len(PREDICTION_DELAYS)]
        checker = CollisionChecker(self._robot, added(self._still.scene, predicted.shapes(later)))
        # the last part of the current path that is free: the waypoints after its last blocked segment;
        # without one, all but the first, which is `start`
        old = self._goals[:0]
        if self._path.to_goal and not self._path_obsolete:
            old = self._path.remaining(self._motion.s[-1])
            free = motions_free(search_space(checker, COARSE_RESOLUTION), old.astype(np.float32))
            old = old[1 + np.flatnonzero(~free).max(initial=0) :]
        roots = np.concatenate([self._goals, old[:-1]])
        usable = checker.free(np.vstack([start, roots]))
        if not usable[0] or not usable[1:].any():
            return None
        clearance = min(float(predicted.margin.min()) + self.settings.clearance, MAX_CLEARANCE)
        request = replace(self._request, seed=self.seed + self._searches, clearance=clearance)
        context = PlanningContext("replanner", self._still, request)
        start_goal = StartGoal(checker, start, roots[usable[1:]])
        search = AnytimeSearch.of(context, start_goal, SearchSettings(), "replanner", bounded=False)
        if not search.first(work=ITERATIONS) or search.best is None:
            return None
        path = start_goal.complete(search.best)
        # the root that the search reached: a goal, or a waypoint of the old path, whose rest then follows
        off = path[-1] - roots
        turns = self._robot.whole_turns(off)
        end = int(np.abs(off - turns).max(axis=1).argmin())
        after = old[end - len(self._goals) + 1 :] + turns[end] if end >= len(self._goals) else old[:0]
        return self._certified(np.concatenate([path, after]))

    def _evasion(self, predicted: PredictedObstacles, rest: Configuration, time: float) -> TimedPath | None:
        """A straight path from `rest` to the random configuration at which an obstacle is predicted to arrive
        latest; None if the arm should stay."""
        robot = self._robot
        directions = self._rng.normal(size=(EVASIONS, robot.dof))
        directions *= EVASION_RADIUS / np.linalg.norm(directions, axis=1, keepdims=True)
        ends = np.clip(rest + directions, robot.lower, robot.upper)
        best = np.stack([rest, rest])  # stay: without length, it is not certified
        comes = predicted.comes(rest, time, HORIZON)
        best_time = np.inf if comes is None else comes
        for end in ends:
            line = np.stack([rest, end])
            lasts = float((np.abs(end - rest) / robot.velocity).max()) + EVASION_OVERHEAD
            comes = predicted.comes(line, np.array([time, time + lasts]), HORIZON)
            later = comes is None or comes > best_time
            if later and motions_free(self._space, line.astype(np.float32)).all():
                best = line
                if comes is None:
                    break
                best_time = comes
        return self._certified(best, False)

    def _change_path(self) -> None:
        """If the arm rests, change to `_next`, which replaces the current path; if there is none and the
        current path has ended, change to its continuation."""
        if not self._rests:
            return
        following = self._next
        if following is None and not self._path_obsolete and self._motion.s[0] >= self._path.end:
            following = self._path.then
        if following is not None:
            self._path = following
            self._next = None
            self._motion = AT_REST
            self._path_obsolete = False

    def _extend(self, predicted: PredictedObstacles, grown: PredictedObstacles, clear: bool) -> bool:
        """Extend the motion along the path if the extension is certified. It must also end where no obstacle
        is predicted, unless the path is clear or an evasion. Returns whether the motion was extended."""
        settings = self.settings
        path = self._path
        s = self._motion.s[0]
        speed = self._motion.speeds[0]
        if s >= path.end or self._path_obsolete:
            return False
        for periods in DRIVING_PERIODS:
            extended = path.advance_then_brake(s, speed, periods * settings.period)
            motion = self._filter.follow(path, extended)
            end_time = self._since + motion.duration
            left_alone = clear or predicted.comes(motion.positions[-1], end_time, REST_TIME) is None
            if grown.clear_of(motion, self._since, settings.clearance) and (left_alone or not path.to_goal):
                self._motion = extended
                return True
        return False
