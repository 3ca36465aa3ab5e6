"""Every planner fulfills each kind of request, or refuses it with a line that names the planner and what it lacks."""

import re
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.panda import HOME, PANDA
from helpers.refusals import refuses
from robotdiffuse.core.transforms import rotation_about, transform
from robotdiffuse.perception.ray_caster import looking_at, ray_cast
from robotdiffuse.planning import CLEARANCE, PATH_CONSTRAINTS, PLANNERS, planners_that_support

GOAL = HOME + np.array([0.4, 0.1, 0.0, 0.1, 0.0, 0.0, 0.1])
HAND = "panda_hand"
ELBOW = "panda_link4"
SCENE = rd.Scene([rd.Box([0.0, -0.8, 0.3], [0.2, 0.2, 0.6], name="crate")])
T_WORLD_BASE = transform(np.array([1.0, -2.0, 0.5]), rotation_about(np.array([0.0, 0.0, 1.0]), 2.0))
MIDDLE = (HOME + GOAL) / 2
POSE = rd.PoseGoal(HAND, PANDA.fk(GOAL, HAND))
ROOMY = rd.PoseGoal(HAND, POSE.T_base_frame, [0.02] * 3, [0.1, 0.1, np.pi])
AT = POSE.T_base_frame[:3, 3]
WAY = AT - PANDA.fk(HOME, HAND)[:3, 3]
CONE = rd.AxisCone(HAND, [0, 0, 1], [0, 0, -1], 0.2)
HELD_CONE = rd.AxisCone("parcel", [0, 0, 1], [0, 0, -1], 0.2).moved(T_WORLD_BASE)
PASSING = rd.MovingObstacle(rd.Sphere([0.9, -0.6, 0.5], 0.1, name="ball"), velocity=[0.0, 0.8, 0.0])
ALL = {"base": True, "held": True, "waypoints": [MIDDLE], "constraints": [HELD_CONE], "blend": 0.1}
ASKED: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "pose": ({"goal": POSE}, {}),
    "pose with room": ({"goal": ROOMY}, {}),
    "poses of two links": ({"goal": rd.PosesGoal([rd.PoseGoal(ELBOW, PANDA.fk(GOAL, ELBOW)), POSE])}, {}),
    "any goal": ({"goal": [POSE, rd.JointGoal(GOAL)]}, {}),
    "waypoints": ({"waypoints": [MIDDLE]}, {}),
    "blended": ({"waypoints": [MIDDLE + 0.1, POSE], "goal": HOME, "blend": 0.05}, {}),
    "base": ({"base": True}, {}),
    "tool and attached": ({"held": True}, {}),
    "views": ({"seen": True}, {}),
    "first": ({}, {"until": "first"}),
    "scaling": ({}, {"velocity_scaling": 0.5, "acceleration_scaling": 0.3}),
    "payload": ({"payload": rd.Payload(2.0, [0.0, 0.0, 0.1], HAND)}, {}),
    "jerk": ({}, {"jerk": 100.0}),
    "no clearance": ({}, {"clearance": 0.0}),
    "clearance": ({}, {"clearance": 0.03}),
    "clearance of the problem": ({"clearance": 0.03}, {}),
    "cone": ({"constraints": [CONE]}, {}),
    "box": ({"constraints": [rd.PositionBox(HAND, [0, -1, 0], [1, 1, 1])]}, {}),
    "plane": ({"constraints": [rd.OnPlane(HAND, AT, [0, 0, 1], 0.05)]}, {}),
    "line": ({"constraints": [rd.OnLine(HAND, AT, WAY, 0.01)]}, {}),
    "Cartesian line": ({"constraints": [rd.CartesianLine(HAND, 0.002, 0.05, 0.2)]}, {}),
    "all of it": (ALL | {"payload": rd.Payload(0.5, link="parcel")}, {"clearance": 0.02, "jerk": 100.0}),
    "moving": ({"moving": [PASSING]}, {}),
    "moving and waypoints": ({"moving": [PASSING], "waypoints": [MIDDLE]}, {}),
    "moving and a cone": ({"moving": [PASSING], "constraints": [CONE]}, {}),
    "start velocity": ({"start_velocity": [0.1, 0, 0, 0, 0, 0, 0]}, {}),
    "views and a cone": ({"seen": True, "constraints": [CONE]}, {}),
}
"""What the problem has, and what the call asks for."""
planner_named = cache(rd.load_planner)


@cache
def problem_of(asked: str) -> rd.Problem:
    fields = dict(ASKED[asked][0])
    robot, scene, goal = PANDA, SCENE, fields.pop("goal", GOAL)
    if fields.pop("held", False):
        robot = PANDA.with_tool(HAND, transform(np.array([0.0, 0.0, 0.12])), [rd.Cylinder([0, 0, 0.09], 0.01, 0.06)])
        robot = robot.attach(rd.Box([0, 0, 0.04], [0.06] * 3, name="parcel"), "tool")
    if fields.pop("seen", False):
        T = looking_at(np.array([1.7, 0.0, 0.3]), np.array([0.0, 0.0, 0.3]))
        scene = rd.Scene()
        fields |= {"views": [ray_cast(SCENE, T, (75.0, 75.0, 39.5, 29.5), (80, 60), PANDA, HOME)], "unknown": "padded"}
    if fields.pop("base", False):
        return rd.Problem.in_world(T_WORLD_BASE, robot, scene.moved(T_WORLD_BASE), HOME, goal, **fields)
    return rd.Problem(robot, scene, HOME, goal, **fields)


THROUGH = ("robotdiffuse", "rrt_connect")
QUICK = ("pose", "any goal", "waypoints", "views", "clearance", "cone", "line", "moving", "start velocity")


@pytest.mark.parametrize(
    ("name", "asked"),
    [
        # the pipeline is one for all planners: the quick suite takes two of them through every request
        pytest.param(name, asked, marks=[pytest.mark.slow] * (name not in THROUGH and asked not in QUICK))
        for name, asked in product(PLANNERS, ASKED)
    ],
)
def test_every_request_is_met_or_refused_by_one_line(name: str, asked: str) -> None:
    if name.startswith("ompl_"):
        pytest.importorskip("ompl", reason="the extra `baselines` (ompl) is not installed")
    planner, problem, (fields, request) = planner_named(name), problem_of(asked), ASKED[asked]
    clear = fields.get("clearance") or request.get("clearance")
    needs = [PATH_CONSTRAINTS] * ("constraints" in fields) + [CLEARANCE] * bool(clear)
    for what in needs:
        assert (name in planners_that_support(what)) == (what in planner.supports)
    lacking = next((what for what in needs if what not in planner.supports), None)
    if lacking is not None:
        able = ", ".join(planners_that_support(lacking))
        message = f"planner {name} does not support {lacking}; these do: {able}"
        refuses(f"^{re.escape(message)}$", planner.plan, problem, time_limit=3.0, **request)
        return
    result = planner.plan(problem, time_limit=40.0, **{"until": "first", **request})
    assert result.path is not None and result.trajectory is not None, result.reason
    assert rd.verify(problem, result.path).valid and rd.verify(problem, result.trajectory).valid
