"""What people ask a planner for: objects carried, tools, bases elsewhere, goals that leave room, waypoints,
a pose for each hand.

    python benchmarks/requests.py --scenes FOLDER [--places 1] [--number 120] [--planner aorrtc]
    python benchmarks/requests.py --kinds both_hands

Carried: MotionBenchMaker's table_pick (FOLDER), with the can in the hand where its problems end, to random
places on the table: upright, at any turn about the vertical, 5 mm above the top. Places that the can itself
finds taken, or that no free configuration reaches, are drawn again. Together: held-out problems of the
families shelf and table, with the base turned and moved, a tool of 6 cm, a held box of random size, the goal
as a pose of that box with tolerances, and a waypoint; those that start in collision are left out. Both hands:
Baxter, with a post on a table before it, from a random configuration to poses of both hands that a random one
has; both configurations are free.

Every motion that is returned goes before two oracles: Coal on the exact meshes, every 0.01 rad of the path
and at every row of the timed motion; and PyBullet, which has robot and tool as a URDF of its own and, where
the problem has a base, all in the world's frame. PyBullet's own kinematics say where the object ends.
Path constraints are measured by constraints.py.
"""

import argparse
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pybullet
from numpy import ndarray
from report import header, print_table, progress

import robotdiffuse as rd
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.collision.motions import largest_motion_radii
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.transforms import inverse, rotation_from_rpy, transform
from robotdiffuse.core.types import Path as JointPath
from robotdiffuse.planning import context
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.start_goal import usable_start_goal
from robotdiffuse.problems.files import load_motion_bench_maker
from robotdiffuse.problems.goals import Goal, JointGoal, PoseGoal, PosesGoal, poses_of
from robotdiffuse.problems.held_out import SEED, held_out_problem
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.simulation.validator import PyBulletOracle
from robotdiffuse.simulation.world import World
from robotdiffuse.validation.tolerances import goal_error

SHORT, LONG = 1.0, 10.0
"""Time limits, of CPU time [s]; the longer one says what can be solved."""
ABOVE = 0.005
"""Between the can and the table where it is put [m]."""
REACH = 0.75
"""Places are at most so far from the base's axis [m]."""
TRIES = 40
"""Places that are drawn until one can be reached."""
STEP, TOLERANCE = 0.01, 0.001
"""Between the configurations of a path that oracles look at [rad]; PyBullet's own error [m]."""
LOOKING = 0.15
"""Time limit of a call that only looks for configurations at a place [s]."""
CAN = "Can1"
HANDS = ("left_gripper", "right_gripper")


class CpuClock:
    """Time limits are of CPU time here, for others share the machine."""

    perf_counter = staticmethod(time.process_time)


class Asked(NamedTuple):
    name: str
    problem: Problem


class Seen(NamedTuple):
    """What two oracles say of a motion."""

    coal: int
    """Configurations in collision."""
    bullet: int
    off: float
    """Where a held object or a hand ends, off its goal beyond what was allowed, by PyBullet's kinematics
    [m]."""


def carried(folder: Path, places: int) -> Iterator[Asked]:
    """The can of each scene, to random places on its table."""
    for number, entry in enumerate(load_motion_bench_maker(folder)):
        rng = np.random.default_rng([SEED, number])
        if entry.problem is None or not isinstance(entry.problem.goal, JointGoal):
            continue
        robot, q = entry.problem.robot, entry.problem.goal.positions[0]
        scene, holding = entry.problem.scene.attach(CAN, robot, q)
        kept = 0
        for _ in range(TRIES):
            goal = PoseGoal(CAN, _place(scene, entry.problem.scene, rng), [0, 0, 0], [0, 0, np.pi])
            problem = Problem(holding, scene, q, goal)
            if not isinstance(usable_start_goal(PlanningContext("places", problem, LOOKING, 0)), PlanResult):
                yield Asked(f"{entry.name}-{kept}", problem)
                kept += 1
            if kept == places:
                break


def _place(scene: rd.Scene, whole: rd.Scene, rng: np.random.Generator) -> ndarray:
    """T_base_can somewhere on the table, not inside another object, upright."""
    [top] = [shape for shape in scene.shapes if shape.name == "table_top"]
    [can] = [shape for shape in whole.shapes if shape.name == CAN]
    assert isinstance(top, rd.Box) and isinstance(can, rd.Cylinder)
    T, grown = transform(top.center, top.rotation), np.array([[-can.radius], [can.radius]])
    while True:
        x, y = rng.uniform(-0.5, 0.5, 2) * top.size[:2]
        at = T @ [x, y, top.size[2] / 2 + can.height / 2 + ABOVE, 1.0]
        around = [shape.bounds + grown for shape in scene.shapes if shape is not top]
        low, high = at[2] - can.height / 2, at[2] + can.height / 2
        taken = any(
            (b[0, :2] < at[:2]).all() and (at[:2] < b[1, :2]).all() and b[0, 2] < high and low < b[1, 2]
            for b in around
        )
        if np.linalg.norm(at[:2]) < REACH and not taken:
            return transform(at[:3])


def together(number: int) -> Iterator[Asked]:
    """Held-out problems with all of it."""
    for i in range(number):
        rng, given = np.random.default_rng([SEED, 1, i]), held_out_problem(("shelf", "table")[i % 2], i // 2)
        assert isinstance(given.goal, JointGoal)
        T_hand_tool = transform(np.array([0.0, 0.0, 0.12]))
        robot = given.robot.with_tool("panda_hand", T_hand_tool, [rd.Cylinder([0, 0, 0.09], 0.01, 0.06)])
        size = rng.uniform(0.03, 0.1, 3)
        robot = robot.attach(rd.Box([0, 0, size[2] / 2 + 0.001], size, name="parcel"), "tool")
        T_world_base = transform(rng.uniform(-1, 1, 3), rotation_from_rpy(*rng.uniform(-3, 3, 3).tolist()))
        goals: list[Goal] = [
            PoseGoal("parcel", T_world_base @ link_pose(robot, q, "parcel"), [0.02] * 3, [0.1, 0.1, np.pi])
            for q in (given.goal.positions[0], given.start)
        ]
        world = given.scene.moved(T_world_base)
        try:
            problem = Problem.in_world(
                T_world_base, robot, world, given.start, goals[1], waypoints=[goals[0]]
            )
        except InputError:
            continue
        yield Asked(f"{('shelf', 'table')[i % 2]}/{i // 2}", problem)


def both_hands(number: int) -> Iterator[Asked]:
    """Poses for both of Baxter's hands."""
    robot = rd.load_robot("baxter")
    table = rd.Box([0.75, 0.0, 0.05], [0.5, 1.2, 0.04], name="table")
    scene = rd.Scene([table, rd.Box([0.75, 0.0, 0.27], [0.12, 0.12, 0.4], name="post")])
    checker, rng = CollisionChecker(robot, scene), np.random.default_rng([SEED, 3])
    for i in range(number):
        free = np.zeros((0, robot.dof))
        while len(free) < 2:
            drawn = rng.uniform(robot.lower, robot.upper, (16, robot.dof))
            free = np.concatenate([free, drawn[checker.free(drawn)]])
        poses = [PoseGoal(hand, link_pose(robot, free[1], hand)) for hand in HANDS]
        yield Asked(f"baxter/{i}", Problem(robot, scene, free[0], PosesGoal(poses)))


def looked_at(asked: Asked, result: PlanResult) -> Seen:
    """The motion before Coal and PyBullet."""
    problem = asked.problem
    assert result.path is not None and result.trajectory is not None
    frames = np.concatenate([_dense(result.path), result.trajectory.positions])
    coal = int(ExactCollision(problem.robot, problem.scene).collides(frames).sum())
    standing, world = problem.standing()
    with PyBulletOracle(standing, world) as oracle:
        bullet = sum(oracle.check_frames(rows, TOLERANCE) is not None for rows in (frames,))
    end = result.trajectory.positions[-1]
    with World(standing, rd.Scene()) as simulated:
        simulated.place(end)
        off = max(_off(problem, pose, simulated) for pose in poses_of(problem.goal))
    assert goal_error(problem.robot, problem.goal, end) is None
    return Seen(coal, bullet, off)


def _off(problem: Problem, pose: PoseGoal, simulated: World) -> float:
    """How far a link of the simulated robot is off its pose beyond what was allowed [m]."""
    state = pybullet.getLinkState(
        simulated.body,
        simulated.links[pose.frame],
        computeForwardKinematics=1,
        physicsClientId=simulated.client,
    )
    T = np.eye(4) if problem.T_world_base is None else problem.T_world_base
    there = inverse(T @ pose.T_base_frame) @ [*state[4], 1.0]
    allowed = np.zeros(3) if pose.xyz_tolerance is None else pose.xyz_tolerance
    return float(np.maximum(np.abs(there[:3]) - allowed, 0.0).max())


def _dense(path: JointPath) -> ndarray:
    rows = [path.positions[:1]]
    for a, b in zip(path.positions[:-1], path.positions[1:], strict=True):
        count = max(1, int(np.ceil(np.linalg.norm(b - a) / STEP)))
        rows.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(rows)


def measured(title: str, every: list[Asked], name: str) -> None:
    """Plan, show to the oracles, and print."""
    planner = rd.load_planner(name)
    planner.warm_up(every[0].problem, "short")
    results, longer, seen = [], [], []
    for i, asked in enumerate(progress(every, title)):
        result = planner.plan(asked.problem, time_limit=SHORT, seed=i)
        long = result if result.solved else planner.plan(asked.problem, time_limit=LONG, seed=i + 1)
        results.append(result)
        longer.append(long)
        if long.solved:
            seen.append(looked_at(asked, long))
    solved, possible = sum(r.solved for r in results), sum(r.solved for r in longer)
    times = [1e3 * r.planning_time for r in results if r.solved]
    print_table(
        f"{title}: {len(every)} problems, {name}",
        ("", "figure"),
        [
            (f"solved in {SHORT:.0f} s", f"{solved} of {possible} that {LONG:.0f} s solve"),
            (
                "CPU time of planning, median / p95",
                f"{np.median(times):.0f} / {np.percentile(times, 95):.0f} ms",
            ),
            ("motions before the oracles", str(len(seen))),
            ("in collision by Coal", str(sum(s.coal > 0 for s in seen))),
            ("in collision by PyBullet", str(sum(s.bullet > 0 for s in seen))),
            (
                "held object or hand off its goal at the end, most, by PyBullet",
                f"{1e3 * max(s.off for s in seen):.3f} mm",
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
    """CPU time of taking up a box of a size that was not seen before."""
    robot, rng = rd.load_robot("panda"), np.random.default_rng(0)
    rows = []
    for what, prepared in (("robot.attach", False), ("and all arrays of search and validator", True)):
        spent = []
        for _ in range(30):
            began = time.process_time()
            held = robot.attach(rd.Box([0, 0, 0.15], rng.uniform(0.03, 0.1, 3), name="box"), "panda_hand")
            if prepared:
                compile_robot(held)
                largest_motion_radii(held)
            spent.append(1e3 * (time.process_time() - began))
        rows.append((what, f"{np.median(spent):.0f} ms", f"{np.max(spent[1:]):.0f} ms"))
    print_table("A box on the hand, CPU time of 30", ("", "median", "most"), rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="Requests: held objects, tools, bases, goals, waypoints.")
    parser.add_argument("--kinds", default="carried,together,both_hands", help="(all three)")
    parser.add_argument("--scenes", type=Path, help="folder of table_pick, for carried")
    parser.add_argument("--places", type=int, default=1, help="of each scene (1)")
    parser.add_argument("--number", type=int, default=120, help="of problems of each other kind (120)")
    parser.add_argument("--planner", default="aorrtc", help="(aorrtc)")
    arguments = parser.parse_args()
    context.time = CpuClock  # type: ignore[attr-defined]
    print(header("numba", "numpy", "coal", "pybullet"))
    kinds = arguments.kinds.split(",")
    if "carried" in kinds:
        attaching()
        measured("Carried", list(carried(arguments.scenes, arguments.places)), arguments.planner)
    if "together" in kinds:
        every = together(arguments.number)
        usable = [asked for asked in every if not _touches(asked.problem)]
        measured("Together", usable, arguments.planner)
    if "both_hands" in kinds:
        measured("Both hands", list(both_hands(arguments.number)), arguments.planner)


def _touches(problem: Problem) -> bool:
    """Whether the start is in collision."""
    return bool(ExactCollision(problem.robot, problem.scene).collides(problem.start[None])[0])


if __name__ == "__main__":
    main()
