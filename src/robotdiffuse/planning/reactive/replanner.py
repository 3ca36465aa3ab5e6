"""Reacting to obstacles of which only the position now and a greatest speed are known, at 50 Hz.

**What is promised.** Whatever `Replanner.step` returns is a motion that ends at rest, and that is certified
until it rests: no point of the arm comes near a place where an obstacle can be by then, wherever it goes
from where it was last seen, no faster than its greatest speed (`collision/moving_obstacles.py`); the path itself passed
the validator among what stands still and of the arm with itself. When no such motion goes on, the last one is
kept, which was certified too. An arm at rest may be run into: what comes is told to be no slower than it
likes, and may corner any arm. The loop gives way before that where it sees it coming.

**What is guessed.** Which way to go is settled by where the obstacles will be if they keep the velocity that
was last seen. Nothing that is promised rests on it.
"""

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from numbers import Integral
from typing import Annotated

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import Space, motions_free
from robotdiffuse.collision.motions import search_space
from robotdiffuse.collision.moving_obstacles import MovingCollision
from robotdiffuse.core.bounds import numbers, rigid_transform, within
from robotdiffuse.core.errors import InputError, check_type, shown, unknown_name
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Count, NotNegative, Positive, Settings
from robotdiffuse.core.transforms import inverse, rotation_angle, transform
from robotdiffuse.core.types import Trajectory
from robotdiffuse.planning.context import PlanningContext, Request
from robotdiffuse.planning.reactive.timed_path import Course, Speeds
from robotdiffuse.planning.search.anytime import AnytimeSearch, SearchSettings
from robotdiffuse.planning.start_goal import StartGoal, usable_start_goal
from robotdiffuse.problems.problem import Problem, check_problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.moving_obstacles import MovingObstacle
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shape_transforms import placed
from robotdiffuse.scenes.shapes import Shape
from robotdiffuse.validation.validator import verifier

SLACK = 1e-3
"""What an obstacle may seem to have moved beyond its greatest speed, as observations are not exact [m]."""
FIRST_TIME = 10.0
"""For the first path [s]."""
COARSE, COARSE_TIME = 0.05, 0.04
"""No point of the arm moves further between two looks at a guess [m]; time between two rows of one [s]."""
BERTHS = 1.0, 0.6, 0.3
"""Shares of the berth that are tried."""
PERIODS = 1, 6
"""So long the arm goes on at least before it stops; the longer gets it away from what is near already."""
LATER = 0.3, 0.0, 0.8
"""After it rests, a search takes the obstacles as they are guessed to be then [s], in turn."""
DODGE_TIME = 0.2
"""What a way out takes beyond its length at full speed [s]."""
RESTING = Speeds(np.zeros(2), np.zeros(2))


@dataclass(frozen=True)
class ReplannerSettings(Settings, name="replanner"):
    period: Annotated[float, Bound(least=1e-3, most=1.0)] = 0.02
    """Time between two steps [s]: what a step returns begins so long after its observation."""
    clearance: NotNegative = 0.005
    """Kept to where the obstacles can be [m], by the covering spheres."""
    horizon: Positive = 2.5
    """How far ahead guesses go [s]."""
    hold: Positive = 1.0
    """Where the arm stops it is to be left alone for so long, by the guess [s]."""
    berth: NotNegative = 0.2
    """Guesses keep away from obstacles as far as these can get at their greatest speed in so long [s], where
    that is possible: nearer to one the arm has hardly any motion that is certified to stop in time."""
    iterations: Count = 600
    """Of a search for a path; there is at most one a step."""
    dodges: Count = 24
    """Directions in which a way out is looked for, when the arm rests where something comes."""
    dodge: Positive = 0.8
    """Length of the ways out [rad, joint-space L2]."""
    sample_time: Annotated[float, Bound(least=1e-3, most=0.1)] = 0.01
    """Time between the rows of what a step returns [s]."""
    from_scratch: bool = False
    """Whether each step searches for a whole new path, whatever becomes of the old one: the control."""


@dataclass(frozen=True, eq=False)
class Command:
    """What the arm is to do."""

    begins: float
    """When the motion begins [s], on the clock of `now`: a period after the step."""
    motion: Trajectory
    """Certified until it ends at rest. Its times count from `begins`."""
    renewed: bool
    """Whether it goes further than the last one did; else it is the rest of that."""
    arrived: bool
    """Whether the arm rests at a goal."""


class Replanner:
    """A loop that takes an arm to a goal among obstacles that move as they like, up to a greatest speed.

    `problem.moving` are the obstacles: each with its `max_speed`, or the greatest of its known motion. The
    scene is what stands still, the start where the arm rests.
    """

    def __init__(
        self, problem: Problem, settings: ReplannerSettings = ReplannerSettings(), seed: int = 0
    ) -> None:
        """Finds the first path. Raises InputError for a problem without moving obstacles, and for one that
        has no path among what stands still."""
        check_problem(problem)
        check_type("settings", settings, ReplannerSettings, "ReplannerSettings")
        if not isinstance(seed, Integral) or seed < 0:
            raise InputError(f"seed is {shown(seed)}; it must be a whole number, at least 0")
        if not problem.moving:
            raise InputError("problem.moving is empty; a Replanner needs obstacles that move")
        for what in ("waypoints", "constraints", "payload"):
            if getattr(problem, what):
                raise InputError(f"problem.{what}: the replanner knows of none; rd.plan does")
        self.problem, self.settings, self.seed = problem, settings, seed
        self._robot, self._still = problem.robot, replace(problem, moving=())
        self._validator = verifier(self._still)
        self._rng = np.random.default_rng(seed)
        self._seen = {one.name: _Seen(one) for one in problem.moving}
        self._now, self._searches = -np.inf, 0
        self._next: Course | None = None
        self._course, self._goals, self._space = self._begun()
        self._since, self._left = -np.inf, RESTING
        """The motion that is under way: along the course, from this time on."""

    def step(self, observation: Mapping[str, ArrayLike], now: float) -> Command:
        """What to do from a period after `now` [s] on, having seen the obstacles at `now`.

        `observation` holds T_base_obstacle [4, 4], or only the origin of its frame [3], by name; one that is
        not seen may be anywhere that it can have got to since.

        Raises InputError for unknown names, poses that are none, obstacles that were faster than their
        greatest speed, which voids what was promised, and time that does not go on.
        """
        clock = numbers(now)
        if clock is None or clock.ndim != 0 or not np.isfinite(clock):
            raise InputError(f"now is {shown(now)}; it must be a finite number of seconds")
        if now <= self._now:
            raise InputError(f"now is {now:g} s after {self._now:g} s; time must go on from step to step")
        self._observe(observation, float(now))
        begins = self._now + self.settings.period
        if np.isfinite(self._since):
            self._left = self._left.rest(begins - self._since)
        self._since = begins
        oldest = min(seen.time for seen in self._seen.values())
        guess = self._guess()
        grown = _Ahead(self._robot, [seen.anywhere() for seen in self._seen.values()], oldest)
        clear = self._choose(guess)
        self._change_course()
        renewed = self._next is None and self._goes_on(guess, grown, clear)
        motion = self._course.rows(self._left, self.settings.sample_time)
        course, at_rest = self._course, self._left.speeds[0] == 0
        arrived = at_rest and course.to_goal and course.then is None and self._left.s[0] >= course.end
        return Command(begins, motion, renewed, bool(arrived))

    def _begun(self) -> tuple[Course, Float[ndarray, "k dof"], Space]:
        """The first course, the configurations of the goal, and what motions are checked in."""
        context = PlanningContext("replanner", self._still, FIRST_TIME, self.seed)
        start_goal = usable_start_goal(context)
        if isinstance(start_goal, PlanResult):
            raise InputError(f"the replanner cannot begin: {start_goal.reason}")
        search = AnytimeSearch(context, start_goal, SearchSettings(), "replanner", bounded=False)
        while search.first(context.search_until) and search.best is not None:
            course = Course.certified(self._robot, self._validator, start_goal.complete(search.best), True)
            if course is not None:
                return course, np.array(start_goal.goals), search_space(start_goal.checker, COARSE)
            search.refuse(None)
        raise InputError("the replanner cannot begin: no path was found among what stands still")

    def _observe(self, observation: Mapping[str, ArrayLike], now: float) -> None:
        if not isinstance(observation, Mapping):
            raise InputError(f"observation is {shown(observation)}; it must be poses by names of obstacles")
        for name in observation:
            if name not in self._seen:
                raise unknown_name("obstacle in observation:", str(name), self._seen)
        seen = {name: self._seen[name].again(value, now) for name, value in observation.items()}
        self._seen |= seen
        self._now = now
        for name, one in self._seen.items():
            if not np.isfinite(one.time):
                self._seen[name] = replace(one, time=now)  # until then it is where the problem says

    def _guess(self) -> "_Ahead":
        """Where the obstacles will be, with as much of the berth as the arm has now."""
        moving = [seen.straight_on(self._now) for seen in self._seen.values()]
        speeds = np.array([seen.obstacle.greatest_speed for seen in self._seen.values()])
        here = self._course.at(float(self._left.s[0]))
        guess = _Ahead(self._robot, moving, self._now)
        for share in BERTHS:
            wide = guess.wider(share * self.settings.berth * speeds)
            if wide.comes(here, self._now, self.settings.period) is None:
                return wide
        return guess

    def _choose(self, guess: "_Ahead") -> bool:
        """Look for another course where something is guessed to come in the way of this one; whether
        nothing is in the way of that which the arm is on."""
        settings = self.settings
        rest_time, rest = self._since + self._left.duration, self._course.at(float(self._left.s[-1]))
        ahead = self._course if self._next is None else self._next
        clear = self._clear(guess, ahead, self._next is None)
        moving = self._left.duration > 0
        done = clear and (ahead.to_goal or moving)
        if done and not settings.from_scratch:
            return clear
        found = self._searched(guess, rest, rest_time)
        if done:
            return clear
        if found is not None and guess.free(
            found.rows(found.onwards(0.0, 0.0), COARSE_TIME), rest_time, settings
        ):
            self._next = found
        elif not moving and guess.comes(rest, rest_time, settings.hold) is not None:
            self._next = self._dodge(guess, rest, rest_time) or self._next
        return clear

    def _clear(self, guess: "_Ahead", course: Course, under_way: bool) -> bool:
        """Whether the arm can go on to the end of a course, by the guess."""
        s, speed = (float(self._left.s[0]), float(self._left.speeds[0])) if under_way else (0.0, 0.0)
        begins = self._since if under_way else self._since + self._left.duration
        motion = course.rows(course.onwards(s, speed), COARSE_TIME)
        return guess.free(motion, begins, self.settings)

    def _searched(self, guess: "_Ahead", start: Float[ndarray, "dof"], time: float) -> Course | None:
        """A course from where the arm can rest to a goal, around the obstacles as they will be some time
        after that; or back to the course that it is on, from where that is free."""
        settings, self._searches = self.settings, self._searches + 1
        later = time + LATER[self._searches % len(LATER)]
        checker = CollisionChecker(self._robot, Scene([*self._still.scene.shapes, *guess.shapes(later)]))
        roots, after = list(self._goals), [np.zeros((0, self._robot.dof))] * len(self._goals)
        if self._course.to_goal and not settings.from_scratch:
            old = self._course.remaining(float(self._left.s[-1]))
            free = motions_free(search_space(checker, COARSE), old.astype(np.float32))
            first = len(free) - int(np.argmin(free[::-1])) if not free.all() else 1
            roots += list(old[first:-1])
            after += [old[i + 1 :] for i in range(first, len(old) - 1)]
        usable = checker.free(np.array([start, *roots]))
        if not usable[0] or not usable[1:].any():
            return None
        chosen = np.array([root for root, free in zip(roots, usable[1:], strict=True) if free])
        request = Request(clearance=float(guess.berth.min()) + settings.clearance)
        context = PlanningContext("replanner", self._still, FIRST_TIME, self.seed + self._searches, request)
        search = AnytimeSearch(
            context, StartGoal(checker, start, chosen), SearchSettings(), "replanner", bounded=False
        )
        if not search.first(FIRST_TIME, work=settings.iterations) or search.best is None:
            return None
        path = search.start_goal.complete(search.best)
        end = int(np.abs(np.array(roots) - path[-1]).max(axis=1).argmin())
        return Course.certified(self._robot, self._validator, np.concatenate([path, after[end]]), True)

    def _dodge(self, guess: "_Ahead", rest: Float[ndarray, "dof"], time: float) -> Course | None:
        """A straight way to where nothing comes for longest, by the guess; None where that is here."""
        settings, robot = self.settings, self._robot
        ways = self._rng.normal(size=(settings.dodges, robot.dof))
        ways *= settings.dodge / np.linalg.norm(ways, axis=1, keepdims=True)
        start_goal = np.clip(rest + ways, robot.lower, robot.upper)
        best, best_time = None, guess.comes(rest, time, settings.horizon) or np.inf
        for end in start_goal:
            lasts = float((np.abs(end - rest) / robot.velocity).max()) + DODGE_TIME
            comes = guess.comes_to(np.stack([rest, end]), np.array([time, time + lasts]), settings.horizon)
            if comes is not None and comes <= best_time:
                continue
            if not motions_free(self._space, np.stack([rest, end]).astype(np.float32)).all():
                continue
            best, best_time = end, np.inf if comes is None else comes
            if comes is None:
                break
        if best is None:
            return None
        return Course.certified(robot, self._validator, np.stack([rest, best]), False)

    def _change_course(self) -> None:
        """At rest, onto the next course, or what follows the one that the arm is on."""
        if self._left.speeds[0] > 0:
            return
        if self._next is not None:
            self._course, self._next, self._left = self._next, None, RESTING
        elif self._course.then is not None and self._left.s[0] >= self._course.end:
            self._course, self._left = self._course.then, RESTING

    def _goes_on(self, guess: "_Ahead", grown: "_Ahead", clear: bool) -> bool:
        """Go further than so far, where that is certified and makes sense."""
        settings, course = self.settings, self._course
        s, speed = float(self._left.s[0]), float(self._left.speeds[0])
        if s >= course.end:
            return False
        for periods in PERIODS:
            further = course.on_then_rest(s, speed, periods * settings.period)
            motion = course.rows(further, settings.sample_time)
            rests = self._since + motion.duration
            left_alone = clear or guess.comes(motion.positions[-1], rests, settings.hold) is None
            certified = grown.near(motion, self._since, settings.clearance) is None
            if certified and (left_alone or not course.to_goal):
                self._left = further
                return True
        return False


@dataclass(frozen=True, eq=False)
class _Seen:
    """An obstacle as it was seen last."""

    obstacle: MovingObstacle
    """As the problem has it, or standing where it was seen."""
    time: float = np.nan
    velocity: Float[ndarray, "3"] | None = None

    def again(self, value: ArrayLike, now: float) -> "_Seen":
        """Seen anew."""
        name, T_before = self.obstacle.name, placed(self.obstacle.shape)
        xyz = numbers(value)
        if xyz is not None and xyz.shape == (3,) and within(xyz):
            T = transform(xyz, T_before[:3, :3])
        else:
            T = rigid_transform(f"observation[{name!r}]", value)
        most = self.obstacle.greatest_speed
        velocity = self.obstacle.velocity
        if np.isfinite(self.time):
            passed = now - self.time
            moved = np.linalg.norm(T[:3, 3] - T_before[:3, 3])
            moved += self.obstacle.radius * rotation_angle(T_before[:3, :3].T @ T[:3, :3])
            if moved > most * passed + SLACK:
                raise InputError(
                    f"observation[{name!r}] is {moved:.3g} m from where it was {passed:.3g} s ago; its "
                    f"greatest speed {most:g} m/s allows {most * passed:.3g} m"
                )
            velocity = (T[:3, 3] - T_before[:3, 3]) / passed
        shape = self.obstacle.shape.moved(T @ inverse(T_before))
        return _Seen(MovingObstacle(shape, max_speed=most), now, velocity)

    def anywhere(self) -> MovingObstacle:
        """From when it was seen on, in any way."""
        return MovingObstacle(self.obstacle.shape, max_speed=self.obstacle.greatest_speed)

    def straight_on(self, now: float) -> MovingObstacle:
        """From now on, as it moved when it was seen."""
        velocity = np.zeros(3) if self.velocity is None else self.velocity
        passed = transform((now - self.time) * velocity)
        return MovingObstacle(self.obstacle.shape.moved(passed), velocity=velocity)


class _Ahead:
    """Obstacles as they will be, from a time on."""

    def __init__(self, robot: Robot, moving: list[MovingObstacle], since: float) -> None:
        self._moving, self._since = moving, since
        self._collision = MovingCollision(robot, moving, 0.0, 0.0)
        self.berth = np.zeros(len(moving))

    def wider(self, berth: Float[ndarray, "obstacles"]) -> "_Ahead":
        """The same, each obstacle larger by so much [m]."""
        other = copy(self)
        other.berth = self.berth + berth
        other._collision = self._collision.wider(berth)
        return other

    def shapes(self, time: float) -> list[Shape]:
        """Where they are."""
        return [one.at(time - self._since) for one in self._moving]

    def near(self, motion: Trajectory, begins: float, clearance: float) -> float | None:
        """When they first may come nearer than the clearance, None if they do not."""
        times = motion.times + (begins - self._since)
        first = self._collision.covered_free(times, motion.positions, clearance)
        return None if first is None else first + self._since

    def comes_to(self, q: Float[ndarray, "n dof"], times: Float[ndarray, "n"], hold: float) -> float | None:
        """When something first comes to the arm on its way, or where it rests for some time then."""
        times = np.append(times, times[-1] + hold) - self._since
        first = self._collision.covered_free(times, np.concatenate([q, q[-1:]]), 0.0)
        return None if first is None else first + self._since

    def comes(self, q: Float[ndarray, "dof"], time: float, hold: float) -> float | None:
        """When something first comes to the arm at rest."""
        return self.comes_to(q[None], np.array([time]), hold)

    def free(self, motion: Trajectory, begins: float, settings: ReplannerSettings) -> bool:
        """Whether nothing comes to the arm up to the horizon, or until it has rested at the end for a bit."""
        soon = max(int(np.searchsorted(motion.times, settings.horizon)), 1)
        times = motion.times[:soon] + begins
        hold = settings.hold if soon == len(motion.times) else 0.0
        return self.comes_to(motion.positions[:soon], times, hold + 1e-3) is None
