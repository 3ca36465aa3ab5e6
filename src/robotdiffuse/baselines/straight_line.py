"""The straight line in joint space, without planning: a control for every planner."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy import ndarray

from robotdiffuse.core.settings import OneOf, Settings
from robotdiffuse.core.types import Configurations, Path, PlanResult
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.planner import Planner
from robotdiffuse.planning.start_goal import StartGoal

NEAREST = "nearest"
ANY = "any"


@dataclass(frozen=True)
class StraightLineSettings(Settings, name="straight_line"):
    goals: Annotated[str, OneOf((NEAREST, ANY))] = ANY
    """Goal configurations that are tried: only the nearest one, or all of them, the nearest first."""


def shortest_accepted(
    context: PlanningContext, start_goal: StartGoal, candidates: Iterable[Configurations], stage: str
) -> PlanResult | None:
    """The result of the shortest candidate that the validator accepts; None if it accepts none in time."""
    names = context.problem.robot.joint_names
    paths = [Path(names, start_goal.complete(q)) for q in candidates]
    for path in sorted(paths, key=lambda path: path.length):
        result = context.finish(path.positions, stage)
        if result is not None or context.ended:
            return result
    return None


def straight_lines(start_goal: StartGoal) -> ndarray:
    """The straight lines from the start to the goals [goals, 2, dof]."""
    start, goals = start_goal.leads()
    return np.stack([np.broadcast_to(start, goals.shape), goals], axis=1)


class StraightLine(Planner[StraightLineSettings]):
    """Returns the shortest straight line from the start to a goal configuration that passes the validator."""

    name = "straight_line"
    settings_class = StraightLineSettings

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        lines = straight_lines(start_goal)
        if self.settings.goals == NEAREST:
            lines = lines[[np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).argmin()]]
        subject = "line is" if len(lines) == 1 else f"lines to {len(lines)} goal configurations are"
        result = shortest_accepted(context, start_goal, lines, self.name)
        return result or context.unsolved(f"the straight {subject} refused")
