"""Pydantic models that describe requests and answers in /openapi.json.

They only describe: the workers parse requests with the strict parser of problem files, and write answers as
result files do.
"""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from robotdiffuse.core.types import CONVERGED, MAX_SAMPLE_RATE, TIME, Status
from robotdiffuse.planning import DEFAULT_PLANNER

PROBLEM: dict[str, Any] = {
    "robot": "panda",
    "scene": [{"box": {"center": [0.45, 0.0, 0.3], "size": [0.3, 0.05, 0.6], "name": "wall"}}],
    "start": [0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785],
    "goal": {"joints": [-0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785]},
}
WAYPOINTS = [PROBLEM["start"], PROBLEM["goal"]["joints"]]
JOINT_NAMES = [f"panda_joint{i}" for i in range(1, 8)]
VERIFY_EXAMPLE: Any = {"problem": PROBLEM, "path": {"joint_names": JOINT_NAMES, "positions": WAYPOINTS}}

Rows = list[list[float]]
Scaling = Annotated[float, Field(gt=0, le=1)]
ProblemField = Annotated[dict[str, Any], Field(description="as in a problem file", examples=[PROBLEM])]


class Error(BaseModel):
    """Any error."""

    error: str = Field(description="one line that says what is wrong")


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid")


class PlanRequest(_Request):
    """A problem, and the arguments of `plan`."""

    problem: ProblemField
    planner: str = Field(DEFAULT_PLANNER, description="a name of /planners")
    time_limit: float = Field(1.0, gt=0, description="[s]")
    seed: int = Field(0, ge=0)
    until: Literal["first", "converged", "time_limit"] = CONVERGED
    clearance: float | None = Field(None, ge=0, le=0.5, description="distance to keep where possible [m]")
    velocity_scaling: Scaling = 1.0
    acceleration_scaling: Scaling = 1.0
    objective: Literal["length", "time"] = TIME
    jerk: float | None = Field(
        None, gt=0, description="largest jerk of any joint [rad/s³]; null: the robot's limits"
    )
    rate: float | None = Field(
        None,
        gt=0,
        le=MAX_SAMPLE_RATE,
        description="rows per second of the answer's motion, which is validated so [Hz]; null: its own rows",
    )


class PathMotion(_Request):
    """Waypoints; radians, meters for prismatic joints."""

    joint_names: list[str] = Field(examples=[JOINT_NAMES])
    positions: Rows = Field(examples=[WAYPOINTS])


class TrajectoryMotion(PathMotion):
    """A timed motion; each array has a row for each time [s]."""

    times: list[float]
    velocities: Rows
    accelerations: Rows


class VerifyRequest(_Request):
    """A problem, and a path, a trajectory or both."""

    model_config = ConfigDict(json_schema_extra={"example": VERIFY_EXAMPLE})
    problem: ProblemField
    path: PathMotion | None = None
    trajectory: TrajectoryMotion | None = None


class PlanAnswer(BaseModel):
    """A result, as in a result file of `robotdiffuse plan --out`."""

    model_config = ConfigDict(extra="allow")
    status: Status
    reason: str
    verified: bool
    goal_index: int | None
    joint_names: list[str]
    waypoints: Rows | None
    times: list[float]
    positions: Rows
    velocities: Rows
    accelerations: Rows


class Violation(BaseModel):
    """The first thing that is wrong with a motion."""

    model_config = ConfigDict(extra="allow")
    kind: str
    message: str
    time: float


class MotionReport(BaseModel):
    """The validator's report on one motion; clearances are lower bounds [m]."""

    valid: bool
    min_clearance: float | None
    scene_clearance: float | None
    self_clearance: float | None
    violation: Violation | None


class VerifyAnswer(BaseModel):
    """The validator's report on each motion of the request."""

    valid: bool
    path: MotionReport | None = None
    trajectory: MotionReport | None = None


class JointInfo(BaseModel):
    """A planned joint: limits in rad, m, rad/s and so on; null for the limits of a continuous joint."""

    name: str
    kind: str
    lower: float | None
    upper: float | None
    velocity: float
    acceleration: float


class RobotInfo(BaseModel):
    """A robot that problems may name."""

    name: str
    base: str
    tip: str
    joints: list[JointInfo]
    links: list[str]


class PlannerInfo(BaseModel):
    """A planner that requests may name."""

    name: str
    kind: str
    description: str
    default: bool


class Health(BaseModel):
    """State of the server."""

    status: Literal["starting", "ok", "stopping"]
    workers: int
    workers_ready: int
    workers_busy: int
    requests_waiting: int


class Cancelled(BaseModel):
    """The request that was cancelled."""

    cancelled: str = Field(description="its X-Request-ID")
