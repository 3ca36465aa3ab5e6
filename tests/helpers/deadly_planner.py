"""RRT-Connect that kills its process in scenes with a shape named deadly, and refuses the robot "unknown"."""

import os
import signal

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.results import PlanResult
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.search.rrt import RRTConnect, RRTConnectSettings
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.robots.robot import Robot

__all__ = ["Deadly", "RRTConnectSettings"]


class Deadly(RRTConnect):
    def prepare(self, robot: Robot) -> None:
        if robot.name == "unknown":
            raise InputError("no such robot")

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        if any(shape.name == "deadly" for shape in context.problem.scene.shapes):
            os.kill(os.getpid(), signal.SIGKILL)
        return super().solve(context, start_goal)
