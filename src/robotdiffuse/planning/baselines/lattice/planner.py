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

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations, product
from math import comb, sqrt
from typing import Annotated, Generic, TypeVar

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.lane_collision import W, make_workspace
from robotdiffuse.collision.motions import FINEST_RESOLUTION, largest_motion_radii, search_space
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Count, NotNegative, Positive, Settings
from robotdiffuse.core.types import Status
from robotdiffuse.planning.baselines.lattice import kernel, table
from robotdiffuse.planning.baselines.lattice.kernel import UNITS, Lattice, Outcome
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
    max_nodes: Annotated[int, Bound(least=1.0, most=2e9)] = 2_000_000
    """Largest number of nodes in memory; each takes about 80 bytes. D* Lite needs one more byte for each goal
    and for each pair of edges, and has room for the nodes around the goals besides."""
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
    moves = list(np.eye(dof, dtype=np.int64)[:: 1 if joints == 1 else -1])
    for count in range(2, min(joints, dof) + 1):
        rows = []
        for moving, signs in product(combinations(range(dof), count), product((1, -1), repeat=count - 1)):
            rows.append(np.zeros(dof, np.int64))
            rows[-1][list(moving)] = (1, *signs)
        moves += sorted(rows, key=lambda move: list(move % 3))
    return np.array(moves)


class _Search(Generic[LatticePlannerSettings]):
    """The lattice, the nodes in memory, the search and the path along it."""

    checker: CollisionChecker
    _table: table.Table
    _search: kernel.Search

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
        self._expansions = max(CLOCK_INTERVAL // len(self._lattice.moves), 1)
        self._begin(checker, key)

    def _begin(self, checker: CollisionChecker, start_key: int) -> None:
        """Make the table, and queue the nodes of the source."""
        raise NotImplementedError

    def _use(
        self,
        checker: CollisionChecker,
        targets: Float[ndarray, "n dof"],
        cell: int,
        inflation: float,
        ties: int,
    ) -> None:
        """The compiled search among the obstacles of a checker; see `kernel.Search`."""
        space = search_space(checker, self.settings.resolution, self.padding)
        edges, dof = len(self._lattice.moves) + len(self.goals), checker.robot.dof
        near, steps, near_other, steps_other = np.empty((4, edges), np.int64)
        a, b = np.empty((2, dof), np.float32)
        self.checker = checker
        self._search = kernel.Search(
            *(space, self._lattice, self._table, targets, cell, float(inflation), ties),
            *(near, steps, near_other, steps_other, np.empty(dof, np.int64), np.empty(W, np.int64)),
            *(a, b, np.empty((dof, W), np.float32), make_workspace(space.robot, space.scene)),
        )

    def run(self, stop: Callable[[], bool] = lambda: False) -> Outcome:
        """Search until there is a path, there is none, memory is full, or `stop` returns True."""
        while True:
            outcome = Outcome(kernel.search(self._search, self._expansions))
            if outcome is not Outcome.GOING or stop():
                return outcome

    def path(self) -> Float[ndarray, "n dof"] | None:
        """The start, the nodes at which the path found so far turns, and the goal; None if there is none."""
        nodes = [int(self._table.values[table.TARGET])]
        if self._table.rhs[nodes[0]] >= table.INFINITE:
            return None
        while (parent := int(self._table.parent[nodes[-1]])) >= 0:
            nodes.append(parent)
        *nodes, goal = nodes if nodes[-1] < len(self.goals) else reversed(nodes)
        at = self._coordinates(self._table.keys[nodes])
        turns = np.ones(len(at), np.bool_)
        turns[1:-1] = (np.diff(at, 2, axis=0) != 0).any(axis=1)
        return np.concatenate([self._configurations(at[turns]), self.goals[[goal]].astype(np.float64)])

    @property
    def cost(self) -> float:
        """Length of the path found so far [rad]; infinite if there is none."""
        units = int(self._table.rhs[self._table.values[table.TARGET]])
        return float("inf") if units >= table.INFINITE else units * self.settings.spacing / UNITS

    @property
    def expansions(self) -> int:
        """Number of expansions so far; a node may be expanded several times."""
        return int(self._table.values[table.EXPANSIONS])

    @property
    def nodes(self) -> int:
        """Nodes in memory."""
        return int(self._table.values[table.NODES]) - len(self.goals)

    def _coordinates(self, keys: Int[ndarray, "n"]) -> Int[ndarray, "n dof"]:
        return keys[:, None] // self._lattice.strides % self._lattice.counts

    def _configurations(self, at: Int[ndarray, "n dof"]) -> Float[ndarray, "n dof"]:
        robot, lattice = self.checker.robot, self._lattice
        return np.clip(lattice.origin + lattice.spacing * at, robot.lower, robot.upper)


class AStarSearch(_Search[AStarSettings]):
    """Weighted A* from the start, which must be free, to the nearest goal."""

    def _begin(self, checker: CollisionChecker, start_key: int) -> None:
        self._table = table.make_table(len(self.goals), self.settings.max_nodes, 0)
        [start] = table.add_nodes(self._table, np.array([start_key]))
        self._table.rhs[start], self._table.state[start] = 0, table.FREE
        table.put(self._table, start, 0, 0)
        self._use(checker, self._lattice.goals_at, 1, self.settings.inflation, -1)


class DStarLiteSearch(_Search[DStarLiteSettings]):
    """D* Lite from the goals, which can be repaired when obstacles or the arm have moved. Needs memory for
    the 2^dof nodes around each goal."""

    def _begin(self, checker: CollisionChecker, start_key: int) -> None:
        goals, lattice = len(self.goals), self._lattice
        half = len(lattice.moves) // 2
        corners = np.floor(lattice.goals_at).astype(np.int64)[:, None] + list(
            product((0, 1), repeat=len(lattice.counts))
        )
        corners = corners[((corners >= 0) & (corners < lattice.counts)).all(axis=2)]
        keys = np.unique(corners @ lattice.strides)
        self._table = table.make_table(goals, self.settings.max_nodes + len(keys), half + goals)
        self._table.g[:goals] = self._table.rhs[:goals] = 0
        table.add_nodes(self._table, np.array([start_key, *keys]))
        self._table.values[table.TARGET] = goals
        radii = largest_motion_radii(checker.robot)
        reaches = 0.5 * self.settings.spacing * np.abs(lattice.moves[:half]) @ radii
        self._reaches = reaches.astype(np.float32)
        """How far any point of the arm moves by half of each move [m]."""
        self._update(checker, np.full(len(self._table.keys), np.inf, np.float32))

    def _update(self, checker: CollisionChecker, distances: Float[ndarray, "capacity"]) -> None:
        start = self._table.keys[self._table.values[table.TARGET]]
        self._use(checker, self._coordinates(start[None]).astype(np.float64), 0, 1.0, 1)
        kernel.update(self._search, distances, self._reaches)

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
        self._update(checker, self._distances_to_changes(checker))

    def _distances_to_changes(self, checker: CollisionChecker) -> Float[ndarray, "capacity"]:
        """A lower bound of the distance of the arm at each node from shapes that were added, removed or moved
        [m]."""
        distances = np.full(len(self._table.keys), np.inf, np.float32)
        before, after = self.checker.scene.shapes, checker.scene.shapes
        kept = {id(shape) for shape in before} & {id(shape) for shape in after}
        kept = kept if self.checker.scene.allowed_contacts == checker.scene.allowed_contacts else set()
        moved = [shape for shape in (*before, *after) if id(shape) not in kept]
        known = slice(len(self.goals), self._table.values[table.NODES])
        if checker.padding != self.checker.padding:
            distances[known] = -np.inf
        elif moved:
            margin = float(self._search.space.padding) + ROUNDING
            q = self._configurations(self._coordinates(self._table.keys[known]))
            limit = float(self._reaches.max()) + 2 * margin
            clearances = CollisionChecker(checker.robot, Scene(moved)).link_clearances(q, limit=limit)
            distances[known] = clearances.min(axis=1, initial=np.inf) - margin
        return distances

    def _move_start(self, start: Float[ndarray, "dof"]) -> None:
        lattice = self._lattice
        at = (np.asarray(start, np.float64) - lattice.origin) / lattice.spacing
        whole = np.round(at).astype(np.int64)
        if np.abs(at - whole).max() > 1e-3 or (whole < 0).any() or (whole >= lattice.counts).any():
            raise InputError(f"start is {np.round(start, 4)}; it must be a node of the lattice")
        [node] = table.add_nodes(self._table, np.array([whole @ lattice.strides]))
        if node < 0:
            raise InputError(
                f"start is {np.round(start, 4)}; the search has not reached it, and memory is full"
            )
        if node != self._table.values[table.TARGET]:
            # rounded up: queued keys must stay lower bounds
            self._table.values[table.OFFSET] += kernel.heuristic(lattice, whole, self._search.targets, 0) + 2
        self._table.values[table.TARGET] = node


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
