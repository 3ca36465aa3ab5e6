"""Kinds of requests: carried objects, tools, bases, tolerances, waypoints, both hands, payloads.

    python benchmarks/planning_requests.py --scenes FOLDER [--places 1] [--number 120] [--planner aorrtc]
    python benchmarks/planning_requests.py --parts blended,payloads [--number 20]

`carried`, `together` and `both_hands` print benchmarks/results/requests.txt, the others one_motion.txt.

- carried: scenes of MotionBenchMaker's table_pick (FOLDER). The arm holds the can where the scene's problem
  ends, and carries it to random places on the table: upright, at any angle about the vertical, 5 mm above the
  top. A place that another object occupies, or that no free configuration reaches, is drawn again.
- together: held-out problems of the families shelf and table, with a moved and turned base, a tool of 6 cm, a
  held box of random size, a pose of this box with tolerances as the goal, and a waypoint. Problems that start
  in collision are left out.
- both_hands: Baxter with a post on a table in front of it, from a random free configuration to the poses of
  both hands in another free configuration.
- blended: from the start of a held-out problem through three random waypoints to its goal. In half of the
  problems, waypoints are configurations, in the others poses of the hand. The arm stops at each waypoint, or
  passes it within the blend; the seed is equal, so that the segments are equal too.
- payloads: held-out problems with masses 10 cm in front of the hand's frame; torques are computed at every
  row of the motion.

Time limits are of CPU time. Coal on the exact meshes and PyBullet check every returned motion: its path every
0.01 rad, and each row of the timed motion. PyBullet loads robot and tool from a URDF; if the problem has a
base, everything is in the world's frame. PyBullet's own kinematics tell where the held object ends.
"""

import argparse
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray
from scipy.interpolate import CubicHermiteSpline

import robotdiffuse as rd
from common import (
    TIME_LIMIT,
    contacts_on_meshes,
    dense,
    header,
    parse,
    parts_of,
    print_table,
    progress,
    use_processor_time,
)
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import inverse, rotation_from_rpy, transform
from robotdiffuse.core.types import PlanResult, Trajectory
from robotdiffuse.planning.context import PlanningContext, PlanRequest
from robotdiffuse.planning.start_goal import usable_start_goal
from robotdiffuse.problems.files import SEED, held_out_problem, load_motion_bench_maker
from robotdiffuse.problems.problem import Goal, JointGoal, PoseGoal, PosesGoal, Problem, poses_of
from robotdiffuse.robots.dynamics import Dynamics
from robotdiffuse.simulation.world import World
from robotdiffuse.validation.tolerances import goal_error

# Time limits [s]. A problem counts as solvable if it is solved within the longer one.
SHORT = 1.0
LONG = 10.0
CAN = "Can1"
HAND = "panda_hand"
PLACE_GAP = 0.005
"""Height above the table at which the can is put down [m]."""
PLACE_REACH = 0.75
"""Largest distance of a place from the base's axis [m]."""
PLACE_TRIES = 40
"""Largest number of places that are drawn until `places` of them can be reached."""
PLACE_LIMIT = 0.15
"""Time limit of a call that looks for configurations at a place [s]."""
PATH_STEP = 0.01
"""Largest joint motion between two checked configurations of a path [rad]."""
HANDS = ("left_gripper", "right_gripper")
BLENDS = (0.02, 0.05, 0.1, 0.2)
MASSES = (0.0, 1.0, 2.0, 3.0)
"""[kg]; a Panda carries up to 3."""
MOTION_LIMIT = 5.0
"""Time limit of calls with blends and payloads [s]."""
CURVE_SAMPLES = 20_000
"""Number of times of a motion at which its distance to waypoints is measured."""


class NamedProblem(NamedTuple):
    name: str
    problem: Problem


class Checked(NamedTuple):
    """A motion as Coal and PyBullet see it."""

    coal: int
    """Number of configurations in collision by Coal."""
    pybullet: bool
    """Whether any configuration is in collision by PyBullet."""
    off: float
    """How far the held object or a hand ends off its goal beyond the tolerances [m]."""


def carried(folder: Path, places: int) -> Iterator[NamedProblem]:
    """Problems that carry the can of each scene to random places on its table."""
    for number, entry in enumerate(load_motion_bench_maker(folder)):
        rng = np.random.default_rng([SEED, number])
        if entry.problem is None or not isinstance(entry.problem.goal, JointGoal):
            continue
        robot = entry.problem.robot
        q = entry.problem.goal.positions[0]
        scene, holding = entry.problem.scene.attach(CAN, robot, q)
        reachable = 0
        for _ in range(PLACE_TRIES):
            goal = PoseGoal(CAN, _place(scene, entry.problem.scene, rng), [0, 0, 0], [0, 0, np.pi])
            problem = Problem(holding, scene, q, goal)
            if not isinstance(
                usable_start_goal(PlanningContext("places", problem, PlanRequest(PLACE_LIMIT))), PlanResult
            ):
                yield NamedProblem(f"{entry.name}-{reachable}", problem)
                reachable += 1
            if reachable == places:
                break


def _place(scene: rd.Scene, whole: rd.Scene, rng: np.random.Generator) -> ndarray:
    """A random upright T_base_can on the table, not inside another object."""
    [top] = [shape for shape in scene.shapes if shape.name == "table_top"]
    [can] = [shape for shape in whole.shapes if shape.name == CAN]
    assert isinstance(top, rd.Box) and isinstance(can, rd.Cylinder)
    T = transform(top.center, top.rotation)
    grown = np.array([[-can.radius], [can.radius]])
    while True:
        x, y = rng.uniform(-0.5, 0.5, 2) * top.size[:2]
        at = T @ [x, y, top.size[2] / 2 + can.height / 2 + PLACE_GAP, 1.0]
        around = [shape.bounds + grown for shape in scene.shapes if shape is not top]
        low = at[2] - can.height / 2
        high = at[2] + can.height / 2
        is_occupied = any(
            (b[0, :2] < at[:2]).all() and (at[:2] < b[1, :2]).all() and b[0, 2] < high and low < b[1, 2]
            for b in around
        )
        if np.linalg.norm(at[:2]) < PLACE_REACH and not is_occupied:
            return transform(at[:3])


def together(number: int) -> Iterator[NamedProblem]:
    """Held-out problems with base, tool, held box, tolerances and a waypoint, that do not start in
    collision."""
    for i in range(number):
        rng = np.random.default_rng([SEED, 1, i])
        held_out = held_out_problem(("shelf", "table")[i % 2], i // 2)
        assert isinstance(held_out.goal, JointGoal)
        T_hand_tool = transform(np.array([0.0, 0.0, 0.12]))
        robot = held_out.robot.with_tool("panda_hand", T_hand_tool, [rd.Cylinder([0, 0, 0.09], 0.01, 0.06)])
        size = rng.uniform(0.03, 0.1, 3)
        robot = robot.attach(rd.Box([0, 0, size[2] / 2 + 0.001], size, name="parcel"), "tool")
        T_world_base = transform(rng.uniform(-1, 1, 3), rotation_from_rpy(*rng.uniform(-3, 3, 3).tolist()))
        goals: list[Goal] = [
            PoseGoal("parcel", T_world_base @ robot.fk(q, "parcel"), [0.02] * 3, [0.1, 0.1, np.pi])
            for q in (held_out.goal.positions[0], held_out.start)
        ]
        world = held_out.scene.moved(T_world_base)
        try:
            problem = Problem.in_world(
                T_world_base, robot, world, held_out.start, goals[1], waypoints=[goals[0]]
            )
        except InputError:
            continue
        if ExactCollision(problem.robot, problem.scene).collides(problem.start[None])[0]:
            continue
        yield NamedProblem(f"{('shelf', 'table')[i % 2]}/{i // 2}", problem)


def both_hands(number: int) -> Iterator[NamedProblem]:
    """Problems whose goals are poses of both of Baxter's hands."""
    robot = rd.load_robot("baxter")
    table = rd.Box([0.75, 0.0, 0.05], [0.5, 1.2, 0.04], name="table")
    scene = rd.Scene([table, rd.Box([0.75, 0.0, 0.27], [0.12, 0.12, 0.4], name="post")])
    checker = CollisionChecker(robot, scene)
    rng = np.random.default_rng([SEED, 3])
    for i in range(number):
        free = np.zeros((0, robot.dof))
        while len(free) < 2:
            drawn = rng.uniform(robot.lower, robot.upper, (16, robot.dof))
            free = np.concatenate([free, drawn[checker.free(drawn)]])
        poses = [PoseGoal(hand, robot.fk(free[1], hand)) for hand in HANDS]
        yield NamedProblem(f"baxter/{i}", Problem(robot, scene, free[0], PosesGoal(poses)))


def checked(named: NamedProblem, result: PlanResult) -> Checked:
    """Check the motion of a result by Coal and PyBullet."""
    problem = named.problem
    assert result.path is not None and result.trajectory is not None
    path = dense(result.path.positions, PATH_STEP)
    contacts = contacts_on_meshes(problem, np.concatenate([path, result.trajectory.positions]))
    end = result.trajectory.positions[-1]
    standing, _ = problem.robot_and_scene_in_world()
    with World(standing, rd.Scene()) as simulated:
        simulated.place(end)
        off = max(_off(problem, pose, simulated) for pose in poses_of(problem.goal))
    assert goal_error(problem.robot, problem.goal, end) is None
    return Checked(*contacts, off)


def _off(problem: Problem, pose: PoseGoal, simulated: World) -> float:
    """How far the position of a link of the simulated robot is off its goal, beyond the tolerance [m]."""
    state = simulated.bullet.getLinkState(
        simulated.body,
        simulated.links[pose.frame],
        computeForwardKinematics=1,
    )
    T = np.eye(4) if problem.T_world_base is None else problem.T_world_base
    p_goal = inverse(T @ pose.T_base_frame) @ [*state[4], 1.0]
    allowed = np.zeros(3) if pose.xyz_tolerance is None else pose.xyz_tolerance
    return float(np.maximum(np.abs(p_goal[:3]) - allowed, 0.0).max())


def measured(title: str, every: list[NamedProblem], name: str) -> None:
    """Plan all problems with the planner `name`, check the motions on meshes, and print a table."""
    planner = rd.load_planner(name)
    planner.warm_up(every[0].problem, TIME_LIMIT)
    results = []
    longer = []
    checks = []
    for i, named in enumerate(progress(every, title)):
        result = planner.plan(named.problem, time_limit=SHORT, seed=i)
        long = result if result.solved else planner.plan(named.problem, time_limit=LONG, seed=i + 1)
        results.append(result)
        longer.append(long)
        if long.solved:
            checks.append(checked(named, long))
    solved = sum(r.solved for r in results)
    possible = sum(r.solved for r in longer)
    times = [1e3 * r.planning_time for r in results if r.solved]
    print_table(
        f"{title}: {len(every)} problems, {name}",
        ("", "figure"),
        [
            (f"solved in {SHORT:.0f} s", f"{solved} of {possible} that {LONG:.0f} s solve"),
            (
                "CPU time of planning, median / p95",
                f"{np.median(times):.0f} / {np.percentile(times, 95):.0f} ms" if times else "-",
            ),
            ("motions that are checked", str(len(checks))),
            ("in collision by Coal", str(sum(s.coal > 0 for s in checks))),
            ("in collision by PyBullet", str(sum(s.pybullet for s in checks))),
            (
                "largest distance of held object or hand from its goal at the end, by PyBullet",
                f"{1e3 * max((s.off for s in checks), default=0.0):.3f} mm",
            ),
        ],
        [
            f"{count} not solved: {what}"
            for what, count in Counter(
                f"{r.status.value}, {r.reason.split(':')[0][:60]}" for r in longer if not r.solved
            ).items()
        ],
    )


def attaching() -> None:
    """Print the CPU time of attaching a box of a new size."""
    robot = rd.load_robot("panda")
    rng = np.random.default_rng(0)
    rows = []
    for what, prepared in (("robot.attach", False), ("and all arrays of search and validator", True)):
        spent = []
        for _ in range(30):
            began = time.process_time()
            held = robot.attach(rd.Box([0, 0, 0.15], rng.uniform(0.03, 0.1, 3), name="box"), "panda_hand")
            if prepared:
                search_space(CollisionChecker(held, rd.Scene()), 0.02)
            spent.append(1e3 * (time.process_time() - began))
        rows.append((what, f"{np.median(spent):.0f} ms", f"{np.max(spent[1:]):.0f} ms"))
    print_table("A box on the hand, CPU time of 30", ("", "median", "largest"), rows)


def sequences(number: int) -> Iterator[Problem]:
    """Problems with three waypoints each: configurations in half of the problems, poses in the others."""
    for i in range(number):
        rng = np.random.default_rng([SEED, 2, i])
        held_out = held_out_problem(("shelf", "table")[i % 2], i // 2)
        robot = held_out.robot
        exact = ExactCollision(held_out.robot, held_out.scene)
        waypoints: list[Any] = []
        while len(waypoints) < 3:
            q = held_out.start + rng.uniform(-1.0, 1.0, robot.dof)
            within = ((q > robot.lower) & (q < robot.upper)).all()
            if within and not exact.collides(q[None])[0]:
                waypoints.append(PoseGoal(HAND, robot.fk(q, HAND)) if i // 2 % 2 else JointGoal(q))
        yield replace(held_out, waypoints=waypoints)


def nearest(problem: Problem, motion: Trajectory) -> list[float]:
    """The least distance of a motion to each waypoint [rad] or [m]."""
    curve = CubicHermiteSpline(motion.times, motion.positions, motion.velocities)
    q: ndarray = curve(np.linspace(0, motion.duration, CURVE_SAMPLES))
    distances = []
    for goal in problem.waypoints:
        if isinstance(goal, JointGoal):
            apart = q - goal.positions[0]
        else:
            assert isinstance(goal, PoseGoal)
            apart = problem.robot.fk(q, goal.frame)[:, :3, 3] - goal.T_base_frame[:3, 3]
        distances.append(float(np.linalg.norm(apart, axis=1).min()))
    return distances


def blended(number: int, name: str) -> None:
    """Plan with stops and with each blend, check the motions on meshes, and print a table."""
    planner = rd.load_planner(name)
    problems = list(sequences(number))
    planner.warm_up(problems[0], TIME_LIMIT)
    rows = []
    collisions = 0
    for i, problem in enumerate(progress(problems, "Blended")):
        by_blend: dict[str, Any] = {}
        for blend in (0.0, *BLENDS):
            named = replace(problem, blend=blend)
            began = time.process_time()
            result = planner.plan(named, time_limit=MOTION_LIMIT, seed=i)
            spent = time.process_time() - began
            if result.trajectory is None:
                break
            motion = result.trajectory
            contacts = contacts_on_meshes(problem, motion.positions)
            collisions += int(contacts.coal > 0) + int(contacts.pybullet)
            speeds = np.linalg.norm(motion.velocities[1:-1], axis=1)
            beyond = [d / blend if blend else d for d in nearest(problem, motion)]
            by_blend[f"{blend:g}"] = motion.duration, spent, float(speeds.min()), max(beyond)
        if len(by_blend) == 1 + len(BLENDS):
            rows.append(by_blend)
    if not rows:
        print(f"Blended: none of {number} sequences is solved")
        return
    stops = np.array([row["0"][:2] for row in rows])
    table = []
    for blend in ("0", *(f"{blend:g}" for blend in BLENDS)):
        values = np.array([row[blend] for row in rows])
        ratio = values[:, 0] / stops[:, 0]
        table.append(
            (
                "stopped at" if blend == "0" else f"blend {blend}",
                f"{np.median(values[:, 0]):.2f} s",
                f"{np.median(ratio):.3f}",
                f"{ratio.min():.3f} to {ratio.max():.3f}",
                f"{(values[:, 2] > 1e-3).sum()}",
                "" if blend == "0" else f"{values[:, 3].max():.3f}",
                f"{1e3 * np.median(values[:, 1]):.0f} ms",
            )
        )
    print_table(
        f"{len(rows)} of {number} sequences of three waypoints, {name}",
        (
            "",
            "duration, median",
            "over that with stops",
            "least to most",
            "without any stop",
            "largest distance from a waypoint, over blend",
            "CPU time",
        ),
        table,
        [f"{5 * len(rows)} motions before Coal and PyBullet: {collisions} in collision"],
    )


def payloads(number: int, name: str) -> None:
    """Print durations and torques of motions with payloads."""
    planner = rd.load_planner(name)
    rows = []
    for mass in MASSES:
        ratios = list[float]()
        shares = list[float]()
        refused = 0
        spent = list[float]()
        for i in range(number):
            unloaded = held_out_problem(("shelf", "table")[i % 2], i // 2)
            problem = replace(unloaded, payload=rd.Payload(mass, [0.0, 0.0, 0.1], HAND))
            without_payload = planner.plan(unloaded, time_limit=MOTION_LIMIT, seed=i)
            began = time.process_time()
            result = planner.plan(problem, time_limit=MOTION_LIMIT, seed=i)
            spent.append(1e3 * (time.process_time() - began))
            refused += result.status.value in ("invalid_start", "invalid_goal")
            if result.trajectory is None or without_payload.trajectory is None:
                continue
            motion = result.trajectory
            dynamics = Dynamics(problem.robot, rd.Payload(mass, [0.0, 0.0, 0.1], HAND))
            torques = dynamics.torques(motion.positions, motion.velocities, motion.accelerations)
            ratios.append(motion.duration / without_payload.trajectory.duration)
            shares.append(float((np.abs(torques) / dynamics.limits).max()))
        rows.append(
            (
                f"{mass:g} kg",
                f"{len(ratios)} of {number}",
                str(refused),
                f"{np.median(ratios):.3f}",
                f"{max(ratios, default=np.nan):.3f}",
                f"{max(shares, default=np.nan):.3f}",
                f"{np.median(spent):.0f} ms",
            )
        )
    columns = (
        "solved",
        "ends not held",
        "duration over that without payload, median",
        "most",
        "torque over limit",
        "CPU time",
    )
    print_table(f"Payloads, {name}", ("", *columns), rows)


PARTS = ("carried", "together", "both_hands", "blended", "payloads")


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Held objects, tools, bases, waypoints, both hands, payloads."
    )
    parser.add_argument(
        "--parts", help=f"parts of {','.join(PARTS)}, separated by commas (all; carried only with --scenes)"
    )
    parser.add_argument("--scenes", type=Path, help="folder of table_pick, for `carried`")
    parser.add_argument(
        "--places", type=int, default=1, help="number of places in each scene, for `carried` (1)"
    )
    parser.add_argument("--number", type=int, default=120, help="number of problems of each other kind (120)")
    parser.add_argument("--planner", default="aorrtc", help="planner to use (aorrtc)")
    arguments = parse(parser, number=1)
    default = PARTS if arguments.scenes else PARTS[1:]
    parts = parts_of(arguments.parts or ",".join(default), PARTS)
    use_processor_time()
    print(header("numba", "numpy", "coal", "pybullet"))
    number = arguments.number
    planner = arguments.planner
    if "carried" in parts:
        attaching()
        measured("Carried", list(carried(arguments.scenes, arguments.places)), planner)
    if "together" in parts:
        measured("Together", list(together(number)), planner)
    if "both_hands" in parts:
        measured("Both hands", list(both_hands(number)), planner)
    if "blended" in parts:
        blended(number, planner)
    if "payloads" in parts:
        payloads(number, planner)


if __name__ == "__main__":
    main()
