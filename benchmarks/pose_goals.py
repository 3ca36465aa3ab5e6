"""Pose goals: motions compared with the nearest goal configuration, arms of few joints, several goals.

    python benchmarks/pose_goals.py [--robots iiwa14 ...] [--starts 60]

Prints benchmarks/results/pose_goals.txt. There are no obstacles, but the links must not touch each other. The
nearest configuration comes from a separate search: Gauss-Newton steps from many seeds, which also pull
towards the start. Its distance is a reference for the length of motions, not a bound, because this search may
miss a nearer configuration.
"""

import argparse
import time
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float
from numpy import ndarray

import robotdiffuse as rd
from common import header, parse, print_table, progress
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.core.transforms import rotation_from_rpy, transform
from robotdiffuse.robots.fitting.preparation import PreparationSettings, prepare
from robotdiffuse.robots.parsing.urdf import UrdfTree
from robotdiffuse.robots.robot import Robot

ROBOTS = ("iiwa14", "gen3", "xarm7", "panda", "ur5e", "fr3")
# Number of seeds and steps of the search for the nearest configuration.
SEEDS = 150
STEPS = 80
PULL = 0.3
"""Fraction of the distance to the start by which a step of this search moves within the null space of the
pose."""
EXACT = 1e-4
"""Largest error of a pose [m], [rad]."""
SHORTEST = 0.01
"""Smaller distances are raised to this value, so that ratios of distances near 0 are meaningful [rad]."""
FEW_JOINTS = Path(__file__).parents[1] / "docs" / "how_to" / "robot.md"
"""The page whose first URDF is an arm of four joints."""


def rotation_vectors(rotations: Float[ndarray, "n 3 3"]) -> Float[ndarray, "n 3"]:
    skew = 0.5 * (rotations - rotations.transpose(0, 2, 1))
    axis = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(rotations, axis1=1, axis2=2) - 1.0))
    return axis * (angle / np.maximum(sine, 1e-9))[:, None]


def nearest_distance(
    robot: Robot, frame: str, T: Float[ndarray, "4 4"], start: Float[ndarray, "dof"], rng: np.random.Generator
) -> float:
    """Distance from the start to the nearest configuration that reaches the pose without a collision [rad];
    infinite if none is found."""
    continuous = np.array(robot.continuous)
    lower = np.where(continuous, -np.inf, robot.lower)
    upper = np.where(continuous, np.inf, robot.upper)
    half_turn = np.where(robot.prismatic, np.inf, np.pi)
    q = rng.uniform(
        np.maximum(lower, start - half_turn), np.minimum(upper, start + half_turn), (SEEDS, robot.dof)
    )
    q[0] = start
    q[1 : SEEDS // 4] = np.clip(start + rng.normal(0, 0.5, (SEEDS // 4 - 1, robot.dof)), lower, upper)
    for k in range(STEPS):
        pull = PULL if STEPS // 4 < k < STEPS - 15 else 0.0
        poses = robot.fk(q, frame)
        jacobians = robot.jacobian(q, frame)
        turned = rotation_vectors(T[:3, :3] @ poses[:, :3, :3].transpose(0, 2, 1))
        error = np.concatenate([T[:3, 3] - poses[:, :3, 3], turned], axis=1)
        drift = pull * (start - q)
        wanted = error - (jacobians @ drift[..., None])[..., 0]
        damped = jacobians @ jacobians.transpose(0, 2, 1) + 1e-6 * np.eye(6)
        step = drift + (jacobians.transpose(0, 2, 1) @ np.linalg.solve(damped, wanted[..., None]))[..., 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        q = np.clip(q + step * np.minimum(1.0, 1.0 / np.maximum(length, 1e-9)), lower, upper)
    poses = robot.fk(q, frame)
    turned = rotation_vectors(T[:3, :3] @ poses[:, :3, :3].transpose(0, 2, 1))
    error = np.concatenate([T[:3, 3] - poses[:, :3, 3], turned], axis=1)
    q = q[np.abs(error).max(axis=1) < EXACT]
    q = np.array([image for row in q for image in robot.equivalent_configurations(row, start)[:1]])
    if not len(q):
        return np.inf
    difference = q - start
    difference -= robot.whole_turns(difference)
    order = np.argsort(np.linalg.norm(difference, axis=1))
    exact = ExactCollision(robot, rd.Scene())
    free = next((i for i in order if not exact.collides(q[i : i + 1])[0]), None)
    return np.inf if free is None else float(np.linalg.norm(difference[free]))


def free_configurations(robot: Robot, count: int, rng: np.random.Generator) -> Float[ndarray, "n dof"]:
    q = rng.uniform(robot.lower, robot.upper, (20 * count, robot.dof))
    return q[~ExactCollision(robot, rd.Scene()).collides(q)][:count]


def length_rows(name: str, starts: int) -> list[list[str]]:
    """Rows with lengths and durations of motions to three kinds of poses: that of the hand at the start, 5 cm
    away from it, and that at a random configuration."""
    robot = rd.load_robot(name)
    rng = np.random.default_rng(7)
    configurations = free_configurations(robot, 2 * starts, rng)
    rd.plan(rd.Problem(robot, rd.Scene(), configurations[0], rd.PoseGoal(robot.tip, np.eye(4))))
    rows = []
    for where in ("here", "5 cm", "anywhere"):
        ratios = []
        durations = []
        seconds = []
        solved = 0
        for k, start in enumerate(progress([*configurations[:starts]], f"{name}, {where}")):
            T = robot.fk(start)
            if where == "5 cm":
                direction = rng.normal(size=3)
                T = transform(T[:3, 3] + 0.05 * direction / np.linalg.norm(direction), T[:3, :3])
            elif where == "anywhere":
                T = robot.fk(configurations[starts + k])
            nearest = nearest_distance(robot, robot.tip, T, start, rng)
            if nearest == np.inf:
                continue
            problem = rd.Problem(robot, rd.Scene(), start, rd.PoseGoal(robot.tip, T))
            began = time.process_time()
            result = rd.plan(problem, seed=k)
            seconds.append(time.process_time() - began)
            if result.path is not None and result.duration is not None:
                solved += 1
                ratios.append(max(result.path.length, SHORTEST) / max(nearest, SHORTEST))
                durations.append(result.duration)
        above = sum(ratio > 1.1 for ratio in ratios)
        numbers = (np.median(ratios), np.quantile(ratios, 0.95), max(ratios))
        cells = [*(f"{number:.2f}" for number in numbers), str(above), f"{np.mean(durations):.2f}"]
        rows.append([name, where, f"{solved}/{len(seconds)}", *cells, f"{1e3 * np.median(seconds):.0f}"])
    return rows


@cache
def four_joints() -> Robot:
    text = FEW_JOINTS.read_text().split("```xml\n")[1].partition("```")[0]
    with TemporaryDirectory() as folder:
        file = Path(folder) / "arm.urdf"
        file.write_text(text)
        tree = UrdfTree(file, {})
        robot = tree.robot("base")
        surfaces = {link: tree.surfaces(link) for link in robot.meshes}
        return prepare(robot, surfaces, PreparationSettings()).robot


def few_joints_rows(poses: int) -> list[list[str]]:
    """Rows for arms of four and five joints: poses near that of a random configuration, with tolerances."""
    rows = []
    for robot in (rd.load_robot("so101"), four_joints()):
        for label, xyz, rpy in (
            ("any orientation", None, [np.pi] * 3),
            ("±0.5 rad", None, [0.5] * 3),
            ("1 mm off", None, None),
            ("±5 mm, any turn about z", [0.005] * 3, [0.3, 0.3, np.pi]),
        ):
            rng = np.random.default_rng(11)
            there = free_configurations(robot, poses, rng)
            start = 0.5 * (robot.lower + robot.upper)
            solved = 0
            seconds = []
            for k, q in enumerate(there):
                T = robot.fk(q)
                if rpy is not None:
                    turn = rng.uniform(-0.9, 0.9, 3) * np.minimum(rpy, 0.5)
                    T = T @ transform(np.zeros(3), rotation_from_rpy(*turn))
                else:
                    direction = rng.normal(size=3)
                    T = transform(T[:3, 3] + 1e-3 * direction / np.linalg.norm(direction), T[:3, :3])
                goal = rd.PoseGoal(robot.tip, T, xyz, rpy)
                began = time.process_time()
                solved += rd.plan(rd.Problem(robot, rd.Scene(), start, goal), seed=k).solved
                seconds.append(time.process_time() - began)
            rows.append([robot.name, label, f"{solved}/{poses}", f"{1e3 * np.median(seconds):.0f}"])
    return rows


def several_rows(problems: int) -> list[list[str]]:
    """Rows for goals of twenty poses of the hand, half of them in an obstacle, with a limit of 0.1 s."""
    robot = rd.load_robot("panda")
    rng = np.random.default_rng(3)
    rows = []
    for until in ("first", "converged"):
        seconds = []
        walls = []
        solved = 0
        for k in range(problems):
            configurations = free_configurations(robot, 200, rng)
            start = configurations[0]
            candidates = configurations[1:]
            blocked = candidates[:10]
            balls = [rd.Sphere(robot.fk(q)[:3, 3], 0.06) for q in blocked]
            exact = ExactCollision(robot, rd.Scene(balls))
            if exact.collides(start[None])[0]:
                continue
            free = candidates[~exact.collides(candidates)][:10]
            goals = [rd.PoseGoal(robot.tip, robot.fk(q)) for q in [*blocked, *free]]
            problem = rd.Problem(robot, rd.Scene(balls), start, rd.AnyGoal(tuple(goals)))
            if k == 0:
                rd.plan(problem, 1.0, until=until)
            cpu = time.process_time()
            began = time.perf_counter()
            result = rd.plan(problem, 0.1, seed=k, until=until)
            seconds.append(time.process_time() - cpu)
            walls.append(time.perf_counter() - began)
            solved += result.solved
        cells = [f"{1e3 * value:.0f}" for value in (np.median(seconds), max(seconds), max(walls))]
        rows.append([until, f"{solved}/{len(seconds)}", *cells])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description="Goals as poses.")
    parser.add_argument("--robots", nargs="*", default=ROBOTS)
    parser.add_argument("--starts", type=int, default=60, help="number of starts for each robot (60)")
    parser.add_argument("--few", type=int, default=15, help="number of poses for each arm of few joints (15)")
    parser.add_argument("--problems", type=int, default=20, help="number of problems with several goals (20)")
    arguments = parse(parser, robots=["ur5e"], starts=2, few=2, problems=2)
    print(header("numpy", "numba") + "; benchmarks/pose_goals.py")
    rows = [row for name in arguments.robots for row in length_rows(name, arguments.starts)]
    ratio = ("median", "95 %", "most", "above 1.1")
    if rows:
        columns = ("robot", "goal", "solved", *ratio, "duration, s", "CPU, ms")
        print_table("Length over the distance of the nearest configuration", columns, rows)
    print_table("Arms of few joints", ("robot", "goal", "solved", "CPU, ms"), few_joints_rows(arguments.few))
    columns = ("until", "solved", "CPU, ms", "most CPU, ms", "most wall, ms")
    title = "Twenty poses, of which ten are blocked, in 0.1 s"
    print_table(title, columns, several_rows(arguments.problems))


if __name__ == "__main__":
    main()
