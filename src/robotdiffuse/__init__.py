"""Motion planning for redundant arms: `import robotdiffuse as rd`; every motion is verified."""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

from robotdiffuse.compile_cache import ensure_cache

if TYPE_CHECKING:
    from robotdiffuse.certificates.certificate import Certificate as Certificate
    from robotdiffuse.certificates.certificate import load_certificate as load_certificate
    from robotdiffuse.certificates.writer import certify as certify
    from robotdiffuse.data.dataset import RopDataset as RopDataset
    from robotdiffuse.errors import InputError as InputError
    from robotdiffuse.planners import load_planner as load_planner
    from robotdiffuse.planners import plan as plan
    from robotdiffuse.planners.many import plan_many as plan_many
    from robotdiffuse.planners.next_view import NextView as NextView
    from robotdiffuse.planners.next_view import next_view as next_view
    from robotdiffuse.planners.replanner import Replanner as Replanner
    from robotdiffuse.planners.replanner import ReplannerSettings as ReplannerSettings
    from robotdiffuse.problems.constraints import AxisCone as AxisCone
    from robotdiffuse.problems.constraints import CartesianLine as CartesianLine
    from robotdiffuse.problems.constraints import OnLine as OnLine
    from robotdiffuse.problems.constraints import OnPlane as OnPlane
    from robotdiffuse.problems.constraints import PositionBox as PositionBox
    from robotdiffuse.problems.files import load_problem as load_problem
    from robotdiffuse.problems.goals import AnyGoal as AnyGoal
    from robotdiffuse.problems.goals import JointGoal as JointGoal
    from robotdiffuse.problems.goals import PoseGoal as PoseGoal
    from robotdiffuse.problems.goals import PosesGoal as PosesGoal
    from robotdiffuse.problems.problem import Problem as Problem
    from robotdiffuse.results import PlanResult as PlanResult
    from robotdiffuse.results import load_result as load_result
    from robotdiffuse.robots import load_robot as load_robot
    from robotdiffuse.robots.inertias import Payload as Payload
    from robotdiffuse.scenes.depth_view import DepthView as DepthView
    from robotdiffuse.scenes.moving import MovingObstacle as MovingObstacle
    from robotdiffuse.scenes.scene import Scene as Scene
    from robotdiffuse.scenes.shapes import Box as Box
    from robotdiffuse.scenes.shapes import Capsule as Capsule
    from robotdiffuse.scenes.shapes import Cylinder as Cylinder
    from robotdiffuse.scenes.shapes import Mesh as Mesh
    from robotdiffuse.scenes.shapes import PointCloud as PointCloud
    from robotdiffuse.scenes.shapes import Sphere as Sphere
    from robotdiffuse.types import Path as Path
    from robotdiffuse.types import Status as Status
    from robotdiffuse.types import Trajectory as Trajectory
    from robotdiffuse.verify import verify as verify
    from robotdiffuse.viewer.notebook import show as show

__version__ = "0.1.0"
ensure_cache()

_HOME = {
    "Certificate": "robotdiffuse.certificates.certificate",
    "certify": "robotdiffuse.certificates.writer",
    "load_certificate": "robotdiffuse.certificates.certificate",
    "InputError": "robotdiffuse.errors",
    "RopDataset": "robotdiffuse.data.dataset",
    "load_result": "robotdiffuse.results",
    "load_planner": "robotdiffuse.planners",
    "NextView": "robotdiffuse.planners.next_view",
    "next_view": "robotdiffuse.planners.next_view",
    "plan": "robotdiffuse.planners",
    "plan_many": "robotdiffuse.planners.many",
    "Replanner": "robotdiffuse.planners.replanner",
    "ReplannerSettings": "robotdiffuse.planners.replanner",
    "AnyGoal": "robotdiffuse.problems.goals",
    "JointGoal": "robotdiffuse.problems.goals",
    "PoseGoal": "robotdiffuse.problems.goals",
    "PosesGoal": "robotdiffuse.problems.goals",
    "AxisCone": "robotdiffuse.problems.constraints",
    "CartesianLine": "robotdiffuse.problems.constraints",
    "OnLine": "robotdiffuse.problems.constraints",
    "OnPlane": "robotdiffuse.problems.constraints",
    "PositionBox": "robotdiffuse.problems.constraints",
    "Problem": "robotdiffuse.problems.problem",
    "load_problem": "robotdiffuse.problems.files",
    "load_robot": "robotdiffuse.robots",
    "Scene": "robotdiffuse.scenes.scene",
    "DepthView": "robotdiffuse.scenes.depth_view",
    "MovingObstacle": "robotdiffuse.scenes.moving",
    "Payload": "robotdiffuse.robots.inertias",
    "Box": "robotdiffuse.scenes.shapes",
    "Capsule": "robotdiffuse.scenes.shapes",
    "Cylinder": "robotdiffuse.scenes.shapes",
    "Mesh": "robotdiffuse.scenes.shapes",
    "PointCloud": "robotdiffuse.scenes.shapes",
    "Sphere": "robotdiffuse.scenes.shapes",
    "Path": "robotdiffuse.types",
    "PlanResult": "robotdiffuse.results",
    "Status": "robotdiffuse.types",
    "Trajectory": "robotdiffuse.types",
    "show": "robotdiffuse.viewer.notebook",
    "verify": "robotdiffuse.verify",
}

__all__ = ["__version__", *_HOME]  # pyright: ignore[reportUnsupportedDunderAll]


class _Package(ModuleType):
    def __setattr__(self, name: str, value: object) -> None:
        # The import system would put the module robotdiffuse.verify in the place of the function.
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> object:
    """Import a public name when it is first used: PyTorch and the kernels take a second to import."""
    if name not in _HOME:
        raise AttributeError(f"module 'robotdiffuse' has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
