"""Moving obstacles: `rd.Replanner` among balls that cross the arm's workspace, checked by PyBullet.

    python benchmarks/moving_obstacles.py [--runs 100] [--lattice-runs 5]

Prints benchmarks/results/moving.txt. A Panda goes from one side to the other while balls of 10 cm radius fly
through its workspace on straight lines, each at 50 to 100 % of the `max_speed` that the loop assumes (0.4
m/s), and turn round twice. No ball comes near the shoulder, which cannot move out of the way. A run counts
only if a solution is known: `plan`, given the balls' trajectories, finds a certified motion from start to
goal. The loop observes only the positions of the balls, every 20 ms. PyBullet checks the meshes every 5 ms.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

import robotdiffuse as rd
from common import FIRST, header, parse, print_table, progress
from robotdiffuse.baselines.lattice import DStarLiteSettings, LatticeSearch
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.transforms import transform
from robotdiffuse.robots.robot import Robot
from robotdiffuse.simulation.validator import PyBulletOracle

# Largest speed [m/s] and radius [m] of the balls.
SPEED = 0.4
RADIUS = 0.1
START = [-1.0, 0.3, 0, -1.8, 0, 2.1, 0.8]
GOAL = [1.0, 0.3, 0, -1.8, 0, 2.1, 0.8]
FLOOR = rd.Box([0, 0, -0.06], [2, 2, 0.1], name="floor")
# Period of the loop; period of PyBullet's checks; time after which a run ends [s].
PERIOD = 0.02
CHECK_PERIOD = 0.005
RUN_LIMIT = 30.0
# Least distance of balls from the axis of the base, and from the arm at its start [m].
BASE_DISTANCE = 0.45
START_DISTANCE = 0.2
LATTICE_LIMIT = 1.0
"""CPU time limit of a search of D* Lite [s]."""


def scene(robot: Robot, count: int, seed: int) -> tuple[rd.MovingObstacle, ...]:
    """Balls with their trajectories."""
    rng = np.random.default_rng(seed)
    checker = CollisionChecker(robot, rd.Scene())
    balls: list[rd.MovingObstacle] = []
    while len(balls) < count:
        radius = rng.uniform(0.35, 0.75)
        angle = rng.uniform(-1.3, 1.3)
        through = np.array([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0.2, 0.8)])
        direction = rng.normal(size=3) * [1, 1, 0.3]
        direction /= np.linalg.norm(direction)
        flat = direction[:2] / np.linalg.norm(direction[:2])
        if np.linalg.norm(through[:2] - flat * (through[:2] @ flat)) < BASE_DISTANCE:
            continue
        speed = SPEED * rng.uniform(0.5, 1.0)
        before = rng.uniform(0.8, 3.5)
        ends = [through - speed * before * direction, through + speed * rng.uniform(2.0, 4.0) * direction]
        crossing_time = np.linalg.norm(ends[1] - ends[0]) / speed
        times = crossing_time * np.arange(4)
        places = [ends[i % 2] for i in range(4)]
        ball = rd.MovingObstacle(
            rd.Sphere(ends[0], RADIUS), times=times, poses=[transform(place) for place in places]
        )
        near = CollisionChecker(robot, rd.Scene([rd.Sphere(ends[0], RADIUS)]))
        q = np.array([START])
        if near.link_clearances(q).min() > START_DISTANCE and checker.free(q).all():
            balls.append(ball)
    return tuple(balls)


def problem_of(robot: Robot, balls: tuple[rd.MovingObstacle, ...]) -> rd.Problem:
    """The problem among balls with known trajectories."""
    return rd.Problem(robot, rd.Scene([FLOOR]), START, GOAL, moving=balls)


@dataclass
class Run:
    """The outcome of a run."""

    arrived: bool = False
    took: float = 0.0
    """Time until the arm rests at the goal [s]."""
    contact_moving: bool = False
    """Whether the arm was in contact with an obstacle while it moved."""
    contact_resting: bool = False
    """Whether the arm was in contact with an obstacle while it was at rest."""
    steps: list[float] = field(default_factory=list)
    """CPU time of each step except the first, which does not search yet [ms]."""


def check(
    run: Run,
    oracle: PyBulletOracle,
    balls: tuple[rd.MovingObstacle, ...],
    q: np.ndarray,
    at: float,
    moves: bool,
) -> None:
    """Record in `run` whether the arm is in contact at configuration q and time `at` [s].

    moves: whether the arm moves at this time.
    """
    oracle.set_scene(rd.Scene([FLOOR, *(ball.at(at) for ball in balls)]))
    if oracle.check_rows(q[None]) is not None:
        run.contact_moving = run.contact_moving or moves
        run.contact_resting = run.contact_resting or not moves


def looped(settings: rd.ReplannerSettings) -> Callable[[rd.Problem, PyBulletOracle, int], Run]:
    """A function that runs the loop with these settings on a problem."""

    def go(problem: rd.Problem, oracle: PyBulletOracle, seed: int) -> Run:
        run = Run()
        balls = problem.moving
        tracked = tuple(rd.MovingObstacle(ball.shape, max_speed=SPEED) for ball in balls)
        loop = rd.Replanner(replace(problem, moving=tracked), settings, seed)
        executed = None
        for k in range(int(RUN_LIMIT / PERIOD)):
            now = k * PERIOD
            began = time.process_time()
            command = loop.step({ball.name: ball.pose(now) for ball in balls}, now)
            if k:
                run.steps.append(1e3 * (time.process_time() - began))
            if executed is not None:
                for at in np.arange(now, now + PERIOD - 1e-9, CHECK_PERIOD):
                    q, moves = followed(executed.motion, at - executed.begins)
                    check(run, oracle, balls, q, at, moves)
            executed = command
            if command.arrived:
                run.arrived = True
                run.took = command.begins
                break
        return run

    return go


def played(problem: rd.Problem, oracle: PyBulletOracle, seed: int) -> Run:
    """Plan as if the balls stood still, and execute the motion."""
    run = Run()
    still = replace(problem, moving=())
    trajectory = rd.load_planner("rrt_connect").plan(still, 5.0, seed, until=FIRST).trajectory
    assert trajectory is not None
    for at in np.arange(0.0, trajectory.duration, CHECK_PERIOD):
        q, moves = followed(trajectory, at)
        check(run, oracle, problem.moving, q, at, moves)
    run.arrived = True
    run.took = trajectory.duration
    return run


def followed(motion: rd.Trajectory, time: float) -> tuple[np.ndarray, bool]:
    """The configuration of a motion at a time, and whether the arm moves then."""
    time = max(time, 0.0)
    q = np.array([np.interp(time, motion.times, column) for column in motion.positions.T])
    i = min(int(np.searchsorted(motion.times, time, side="right")), len(motion.times) - 1)
    return q, time < motion.duration and bool(np.abs(motion.velocities[i - 1 : i + 1]).max() > 1e-6)


def late(until: float) -> bool:
    """Whether the CPU time of this process exceeds `until` [s]."""
    return time.process_time() > until


def repairs(robot: Robot, runs: int) -> Iterator[float]:
    """CPU times of repairs of D* Lite after one ball has moved for a period, at most LATTICE_LIMIT [ms]."""
    for seed in range(runs):
        [ball] = scene(robot, 1, seed)
        times = np.arange(0.0, ball.track[0][1], PERIOD)
        checkers = [CollisionChecker(robot, rd.Scene([FLOOR, ball.at(t)])) for t in times]
        start = np.array(START)
        settings = DStarLiteSettings(clearance=0.0)
        search = LatticeSearch(checkers[0], start, np.array([GOAL]), settings)
        for checker in checkers[:: max(len(times) // 20, 1)]:
            began = time.process_time()
            search.update(checker, np.array(START))
            search.run(partial(late, began + LATTICE_LIMIT))
            yield 1e3 * (time.process_time() - began)


def row(name: str, count: int, runs: list[Run]) -> tuple[str, ...]:
    done = [run.took for run in runs if run.arrived]
    steps = [ms for run in runs for ms in run.steps]

    def share(number: int) -> str:
        return f"{100 * number / max(len(runs), 1):.1f} %"

    spent = [f"{np.percentile(steps, p):.1f}" for p in (50, 99, 100)] if steps else ["", "", ""]
    return (
        f"{count} balls, {name}",
        str(len(runs)),
        share(sum(not run.contact_moving for run in runs)),
        share(sum(not (run.contact_moving or run.contact_resting) for run in runs)),
        share(len(done)),
        f"{np.median(done):.2f}" if done else "",
        *spent,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Obstacles that cross an arm's way.")
    parser.add_argument("--runs", type=int, default=100, help="number of runs for each number of balls (100)")
    parser.add_argument(
        "--lattice-runs", type=int, default=5, help="number of runs of D* Lite, with one ball (5)"
    )
    parser.add_argument("--balls", type=int, nargs="*", default=[1, 3, 5], help="numbers of balls (1 3 5)")
    arguments = parse(parser, runs=1, lattice_runs=1, balls=[1])
    print(header("numba", "numpy", "pybullet"))
    robot = rd.load_robot("panda")
    planner = rd.load_planner("rrt_connect")
    methods = {
        "the loop": looped(rd.ReplannerSettings()),
        "played blindly": played,
    }
    compiling = problem_of(robot, scene(robot, 3, 10**6))
    methods["the loop"](compiling, PyBulletOracle(robot, rd.Scene()), 0)
    rows = []
    notes = []
    with PyBulletOracle(robot, rd.Scene()) as oracle:
        for count in arguments.balls:
            problems = [problem_of(robot, scene(robot, count, seed)) for seed in range(arguments.runs)]
            plans = [
                planner.plan(problem, 5.0, until=FIRST) for problem in progress(problems, f"{count} balls")
            ]
            solvable = [
                (seed, problem) for seed, problem in enumerate(problems) if plans[seed].trajectory is not None
            ]
            took = [plan.trajectory.duration for plan in plans if plan.trajectory is not None]
            spent = [1e3 * plan.planning_time for plan in plans if plan.trajectory is not None]
            notes.append(
                f"{count} balls: a motion is known in {len(solvable)} of {len(problems)} runs; it takes "
                f"{np.median(took):.2f} s (median), found in {np.median(spent):.0f} ms (median)"
            )
            for name, go in methods.items():
                runs = [go(problem, oracle, seed) for seed, problem in progress(solvable, name)]
                rows.append(row(name, count, runs))
    columns = [
        "",
        "runs",
        "no contact moving",
        "none at all",
        "arrived",
        "s to goal",
        "ms p50",
        "p99",
        "most",
    ]
    print_table("Balls that cross", columns, rows, notes)
    lattice = list(repairs(robot, arguments.lattice_runs))
    if lattice:
        p50, p99 = np.percentile(lattice, (50, 99))
        out = np.mean([ms >= 1e3 * LATTICE_LIMIT for ms in lattice])
        print(
            f"D* Lite on its lattice, one ball: {p50:.1f} ms for a repair (median), p99 {p99:.0f} ms, "
            f"{100 * out:.0f} % not done in {LATTICE_LIMIT:g} s, {len(lattice)} repairs."
        )
    print("ms: CPU time of a step, search and certificate included. Time to goal: median.")


if __name__ == "__main__":
    main()
