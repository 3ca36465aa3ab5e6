"""RRT-Connect that dies of a scene whose first shape is called deadly, and knows no robot "unknown"."""

import os
import signal

from robotdiffuse.errors import InputError
from robotdiffuse.planners.call import Call
from robotdiffuse.planners.ends import Ends
from robotdiffuse.planners.rrt_connect import RRTConnect, RRTConnectSettings
from robotdiffuse.results import PlanResult
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
