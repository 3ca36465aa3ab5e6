"""Every planner: solved means verified, all else has a reason; requests; seeds; many problems; continuous joints."""

import inspect
import re
import subprocess
import sys
import traceback
from dataclasses import fields, replace
from functools import cache, partial
from itertools import product
from pathlib import Path, Path as FilePath
from typing import Any

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.commands import python
from helpers.panda import HOME, LEFT, PANDA, RIGHT
from helpers.refusals import refuses
from robotdiffuse.core.registry import Entry
from robotdiffuse.core.transforms import rotation_about, transform
from robotdiffuse.interop.recorded_motion import RecordedMotion, motion_of_robot
from robotdiffuse.perception.ray_caster import looking_at, ray_cast
from robotdiffuse.planning import CLEARANCE, DEFAULT_PLANNER, PATH_CONSTRAINTS, PLANNERS, SEARCH, planners_that_support
from robotdiffuse.planning.context import PlanRequest
from robotdiffuse.planning.planner import Planner
from robotdiffuse.planning.search import rrt_kernel
from robotdiffuse.problems.files import held_out_problem
from robotdiffuse.robots.kinematic_tree import CONTINUOUS_LIMIT
from robotdiffuse.robots.parsing.urdf import with_limits
from robotdiffuse.robots.robot_folder import read_robot_folder, write_robot_folder
from robotdiffuse.validation.report import Report, Violation
from robotdiffuse.validation.validator import Verifier

GOAL = HOME + np.array([1.2, 0.3, 0.0, 0.4, 0.0, 0.0, 0.0])


@pytest.fixture(params=PLANNERS)
def name(request: pytest.FixtureRequest) -> str:
    if request.param.startswith("ompl_"):
        pytest.importorskip("ompl", reason="the extra `baselines` (ompl) is not installed")
    return request.param


@pytest.mark.parametrize("number", [0, 4])
def test_solved_means_verified(name: str, number: int) -> None:
    problem = held_out_problem("rop", number)
    result = rd.load_planner(name).plan(problem, time_limit=0.5, seed=number)
    assert result.planner == name and result.reason
    assert (result.path is not None) == (result.trajectory is not None) == result.solved
    if result.path is None or result.trajectory is None:
        assert result.progress == ()
        return
    assert rd.verify(problem, result.path).valid and rd.verify(problem, result.trajectory).valid
    times, lengths = np.array(result.progress).T
    assert (np.diff(times) >= 0).all() and (np.diff(lengths) < 0).all() and lengths[-1] == pytest.approx(result.path.length)


def test_a_goal_in_collision_is_reported_and_time_limit_and_seed_are_checked(name: str) -> None:
    problem = rd.Problem(PANDA, rd.Scene([rd.Sphere((0.2, 0.5, 0.5), 0.3)]), HOME, GOAL)
    planner = rd.load_planner(name)
    result = planner.plan(problem, time_limit=30.0)
    assert result.status is rd.Status.INVALID_GOAL and "in collision" in result.reason
    for wrong, message in (({"time_limit": 0.0}, "time_limit is 0"), ({"seed": -1}, "seed is -1")):
        refuses(message, planner.plan, problem, **wrong)


def test_weights_are_for_learned_planners_alone(name: str) -> None:
    learned = PLANNERS[name].kind != SEARCH
    with pytest.raises(rd.InputError, match="nowhere" if learned else "has no weights"):
        rd.load_planner(name, weights="nowhere").plan(rd.Problem(PANDA, rd.Scene([]), HOME, GOAL))


def test_weights_join_other_settings() -> None:
    settings = rd.load_planner("diffusion", {"samples": 1}, "panda_points").settings
    assert (settings.samples, settings.weights) == (1, "panda_points")
    refuses("weights twice", rd.load_planner, "diffusion", {"weights": "panda_points"}, "panda_points")


def test_plan_takes_the_fields_of_a_request() -> None:
    request = [(field.name, field.default) for field in fields(PlanRequest)]
    arguments = list(inspect.signature(rd.plan).parameters.values())
    arguments = [argument for argument in arguments if argument.name not in ("self", "problem", "planner", "settings")]
    assert [(argument.name, argument.default) for argument in arguments] == request


def test_plan_with_a_planner_and_settings_by_name() -> None:
    problem = rd.Problem(PANDA, rd.Scene(), HOME, GOAL)
    first = rd.plan(problem, planner="aorrtc", settings={"range": 0.5, "keep_trees": True})
    assert first.solved and first.planner == "aorrtc"
    nested = rd.load_planner("diffusion", {"guidance": {"margin": 0.03}, "guidance.self_margin": 0.02})
    assert (nested.settings.guidance.margin, nested.settings.guidance.self_margin) == (0.03, 0.02)  # type: ignore[attr-defined]
    refuses(r"patience=16000; did you mean range\?", rd.plan, problem, planner="aorrtc", settings={"rang": 1})
    refuses(r"aorrtc\.range is -1\.0", rd.plan, problem, planner="aorrtc", settings={"range": -1.0})
    refuses("settings is 'range=1'; it must be a table", rd.plan, problem, planner="aorrtc", settings="range=1")


def test_the_default_planner_is_aorrtc_and_needs_no_weights() -> None:
    panda = replace(PANDA, name="stranger")
    problem = rd.Problem(panda, rd.Scene([rd.Sphere([0.5, 0.0, 0.4], 0.15, name="ball")]), LEFT, RIGHT)
    names = (DEFAULT_PLANNER, "aorrtc")
    first, second = (rd.load_planner(name).plan(problem, 60.0, seed=3) for name in names)
    assert np.array_equal(first.path.positions, second.path.positions)
    assert (first.planner, second.planner) == names and first.stage == "aorrtc" and not first.notes


def test_warming_up_loads_what_a_plan_needs_by_default() -> None:
    # it ended at first paths, and the first plan then compiled the search for the fastest motion (10 s)
    assert inspect.signature(Planner.warm_up).parameters["until"].default == PlanRequest().until
    results = rd.load_planner("aorrtc").warm_up(rd.Problem(PANDA, rd.Scene([]), HOME, GOAL))
    rows = [len(result.path.positions) for result in results if result.path]
    assert rows[0] == 2 and max(rows) > 2, "balls in the way make corners"


def test_at_most_nine_functions_lead_to_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """docs/architecture.md lists these functions; the type checks of the tests do not count."""
    depths = set[int]()
    search = rrt_kernel.search

    def measured(*arguments: object) -> object:
        frames = [frame for frame, _ in traceback.walk_stack(None)]
        own = [frame for frame in frames if frame.f_globals["__name__"].startswith("robotdiffuse.")]
        depths.add(sum(not frame.f_code.co_filename.startswith("<@beartype") for frame in own))
        return search(*arguments)

    monkeypatch.setattr(rrt_kernel, "search", measured)
    assert rd.plan(rd.Problem(PANDA, rd.Scene([rd.Box([0.45, 0.0, 0.4], [0.3, 0.05, 0.8])]), LEFT, RIGHT)).solved
    assert depths and max(depths) <= 9


NEAR = HOME + np.array([0.4, 0.1, 0.0, 0.1, 0.0, 0.0, 0.1])
HAND = "panda_hand"
SCENE = rd.Scene([rd.Box([0.0, -0.8, 0.3], [0.2, 0.2, 0.6], name="crate")])
T_WORLD_BASE = transform(np.array([1.0, -2.0, 0.5]), rotation_about(np.array([0.0, 0.0, 1.0]), 2.0))
MIDDLE = (HOME + NEAR) / 2
POSE = rd.PoseGoal(HAND, PANDA.fk(NEAR, HAND))
AT = POSE.T_base_frame[:3, 3]
CONE = rd.AxisCone(HAND, [0, 0, 1], [0, 0, -1], 0.2)
HELD_CONE = rd.AxisCone("parcel", [0, 0, 1], [0, 0, -1], 0.2).moved(T_WORLD_BASE)
PASSING = rd.MovingObstacle(rd.Sphere([0.9, -0.6, 0.5], 0.1, name="ball"), velocity=[0.0, 0.8, 0.0])
ALL = {"base": True, "held": True, "waypoints": [MIDDLE], "constraints": [HELD_CONE], "blend": 0.1}
ASKED: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "pose": ({"goal": POSE}, {}),
    "pose with room": ({"goal": rd.PoseGoal(HAND, POSE.T_base_frame, [0.02] * 3, [0.1, 0.1, np.pi])}, {}),
    "poses of two links": ({"goal": rd.PosesGoal([rd.PoseGoal("panda_link4", PANDA.fk(NEAR, "panda_link4")), POSE])}, {}),
    "any goal": ({"goal": [POSE, rd.JointGoal(NEAR)]}, {}),
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
    "line": ({"constraints": [rd.OnLine(HAND, AT, AT - PANDA.fk(HOME, HAND)[:3, 3], 0.01)]}, {}),
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
    robot, scene, goal = PANDA, SCENE, fields.pop("goal", NEAR)
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


SHELF = Path(__file__).parents[2] / "src" / "robotdiffuse" / "examples" / "shelf.yaml"
SEEDED = ("rrt_connect", "aorrtc", "shared_tree_rrt_star", "diffusion", "robotdiffuse")
TWICE = f"""
import hashlib
import robotdiffuse as rd
from robotdiffuse.core.loading import compiled

problem = rd.load_problem({str(SHELF)!r})
for name in {SEEDED}:
    planner = rd.load_planner(name)
    for _ in range(2):
        motion = planner.plan(problem, 60.0, seed=3).trajectory
        print(name, hashlib.sha256(motion.times.tobytes() + motion.positions.tobytes()).hexdigest())
print("compiled", len(compiled))
"""


def motions(threads: int) -> list[str]:
    """A line for each motion, by a process that does not compile: in one that compiles, the last bits may differ."""
    counts = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))
    for _ in range(2):
        *lines, compiled = python(TWICE, 0, **counts).stdout.splitlines()
        if compiled == "compiled 0":
            break
    return lines


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_same_seed_gives_the_same_motion() -> None:
    here = motions(1)
    there = motions(2)
    assert len(here) == 2 * len(SEEDED)
    assert here[::2] == here[1::2], "twice in one process"
    assert here == there, "in another process with other threads"


@pytest.mark.parametrize("planner", ["aorrtc", "rrt_connect"])
def test_the_first_call_and_later_ones_give_the_same_path_although_paths_are_refused(planner, monkeypatch):
    """Regression: the duration of earlier validations decided when later calls validated, which changes their search."""
    accepted = Verifier.path
    refusals = list[float]()

    def refuses_some(verifier: Verifier, path: rd.Path) -> Report:
        report = accepted(verifier, path)
        if int(path.length * 1e9) % 3:
            return report
        refusals.append(path.length)
        return Report(False, Violation("scene_collision", 0.0, "refused by the test"), None, None)

    call = partial(rd.plan, rd.load_problem(SHELF), 60.0, planner=planner)
    monkeypatch.setattr(Verifier, "path", refuses_some)
    first = call(seed=1)
    refused = len(refusals)
    assert refused > 0
    for seed in range(2, 4):
        other = call(seed=seed, until="first").path
    refusals.clear()
    later = call(seed=1)
    assert len(refusals) == refused
    assert np.array_equal(first.path.positions, later.path.positions)
    assert not np.array_equal(first.path.positions, other.positions)


BURIED = rd.Scene([rd.Sphere([0.0, 0.0, 0.3], 0.5, name="everything")])


def problems() -> list[rd.Problem]:
    scenes = [rd.Scene([rd.Box([0.45, 0.0, h], [0.3, 0.05, 0.4], name="wall")]) for h in (0.2, 0.4, 0.6)]
    return [rd.Problem(PANDA, scene, LEFT, RIGHT) for scene in [*scenes, BURIED]]


def test_results_are_in_order_and_as_alone() -> None:
    counts: list[tuple[int, int]] = []
    cup = rd.Cylinder([0, 0, 0.16], 0.03, 0.12, name="cup")
    assert list(rd.plan_many([])) == []
    asked = problems()
    asked.insert(1, replace(asked[0], robot=PANDA.attach(cup, "panda_hand")))
    request: dict[str, Any] = {"settings": {"range": 0.3}, "until": "first", "time_limit": 300.0, "seed": 3}
    results = list(rd.plan_many(asked, "aorrtc", workers=2, progress=lambda *at: counts.append(at), **request))
    assert counts == [(done, 5) for done in range(1, 6)]
    assert [result.status for result in results] == [rd.Status.SOLVED] * 4 + [rd.Status.INVALID_START]
    for problem, together in zip(asked[:4], results[:4], strict=True):
        assert np.array_equal(together.path.positions, rd.plan(problem, planner="aorrtc", **request).path.positions)
        assert rd.verify(problem, together.path).valid


def test_a_process_that_dies_costs_one_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = problems()[:3]
    deadly = rd.Scene([rd.Box([0.45, 0.0, 0.4], [0.3, 0.05, 0.4], name="deadly")])
    asked.insert(1, rd.Problem(PANDA, deadly, LEFT, RIGHT))
    asked.insert(3, replace(asked[0], robot=replace(PANDA, name="unknown")))
    monkeypatch.setitem(PLANNERS, "deadly", Entry("helpers.planners:Deadly", "dies of it", "RRTConnectSettings", SEARCH))
    results = list(rd.plan_many(asked, "deadly", workers=1, time_limit=300.0))
    ends = [result.status for result in results]
    assert ends == [rd.Status.SOLVED, rd.Status.ERROR, rd.Status.SOLVED, rd.Status.ERROR, rd.Status.SOLVED]
    assert results[1].problem is asked[1] and "died" in results[1].reason and "no such robot" in results[3].reason


def test_arguments_are_checked_at_once() -> None:
    refuses("workers is 0", rd.plan_many, problems()[:1], workers=0)
    refuses("unknown planner 'rrt'", rd.plan_many, problems()[:1], planner="rrt")
    refuses("unknown argument 'time'; known: .*time_limit.*workers", rd.plan_many, problems()[:1], time=1.0)
    refuses("unknown until .soon.", rd.plan_many, problems()[:1], until="soon")


PLANS = """
import robotdiffuse as rd
panda = rd.load_robot("panda")
middle = (panda.lower + panda.upper) / 2
problems = [rd.Problem(panda, rd.Scene([]), middle, middle + 0.1)] * 2
for result in rd.plan_many(problems, "rrt_connect", workers=2):
    print(result.status.value, result.reason)
"""


@pytest.mark.parametrize("others", ["", "raise SystemExit", pytest.param("import os; os._exit(0)", marks=pytest.mark.slow)])
def test_a_script_that_processes_cannot_import_is_an_error(others: str, tmp_path: Path) -> None:
    """Regression: the call hung, since the robots for a starting process do not fit into a pipe that nobody reads."""
    script = tmp_path / "script.py"
    script.write_text(f'if __name__ != "__main__":\n    {others or "pass"}\n{PLANS}')
    lines = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=500).stdout.splitlines()
    assert len(lines) == 2 and len({*lines}) == 1
    assert lines[0].startswith("error a worker process could not import the main script")
    assert lines[0].endswith('below the line: if __name__ == "__main__":')


TURNING = {"kind": "continuous", "lower": -CONTINUOUS_LIMIT, "upper": CONTINUOUS_LIMIT}
ARM = replace(box_arm(), joints=tuple(replace(j, **TURNING) if j.name in ("j0", "j2") else j for j in box_arm().joints))
POST = rd.Scene([rd.Box([-0.7, 0.0, 0.0], [0.4, 0.05, 0.2], name="post")])
"""Where the stretched arm points at half a turn."""


def planned(planner: str, start: list[float], goal: object, scene: rd.Scene | None = None, **more: object) -> rd.Path:
    problem = rd.Problem(ARM, scene or rd.Scene(), start, goal)  # type: ignore[arg-type]
    result = rd.load_planner(planner).plan(problem, time_limit=60.0, **more)  # type: ignore[arg-type]
    assert result.solved, result.reason
    assert rd.verify(problem, result.path).valid and rd.verify(problem, result.trajectory).valid
    assert np.array_equal(result.path.positions[0], problem.start)
    assert np.abs(np.diff(result.trajectory.positions, axis=0)).max() < 0.05  # no jump: 2 rad/s at rows of 10 ms
    return result.path


@pytest.mark.parametrize(
    ("planner", "turns"), [("rrt_connect", 0), ("aorrtc", -5), ("robotdiffuse", 1), ("shared_tree_rrt_star", 1)]
)
def test_from_3_to_minus_3_is_a_short_way(planner: str, turns: int) -> None:
    """Regression: the way was 6 rad, in place of 0.28 rad across half a turn; the start may have whole turns."""
    start = 3.0 + 2 * np.pi * turns
    path = planned(planner, [start, 0.0, 0.0], [-3.0, 0.0, 0.0])
    assert path.length == pytest.approx(2 * np.pi - 6, abs=1e-6)
    assert path.positions[-1, 0] == pytest.approx(start + 2 * np.pi - 6)


def test_a_pose_is_reached_across_half_a_turn_and_the_long_way_where_something_blocks_the_short_one() -> None:
    assert planned("aorrtc", [2.9, 0.5, 0.2], rd.PoseGoal("tip", ARM.fk([-2.9, 0.5, 0.2], "tip"))).length < 0.6
    path = planned("aorrtc", [2.8, 0.0, 0.0], [-2.8, 0.0, 0.0], POST)
    assert path.positions[-1, 0] == pytest.approx(-2.8) and path.length > 5.5


def test_values_wrapped_to_half_a_turn_are_no_motion_but_those_of_a_file_are_unwrapped() -> None:
    """Regression: a path with wrapped values was valid, the long way round; with times, its rows turned at 1571 rad/s."""
    problem = rd.Problem(ARM, rd.Scene(), [3.0, 0.0, 0.0], [-3.0, 0.0, 0.0])
    motion = rd.load_planner("aorrtc").plan(problem).trajectory
    wrapped = (motion.positions + np.pi) % (2 * np.pi) - np.pi
    for rows in (rd.Path(ARM.joint_names, wrapped), replace(motion, positions=wrapped)):
        violation = rd.verify(problem, rows).violation
        assert violation.kind == "jump" and violation.subject == "j0" and "unwrap" in violation.message
    for times in (None, motion.times):
        velocities = None if times is None else motion.velocities
        read = motion_of_robot(RecordedMotion(ARM.joint_names, wrapped, times, velocities), ARM)
        assert isinstance(read.motion, rd.Path if times is None else rd.Trajectory)
        assert read.notes[0] == "values of j0 jump by whole turns; they were unwrapped"
        assert np.allclose(read.motion.positions, motion.positions) and rd.verify(problem, read.motion).valid


def test_images_of_a_goal() -> None:
    start = np.array([3.0, 1.0, -0.2])
    nearest, first, last = ARM.turned_both_ways(np.array([-3.0 - 4 * np.pi, -1.0, 0.2]), start, ARM.continuous)
    np.testing.assert_allclose(nearest, [2 * np.pi - 3, -1.0, 0.2])
    np.testing.assert_allclose(first, [-3.0, -1.0, 0.2])
    np.testing.assert_allclose(last, [2 * np.pi - 3, -1.0, 0.2 - 2 * np.pi])
    assert len(box_arm().turned_both_ways(start, start, box_arm().continuous)) == 1
    assert (np.abs([nearest, first, last]) <= CONTINUOUS_LIMIT).all()


def test_elbows_that_cannot_fold_through_reach_a_goal_on_the_other_side() -> None:
    """Regression: if two elbows on continuous joints had to turn back by way of zero, no goal let both do so: no path."""
    start = np.array([3.0, 1.0, 3.0])
    rows = ARM.turned_both_ways(-start, start, ARM.continuous)
    np.testing.assert_allclose(rows[[0, -1]], np.stack([np.array([2 * np.pi - 3, -1.0, 2 * np.pi - 3]), -start]))
    assert len(rows) == 4


def test_limits_of_a_continuous_joint(tmp_path: FilePath) -> None:
    """Limits make it revolute, as the validator checks none of continuous ones; in robot folders it has those of planning."""
    assert rd.Problem(ARM, rd.Scene(), [50.0, 0.0, 0.0], [0.0, 0.0, 0.0]).start[0] == 50.0
    narrow = with_limits(ARM, {"j0": {"lower": -1.0}})
    assert (narrow.planned_joints[0].kind, narrow.lower[0], narrow.upper[0]) == ("revolute", -1.0, np.pi)
    refuses("j0 is 50 rad; its limits are -1", rd.Problem, narrow, rd.Scene(), [50.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    joints = tuple(replace(j, lower=-np.pi, upper=np.pi) if j.name == "j0" else j for j in ARM.joints)
    write_robot_folder(replace(ARM, joints=joints), tmp_path, {})
    robot = read_robot_folder(tmp_path)
    assert robot.planned_joints[0].kind == "continuous" and robot.upper[0] == CONTINUOUS_LIMIT


def test_a_slow_start_velocity_near_a_joint_limit() -> None:
    start = np.array([PANDA.upper[0] - 0.003, *HOME[1:]])
    assert rd.plan(rd.Problem(PANDA, rd.Scene(), start, HOME, start_velocity=[0.001, 0, 0, 0, 0, 0, 0])).solved
