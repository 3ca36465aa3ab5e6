"""Straight lines and screw motions of the tool among furniture, compared with a plain follower and the
search.

    python benchmarks/lines.py [--lines 200] [--screws 100] [--searched 20]

Prints benchmarks/results/lines.txt. Scenes are those of the held-out families shelf and table. A line leads
15 to 40 cm in a random direction, a screw motion 5 to 25 cm and turns by 0.3 to 1.2 rad about a random axis;
both begin at a free configuration with the hand pointing down. Only motions count that a plain follower can
follow: poses are 5 mm or 0.02 rad apart, damped least squares reaches each from the configuration before, and
the validator accepts the path. The search is aorrtc's search under the constraint, until it converges, the
best of eight seeds. Times and limits (1 s) are CPU time.
"""

import argparse
import time
from collections.abc import Iterator

import numpy as np
from numpy import ndarray

import robotdiffuse as rd
from common import header, parse, print_table, progress, use_processor_time
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.transforms import rotation_about, rotation_from_rpy, transform
from robotdiffuse.problems.compiled_constraints import pose_difference
from robotdiffuse.problems.files import SEED, held_out_problem
from robotdiffuse.robots.inverse_kinematics import inverse_kinematics
from robotdiffuse.robots.robot import Robot

HAND = "panda_hand"
LOW, HIGH = np.array([0.25, -0.5, 0.25]), np.array([0.7, 0.5, 0.8])
"""Corners of the box from which the hand's position is drawn [m]."""
# Tolerances of the line: distance [m], angle [rad].
TOLERANCE, ANGLE = 0.001, 0.05
TIME_LIMIT = 1.0
SEEDS = 8
# The plain follower: distance between poses [m], [rad]; damping and iterations of its least squares.
STEP, TURN_STEP = 0.005, 0.02
DAMPING = 1e-4
MAX_ITERATIONS = 20
LONGEST_STEP = 0.25
"""If a joint moves by more than this from pose to pose, the follower has jumped and fails [rad]."""


def drawn(kind: str) -> Iterator[tuple[rd.Problem, ndarray]]:
    """Yields problems of lines or screw motions, each with the end pose T_base_hand."""
    i = 0
    while True:
        rng = np.random.default_rng([SEED, 5, i])
        held_out = held_out_problem(("shelf", "table")[i % 2], i // 2)
        i += 1
        robot = held_out.robot
        free = CollisionChecker(robot, held_out.scene).free
        T = transform(rng.uniform(LOW, HIGH), rotation_from_rpy(np.pi, 0.0, rng.uniform(-np.pi, np.pi)))
        starts = inverse_kinematics(robot, HAND, T, 1, rng=rng, accept=free)
        if not len(starts):
            continue
        T = robot.fk(starts[0], HAND)
        direction, axis = rng.normal(size=(2, 3))
        length, angle = (rng.uniform(0.15, 0.4), 0.0)
        if kind == "screw":
            length, angle = rng.uniform(0.05, 0.25), rng.uniform(0.3, 1.2)
        turn = rotation_about(axis / np.linalg.norm(axis), angle)
        end = transform(T[:3, 3] + length * direction / np.linalg.norm(direction), turn @ T[:3, :3])
        line = rd.CartesianLine(HAND, TOLERANCE, ANGLE)
        yield rd.Problem(robot, held_out.scene, starts[0], rd.PoseGoal(HAND, end), constraints=[line]), end


def followed(robot: Robot, start: ndarray, end: ndarray) -> ndarray | None:
    """Configurations along the line by a plain follower; None if the follower does not reach the end."""
    T = robot.fk(start, HAND)
    translation, turn = pose_difference(T, end)
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle > 1e-9 else np.eye(3)[2]
    count = int(np.ceil(max(np.linalg.norm(translation) / STEP, angle / TURN_STEP)))
    rows = [start]
    for share in np.linspace(0, 1, count + 1)[1:]:
        target = transform(T[:3, 3] + share * translation, rotation_about(axis, share * angle) @ T[:3, :3])
        q = rows[-1]
        for _ in range(MAX_ITERATIONS):
            error = np.append(*pose_difference(robot.fk(q, HAND), target))
            if np.abs(error).max() < 1e-6:
                break
            J = robot.jacobian(q, HAND)
            q = q + J.T @ np.linalg.solve(J @ J.T + DAMPING**2 * np.eye(6), error)
        else:
            return None
        inside = (q >= robot.lower).all() and (q <= robot.upper).all()
        if not inside or np.abs(q - rows[-1]).max() > LONGEST_STEP:
            return None
        rows.append(q)
    return np.array(rows)


def measured(kind: str, number: int, searched: int) -> None:
    """Plan `number` lines or screw motions, the first `searched` solved ones also by search, and print a
    table."""
    aorrtc = rd.load_planner("aorrtc")
    search = rd.load_planner("aorrtc")
    search.follows_lines = False  # type: ignore[misc]
    chosen: list[rd.Problem] = []
    tried = 0
    for problem, end in drawn(kind):
        rows = followed(problem.robot, problem.start, end)
        tried += 1
        if rows is not None and rd.verify(problem, rd.Path(problem.robot.joint_names, rows)).valid:
            chosen.append(problem)
        if len(chosen) == number:
            break
    for planner in (aorrtc, search):
        planner.warm_up(chosen[0])
    answers = []
    seconds = []
    for problem in progress(chosen, kind):
        began = time.process_time()
        answers.append(aorrtc.plan(problem, time_limit=TIME_LIMIT))
        seconds.append(1e3 * (time.process_time() - began))
    solved = [answer.solved for answer in answers]
    by_following = sum(answer.stage == "line" for answer in answers)
    compared = [i for i in range(number) if solved[i]][:searched]
    ratios = []
    for i in progress(compared, f"{kind}, search"):
        others = [search.plan(chosen[i], time_limit=TIME_LIMIT, seed=seed) for seed in range(SEEDS)]
        best = min([answer.duration for answer in others if answer.solved], default=np.inf)
        ratios.append(answers[i].duration / min(best, answers[i].duration))
    reversals = [reversed_accelerations(answer.trajectory) for answer in answers if answer.solved]
    table = [
        ("followed by the plain follower", f"{number} of {tried} drawn"),
        ("solved by aorrtc, of these", f"{sum(solved)} ({by_following} by following)"),
        (
            "CPU time of the call, median / p95",
            f"{np.median(seconds):.1f} / {np.percentile(seconds, 95):.1f} ms",
        ),
        (
            "reversals of acceleration, median / largest",
            f"{np.median(reversals):.0f} / {max(reversals)}",
        ),
    ]
    if ratios:
        durations = f"{np.median(ratios):.3f} / {np.percentile(ratios, 95):.3f} / {max(ratios):.3f}"
        title = f"duration over the best of aorrtc and search, median / p95 / largest of {len(ratios)}"
        table.append((title, durations))
    print_table(f"{kind}s", ("", "aorrtc"), table)
    for i in range(number):
        if not solved[i]:
            print(f"{kind} {i}: {answers[i].reason}")


def reversed_accelerations(trajectory: rd.Trajectory) -> int:
    """How often the acceleration of the joint that moves furthest changes its sign."""
    joint = int(np.ptp(trajectory.positions, axis=0).argmax())
    a = trajectory.accelerations[:, joint]
    signs = np.sign(a[np.abs(a) > 0.02 * np.abs(a).max()])
    return int((np.diff(signs) != 0).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description="Straight lines and screws in furniture.")
    parser.add_argument("--lines", type=int, default=200, help="number of lines (200)")
    parser.add_argument("--screws", type=int, default=100, help="number of screw motions (100)")
    parser.add_argument(
        "--searched",
        type=int,
        default=20,
        help="number of lines and of screw motions that are also planned by search (20)",
    )
    arguments = parse(parser, lines=2, screws=2, searched=1)
    use_processor_time()
    print(header("numba", "numpy"))
    measured("line", arguments.lines, arguments.searched)
    measured("screw", arguments.screws, arguments.searched)


if __name__ == "__main__":
    main()
