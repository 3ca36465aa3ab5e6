"""A* and D* Lite on a lattice of configurations: the classical graph searches, as baselines.

A*: P. Hart, N. Nilsson and B. Raphael, "A formal basis for the heuristic determination of minimum cost
paths", IEEE Trans. SSC 1968. D* Lite: S. Koenig and M. Likhachev, "D* Lite", AAAI 2002, optimized version.

The lattice. In each planned joint, nodes lie whole steps of `spacing` from the start. Edges change one joint
by a step (or up to `joints_per_move` joints); their cost is joint-space length [rad]. The corners of the cell
around a goal are connected to it by exact last edges. Nodes and edges are created and checked when a search
reaches them. The result is the path along the lattice, without shortcuts.

Limits, with seven joints. A node has 14 neighbours, or 2,186 if all joints may move at once, and a spacing of
0.3 rad makes 10^9 nodes. The heuristic ignores obstacles: before the search leaves one, it fills the whole
pocket in front of it, whose size grows with the seventh power of its width. With inflation 1 it also expands
every node whose straight-line estimate is below the cost, and all orders of the same steps are ties. So
optimal search is fast only where the path is nearly straight; inflation trades length for speed. Passages
narrower than a step are not found: no path on the lattice does not mean no path. A path of single-joint steps
is a staircase, up to sqrt(dof) times as long as the straight line that it follows.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from itertools import combinations, product
from math import ceil, comb, sqrt
from typing import Annotated, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.motions import FINEST_RESOLUTION, largest_motion_radii, search_space
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Count, NotNegative, Positive, Settings
from robotdiffuse.core.types import Status
from robotdiffuse.planning.baselines.lattice import graph as lattice_graph
from robotdiffuse.planning.baselines.lattice import kernel, table
from robotdiffuse.planning.baselines.lattice.graph import UNITS, Lattice
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.planner import Planner, ever_finer
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

CLOCK_INTERVAL = 4000
"""Approximate number of edges between two readings of the clock; some take 10 microseconds."""
MAX_MOVES = 100_000
"""Largest number of edges of a node."""
MAX_NODE_KEYS = 2**62
"""Largest number of nodes of a lattice."""
ROUNDING = 1e-4
"""Bound on rounding errors of single precision [m]."""
LIMIT_MARGIN = 1e-9
"""Distance of the lattice from the joint limits [steps]."""


@dataclass(frozen=True)
class LatticeSettings(Settings):
    spacing: Positive = 0.4
    """Step of the lattice [rad], [m] for prismatic joints."""
    joints_per_move: Count = 1
    """Largest number of joints that an edge moves, each by one step."""
    max_nodes: Annotated[int, Bound(least=1.0, below=2.0**31 - 1)] = 2_000_000
    """Largest number of nodes in memory; each takes 60 to 80 bytes, more with `joints_per_move`."""
    resolution: Positive = 0.05
    """No point of the arm moves further than this between two checks of an edge [m]; after a path that the
    validator refuses, the search starts again at half the distance."""
    clearance: NotNegative = 0.002
    """Distance to obstacles that paths keep where start and goal allow it [m]."""


@dataclass(frozen=True)
class AStarSettings(LatticeSettings, name="a_star"):
    joints_per_move: Count = 2
    """See LatticeSettings. Higher values make paths shorter (2.1, 1.6, 1.35 and 1.2 times the straight line
    with 1, 2, 3 and 7 on ROP problems) and the search slower: an expansion checks up to 14, 98, 378 and 2,186
    edges."""
    inflation: Annotated[float, Bound(least=1.0, most=1000.0)] = 1.5
    """Factor on the heuristic (weighted A*): paths are at most this much longer than the shortest of the
    lattice; 1 finds the shortest, with seven joints often not in time."""


@dataclass(frozen=True)
class DStarLiteSettings(LatticeSettings, name="d_star_lite"):
    """No inflation: repairs are right only with a consistent heuristic."""


LatticePlannerSettings = TypeVar("LatticePlannerSettings", bound=LatticeSettings)


class Outcome(Enum):
    """State of a search."""

    GOING = kernel.GOING
    """Stopped; it can be continued."""
    FOUND = kernel.FOUND
    EXHAUSTED = kernel.EXHAUSTED
    """No path on the lattice."""
    FULL = kernel.FULL
    """`max_nodes` nodes are in use."""


class _Graph(NamedTuple):
    lattice: Lattice
    lowest: Float[ndarray, "dof"]
    highest: Float[ndarray, "dof"]
    """The joint limits."""
    start_key: int

    def configurations(self, keys: Int[ndarray, "n"]) -> Float[ndarray, "n dof"]:
        """The nodes' joint positions."""
        at = keys[:, None] // self.lattice.strides % self.lattice.counts
        return np.clip(self.lattice.origin + self.lattice.spacing * at, self.lowest, self.highest)


def _make_graph(
    robot: Robot, start: Float[ndarray, "dof"], goals: Float[ndarray, "k dof"], settings: LatticeSettings
) -> _Graph:
    spacing, lower, upper = settings.spacing, robot.lower.astype(float), robot.upper.astype(float)
    start = start.astype(np.float64)
    below = np.maximum(np.floor((start - lower) / spacing - LIMIT_MARGIN), 0).astype(np.int64)
    above = np.maximum(np.floor((upper - start) / spacing - LIMIT_MARGIN), 0).astype(np.int64)
    counts = below + above + 1
    if (total := np.prod(counts.astype(float))) >= MAX_NODE_KEYS:
        raise InputError(
            f"{settings.settings_name}.spacing is {spacing:g}; on {robot.name} that makes {total:.0e} nodes, "
            f"which must be below {MAX_NODE_KEYS:.0e}: a spacing of "
            f"{spacing * (total / MAX_NODE_KEYS) ** (1 / robot.dof) * 1.1:.2g} does it"
        )
    edges = [comb(robot.dof, k) * 2**k for k in range(1, robot.dof + 1)]
    if sum(edges[: settings.joints_per_move]) > MAX_MOVES:
        most = int(np.searchsorted(np.cumsum(edges), MAX_MOVES, side="right"))
        raise InputError(
            f"{settings.settings_name}.joints_per_move is {settings.joints_per_move}; on {robot.name} that "
            f"makes {sum(edges[: settings.joints_per_move])} edges of a node; it must be at most {most}"
        )
    strides = np.concatenate([[1], np.cumprod(counts[:-1])]).astype(np.int64)
    origin = start - spacing * below
    half = lattice_moves(robot.dof, settings.joints_per_move)
    moves = np.concatenate([half, -half])
    goals_at = (goals.astype(np.float64) - origin) / spacing
    lattice = Lattice(
        origin,
        float(spacing),
        counts,
        strides,
        moves,
        np.ceil(UNITS * np.sqrt(np.abs(moves).sum(axis=1))).astype(np.int64),
        1 / sqrt(min(settings.joints_per_move, robot.dof)),
        np.ascontiguousarray(goals, np.float32),
        goals_at,
        np.floor(goals_at).astype(np.int64),
    )
    return _Graph(lattice, lower, upper, int(below @ strides))


def lattice_moves(dof: int, joints: int) -> Int[ndarray, "moves dof"]:
    """One of each pair of opposite moves, that in which the first moving joint moves up; those of few joints
    first."""
    if joints == 1:
        return np.eye(dof, dtype=np.int64)
    moves = []
    for count in range(1, min(joints, dof) + 1):
        signs = [(1, *others) for others in product((1, -1), repeat=count - 1)]
        rows = np.zeros((comb(dof, count), len(signs), dof), np.int64)
        for row, moving in zip(rows, combinations(range(dof), count), strict=True):
            row[:, moving] = signs
        moves += sorted(rows.reshape(-1, dof).tolist(), key=lambda move: [step % 3 for step in move])
    return np.array(moves, np.int64)


class _Search:
    """Base of both searches: the graph, the table of nodes, and the path along it."""

    def __init__(
        self,
        checker: CollisionChecker,
        start: Float[ndarray, "dof"],
        goals: Float[ndarray, "k dof"],
        settings: LatticeSettings,
        padding: float,
        incremental: bool,
    ) -> None:
        self.checker, self.settings, self.padding = checker, settings, padding
        self.goals = goals
        self._graph = _make_graph(checker.robot, start, goals, settings)
        self._expansions = max(CLOCK_INTERVAL // len(self._graph.lattice.moves), 1)
        self._table = table.make_table(self._graph.lattice, settings.max_nodes, incremental)
        self._space = search_space(checker, settings.resolution, padding)

    @property
    def expansions(self) -> int:
        """Number of expansions so far; a node may be expanded several times."""
        return int(self._table.count[table.EXPANSIONS])

    @property
    def nodes(self) -> int:
        """Nodes in memory."""
        return int(self._table.count[table.NODES]) - 1

    def _radians(self, units: int) -> float:
        return float("inf") if units >= table.INFINITE else units * self.settings.spacing / UNITS

    def _waypoints(self, keys: Int[ndarray, "n"]) -> Float[ndarray, "m dof"]:
        """The start, the nodes at which the path turns, and the goal."""
        lattice = self._graph.lattice
        at = keys[:, None] // lattice.strides % lattice.counts
        turns = np.ones(len(keys), np.bool_)
        turns[1:-1] = (np.diff(at, 2, axis=0) != 0).any(axis=1)
        goal = self.goals[self._table.count[table.GOAL]].astype(np.float64)
        return np.concatenate([self._graph.configurations(keys[turns]), goal[None]])


class AStarSearch(_Search):
    """A* from the start. `start` and at least one of the goals should be free of collision."""

    def __init__(
        self,
        checker: CollisionChecker,
        start: Float[ndarray, "dof"],
        goals: Float[ndarray, "k dof"],
        settings: AStarSettings,
        padding: float = 0.0,
    ) -> None:
        """`padding` is the distance to obstacles that paths keep [m]."""
        super().__init__(checker, start, goals, settings, padding, incremental=False)
        self._inflation = float(settings.inflation)
        kernel.begin_a_star(self._graph.lattice, self._table, self._graph.start_key, self._inflation)

    def run(self, stop: Callable[[], bool] = lambda: False) -> Outcome:
        """Search until there is a path, there is none, memory is full, or `stop` returns True."""
        while True:
            code = kernel.a_star(
                self._space, self._graph.lattice, self._table, self._inflation, self._expansions
            )
            if code != kernel.GOING or stop():
                return Outcome(code)

    @property
    def cost(self) -> float:
        """Length of the best path so far [rad]; infinite if there is none."""
        return self._radians(int(self._table.g[table.AT_GOAL]))

    def path(self) -> Float[ndarray, "n dof"] | None:
        """Waypoints from the start to a goal; None if there is none yet."""
        node = int(self._table.parent[table.AT_GOAL])
        if self._table.g[table.AT_GOAL] >= table.INFINITE:
            return None
        keys = []
        while node >= 0:
            keys.append(self._table.keys[node])
            node = int(self._table.parent[node])
        return self._waypoints(np.array(keys[::-1]))


class DStarLiteSearch(_Search):
    """D* Lite from the goals, which can be repaired when obstacles or the arm have moved."""

    def __init__(
        self,
        checker: CollisionChecker,
        start: Float[ndarray, "dof"],
        goals: Float[ndarray, "k dof"],
        settings: DStarLiteSettings,
        padding: float = 0.0,
    ) -> None:
        """`padding` is the distance to obstacles that paths keep [m]. Needs memory for 2^dof edges to each
        goal."""
        super().__init__(checker, start, goals, settings, padding, incremental=True)
        self._last = np.zeros((len(goals), 2 ** len(start)), np.uint8)
        moves = np.abs(self._graph.lattice.moves[: len(self._graph.lattice.moves) // 2])
        self._reaches = (0.5 * settings.spacing * moves @ largest_motion_radii(checker.robot)).astype(
            np.float32
        )
        """How far any point of the arm moves by half of each move [m]."""
        self._offset = 0
        self._start = int(table.find_or_add(self._table, self._graph.start_key))
        self._has_room = self._update(np.full(len(self._table.keys), np.inf, np.float32))

    def run(self, stop: Callable[[], bool] = lambda: False) -> Outcome:
        """Search until there is a path, there is none, memory is full, or `stop` returns True."""
        if self._table.state[self._start] == table.BLOCKED:
            return Outcome.EXHAUSTED
        if not self._has_room:
            return Outcome.FULL
        while True:
            code = kernel.d_star_lite(
                self._space,
                self._graph.lattice,
                self._table,
                self._last,
                self._start,
                self._offset,
                self._expansions,
            )
            if code != kernel.GOING or stop():
                return Outcome(code)

    @property
    def cost(self) -> float:
        """Length of the path that `run` found [rad]; infinite if there is none."""
        return self._radians(int(self._table.rhs[self._start]))

    def path(self) -> Float[ndarray, "n dof"] | None:
        """Waypoints from the start to a goal, after `run` returned FOUND; None if there is no path."""
        if self._table.rhs[self._start] >= table.INFINITE:
            return None
        return self._waypoints(kernel.path_from(self._graph.lattice, self._table, self._last, self._start))

    def update(self, checker: CollisionChecker, start: Float[ndarray, "dof"] | None = None) -> None:
        """Take over a changed scene, and a new start at another node of the lattice; `run` then repairs the
        search.

        Shapes that are the same objects in both scenes are taken to be unchanged. Only nodes and known edges
        within reach of the other shapes are checked again. Raises InputError for another robot, and for a
        start that is no node.
        """
        if checker.robot is not self.checker.robot:
            raise InputError(
                f"checker has the robot {checker.robot.name}; it must have that of the search, "
                f"{self.checker.robot.name}"
            )
        if start is not None:
            self._move_start(start)
        near = self._distances_to_changes(checker)
        self.checker = checker
        self._space = search_space(checker, self.settings.resolution, self.padding)
        self._has_room = self._update(near)

    def _distances_to_changes(self, checker: CollisionChecker) -> Float[ndarray, "capacity"]:
        """A lower bound of the distance of the arm at each node from shapes that were added, removed or moved
        [m]."""
        near = np.full(len(self._table.keys), np.inf, np.float32)
        before, after = self.checker.scene.shapes, checker.scene.shapes
        kept = {id(shape) for shape in before} & {id(shape) for shape in after}
        moved = [shape for shape in (*before, *after) if id(shape) not in kept]
        known = slice(1, self.nodes + 1)
        if checker.padding != self.checker.padding:
            near[known] = -np.inf
        elif moved:
            margin = float(self._space.padding) + ROUNDING
            changes = CollisionChecker(checker.robot, Scene(moved))
            q = self._graph.configurations(self._table.keys[known])
            clearances = changes.link_clearances(q, limit=float(self._reaches.max()) + 2 * margin)
            near[known] = clearances.min(axis=1, initial=np.inf) - margin
        return near

    def _move_start(self, start: Float[ndarray, "dof"]) -> None:
        lattice = self._graph.lattice
        at = (np.asarray(start, np.float64) - lattice.origin) / lattice.spacing
        whole = np.round(at).astype(np.int64)
        if np.abs(at - whole).max() > 1e-3 or (whole < 0).any() or (whole >= lattice.counts).any():
            raise InputError(f"start is {np.round(start, 4)}; it must be a node of the lattice")
        before = self._table.keys[self._start] // lattice.strides % lattice.counts
        node = int(table.find_or_add(self._table, int(whole @ lattice.strides)))
        if node < 0:
            raise InputError(
                f"start is {np.round(start, 4)}; the search has not reached it, and memory is full"
            )
        steps = np.abs(whole - before)
        way = max(float(np.linalg.norm(steps)), float(steps.sum()) * lattice.slope)
        # rounded up: queued keys must stay lower bounds
        self._offset += ceil(UNITS * way + lattice_graph.ROUNDING) if way else 0
        self._start = node

    def _update(self, near: Float[ndarray, "capacity"]) -> bool:
        lattice, offset = self._graph.lattice, self._offset
        return kernel.update(
            self._space, lattice, self._table, self._last, self._start, offset, near, self._reaches
        )


class _LatticePlanner(Planner[LatticePlannerSettings]):
    """Base of both planners. The path depends on the seed only through the configurations of a goal pose."""

    search: Callable[..., AStarSearch | DStarLiteSearch]

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        padding = start_goal.kept_clearance(self.settings.clearance)
        for settings, _ in ever_finer(context, self.settings):
            search = self.search(start_goal.checker, *start_goal.rows(), settings, padding)
            outcome = search.run(lambda: context.remaining <= 0)
            path = search.path() if outcome is Outcome.FOUND else None
            if path is None:
                status = Status.TIMEOUT if outcome is Outcome.GOING else Status.NO_PATH
                return context.fail(status, _reason(outcome, settings, search))
            done = f"solved by {context.planner_name}: {search.expansions} expansions"
            result = context.finish(start_goal.complete(path), context.planner_name, reason=done)
            if result is not None:
                return result
            if settings.resolution <= FINEST_RESOLUTION:
                break
        return context.unsolved(
            "the validator refused every path that was found; a larger clearance may help"
        )


class AStar(_LatticePlanner[AStarSettings]):
    """Weighted A* on a lattice."""

    name, settings_class, search = "a_star", AStarSettings, AStarSearch


class DStarLite(_LatticePlanner[DStarLiteSettings]):
    """D* Lite on a lattice, for one problem; `DStarLiteSearch` can be repaired after changes."""

    name, settings_class, search = "d_star_lite", DStarLiteSettings, DStarLiteSearch


def _reason(outcome: Outcome, settings: LatticeSettings, search: AStarSearch | DStarLiteSearch) -> str:
    spacing = f"{settings.settings_name}.spacing (now {settings.spacing:g} rad)"
    if outcome is Outcome.FULL:
        return (
            f"memory is full: {search.nodes} nodes after {search.expansions} expansions; take a coarser "
            f"{spacing} or a larger {settings.settings_name}.max_nodes"
        )
    if outcome is Outcome.EXHAUSTED:
        return f"there is no path on the lattice; a finer {spacing} may have one"
    return f"time ran out after {search.expansions} expansions; a coarser {spacing} searches faster"
