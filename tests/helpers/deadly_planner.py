"""RRT-Connect that dies of a scene whose first shape is called deadly, and knows no robot "unknown"."""

import os
import signal

from robotdiffuse.core.errors import InputError
from robotdiffuse.planning.context import Call
from robotdiffuse.planning.start_goal import Ends
from robotdiffuse.planning.search.rrt_connect import RRTConnect, RRTConnectSettings
from robotdiffuse.core.results import PlanResult
from robotdiffuse.robots.robot import Robot

__all__ = ["Deadly", "RRTConnectSettings"]


class Deadly(RRTConnect):
    def prepare(self, robot: Robot) -> None:
        if robot.name == "unknown":
            raise InputError("no such robot")

    def solve(self, call: Call, ends: Ends) -> PlanResult:
        if any(shape.name == "deadly" for shape in call.problem.scene.shapes):
            os.kill(os.getpid(), signal.SIGKILL)
        return super().solve(call, ends)
