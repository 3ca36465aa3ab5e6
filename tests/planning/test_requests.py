"""Every planner fulfills each kind of request, or refuses it with one line that names the planner and what it
does not support."""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from itertools import product
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pytest

import robotdiffuse as rd
from robotdiffuse.core.transforms import rotation_about, transform
from robotdiffuse.perception.ray_caster import looking_at, ray_cast
from robotdiffuse.planning import CLEARANCE, PATH_CONSTRAINTS, PLANNERS, planners_that_support
from robotdiffuse.planning.planner import Planner

PANDA = rd.load_robot("panda")
START = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
GOAL = START + np.array([0.4, 0.1, 0.0, 0.1, 0.0, 0.0, 0.1])
HAND = "panda_hand"
ELBOW = "panda_link4"
FAR = rd.Box([0.0, -0.8, 0.3], [0.2, 0.2, 0.6], name="crate")
SCENE = rd.Scene([FAR])
T_GOAL = PANDA.fk(GOAL, HAND)
T_WORLD_BASE = transform(np.array([1.0, -2.0, 0.5]), rotation_about(np.array([0.0, 0.0, 1.0]), 2.0))
PLAIN = rd.Problem(PANDA, SCENE, START, GOAL)


class Asked(NamedTuple):
    problem: Callable[[], rd.Problem]
    request: Mapping[str, Any] = MappingProxyType({})
    needs: tuple[str, ...] = ()
    """What a planner must support."""


def _goal(goal: object) -> Callable[[], rd.Problem]:
    return lambda: replace(PLAIN, goal=goal)  # type: ignore[arg-type]


def _constrained(*constraints: Any) -> Callable[[], rd.Problem]:
    return lambda: replace(PLAIN, constraints=constraints)


def _held() -> rd.Problem:
    robot = PANDA.with_tool(
        HAND, transform(np.array([0.0, 0.0, 0.12])), [rd.Cylinder([0, 0, 0.09], 0.01, 0.06)]
    )
    return replace(PLAIN, robot=robot.attach(rd.Box([0, 0, 0.04], [0.06] * 3, name="parcel"), "tool"))


def _seen() -> rd.Problem:
    view = ray_cast(
        SCENE,
        looking_at(np.array([1.7, 0.0, 0.3]), np.array([0.0, 0.0, 0.3])),
        (75.0, 75.0, 39.5, 29.5),
        (80, 60),
        PANDA,
        START,
    )
    return rd.Problem(PANDA, rd.Scene(), START, GOAL, views=[view], unknown="padded")


ASKED: dict[str, Asked] = {
    "pose": Asked(_goal(rd.PoseGoal(HAND, T_GOAL))),
    "pose with room": Asked(_goal(rd.PoseGoal(HAND, T_GOAL, [0.02] * 3, [0.1, 0.1, np.pi]))),
    "poses of two links": Asked(
        _goal(rd.PosesGoal([rd.PoseGoal(ELBOW, PANDA.fk(GOAL, ELBOW)), rd.PoseGoal(HAND, T_GOAL)]))
    ),
    "any goal": Asked(_goal([rd.PoseGoal(HAND, T_GOAL), rd.JointGoal(GOAL)])),
    "waypoints": Asked(lambda: replace(PLAIN, waypoints=(rd.JointGoal((START + GOAL) / 2),))),
    "blended": Asked(
        lambda: replace(
            PLAIN,
            waypoints=(rd.JointGoal((START + GOAL) / 2 + 0.1), rd.PoseGoal(HAND, T_GOAL)),
            goal=START,
            blend=0.05,
        )
    ),
    "base": Asked(lambda: rd.Problem.in_world(T_WORLD_BASE, PANDA, SCENE.moved(T_WORLD_BASE), START, GOAL)),
    "tool and attached": Asked(_held),
    "views": Asked(_seen),
    "first": Asked(lambda: PLAIN, {"until": "first"}),
    "scaling": Asked(lambda: PLAIN, {"velocity_scaling": 0.5, "acceleration_scaling": 0.3}),
    "payload": Asked(lambda: replace(PLAIN, payload=rd.Payload(2.0, [0.0, 0.0, 0.1], HAND))),
    "jerk": Asked(lambda: PLAIN, {"jerk": 100.0}),
    "no clearance": Asked(lambda: PLAIN, {"clearance": 0.0}),
    "clearance": Asked(lambda: PLAIN, {"clearance": 0.03}, (CLEARANCE,)),
    "clearance of the problem": Asked(lambda: replace(PLAIN, clearance=0.03), {}, (CLEARANCE,)),
    "cone": Asked(_constrained(rd.AxisCone(HAND, [0, 0, 1], [0, 0, -1], 0.2)), {}, (PATH_CONSTRAINTS,)),
    "box": Asked(_constrained(rd.PositionBox(HAND, [0, -1, 0], [1, 1, 1])), {}, (PATH_CONSTRAINTS,)),
    "plane": Asked(_constrained(rd.OnPlane(HAND, T_GOAL[:3, 3], [0, 0, 1], 0.05)), {}, (PATH_CONSTRAINTS,)),
    "line": Asked(
        _constrained(rd.OnLine(HAND, T_GOAL[:3, 3], T_GOAL[:3, 3] - PANDA.fk(START, HAND)[:3, 3], 0.01)),
        {},
        (PATH_CONSTRAINTS,),
    ),
    "Cartesian line": Asked(_constrained(rd.CartesianLine(HAND, 0.002, 0.05, 0.2)), {}, (PATH_CONSTRAINTS,)),
}


def _all_of_it() -> rd.Problem:
    held = _held()
    cone = rd.AxisCone("parcel", [0, 0, 1], [0, 0, -1], 0.2).moved(T_WORLD_BASE)
    return rd.Problem.in_world(
        T_WORLD_BASE,
        held.robot,
        SCENE.moved(T_WORLD_BASE),
        START,
        GOAL,
        waypoints=[rd.JointGoal((START + GOAL) / 2)],
        constraints=[cone],
        blend=0.1,
        payload=rd.Payload(0.5, link="parcel"),
    )


ASKED["all of it"] = Asked(_all_of_it, {"clearance": 0.02, "jerk": 100.0}, (PATH_CONSTRAINTS, CLEARANCE))
PASSING = rd.MovingObstacle(rd.Sphere([0.9, -0.6, 0.5], 0.1, name="ball"), velocity=[0.0, 0.8, 0.0])
ASKED["moving"] = Asked(lambda: replace(PLAIN, moving=(PASSING,)))
ASKED["moving and waypoints"] = Asked(
    lambda: replace(PLAIN, moving=(PASSING,), waypoints=(rd.JointGoal((START + GOAL) / 2),))
)
ASKED["moving and a cone"] = Asked(
    lambda: replace(PLAIN, moving=(PASSING,), constraints=(rd.AxisCone(HAND, [0, 0, 1], [0, 0, -1], 0.2),)),
    {},
    (PATH_CONSTRAINTS,),
)
ASKED["start velocity"] = Asked(lambda: replace(PLAIN, start_velocity=[0.1, 0, 0, 0, 0, 0, 0]))
ASKED["views and a cone"] = Asked(
    lambda: replace(_seen(), constraints=(rd.AxisCone(HAND, [0, 0, 1], [0, 0, -1], 0.2),)),
    {},
    (PATH_CONSTRAINTS,),
)


@cache
def planner_named(name: str) -> Planner:
    return rd.load_planner(name)


@cache
def problem_of(asked: str) -> rd.Problem:
    return ASKED[asked].problem()


THROUGH = ("robotdiffuse", "rrt_connect")
QUICK = ("pose", "any goal", "waypoints", "views", "clearance", "cone", "line", "moving", "start velocity")


def marks_of(name: str, asked: str) -> list[pytest.MarkDecorator]:
    """The pipeline is one for all planners: the quick suite takes two of them through every request."""
    return [] if name in THROUGH or asked in QUICK else [pytest.mark.slow]


@pytest.mark.parametrize(
    ("name", "asked"),
    [
        pytest.param(name, asked, marks=marks_of(name, asked), id=f"{name}-{asked}")
        for name, asked in product(PLANNERS, ASKED)
    ],
)
def test_every_request_is_met_or_refused_by_one_line(name: str, asked: str) -> None:
    if name.startswith("ompl_"):
        pytest.importorskip("ompl", reason="the extra `baselines` (ompl) is not installed")
    planner, problem, (_, request, needs) = planner_named(name), problem_of(asked), ASKED[asked]
    for what in needs:
        assert (name in planners_that_support(what)) == (what in planner.supports)
    lacking = next((what for what in needs if what not in planner.supports), None)
    if lacking is not None:
        able = ", ".join(planners_that_support(lacking))
        message = f"planner {name} does not support {lacking}; these do: {able}"
        with pytest.raises(rd.InputError, match=f"^{re.escape(message)}$"):
            planner.plan(problem, time_limit=3.0, **request)
        return
    result = planner.plan(problem, time_limit=40.0, **{"until": "first", **request})
    assert result.path is not None and result.trajectory is not None, result.reason
    assert rd.verify(problem, result.path).valid and rd.verify(problem, result.trajectory).valid
