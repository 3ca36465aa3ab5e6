"""OMPL's checks of states and motions by our collision kernel, and when its searches end."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from robotdiffuse.collision.kernels import lane_collision
from robotdiffuse.collision.kernels.motions import Space, motions_free
from robotdiffuse.core.errors import InputError
from robotdiffuse.planning.context import PlanningContext

try:
    from ompl import base as ob
except ImportError:
    raise InputError(
        'planners of OMPL need its Python bindings, not installed: pip install "robotdiffuse[baselines]"'
    ) from None


class Watch:
    """Ends a search of OMPL, and keeps exceptions that Python code raised in it: none may pass through
    C++."""

    def __init__(self, context: PlanningContext) -> None:
        self.context = context
        self._error: BaseException | None = None
        self._condition: ob.PlannerTerminationCondition | None = None
        self._planner: Any = None
        self._shorter_than = np.inf

    @contextmanager
    def until_time_is_over(self) -> Iterator[ob.PlannerTerminationCondition]:
        """A context manager that re-raises at its end an exception that was kept."""
        # not a Python callback: PRM's second thread would wait forever for the lock that the first one holds
        yield from self._while(ob.timedPlannerTerminationCondition(max(self.context.remaining, 0.0)))

    @contextmanager
    def until_shorter(self, planner: Any, than: float) -> Iterator[ob.PlannerTerminationCondition]:
        """A condition that also ends the search once the planner has a path shorter than this [rad]."""
        self._planner, self._shorter_than = planner, than
        yield from self._while(ob.PlannerTerminationCondition(self._is_over))

    def caught(self, error: BaseException) -> None:
        self._error = self._error or error
        if self._condition is not None:
            self._condition.terminate()

    def raise_caught(self) -> None:
        """Raise the kept exception and drop it, as its traceback refers to the validity checkers."""
        error, self._error = self._error, None
        try:
            if error is not None:
                raise error
        finally:
            del error

    def _while(self, condition: ob.PlannerTerminationCondition) -> Iterator[ob.PlannerTerminationCondition]:
        self._condition = condition
        try:
            yield condition
        finally:
            # AORRTC keeps the condition, which refers to the planner: a cycle invisible to the garbage
            # collector
            self._condition = self._planner = None
        self.raise_caught()

    def _is_over(self) -> bool:
        try:
            return self.context.remaining <= 0 or self._planner.bestCost().value() < self._shorter_than
        except BaseException as error:
            self.caught(error)
            return True


class StateChecks(ob.StateValidityChecker):
    """Validity of single states."""

    def __init__(self, information: ob.SpaceInformation, space: Space, watch: Watch) -> None:
        super().__init__(information)
        self._space, self._watch = space, watch
        self._joints = slice(0, len(space.lower))
        self._q = np.empty((1, len(space.lower)), np.float32)

    def isValid(self, state: ob.RealVectorStateType) -> bool:
        try:
            space, self._q[0] = self._space, state[self._joints]
            return bool(lane_collision.free_many(space.robot, space.scene, self._q, space.padding)[0])
        except BaseException as error:
            self._watch.caught(error)
            return False


class MotionChecks(ob.MotionValidator):
    """Validity of straight motions; the start is not checked, as OMPL knows it to be free."""

    def __init__(self, information: ob.SpaceInformation, space: Space, watch: Watch) -> None:
        super().__init__(information)
        self._space, self._watch = space, watch
        self._joints = slice(0, len(space.lower))
        self._line = np.empty((2, len(space.lower)), np.float32)

    def checkMotion(self, a: ob.RealVectorStateType, b: ob.RealVectorStateType) -> bool:
        line = self._line
        try:
            line[0], line[1] = a[self._joints], b[self._joints]
            return bool(motions_free(self._space, line)[0])
        except BaseException as error:
            self._watch.caught(error)
            return False
