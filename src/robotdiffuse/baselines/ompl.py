"""Planners of the Open Motion Planning Library (OMPL 2, Python bindings) over our collision kernel.

I. Sucan, M. Moll and L. Kavraki, "The Open Motion Planning Library", IEEE Robotics and Automation Magazine
2012. Settings that are not in `OmplSettings` have OMPL's defaults.

*Collision.* States are points of a RealVectorStateSpace with the joint limits as bounds. OMPL calls Python
for each state and each motion that it checks. Python calls the compiled kernel that `rrt_connect` uses.

*First-solution planners* (RRT, RRT-Connect, PRM) end with their first path, which OMPL's PathSimplifier
shortens, as in OMPL's SimpleSetup and in MoveIt. *Anytime planners* (RRT*, Informed RRT*, BIT*, AORRTC)
minimize joint-space length until time runs out, or until the path is as short as the straight line. A path is
validated whenever it is shorter than the last validated one by the fraction IMPROVEMENT. So there is still a
valid plan if the validator refuses a later path.

*Seeds.* OMPL has one source of seeds for the whole process. It is set for each search, so the same seed gives
the same path unless time runs out; anytime planners usually run until then. The exception is PRM: a second
thread searches for the path while the roadmap grows, so its path varies from run to run.

*Threads.* OMPL's bindings hold Python's global lock while they search, and searches in several threads would
mix their seeds. Use processes for parallel planning.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from robotdiffuse.collision.kernels.motions import Space, motions_free
from robotdiffuse.collision.motions import finer_resolution
from robotdiffuse.core.errors import InputError, needs
from robotdiffuse.core.settings import Positive
from robotdiffuse.core.types import Configuration, Configurations, Path, PlanResult
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.planner import CheckedSettings, Planner, ever_finer
from robotdiffuse.planning.start_goal import StartGoal

with needs("OMPL's Python bindings", "baselines"):
    from ompl import base as ob
    from ompl import geometric as og
    from ompl import util as ou

IMPROVEMENT = 0.01
"""A path of an anytime planner is validated when it is shorter than the last validated path by this
fraction."""
OPTIMAL = 1e-4
"""A path counts as optimal if it is longer than the straight line by at most this fraction."""
SAME_STATE_DISTANCE = 1e-6
"""Distance between start and goal below which both count as equal [rad]."""


@dataclass(frozen=True)
class OmplSettings(CheckedSettings, name="ompl"):
    range: Positive | None = None
    """Longest extension of a tree [rad, joint-space L2]; None: OMPL's default, 0.2 of the space's diameter.
    PRM and BIT* have no such setting."""
    simplify: bool = True
    """Whether OMPL's PathSimplifier shortens the path of a first-solution planner."""


class Watch:
    """Ends a search of OMPL. Stores exceptions that Python code raises during the search, since no exception
    may pass through C++."""

    def __init__(self, context: PlanningContext) -> None:
        self.context = context
        self._error: BaseException | None = None
        self._condition: ob.PlannerTerminationCondition | None = None
        self._planner: Any = None
        self._shorter_than = np.inf

    @contextmanager
    def until(
        self, planner: Any = None, shorter_than: float = 0.0
    ) -> Iterator[ob.PlannerTerminationCondition]:
        """A condition that ends the search when time runs out, or when `planner`, if given, has a path
        shorter than `shorter_than` [rad]. At the end of the context, a stored exception is raised."""
        self._planner = planner
        self._shorter_than = shorter_than
        # Not a Python callback for first-solution planners: PRM's second thread would wait forever for
        # Python's lock, which the first thread holds.
        self._condition = condition = (
            ob.timedPlannerTerminationCondition(max(self.context.remaining, 0.0))
            if planner is None
            else ob.PlannerTerminationCondition(self._is_over)
        )
        try:
            yield condition
        finally:
            # AORRTC keeps the condition, which refers to the planner: a cycle invisible to the garbage
            # collector
            self._condition = self._planner = None
        self.raise_caught()

    def caught(self, error: BaseException) -> None:
        """Stores the search's first exception, and ends the search."""
        self._error = self._error or error
        if self._condition is not None:
            self._condition.terminate()

    def raise_caught(self) -> None:
        """Raises the stored exception and deletes it, since its traceback keeps the validity checkers
        alive."""
        error = self._error
        self._error = None
        try:
            if error is not None:
                raise error
        finally:
            del error

    def _is_over(self) -> bool:
        try:
            return self.context.remaining <= 0 or self._planner.bestCost().value() < self._shorter_than
        except BaseException as error:
            self.caught(error)
            return True


class MotionChecks(ob.MotionValidator):
    """Validity of straight motions. The first state is not checked, since OMPL has already found it valid."""

    def __init__(self, information: ob.SpaceInformation, space: Space, watch: Watch) -> None:
        super().__init__(information)
        self._space = space
        self._watch = watch

    def checkMotion(self, a: ob.RealVectorStateType, b: ob.RealVectorStateType) -> bool:
        joints = slice(0, len(self._space.lower))
        try:
            return bool(motions_free(self._space, np.array([a[joints], b[joints]], np.float32))[0])
        except BaseException as error:
            self._watch.caught(error)
            return False


class StateChecks(ob.StateValidityChecker):
    """Validity of single states, as motions from a state to itself."""

    def __init__(self, information: ob.SpaceInformation, motions: MotionChecks) -> None:
        super().__init__(information)
        self._motions = motions

    def isValid(self, state: ob.RealVectorStateType) -> bool:
        return self._motions.checkMotion(state, state)


class OmplPlanner(Planner[OmplSettings]):
    """Base class of OMPL's planners. A subclass names a class of ompl.geometric; the table PLANNERS lists the
    subclasses."""

    settings_class = OmplSettings
    algorithm: ClassVar[type[ob.Planner]]
    anytime: ClassVar[bool] = False
    """Whether the planner improves its first path."""
    backwards: ClassVar[bool] = False
    """Whether OMPL searches from the goals to the start."""

    def __init__(self, settings: OmplSettings | None = None) -> None:
        """Raises InputError if `range` is set but the planner has no such setting."""
        super().__init__(settings)
        if self.settings.range is not None and not hasattr(self.algorithm, "setRange"):
            raise InputError(
                f"ompl.range is {self.settings.range}; {self.name} has no range, so it must be None"
            )

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        with _quiet():
            return self._best(context, start_goal) if self.anytime else self._first(context, start_goal)

    def _first(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        for attempt, settings in enumerate(ever_finer(context, self.settings)):
            search = _Search(context, start_goal, self, settings, attempt)
            if not search.run():
                return context.unsolved(search.gave_up)
            if settings.simplify:
                search.simplify()
            result = context.finish(start_goal.complete(search.path()), self.name)
            if result is not None:
                return result
        return context.unsolved()

    def _best(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """Runs an anytime planner until time runs out or a path is optimal; returns its shortest valid
        path."""
        problem = context.problem
        settings = self.settings
        attempt = 0
        start, goals = start_goal.leads()
        nearest = float(np.linalg.norm(goals - start, axis=1).min())
        target_length = (1 + OPTIMAL) * max(nearest, SAME_STATE_DISTANCE)
        best = None
        shortest = np.inf
        last_length = np.inf
        search = _Search(context, start_goal, self, settings, attempt)
        while search.run(shorter_than=max((1 - IMPROVEMENT) * last_length, target_length)):
            path = Path(problem.robot.joint_names, start_goal.complete(search.path()))
            last_length = search.cost
            if path.length < shortest:
                if context.validator.path(path).valid:
                    best = path.positions
                    shortest = path.length
                    context.improved(shortest)
                    if last_length <= target_length:
                        break
                else:
                    settings = replace(settings, resolution=finer_resolution(settings.resolution))
                    attempt = attempt + 1
                    last_length = np.inf
                    search = _Search(context, start_goal, self, settings, attempt)
            if context.remaining <= 0:
                break
        if best is None:
            return context.unsolved(search.gave_up)
        return context.finish(best, self.name) or context.unsolved(
            "the validator refused the motion along the path"
        )


class OmplRRT(OmplPlanner):
    """S. LaValle and J. Kuffner, "Randomized kinodynamic planning", IJRR 2001."""

    name = "ompl_rrt"
    algorithm = og.RRT


class OmplRRTConnect(OmplPlanner):
    """J. Kuffner and S. LaValle, "RRT-Connect: An efficient approach to single-query path planning",
    ICRA 2000."""

    name = "ompl_rrt_connect"
    algorithm = og.RRTConnect


class OmplPRM(OmplPlanner):
    """L. Kavraki et al., "Probabilistic roadmaps for path planning in high-dimensional configuration spaces",
    IEEE Transactions on Robotics and Automation 1996."""

    name = "ompl_prm"
    algorithm = og.PRM
    # OMPL's second thread adds further goals to the roadmap. It would cause a deadlock: it holds the
    # roadmap's lock while it waits for Python's lock, and the first thread does the reverse. A backward
    # search has a single goal.
    backwards = True


class OmplRRTStar(OmplPlanner):
    """S. Karaman and E. Frazzoli, "Sampling-based algorithms for optimal motion planning", IJRR 2011."""

    name = "ompl_rrt_star"
    algorithm = og.RRTstar
    anytime = True


class OmplInformedRRTStar(OmplPlanner):
    """J. Gammell et al., "Informed RRT*: Optimal sampling-based path planning focused via direct sampling of
    an admissible ellipsoidal heuristic", IROS 2014."""

    name = "ompl_informed_rrt_star"
    algorithm = og.InformedRRTstar
    anytime = True


class OmplBITStar(OmplPlanner):
    """J. Gammell et al., "Batch informed trees (BIT*)", IJRR 2020."""

    name = "ompl_bit_star"
    algorithm = og.BITstar
    anytime = True


class OmplAORRTC(OmplPlanner):
    """T. Wilson et al., "AORRTC: Almost-surely asymptotically optimal planning with RRT-Connect",
    IEEE Robotics and Automation Letters 2025."""

    name = "ompl_aorrtc"
    algorithm = og.AORRTC
    anytime = True


class _Search:
    """One search of OMPL, which can be continued. Its paths are not validated."""

    def __init__(
        self,
        context: PlanningContext,
        start_goal: StartGoal,
        planner: OmplPlanner,
        settings: OmplSettings,
        attempt: int,
    ) -> None:
        # seeds all generators that OMPL creates from here on; 0 is not a valid seed
        ou.RNG.setSeed(int(np.random.SeedSequence([context.request.seed, attempt]).generate_state(1)[0]) or 1)
        self._context = context
        self._robot = context.problem.robot
        self._watch = Watch(context)
        space = start_goal.space(settings.resolution, settings.clearance)
        # C++ refers to these objects, so they must live until the search is over
        self._states = ob.RealVectorStateSpace(self._robot.dof)
        bounds = ob.RealVectorBounds(self._robot.dof)
        for joint in range(self._robot.dof):
            bounds.setLow(joint, float(self._robot.lower[joint]))
            bounds.setHigh(joint, float(self._robot.upper[joint]))
        self._states.setBounds(bounds)
        self._information = ob.SpaceInformation(self._states)
        self._motions = MotionChecks(self._information, space, self._watch)
        self._validity = StateChecks(self._information, self._motions)
        self._information.setStateValidityChecker(self._validity)
        self._information.setMotionValidator(self._motions)
        self._information.setup()
        start, goals = start_goal.leads()
        # loads the kernel, whose compilation does not count, before OMPL's own clock starts
        motions_free(space, np.array([start, start], np.float32))
        self._backwards = planner.backwards
        first, last = (goals, start[None]) if self._backwards else (start[None], goals)
        self._goals = ob.GoalStates(self._information)
        for q in last:
            self._goals.addState(self._state(q))
        self._definition = ob.ProblemDefinition(self._information)
        for q in first:
            self._definition.addStartState(self._state(q))
        self._definition.setGoal(self._goals)
        if planner.anytime:
            # with an objective, first-solution planners would go on after their first path
            self._definition.setOptimizationObjective(ob.PathLengthOptimizationObjective(self._information))
        # bestCost, setRange and the constructor are not part of a common base class
        algorithm: Any = planner.algorithm
        self._planner: Any = algorithm(self._information)
        self._watched = self._planner if planner.anytime else None
        if settings.range is not None:
            self._planner.setRange(settings.range)
        self._planner.setProblemDefinition(self._definition)
        # BIT* checks the validity of start and goals here
        self._planner.setup()
        self._watch.raise_caught()
        self._status = ""

    @property
    def cost(self) -> float:
        """The length of the path [rad, joint-space L2]."""
        return float(self._solution().length())

    @property
    def gave_up(self) -> str:
        """The reason why there is no path, if OMPL ended before the time limit; else an empty string."""
        return f"OMPL ended without a path: {self._status}" if self._context.remaining > 0 else ""

    def run(self, shorter_than: float = np.inf) -> bool:
        """Search for a path until time runs out; an anytime planner searches for a path shorter than
        `shorter_than` [rad].

        Returns whether there is a path, even if it is no shorter than that of an earlier call. An exception
        that was raised in a collision check is raised here.
        """
        with self._watch.until(self._watched, shorter_than) as condition:
            self._status = self._planner.solve(condition).asString()
        return self._definition.hasExactSolution()

    def simplify(self) -> None:
        """Shorten the path by OMPL's PathSimplifier, within the time left."""
        with self._watch.until() as condition:
            og.PathSimplifier(self._information, self._goals).simplify(self._solution(), condition)

    def path(self) -> Configurations:
        """Waypoints of the shortest path."""
        rows = np.array([state[0 : self._robot.dof] for state in self._solution().getStates()])
        return rows[::-1] if self._backwards else rows

    def _solution(self) -> Any:
        return self._definition.getSolutionPath()

    def _state(self, q: Configuration) -> ob.RealVectorStateType:
        state = self._information.allocState()
        assert isinstance(state, ob.RealVectorStateType)
        # values rounded to float32 may exceed a limit; OMPL would refuse the state
        for joint, value in enumerate(np.clip(q.astype(np.float64), self._robot.lower, self._robot.upper)):
            state[joint] = float(value)
        return state


@contextmanager
def _quiet() -> Iterator[None]:
    """A context manager that silences OMPL's console output, such as its warning about setting a seed
    again."""
    level = ou.getLogLevel()
    ou.setLogLevel(ou.LogLevel.LOG_NONE)
    try:
        yield
    finally:
        ou.setLogLevel(level)
