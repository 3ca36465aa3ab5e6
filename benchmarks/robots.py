"""The bundled robots: problems of furniture and clutter, and inverse kinematics.

    python benchmarks/robots.py [--robots ur5e fr3 ...] [--problems 200] [--out FILE] [--cpu]
    python benchmarks/robots.py --inverse-kinematics [--poses 1000]

The first command prints benchmarks/results/shipped_arms.txt. FILE is written again after each robot. With
--cpu, time limits are of CPU time. `robotdiffuse` plans first motions with a limit of 1 s, and of 10 s if
that is not enough. Coal and PyBullet check the returned motions every 5 mrad on the robots' meshes. 200
problems take about a minute of one core for each robot, and 11 s more for each problem that is not solved.

The second prints inverse_kinematics.txt: poses of panda_hand at uniform random configurations; kinematics in
NumPy measure the errors.
"""

import argparse
import time
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass, field

import numpy as np

from common import FIRST, dense, header, parse, print_table, progress, use_processor_time
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import rotation_angle, transform
from robotdiffuse.core.types import PlanResult
from robotdiffuse.planning import load_planner
from robotdiffuse.problems.families.scaled import family_for
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import ROBOTS, load_robot
from robotdiffuse.robots.inverse_kinematics import InverseKinematicsSettings, inverse_kinematics
from robotdiffuse.robots.robot import Robot
from robotdiffuse.simulation.validator import PyBulletOracle

FAMILIES = ("shelf", "crate", "table", "clutter", "kitchen")
SEED = 11
"""Seed of the problems; no setting was chosen on them."""
# Time limits [s].
SHORT = 1.0
LONG = 10.0
STEP = 0.005
"""Largest joint motion between two checked configurations [rad]."""
FRAME = "panda_hand"
"""Link whose poses inverse kinematics gets."""


@dataclass
class Tally:
    """Counts of one robot."""

    problems: int = 0
    short: int = 0
    """Problems solved within SHORT, ..."""
    long: int = 0
    """... and within LONG."""
    times: list[float] = field(default_factory=list)
    """Planning times of the problems solved within SHORT [ms]."""
    hard: list[str] = field(default_factory=list)
    """Problems not solved within SHORT, each with the time that it took, or "never"."""
    configurations: int = 0
    """Number of checked configurations."""
    by_coal: int = 0
    """Number of motions in collision by Coal."""
    by_pybullet: int = 0
    """Number of motions in collision by PyBullet."""


def check(problem: Problem, result: PlanResult, oracle: PyBulletOracle, tally: Tally) -> None:
    """Check the timed motion on the meshes."""
    assert result.trajectory is not None
    q = dense(result.trajectory.positions, STEP)
    tally.configurations += len(q)
    tally.by_coal += bool(ExactCollision(problem.robot, problem.scene).collides(q).any())
    oracle.set_scene(problem.scene)
    tally.by_pybullet += oracle.check_rows(q, tolerance=0.0) is not None


def draw(family: str, robot: Robot, count: int) -> list[tuple[str, Problem]]:
    """Problems of a family with their names; fewer than `count` if the arm has no start and goal in most of
    the drawn scenes."""
    rng = np.random.default_rng(SEED)
    drawn = list[tuple[str, Problem]]()
    for _ in range(2 * count):
        with suppress(InputError):  # no free start and goal in this scene
            problem = family_for(family, robot).draw(robot, rng).problem(robot)
            drawn.append((f"{family} {len(drawn)}", problem))
        if len(drawn) == count:
            break
    return drawn


def measure(name: str, problems: int) -> Tally:
    """Plan the problems of one robot."""
    robot = load_robot(name)
    tally = Tally()
    planner = load_planner("robotdiffuse")
    drawn = [problem for family in FAMILIES for problem in draw(family, robot, problems // len(FAMILIES))]
    if not drawn:
        return tally
    planner.warm_up(drawn[0][1], FIRST)
    with PyBulletOracle(robot, drawn[0][1].scene) as oracle:
        for i, (what, problem) in enumerate(progress(drawn, name)):
            tally.problems += 1
            result = planner.plan(problem, SHORT, seed=i, until=FIRST)
            tally.short += result.solved
            if result.solved:
                tally.times.append(1e3 * result.planning_time)
            else:
                result = planner.plan(problem, LONG, seed=i, until=FIRST)
                tally.hard.append(f"{what} {f'{result.planning_time:.1f} s' if result.solved else 'never'}")
            tally.long += result.solved
            if result.solved:
                check(problem, result, oracle, tally)
    return tally


def report(head: str, tallies: dict[str, Tally]) -> None:
    """Print the tables of the robots measured so far."""
    rows = []
    notes = []
    for name, tally in tallies.items():
        if tally.problems == 0:
            rows.append([name, "0", *["-"] * 7])
            continue
        p50, p95 = np.percentile(tally.times, (50, 95))
        counts = [f"{tally.problems}", f"{tally.short}", f"{tally.long}", f"{p50:.1f}", f"{p95:.1f}"]
        rows.append([name, *counts, f"{tally.configurations}", f"{tally.by_coal}", f"{tally.by_pybullet}"])
        if tally.hard:
            notes.append(f"{name}, not within a second: {', '.join(tally.hard)}")
    columns = (
        "robot",
        "problems",
        "solved in 1 s",
        "in 10 s",
        "first ms, median",
        "p95",
    )
    print(head)
    print_table("Furniture and clutter", (*columns, "checked", "Coal", "PyBullet"), rows, notes)


def measure_inverse_kinematics(poses: int) -> None:
    """Print the fraction solved, the errors and the times of inverse kinematics of the Panda."""
    robot = load_robot("panda")
    rng = np.random.default_rng(0)
    start = time.perf_counter()
    inverse_kinematics(robot, FRAME, transform(np.array([0.4, 0.0, 0.4])), rng=rng)
    print(f"first call (compiled, or read from the cache): {time.perf_counter() - start:.2f} s")
    targets = [robot.fk(rng.uniform(robot.lower, robot.upper), FRAME) for _ in range(poses)]
    for what, count, settings in (
        ("pose, 1 solution", 1, InverseKinematicsSettings()),
        ("pose, 10 distinct solutions", 10, InverseKinematicsSettings()),
        ("position only, 10 distinct solutions", 10, InverseKinematicsSettings(position_only=True)),
    ):
        milliseconds = []
        solution_counts = []
        position = 0.0
        rotation = 0.0
        gap = np.inf
        for T in targets:
            start = time.perf_counter()
            solutions = inverse_kinematics(robot, FRAME, T, count, rng=rng, settings=settings)
            milliseconds.append(1e3 * (time.perf_counter() - start))
            solution_counts.append(len(solutions))
            assert ((solutions > robot.lower) & (solutions < robot.upper)).all()
            for i, q in enumerate(solutions):
                reached = robot.fk(q, FRAME)
                position = max(position, float(np.linalg.norm(reached[:3, 3] - T[:3, 3])))
                rotation = max(rotation, rotation_angle(reached[:3, :3] @ T[:3, :3].T))
                gap = min(gap, np.abs(solutions[:i] - q).max(-1).min(initial=np.inf))
        counts = np.array(solution_counts)
        times = np.array(milliseconds)
        print(
            f"{what}: {(counts > 0).mean():.2%} of {poses} solved, all {count} found for"
            f" {(counts == count).mean():.1%}; median {np.median(times):.3f} ms, p95"
            f" {np.percentile(times, 95):.3f} ms, max {times.max():.2f} ms; largest error {position:.1e} m"
            + ("" if settings.position_only else f", {rotation:.1e} rad")
            + (f"; least difference {gap:.3f} rad" if count > 1 else "")
        )
    for what, xyz in (("far", (2.0, 0.0, 0.5)), ("just out of reach", (0.9, 0.0, 0.6))):
        start = time.perf_counter()
        solutions = inverse_kinematics(robot, FRAME, transform(np.array(xyz)), rng=rng)
        elapsed = 1e3 * (time.perf_counter() - start)
        print(f"unreachable ({what}): {len(solutions)} found, given up in {elapsed:.1f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description="Robots of the package: problems, inverse kinematics.")
    parser.add_argument(
        "--robots",
        nargs="+",
        choices=ROBOTS,
        default=list(ROBOTS),
        metavar="ROBOT",
        help="robots to measure (all)",
    )
    parser.add_argument("--problems", type=int, default=200, help="number of problems for each robot (200)")
    parser.add_argument("--out", metavar="FILE", help="file to which the tables are written after each robot")
    parser.add_argument(
        "--cpu", action="store_true", help="time limits are CPU time, so that other work does not count"
    )
    parser.add_argument(
        "--inverse-kinematics",
        action="store_true",
        help="measure inverse kinematics of the Panda instead of planning",
    )
    parser.add_argument(
        "--poses", type=int, default=1000, help="number of poses for inverse kinematics (1000)"
    )
    arguments = parse(parser, robots=["panda"], problems=5, poses=5)
    head = header("numpy", "numba", "coal", "pybullet")
    tallies = {}
    if arguments.inverse_kinematics or arguments.smoke:
        print(header("numpy", "numba"))
        measure_inverse_kinematics(arguments.poses)
        if arguments.inverse_kinematics:
            return
    if arguments.cpu:
        head += "; times of the processor"
        use_processor_time()
    for name in arguments.robots:
        tallies[name] = measure(name, arguments.problems)
        if arguments.out:
            with open(arguments.out, "w", encoding="utf-8") as file, redirect_stdout(file):
                report(head, tallies)
    report(head, tallies)


if __name__ == "__main__":
    main()
