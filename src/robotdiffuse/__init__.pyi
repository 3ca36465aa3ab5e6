"""The public names, each imported when it is first used."""

from .certificates.certificate import Certificate as Certificate
from .certificates.certificate import load_certificate as load_certificate
from .certificates.search import certify as certify
from .core.errors import InputError as InputError
from .core.results import PlanResult as PlanResult
from .core.results import load_result as load_result
from .core.types import Path as Path
from .core.types import Status as Status
from .core.types import Trajectory as Trajectory
from .datasets.loader import RopDataset as RopDataset
from .datasets.own_motions import write_dataset as write_dataset
from .perception.depth_view import DepthView as DepthView
from .planning import load_planner as load_planner
from .planning import plan as plan
from .planning.next_view import NextView as NextView
from .planning.next_view import next_view as next_view
from .planning.plan_many import plan_many as plan_many
from .planning.reactive.replanner import Replanner as Replanner
from .planning.reactive.replanner import ReplannerSettings as ReplannerSettings
from .problems.constraints import AxisCone as AxisCone
from .problems.constraints import CartesianLine as CartesianLine
from .problems.constraints import OnLine as OnLine
from .problems.constraints import OnPlane as OnPlane
from .problems.constraints import PositionBox as PositionBox
from .problems.files import load_problem as load_problem
from .problems.goals import AnyGoal as AnyGoal
from .problems.goals import JointGoal as JointGoal
from .problems.goals import PoseGoal as PoseGoal
from .problems.goals import PosesGoal as PosesGoal
from .problems.problem import Problem as Problem
from .robots import load_robot as load_robot
from .robots.inertias import Payload as Payload
from .scenes.height_map import HeightMap as HeightMap
from .scenes.moving_obstacles import MovingObstacle as MovingObstacle
from .scenes.scene import Scene as Scene
from .scenes.shapes import Box as Box
from .scenes.shapes import Capsule as Capsule
from .scenes.shapes import Cylinder as Cylinder
from .scenes.shapes import Mesh as Mesh
from .scenes.shapes import PointCloud as PointCloud
from .scenes.shapes import Sphere as Sphere
from .validation.validator import verify as verify
from .visualization.notebook import show as show

__version__: str
