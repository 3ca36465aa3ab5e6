"""What benchmarks try beside planners, as searches that go on: batches of the network and of its control,
refined and shortened as RobotDiffuse does it, and the data factory's planner; all with the same checks.

The control are trajectories that no network made: the straight line and random bumps.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import motions_free, path_length
from robotdiffuse.collision.motions import search_space
from robotdiffuse.evaluation.methods import Search
from robotdiffuse.evaluation.runs import Trial
from robotdiffuse.learning.motion_model import MotionModel
from robotdiffuse.planning.diffusion.hybrid import RobotDiffuse, unlearned_starts
from robotdiffuse.planning.search.shared_tree.planner import SharedTreeSearch, SharedTreeSettings
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.problems.held_out import SEED
from robotdiffuse.problems.problem import JointGoal
from robotdiffuse.trajectories.simplification import shortcut

DRAFT = {"samples": 4, "sampling_steps": 3}
"""Of the network's repeated batches."""
BUMPS = 4
"""Unlearned starts in a repeated batch: as many."""
CLEARANCE, SHORTCUTS = 0.002, 80
"""Distance to obstacles that searches keep where the ends do [m]; attempts to shorten each candidate."""

RESOLUTION = 0.02
"""No point of the arm moves further than this between two checks [m]."""


class Candidates(NamedTuple):
    """Trajectories between the ends of a problem, not yet validated."""

    q: Float[ndarray, "count waypoints dof"]
    free: Bool[ndarray, "count"]
    """Whether the compiled check calls them free."""


class Arena:
    """What all of them share on a problem; not timed."""

    def __init__(self, trial: Trial, planner: RobotDiffuse) -> None:
        problem = trial.problem
        assert isinstance(problem.goal, JointGoal)
        self.planner, self.rng, self.robot = planner, trial.rng(), problem.robot
        self.state = random_state(SEED, trial.place)
        self.checker = CollisionChecker(problem.robot, problem.scene)
        self.start_goal = StartGoal(self.checker, problem.start, problem.goal.positions)
        model = planner.model(problem.robot)
        assert model is not None
        self.model: MotionModel = model
        if self.start_goal.reachable:
            self.start, self.goals = self.start_goal.rows()
            self.clearance = self.start_goal.kept_clearance(CLEARANCE)
            self.space = search_space(self.checker, RESOLUTION, self.clearance)

    def line(self) -> Float[ndarray, "2 dof"] | None:
        """The straight line, if it is free."""
        line = np.stack([self.start, self.goals[0]])
        space = search_space(self.checker, RESOLUTION)
        return line if motions_free(space, line).all() else None

    def code(self) -> Float[ndarray, "code"] | None:
        return self.planner.code(self.model, self.checker, self.rng)

    def sampled(self, planner: RobotDiffuse, code: Float[ndarray, "code"] | None) -> Candidates:
        return self.told(planner.draw(self.model, self.checker, code, self.start, self.goals, self.rng))

    def bumps(self, number: int) -> Float[ndarray, "n waypoints dof"]:
        """The line, and as many random bumps as make up the number."""
        waypoints = self.model.settings.waypoints
        return unlearned_starts(self.start, self.goals[0], number, waypoints, self.robot, self.rng)

    def refined(self, q: Float[ndarray, "n waypoints dof"]) -> Candidates:
        return self.told(self.planner.refine(self.checker, q))

    def told(self, q: Float[ndarray, "n waypoints dof"]) -> Candidates:
        """Trajectories with the verdict of the compiled check."""
        space, q = search_space(self.checker, RESOLUTION), np.ascontiguousarray(q, np.float32)
        return Candidates(q, np.array([motions_free(space, path).all() for path in q]))

    def shortened(self, found: Candidates) -> Iterator[ndarray]:
        """The shortest of the free candidates after shortcuts."""
        settings = self.planner.settings
        for path in sorted(found.q[found.free], key=path_length)[: settings.max_simplified]:
            yield shortcut(self.space, path, SHORTCUTS, self.state)


Tries = Callable[[Arena], Iterator[ndarray | None]]


def search(planner: RobotDiffuse, tries: Tries, line: bool = True) -> Search:
    """A search as trials call it; `line`: the straight line is the answer wherever it is free."""

    def begin(trial: Trial) -> Iterator[ndarray | None]:
        arena = Arena(trial, planner)
        if not arena.start_goal.reachable:
            return iter(())
        straight = arena.line() if line else None
        paths = tries(arena) if straight is None else iter([straight])
        return (path if path is None else arena.start_goal.complete(path) for path in paths)

    return begin


def _one_batch(arena: Arena) -> Candidates:
    """Samples of the network, refined if none is free."""
    found = arena.sampled(arena.planner, arena.code())
    return found if found.free.any() else arena.refined(found.q)


def network(arena: Arena) -> Iterator[ndarray | None]:
    """As RobotDiffuse plans without its searches: one batch, refined if none of it is free, shortcuts."""
    yield from arena.shortened(_one_batch(arena))


def as_sampled(arena: Arena) -> Iterator[ndarray | None]:
    """The same without the shortcuts."""
    found = _one_batch(arena)
    yield from found.q[found.free]


def bumps(number: int) -> Tries:
    """The control of `network`: one batch of so many."""

    def tries(arena: Arena) -> Iterator[ndarray | None]:
        yield from arena.shortened(arena.refined(arena.bumps(number)))

    return tries


def as_refined(arena: Arena) -> Iterator[ndarray | None]:
    """The control of `as_sampled`."""
    found = arena.refined(arena.bumps(arena.planner.settings.samples))
    yield from found.q[found.free]


def network_repeated(arena: Arena) -> Iterator[ndarray | None]:
    """Small batches of samples from few steps, refined, shortened, without end."""
    draft = RobotDiffuse(replace(arena.planner.settings, weights=None, **DRAFT))
    code = arena.code()
    while True:
        found = arena.sampled(draft, code)
        if not found.free.all():
            found = arena.refined(found.q)
        yield None
        yield from arena.shortened(found)


def bumps_repeated(arena: Arena) -> Iterator[ndarray | None]:
    """The control: the line and fresh bumps, without end."""
    q = arena.bumps(BUMPS)
    while True:
        found = arena.refined(q)
        yield None
        yield from arena.shortened(found)
        q = arena.bumps(BUMPS + 1)[1:]  # the line would give the same again


def shared_tree(arena: Arena) -> Iterator[ndarray | None]:
    """The anytime planner of the data factory, of which a round is some RRT-Connect and RRT*."""
    settings = SharedTreeSettings(
        safety_distance=arena.clearance,
        steps=1,
        improvement=0.0,
        resolution=RESOLUTION,
    )
    found = SharedTreeSearch(arena.checker, arena.start, arena.goals, settings, arena.state)
    best = np.inf
    while not found.finished:
        found.round()
        yield found.path() if found.cost < best else None
        best = min(best, found.cost)
