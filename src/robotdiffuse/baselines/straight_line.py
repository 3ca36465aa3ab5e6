"""The straight line in joint space, without planning: a control for every planner."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import OneOf, Settings
from robotdiffuse.core.types import Configurations
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.planner import Planner
from robotdiffuse.planning.start_goal import StartGoal

NEAREST = "nearest"
ANY = "any"


@dataclass(frozen=True)
class StraightLineSettings(Settings, name="straight_line"):
    goals: Annotated[str, OneOf((NEAREST, ANY))] = ANY
    """Goal configurations that are tried: only the nearest one, or all of them, the nearest first."""


def first_accepted(
    context: PlanningContext, paths: Iterable[Configurations], stage: str, reason: str
) -> PlanResult | None:
    """The result of the first path that the validator accepts; None if it accepts no path in time."""
    for path in paths:
        result = context.finish(path, stage, reason)
        if result is not None or context.ended:
            return result
    return None


class StraightLine(Planner[StraightLineSettings]):
    """Returns the shortest straight line from the start to a goal configuration that passes the validator."""

    name = "straight_line"
    settings_class = StraightLineSettings

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        start, goals = start_goal.rows()
        order = np.argsort(np.linalg.norm(goals - start, axis=1))
        selected = order[:1] if self.settings.goals == NEAREST else order
        paths = (start_goal.complete(np.stack([start, goal])) for goal in goals[selected])
        plural = "line is" if len(selected) == 1 else f"lines to {len(selected)} goal configurations are"
        return first_accepted(
            context, paths, "straight_line", "solved by the straight line"
        ) or context.unsolved(f"the straight {plural} refused")
