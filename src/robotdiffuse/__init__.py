"""Motion planning for redundant arms: `import robotdiffuse as rd`; every motion is verified."""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

from robotdiffuse.core.compile_cache import ensure_cache

if TYPE_CHECKING:
    from robotdiffuse.certificates.proof import Certificate as Certificate
    from robotdiffuse.certificates.proof import load_certificate as load_certificate
    from robotdiffuse.certificates.search import certify as certify
    from robotdiffuse.core.errors import InputError as InputError
    from robotdiffuse.core.results import PlanResult as PlanResult
    from robotdiffuse.core.results import load_result as load_result
    from robotdiffuse.core.types import Path as Path
    from robotdiffuse.core.types import Status as Status
    from robotdiffuse.core.types import Trajectory as Trajectory
    from robotdiffuse.datasets.loader import RopDataset as RopDataset
    from robotdiffuse.perception.depth_view import DepthView as DepthView
    from robotdiffuse.planning import load_planner as load_planner
    from robotdiffuse.planning import plan as plan
    from robotdiffuse.planning.next_view import NextView as NextView
    from robotdiffuse.planning.next_view import next_view as next_view
    from robotdiffuse.planning.plan_many import plan_many as plan_many
    from robotdiffuse.planning.reactive.replanner import Replanner as Replanner
    from robotdiffuse.planning.reactive.replanner import ReplannerSettings as ReplannerSettings
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
    from robotdiffuse.robots import load_robot as load_robot
    from robotdiffuse.robots.inertias import Payload as Payload
    from robotdiffuse.scenes.moving_obstacles import MovingObstacle as MovingObstacle
    from robotdiffuse.scenes.scene import Scene as Scene
    from robotdiffuse.scenes.shapes import Box as Box
    from robotdiffuse.scenes.shapes import Capsule as Capsule
    from robotdiffuse.scenes.shapes import Cylinder as Cylinder
    from robotdiffuse.scenes.shapes import Mesh as Mesh
    from robotdiffuse.scenes.shapes import PointCloud as PointCloud
    from robotdiffuse.scenes.shapes import Sphere as Sphere
    from robotdiffuse.validation.validator import verify as verify
    from robotdiffuse.visualization.notebook import show as show

__version__ = "0.1.0"
ensure_cache()

_HOME = {
    "Certificate": "robotdiffuse.certificates.proof",
    "certify": "robotdiffuse.certificates.search",
    "load_certificate": "robotdiffuse.certificates.proof",
    "InputError": "robotdiffuse.core.errors",
    "RopDataset": "robotdiffuse.datasets.loader",
    "load_result": "robotdiffuse.core.results",
    "load_planner": "robotdiffuse.planning",
    "NextView": "robotdiffuse.planning.next_view",
    "next_view": "robotdiffuse.planning.next_view",
    "plan": "robotdiffuse.planning",
    "plan_many": "robotdiffuse.planning.plan_many",
    "Replanner": "robotdiffuse.planning.reactive.replanner",
    "ReplannerSettings": "robotdiffuse.planning.reactive.replanner",
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
    "DepthView": "robotdiffuse.perception.depth_view",
    "MovingObstacle": "robotdiffuse.scenes.moving_obstacles",
    "Payload": "robotdiffuse.robots.inertias",
    "Box": "robotdiffuse.scenes.shapes",
    "Capsule": "robotdiffuse.scenes.shapes",
    "Cylinder": "robotdiffuse.scenes.shapes",
    "Mesh": "robotdiffuse.scenes.shapes",
    "PointCloud": "robotdiffuse.scenes.shapes",
    "Sphere": "robotdiffuse.scenes.shapes",
    "Path": "robotdiffuse.core.types",
    "PlanResult": "robotdiffuse.core.results",
    "Status": "robotdiffuse.core.types",
    "Trajectory": "robotdiffuse.core.types",
    "show": "robotdiffuse.visualization.notebook",
    "verify": "robotdiffuse.validation.validator",
}

__all__ = ["__version__", *_HOME]  # pyright: ignore[reportUnsupportedDunderAll]


class _Package(ModuleType):
    def __setattr__(self, name: str, value: object) -> None:
        # The import system would put the module robotdiffuse.validation.validator in the place of the function.
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
