"""A* and D* Lite on a lattice of configurations: the classical graph searches, as baselines.

A*: P. Hart, N. Nilsson and B. Raphael, "A formal basis for the heuristic determination of minimum cost
paths", IEEE Trans. SSC 1968. D* Lite: S. Koenig and M. Likhachev, "D* Lite", AAAI 2002, optimized version.

In each planned joint, nodes lie whole steps of `spacing` from the start. Edges change one joint by a step (or
up to `joints_per_move` joints); their cost is joint-space length [rad]. The corners of the cell around a goal
are connected to it by exact last edges. The result is the path along the lattice, without shortcuts.

Limits, with seven joints: a node has 14 neighbours, or 2,186 if all joints may move at once, and a spacing of
0.3 rad makes 10^9 nodes. The heuristic ignores obstacles: before a search leaves a pocket, it fills it, and
that takes a time that grows with the seventh power of the pocket's width. Inflation trades length for speed.
Passages narrower than a step are not found: no path on the lattice does not mean no path. A path of
single-joint steps is up to sqrt(dof) times as long as the straight line that it follows.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from itertools import combinations, product
from math import comb, sqrt
from typing import Annotated, Generic, TypeVar

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.motions import FINEST_RESOLUTION, largest_motion_radii, search_space
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Count, NotNegative, Positive, Settings
from robotdiffuse.core.types import Status
from robotdiffuse.planning.baselines.lattice import kernel, table
from robotdiffuse.planning.baselines.lattice.kernel import UNITS, Lattice
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


def make_lattice(
    robot: Robot, start: Float[ndarray, "dof"], goals: Float[ndarray, "k dof"], settings: LatticeSettings
) -> tuple[Lattice, int]:
    """The lattice through the start, and the start's key. Raises InputError for one that is too large."""
    spacing, name = settings.spacing, settings.settings_name
    below = _steps(start.astype(float) - robot.lower.astype(float), spacing)
    counts = below + _steps(robot.upper.astype(float) - start.astype(float), spacing) + 1
    if (total := np.prod(counts.astype(float))) >= MAX_NODE_KEYS:
        raise InputError(
            f"{name}.spacing is {spacing:g}; on {robot.name} that makes {total:.0e} nodes, which must be "
            f"below {MAX_NODE_KEYS:.0e}: a spacing of "
            f"{spacing * (total / MAX_NODE_KEYS) ** (1 / robot.dof) * 1.1:.2g} does it"
        )
    edges = np.cumsum([comb(robot.dof, k) * 2**k for k in range(1, robot.dof + 1)])
    if (count := edges[min(settings.joints_per_move, robot.dof) - 1]) > MAX_MOVES:
        raise InputError(
            f"{name}.joints_per_move is {settings.joints_per_move}; on {robot.name} that makes {count} edges "
            f"of a node; it must be at most {np.searchsorted(edges, MAX_MOVES, side='right')}"
        )
    strides = np.concatenate([[1], np.cumprod(counts[:-1])]).astype(np.int64)
    origin = start.astype(float) - spacing * below
    half = lattice_moves(robot.dof, settings.joints_per_move)
    moves = np.concatenate([half, -half])
    costs = np.ceil(UNITS * np.sqrt(np.abs(moves).sum(axis=1))).astype(np.int64)
    slope = 1 / sqrt(min(settings.joints_per_move, robot.dof))
    goals_at = (goals.astype(float) - origin) / spacing
    goals = np.ascontiguousarray(goals, np.float32)
    lattice = Lattice(origin, float(spacing), counts, strides, moves, costs, slope, goals, goals_at)
    return lattice, int(below @ strides)


def _steps(distance: Float[ndarray, "dof"], spacing: float) -> Int[ndarray, "dof"]:
    return np.maximum(np.floor(distance / spacing - LIMIT_MARGIN), 0).astype(np.int64)


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


class _Search(ABC, Generic[LatticePlannerSettings]):
    """Base of both searches: the lattice, the table of nodes, and the path along it."""

    remembers_edges: bool

    def __init__(
        self,
        checker: CollisionChecker,
        start: Float[ndarray, "dof"],
        goals: Float[ndarray, "k dof"],
        settings: LatticePlannerSettings,
        padding: float = 0.0,
    ) -> None:
        """`padding` is the distance to obstacles that paths keep [m]."""
        self.settings, self.padding, self.goals = settings, padding, goals
        self._lattice, key = make_lattice(checker.robot, start, goals, settings)
        moves, dof = self._lattice.moves.shape
        self._expansions = max(CLOCK_INTERVAL // moves, 1)
        self._table = table.make_table(settings.max_nodes, self.remembers_edges * moves // 2)
        self._last = np.zeros((len(goals), self.remembers_edges * 2**dof), np.uint8)
        self._start = self._table.values[table.START] = table.find_or_add(self._table, key)
        self._use(checker)
        self._begin()

    def _use(self, checker: CollisionChecker) -> None:
        self.checker = checker
        space = search_space(checker, self.settings.resolution, self.padding)
        self._search = kernel.make_search(space, self._lattice, self._table, self._last)

    def run(self, stop: Callable[[], bool] = lambda: False) -> Outcome:
        """Search until there is a path, there is none, memory is full, or `stop` returns True."""
        while True:
            outcome = Outcome(self._expand())
            if outcome is not Outcome.GOING or stop():
                return outcome

    def path(self) -> Float[ndarray, "n dof"] | None:
        """The start, the nodes at which the path found so far turns, and the goal; None if there is none."""
        if self._units() >= table.INFINITE:
            return None
        keys = self._path_keys()
        turns = np.ones(len(keys), np.bool_)
        turns[1:-1] = (np.diff(self._coordinates(keys), 2, axis=0) != 0).any(axis=1)
        goal = self.goals[self._table.values[table.GOAL]].astype(np.float64)
        return np.concatenate([self._configurations(keys[turns]), goal[None]])

    @property
    def cost(self) -> float:
        """Length of the path found so far [rad]; infinite if there is none."""
        units = self._units()
        return float("inf") if units >= table.INFINITE else units * self.settings.spacing / UNITS

    @property
    def expansions(self) -> int:
        """Number of expansions so far; a node may be expanded several times."""
        return int(self._table.values[table.EXPANSIONS])

    @property
    def nodes(self) -> int:
        """Nodes in memory."""
        return int(self._table.values[table.NODES]) - 1

    def _coordinates(self, keys: Int[ndarray, "n"]) -> Int[ndarray, "n dof"]:
        return keys[:, None] // self._lattice.strides % self._lattice.counts

    def _configurations(self, keys: Int[ndarray, "n"]) -> Float[ndarray, "n dof"]:
        robot, lattice = self.checker.robot, self._lattice
        q = lattice.origin + lattice.spacing * self._coordinates(keys)
        return np.clip(q, robot.lower.astype(float), robot.upper.astype(float))

    @abstractmethod
    def _begin(self) -> None:
        """Fill the queue."""

    @abstractmethod
    def _expand(self) -> int:
        """Some expansions; returns the value of an Outcome."""

    @abstractmethod
    def _units(self) -> int:
        """Cost of the path found so far [units]."""

    @abstractmethod
    def _path_keys(self) -> Int[ndarray, "n"]:
        """The keys of the path's nodes."""


class AStarSearch(_Search[AStarSettings]):
    """Weighted A* from the start, which must be free, to the nearest goal."""

    remembers_edges = False

    def _begin(self) -> None:
        self._table.g[self._start], self._table.state[self._start] = 0, table.FREE
        table.put(self._table, self._start, 0, 0)

    def _expand(self) -> int:
        return kernel.a_star(self._search, float(self.settings.inflation), self._expansions)

    def _units(self) -> int:
        return int(self._table.g[table.AT_GOAL])

    def _path_keys(self) -> Int[ndarray, "n"]:
        nodes = [self._table.rhs[table.AT_GOAL]]
        while nodes[-1] != self._start:
            nodes.append(self._table.rhs[nodes[-1]])
        return self._table.keys[nodes[::-1]]


class DStarLiteSearch(_Search[DStarLiteSettings]):
    """D* Lite from the goals, which can be repaired when obstacles or the arm have moved. Needs memory for
    2^dof edges to each goal."""

    remembers_edges = True

    def _begin(self) -> None:
        moves = np.abs(self._lattice.moves[: len(self._lattice.moves) // 2])
        reaches = 0.5 * self.settings.spacing * moves @ largest_motion_radii(self.checker.robot)
        self._reaches = reaches.astype(np.float32)
        """How far any point of the arm moves by half of each move [m]."""
        self._has_room = self._repair(np.full(len(self._table.keys), np.inf, np.float32))

    def _repair(self, near: Float[ndarray, "capacity"]) -> bool:
        return kernel.update(self._search, near, self._reaches)

    def _expand(self) -> int:
        return kernel.d_star_lite(self._search, self._expansions) if self._has_room else kernel.FULL

    def _units(self) -> int:
        return int(self._table.rhs[self._start])

    def _path_keys(self) -> Int[ndarray, "n"]:
        return kernel.path_keys(self._search)

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
        self._use(checker)
        self._has_room = self._repair(near)

    def _distances_to_changes(self, checker: CollisionChecker) -> Float[ndarray, "capacity"]:
        """A lower bound of the distance of the arm at each node from shapes that were added, removed or moved
        [m]."""
        near = np.full(len(self._table.keys), np.inf, np.float32)
        before, after = self.checker.scene.shapes, checker.scene.shapes
        kept = {id(shape) for shape in before} & {id(shape) for shape in after}
        kept = kept if self.checker.scene.allowed_contacts == checker.scene.allowed_contacts else set()
        moved = [shape for shape in (*before, *after) if id(shape) not in kept]
        known = slice(1, self.nodes + 1)
        if checker.padding != self.checker.padding:
            near[known] = -np.inf
        elif moved:
            margin = float(self._search.space.padding) + ROUNDING
            q, limit = self._configurations(self._table.keys[known]), float(self._reaches.max()) + 2 * margin
            clearances = CollisionChecker(checker.robot, Scene(moved)).link_clearances(q, limit=limit)
            near[known] = clearances.min(axis=1, initial=np.inf) - margin
        return near

    def _move_start(self, start: Float[ndarray, "dof"]) -> None:
        lattice = self._lattice
        at = (np.asarray(start, np.float64) - lattice.origin) / lattice.spacing
        whole = np.round(at).astype(np.int64)
        if np.abs(at - whole).max() > 1e-3 or (whole < 0).any() or (whole >= lattice.counts).any():
            raise InputError(f"start is {np.round(start, 4)}; it must be a node of the lattice")
        node = table.find_or_add(self._table, int(whole @ lattice.strides))
        if node < 0:
            raise InputError(
                f"start is {np.round(start, 4)}; the search has not reached it, and memory is full"
            )
        if node != self._start:
            # rounded up: queued keys must stay lower bounds
            self._table.values[table.OFFSET] += kernel.heuristic(lattice, whole, self._search.start_at, 0) + 2
        self._start = self._table.values[table.START] = node


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
