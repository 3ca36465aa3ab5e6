"""How near the durations of motions come to the best known ones, with the robot's limits of jerk.

    python benchmarks/durations.py best --problems shelf_nontrivial,FOLDER [--seconds 30] [--seed 0]
    python benchmarks/durations.py compare --problems shelf_nontrivial,FOLDER [--count 12] [--limits 0.1,1]

`best` makes a long call for each problem. The best known duration of each problem, with the planner, the
seed and the time limit that found it, is kept in benchmarks/results/best_durations.json; run `best` with
several seeds and planners. `compare` prints benchmarks/results/durations.txt: durations by planner and
objective, relative to the best known ones and to the least time along the straight line, and the largest
velocity, acceleration and jerk relative to their limits. Time limits are of CPU time. A folder holds problems
of MotionBenchMaker.
"""

import argparse
import json
import os
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from common import (
    CHECK_STEP,
    CONVERGED,
    TIME_LIMIT,
    header,
    limit_shares,
    parse,
    print_table,
    progress,
    use_processor_time,
)
from robotdiffuse.core.files import write_atomically
from robotdiffuse.core.types import LENGTH, TIME, PlanResult, Trajectory
from robotdiffuse.evaluation.runs import gather_cases
from robotdiffuse.planning import load_planner
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems.files import Case
from robotdiffuse.problems.problem import Problem
from robotdiffuse.trajectories.straight_line import straight_line_time

BEST = Path(__file__).parent / "results" / "best_durations.json"
ROWS = (
    ("aorrtc", TIME, CONVERGED),
    ("aorrtc", LENGTH, CONVERGED),
    ("aorrtc", TIME, TIME_LIMIT),
    ("diffusion", TIME, CONVERGED),
    ("ompl_rrt_connect", LENGTH, CONVERGED),
    ("ompl_aorrtc", LENGTH, TIME_LIMIT),
)
"""Planner, objective and `until`."""


def known() -> dict[str, dict]:
    """The best known motions by problem set and name of the problem."""
    return json.loads(BEST.read_text()) if BEST.exists() else {}


def find_best(cases: list[Case], planner: str, seed: int, seconds: float) -> None:
    """Make a long call for each problem; a duration better than the best known one is written at once."""
    loaded = load_planner(planner)
    for case in progress(cases, f"{planner}, seed {seed}"):
        result = loaded.plan(case.problem, seconds, seed, until=TIME_LIMIT)
        best = known()
        name = key(case)
        if result.duration is not None and result.duration < best.get(name, {"duration": np.inf})["duration"]:
            best[name] = {
                "duration": round(result.duration, 5),
                "planner": planner,
                "seed": seed,
                "seconds": seconds,
            }
            write_atomically(BEST, json.dumps(dict(sorted(best.items())), indent=0) + "\n")


def key(case: Case) -> str:
    return f"{case.problem_set}:{case.name}"


def straight(problem: Problem, motion: Trajectory) -> float:
    """Least time along the straight line between start and end of a motion, without jerk limits [s]."""
    robot = problem.robot
    q = motion.positions
    return float(straight_line_time(q[0], q[-1], robot.velocity, robot.acceleration))


def compare(cases: list[Case], limits: list[float]) -> None:
    best = known()
    rows = []
    for limit in limits:
        for name, objective, until in ROWS:
            planner = load_planner(name)
            warm_up(planner, cases)
            results = [
                (case, planner.plan(case.problem, limit, seed=i, until=until, objective=objective))
                for i, case in enumerate(progress(cases, f"{name}, {objective}, {limit:g} s"))
            ]
            suffix = (", length" if objective == LENGTH else "") + (", full" if until == TIME_LIMIT else "")
            rows.append(row(name + suffix, limit, results, best))
    columns = [
        *("planner", "limit s", "solved", "duration s", "of best", "median", "of line", "length", "stops"),
        *("velocity", "accel.", "jerk"),
    ]
    notes = (
        "length: the objective is the path's length, else the motion's duration; full: until the limit, else "
        "until more time hardly helps. of best: sum of durations over that of the best known ones; median of "
        "the ratios. of line: mean ratio to the least time along the straight line. stops: share of motions "
        "that stop on the way. velocity to jerk: the largest share of a limit in any motion, every "
        f"{1e3 * CHECK_STEP:g} ms.",
    )
    print_table(f"{len(cases)} problems", columns, rows, notes)


def warm_up(planner: Planner, cases: list[Case]) -> None:
    for case in cases[:3]:
        planner.plan(case.problem, 5.0)


def row(name: str, limit: float, results: list[tuple[Case, PlanResult]], best: dict[str, dict]) -> list[str]:
    moved = [(case, r.trajectory, r.path) for case, r in results if r.trajectory is not None and r.path]
    if not moved:
        return [name, f"{limit:g}", f"0 of {len(results)}", *["–"] * 9]
    durations = np.array([motion.duration for _, motion, _ in moved])
    least = np.array([best.get(key(case), {"duration": np.nan})["duration"] for case, _, _ in moved])
    lines = np.array([straight(case.problem, motion) for case, motion, _ in moved])
    shares = np.max([limit_shares(case.problem.robot, motion) for case, motion, _ in moved], axis=0)
    known_best = np.isfinite(least)
    return [
        name,
        f"{limit:g}",
        f"{len(moved)} of {len(results)}",
        f"{durations.mean():.3f}",
        f"{durations[known_best].sum() / least[known_best].sum():.4f}" if known_best.any() else "–",
        f"{np.median(durations[known_best] / least[known_best]):.4f}" if known_best.any() else "–",
        f"{(durations / lines).mean():.3f}",
        f"{np.mean([path.length for _, _, path in moved]):.3f}",
        f"{np.mean([len(motion.stops) > 0 for _, motion, _ in moved]):.3f}",
        *(f"{share:.4f}" for share in shares),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", choices=("best", "compare"), nargs="?", default="compare")
    parser.add_argument("--problems", default="shelf_nontrivial", metavar="SETS")
    parser.add_argument("--count", type=int, default=12, metavar="N", help="number of problems of each set")
    parser.add_argument("--planner", default="aorrtc", help="planner of `best`")
    parser.add_argument("--seed", type=int, default=0, help="seed of `best`")
    parser.add_argument("--seconds", type=float, default=30.0, help="time limit of each call of `best`")
    parser.add_argument("--limits", default="0.1,1", help="time limits of `compare` [s]")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/durations"), help="folder that keeps the problems"
    )
    arguments = parse(parser, count=1, limits="0.1", what="compare", out=Path("runs/smoke"))
    use_processor_time()
    sets = arguments.problems.split(",")
    cases = [
        case
        for name in sets
        for case in gather_cases([name], arguments.count, arguments.out, lambda text: None)
    ]
    if arguments.what == "best":
        find_best(cases, arguments.planner, arguments.seed, arguments.seconds)
    else:
        print(header("numba"))
        compare(cases, [float(text) for text in arguments.limits.split(",")])


if __name__ == "__main__":
    main()
