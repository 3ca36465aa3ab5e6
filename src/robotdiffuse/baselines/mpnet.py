"""MPNet: a network proposes states from the start and from the goal in turn, until a free straight line
connects both sides. Then it proposes new states in place of states that collide.

A. Qureshi, Y. Miao, A. Simeonov and M. Yip, "Motion Planning Networks: Bridging the Gap Between
Learning-based and Classical Motion Planners", T-RO 2020. The networks are in `learning.mpnet`. The algorithm
has these parts, by the paper's names:

- *Bidirectional neural planning* (`NeuralPlanning.between`): start and goal side grow towards each other,
  until the straight line between their last states is free. Motions between earlier states are not checked.
- *Lazy states contraction*: states that a free straight line can skip are removed.
- *Replanning*: states in collision are removed, and neural planning runs again between neighboring states
  without a free straight line, up to `replanning` times. The network's dropout makes each run different.
- *Hybrid replanning*, if `hybrid` is on: a classical planner replaces the parts that still collide, here
  RRT-Connect (paper: RRT*). It is off by default, as in the paper's MPNetPath:NR, so that benchmarks measure
  the network.

Differences from the paper: `attempts` paths are planned at once, in one batch of the network, until one of
them is free; the paper plans one path. New attempts begin until time runs out. If the network does not
connect two states, the next replanning tries again; in the paper, the attempt ends there. Attempts are
divided evenly among several goals.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy import ndarray

from robotdiffuse.collision.kernels.motions import motions_free
from robotdiffuse.collision.kernels.random import random_state
from robotdiffuse.collision.motions import finer_resolution
from robotdiffuse.core.settings import Count, Natural, NotNegative, Positive
from robotdiffuse.core.types import Configurations, PlanResult
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.learned import Attempt, LearnedPlanner, LearnedSettings, ranked, scene_clouds
from robotdiffuse.planning.search import rrt_kernel
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.trajectories.simplification import simplify

if TYPE_CHECKING:
    from robotdiffuse.learning.mpnet import MPNetNetwork

SEARCH_ITERATIONS = 500
"""Number of iterations of RRT-Connect between two readings of the clock, in hybrid replanning."""
SEARCH_CAPACITY = 20_000
"""Largest number of states in a tree of RRT-Connect, in hybrid replanning."""
SEARCH_RANGE = np.float32(1.0)
"""Longest extension of a tree of RRT-Connect, in hybrid replanning [rad, joint-space L2]."""


@dataclass(frozen=True)
class MPNetPlannerSettings(LearnedSettings, name="mpnet"):
    attempts: Count = 16
    """Number of paths that are planned at once (paper: 1)."""
    steps: Count = 24
    """Largest number of steps, of about 0.7 rad each, of bidirectional planning between two states."""
    replanning: Natural = 10
    """The paper's N_r: how often colliding parts are replanned before the attempts are given up."""
    hybrid: bool = False
    """Whether RRT-Connect replaces the parts that still collide after replanning."""
    resolution: Positive = 0.03
    """No point of the arm moves further than this between neighboring checked configurations [m]; the
    validator certifies the motion in between. The resolution is halved, down to 2 mm, after each path that
    the validator refuses."""
    clearance: NotNegative = 0.002
    """Distance to obstacles that paths keep where start and goal allow it [m]."""


class MPNet(LearnedPlanner[MPNetPlannerSettings]):
    """Motion Planning Networks as a planner."""

    name = network_name = "mpnet"
    settings_class = MPNetPlannerSettings

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        network = self.network(context.problem.robot)
        settings = self.settings
        best: Attempt | None = None
        rounds = 0
        while rounds == 0 or context.remaining > 0:
            planning = NeuralPlanning(context, start_goal, network, settings)
            candidate = planning.best()
            rounds += 1
            if candidate.broken == 0:
                methods = ", then RRT-Connect" if planning.searched else ""
                reason = (
                    f"solved by {self.name}: round {rounds}; neural replannings: {planning.replanned}"
                    f"{methods}"
                )
                result = context.finish(start_goal.complete(candidate.path), self.name, reason)
                if result is not None:
                    return result
                settings = replace(settings, resolution=finer_resolution(settings.resolution))
            elif best is None or candidate.broken < best.broken:
                best = candidate
        # the validator may accept it nevertheless: covering spheres are larger than the meshes
        result = None if best is None else context.finish(start_goal.complete(best.path), self.name)
        remedy = "a longer time limit" if settings.hybrid else "a longer time limit or hybrid replanning"
        return result or context.unsolved(
            f"no path of the network was valid in {context.elapsed:.2f} s (rounds: {rounds}); {remedy} "
            "may find one"
        )


class NeuralPlanning:
    """One round: several attempts that are planned together."""

    def __init__(
        self,
        context: PlanningContext,
        start_goal: StartGoal,
        network: "MPNetNetwork",
        settings: MPNetPlannerSettings,
    ) -> None:
        rng = context.rng
        self.context = context
        self.network = network
        self.settings = settings
        self.space = start_goal.space(settings.resolution, settings.clearance)
        self.generator = network.generator(int(rng.integers(2**63)))
        self.state = random_state(int(rng.integers(2**31)))
        start, goals = start_goal.leads()
        self.starts = np.tile(start, (settings.attempts, 1))
        self.goals = goals[(np.arange(settings.attempts) + rng.integers(len(goals))) % len(goals)]
        [cloud] = scene_clouds(start_goal.checker, network.region, network.settings.points, 1, rng)
        self.z = network.code_of(cloud)
        self.replanned = 0
        """How often colliding parts were replanned."""
        self.searched = False
        """Whether RRT-Connect was used."""

    def best(self) -> Attempt:
        """The shortest free path, or the path with the fewest segments in collision."""
        attempts = self.contracted(self.between(self.starts, self.goals, True))
        while attempts[0].broken and self.context.remaining > 0:
            if self.replanned == self.settings.replanning:
                break
            self.replanned += 1
            attempts = self.contracted(self.replan([attempt.path for attempt in attempts], self.between))
        if self.settings.hybrid and attempts[0].broken:
            self.searched = True
            attempts = self.contracted(self.replan([attempts[0].path], self.searched_between))
        return attempts[0]

    def contracted(self, paths: list[Configurations]) -> list[Attempt]:
        """The paths after lazy states contraction, without states that free straight lines can skip; the best
        first."""
        return ranked(self.space, [simplify(self.space, path, 0) for path in paths])

    def between(
        self, starts: Configurations, goals: Configurations, stop_at_free: bool = False
    ) -> list[Configurations]:
        """Bidirectional neural planning of many motions at once.

        With `stop_at_free`, planning stops as soon as one motion is free. A motion whose two sides were not
        connected contains a segment in collision. Connected motions may also contain collisions, since their
        other segments are not checked.
        """
        start_sides = [[q] for q in starts]
        goal_sides = [[q] for q in goals]
        near = start_sides
        far = goal_sides
        unconnected = list(range(len(starts)))
        for _ in range(self.settings.steps):
            if not unconnected or self.context.remaining <= 0:
                break
            q, goal = (np.stack([rows[i][-1] for i in unconnected]) for rows in (near, far))
            states = self.network.proposals(self.z, q, goal, self.generator)
            for i, state in zip(unconnected, states, strict=True):
                near[i].append(state)
            ends = {i: np.stack([near[i][-1], far[i][-1]]) for i in unconnected}
            connected = [i for i in unconnected if motions_free(self.space, ends[i])[0]]
            if stop_at_free and any(
                motions_free(self.space, _joined(start_sides[i], goal_sides[i])).all() for i in connected
            ):
                break
            unconnected = [i for i in unconnected if i not in connected]
            near, far = far, near
        return [_joined(*rows) for rows in zip(start_sides, goal_sides, strict=True)]

    def replan(
        self,
        paths: list[Configurations],
        connect: Callable[[Configurations, Configurations], list[Configurations]],
    ) -> list[Configurations]:
        """The paths without their states in collision. Where the straight line between two remaining states
        is not free, `connect` plans a path between them: `between` or `searched_between`."""
        free_states = [self.without_collisions(path) for path in paths]
        broken = [
            (a, int(i))
            for a, path in enumerate(free_states)
            for i in np.flatnonzero(~motions_free(self.space, path))
        ]
        if not broken:
            return free_states
        starts, goals = (np.stack([free_states[a][i + end] for a, i in broken]) for end in (0, 1))
        connections = dict(zip(broken, connect(starts, goals), strict=True))
        return [
            np.concatenate(
                [path[:1]]
                + [
                    connections[a, i][1:] if (a, i) in connections else path[i + 1, None]
                    for i in range(len(path) - 1)
                ]
            )
            for a, path in enumerate(free_states)
        ]

    def searched_between(self, starts: Configurations, goals: Configurations) -> list[Configurations]:
        """Free paths by RRT-Connect; straight lines where time or SEARCH_CAPACITY runs out."""
        paths = list[Configurations]()
        for ends in np.stack([starts, goals], axis=1):
            trees = rrt_kernel.make_trees(ends[0], ends[1:], SEARCH_CAPACITY)
            path = ends[:0]
            while not len(path) and self.context.remaining > 0 and trees.sizes.max() < SEARCH_CAPACITY:
                path = rrt_kernel.search(
                    self.space, None, trees, rrt_kernel.INFINITE, SEARCH_RANGE, SEARCH_ITERATIONS, self.state
                )
            paths.append(path if len(path) else ends)
        return paths

    def without_collisions(self, path: Configurations) -> Configurations:
        """The path without its colliding states; the first and the last state are kept."""
        # a motion from a state to itself checks that state
        free = motions_free(self.space, np.repeat(path, 2, axis=0))[::2]
        free[[0, -1]] = True
        return path[free]


def _joined(forth: list[ndarray], back: list[ndarray]) -> Configurations:
    return np.stack([*forth, *back[::-1]])
