"""What one timed motion gains and keeps: waypoints blended rather than stopped at, payloads.

    python benchmarks/one_motion.py [--number 20] [--planner aorrtc]

Sequences in held-out scenes of the families shelf and table: from the problem's start by three random free
configurations to its goal, half of them as configurations, half as poses of the hand. Each is planned with
stops and with blends, the same seed: the legs are the same. A motion goes before Coal on the exact meshes and
PyBullet at each of its rows, and how near it comes to its waypoints is measured on the cubics between rows.
Payloads: held-out problems with masses 10 cm before the hand's frame; torques at every row.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy import ndarray
from report import header, print_table, progress
from scipy.interpolate import CubicHermiteSpline

import robotdiffuse as rd
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.core.types import Trajectory
from robotdiffuse.planning import context
from robotdiffuse.problems.goals import JointGoal, PoseGoal
from robotdiffuse.problems.held_out import SEED, held_out_problem
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.dynamics import Dynamics
from robotdiffuse.robots.kinematics import link_origins, link_pose
from robotdiffuse.simulation.validator import PyBulletOracle

HAND = "panda_hand"
BLENDS = (0.02, 0.05, 0.1, 0.2)
MASSES = (0.0, 1.0, 2.0, 3.0)
"""[kg]; a Panda is said to carry 3."""
LIMIT = 5.0
"""Of a call, of CPU time [s]."""
TOLERANCE = 0.001
"""PyBullet's own error [m]."""
PLACES = 20_000
"""Of a motion at which its distance to waypoints is measured."""


class CpuClock:
    """Time limits are of CPU time here, for others share the machine."""

    perf_counter = staticmethod(time.process_time)


def sequences(number: int) -> Iterator[Problem]:
    """By configurations and by poses in turn."""
    for i in range(number):
        rng, given = np.random.default_rng([SEED, 2, i]), held_out_problem(("shelf", "table")[i % 2], i // 2)
        robot, exact = given.robot, ExactCollision(given.robot, given.scene)
        way: list[Any] = []
        while len(way) < 3:
            q = given.start + rng.uniform(-1.0, 1.0, robot.dof)
            within = ((q > robot.lower) & (q < robot.upper)).all()
            if within and not exact.collides(q[None])[0]:
                way.append(PoseGoal(HAND, link_pose(robot, q, HAND)) if i // 2 % 2 else JointGoal(q))
        yield replace(given, waypoints=way)


def nearest(problem: Problem, motion: Trajectory) -> list[float]:
    """How near a motion comes to each waypoint."""
    curve = CubicHermiteSpline(motion.times, motion.positions, motion.velocities)
    q: ndarray = curve(np.linspace(0, motion.duration, PLACES))
    found = []
    for goal in problem.waypoints:
        if isinstance(goal, JointGoal):
            apart = q - goal.positions[0]
        else:
            assert isinstance(goal, PoseGoal)
            apart = link_origins(problem.robot, q, goal.frame) - goal.T_base_frame[:3, 3]
        found.append(float(np.linalg.norm(apart, axis=1).min()))
    return found


def blended(number: int, name: str) -> None:
    """Plan, show to the oracles, and print."""
    planner, every = rd.load_planner(name), list(sequences(number))
    planner.warm_up(every[0], "converged")
    rows, collisions = [], 0
    for i, problem in enumerate(progress(every, "Blended")):
        found: dict[str, Any] = {}
        for blend in (0.0, *BLENDS):
            asked = replace(problem, blend=blend)
            began = time.process_time()
            result = planner.plan(asked, time_limit=LIMIT, seed=i)
            spent = time.process_time() - began
            if result.trajectory is None:
                break
            motion = result.trajectory
            hits = ExactCollision(problem.robot, problem.scene).collides(motion.positions).any()
            with PyBulletOracle(problem.robot, problem.scene) as oracle:
                touched = oracle.check_frames(motion.positions, TOLERANCE) is not None
            collisions += int(hits) + int(touched)
            speeds = np.linalg.norm(motion.velocities[1:-1], axis=1)
            beyond = [d / blend if blend else d for d in nearest(problem, motion)]
            found[f"{blend:g}"] = motion.duration, spent, float(speeds.min()), max(beyond)
        if len(found) == 1 + len(BLENDS):
            rows.append(found)
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
            "off a waypoint, most, over blend",
            "CPU time",
        ),
        table,
        [f"{5 * len(rows)} motions before Coal and PyBullet: {collisions} in collision"],
    )


def lifted(number: int, name: str) -> None:
    """Durations with payloads, and the torques of what is returned."""
    planner, rows = rd.load_planner(name), []
    for mass in MASSES:
        ratios, shares, refused, spent = list[float](), list[float](), 0, list[float]()
        for i in range(number):
            free = held_out_problem(("shelf", "table")[i % 2], i // 2)
            problem = replace(free, payload=rd.Payload(mass, [0.0, 0.0, 0.1], HAND))
            bare = planner.plan(free, time_limit=LIMIT, seed=i)
            began = time.process_time()
            result = planner.plan(problem, time_limit=LIMIT, seed=i)
            spent.append(1e3 * (time.process_time() - began))
            refused += result.status.value in ("invalid_start", "invalid_goal")
            if result.trajectory is None or bare.trajectory is None:
                continue
            motion = result.trajectory
            dynamics = Dynamics(problem.robot, rd.Payload(mass, [0.0, 0.0, 0.1], HAND))
            torques = dynamics.torques(motion.positions, motion.velocities, motion.accelerations)
            ratios.append(motion.duration / bare.trajectory.duration)
            shares.append(float((np.abs(torques) / dynamics.limits).max()))
        rows.append(
            (
                f"{mass:g} kg",
                f"{len(ratios)} of {number}",
                str(refused),
                f"{np.median(ratios):.3f}",
                f"{max(ratios):.3f}",
                f"{max(shares):.3f}",
                f"{np.median(spent):.0f} ms",
            )
        )
    columns = (
        "solved",
        "ends not held",
        "duration over bare, median",
        "most",
        "torque over limit",
        "CPU time",
    )
    print_table(f"Payloads, {name}", ("", *columns), rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="Motions by waypoints, blended or stopped at.")
    parser.add_argument("--number", type=int, default=20, help="of sequences (20)")
    parser.add_argument("--planner", default="aorrtc", help="(aorrtc)")
    arguments = parser.parse_args()
    context.time = CpuClock  # type: ignore[attr-defined]
    print(header("numba", "numpy", "coal", "pybullet"))
    blended(arguments.number, arguments.planner)
    lifted(arguments.number, arguments.planner)


if __name__ == "__main__":
    main()
