"""Path constraints: a cup held upright and straight Cartesian lines, compared with sscbirrt.

    python benchmarks/constraints.py [--number 200] [--kinds upright,line] [--without-peer]

Prints benchmarks/results/constraints.txt. Problems are drawn in the scenes of the held-out families shelf and
table, with a cup in the hand that points down, at random places above the ground. Upright: from one place to
another, the cup's axis within 10 degrees of the vertical. Line: to a place 15 to 40 cm away in the same
orientation, the hand's origin within 2 mm of the segment and its orientation within 0.05 rad. Lines are drawn
again until a free configuration exists at nine places of the segment. Goals are up to ten configurations,
identical for all planners.

aorrtc searches among configurations that it projects onto the constraints. diffusion draws from the network,
which knows no constraints, under guidance by the violation of the constraints, and projects every waypoint.

sscbirrt (PyPI) runs in its Python core, with this project's compiled projection and collision check as
callbacks, since its native core takes only MuJoCo's scenes, analytical inverse kinematics and its own
constraint sets. It returns waypoints, checked every 0.05 rad; this package returns timed motions that the
validator proved.

Coal on the exact meshes and PyBullet check every motion, the hand moving at most 1 mm between two checks;
PyBullet's own kinematics measure the constraint there. Time limits are of CPU time.
"""

import argparse
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy import ndarray

import robotdiffuse as rd
from common import (
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
from robotdiffuse.core.transforms import (
    rotation_angle,
    rotation_from_quaternion,
    rotation_from_rpy,
    transform,
)
from robotdiffuse.core.types import Path
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems import constraint_kernel as kernel
from robotdiffuse.problems.compiled_constraints import PathConstraints
from robotdiffuse.problems.files import SEED, held_out_problem
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.problems.projection_kernel import project
from robotdiffuse.robots.inverse_kinematics import inverse_kinematics
from robotdiffuse.robots.robot import Robot
from robotdiffuse.simulation.world import World
from robotdiffuse.validation.validator import verifier

# Time limits [s]. A problem counts as solvable if it is solved within the longer one.
SHORT = 1.0
LONG = 10.0
HAND, CUP = "panda_hand", rd.Cylinder([0, 0, 0.14], 0.03, 0.06, name="cup")
LOW, HIGH = np.array([0.25, -0.5, 0.25]), np.array([0.7, 0.5, 0.8])
"""Corners of the box from which the hand's position is drawn [m]."""
# Tolerances: tilt of the cup [rad], distance from the line [m], rotation along the line [rad].
UPRIGHT = np.radians(10)
OFF_LINE = 0.002
TURNED = 0.05
# Number of goal configurations of a problem; number of places of a line that need a free configuration.
GOALS = 10
LINE_PLACES = 9
STEP = 0.001
"""Largest joint motion between two checks of a motion [rad]. The arm reaches less than 1 m, so the hand moves
by less than 1 mm for each joint."""
CONTACT_FRAMES = 600
"""About how many configurations of a motion are checked for collisions."""
ROUNDING = 1e-6
"""Error of PyBullet's kinematics [m], [rad]."""


class Answer(NamedTuple):
    """A planner's answer to a problem."""

    seconds: float
    """CPU time of the call [s]."""
    first: float
    """CPU time until the first path [s]; for sscbirrt until the answer. Infinite without a motion."""
    positions: ndarray | None
    """Rows of the timed motion, or waypoints."""
    length: float
    proved: bool


class Checked(NamedTuple):
    """A motion as Coal and PyBullet see it."""

    coal: int
    pybullet: bool
    excess: float
    """The largest violation of a tolerance, as a fraction of the tolerance; negative if none is violated."""


def drawn(kind: str, number: int) -> Iterator[Problem]:
    """Held-out problems with a cup in the hand and a constraint."""
    count = 0
    i = 0
    while count < number:
        rng = np.random.default_rng([SEED, 2, i])
        held_out = held_out_problem(("shelf", "table")[i % 2], i // 2)
        i += 1
        robot = held_out.robot.attach(CUP, HAND)
        checker = CollisionChecker(robot, held_out.scene)
        ends = _ends(kind, robot, checker, rng)
        if ends is None:
            continue
        start, goals = ends
        constraint = (
            rd.AxisCone("cup", [0, 0, 1], [0, 0, -1], UPRIGHT)
            if kind == "upright"
            else rd.CartesianLine(HAND, OFF_LINE, TURNED)
        )
        yield Problem(robot, held_out.scene, start, JointGoal(goals), constraints=[constraint])
        count += 1


def _ends(
    kind: str, robot: Robot, checker: CollisionChecker, rng: np.random.Generator
) -> tuple[ndarray, ndarray] | None:
    """A start and configurations of a goal; None if 20 tries find none."""
    for _ in range(20):
        T = _pose(rng)
        start = inverse_kinematics(robot, HAND, T, 1, rng=rng, accept=checker.free)
        if not len(start):
            continue
        T_goal = _pose(rng)
        if kind == "line":
            direction = rng.normal(size=3)
            T_goal = T.copy()
            T_goal[:3, 3] += rng.uniform(0.15, 0.4) * direction / np.linalg.norm(direction)
            shares = np.linspace(0, 1, LINE_PLACES)[1:-1]
            between = [transform((1 - s) * T[:3, 3] + s * T_goal[:3, 3], T[:3, :3]) for s in shares]
            if not all(_reached(robot, P, 1, checker, rng) is not None for P in between):
                continue
        goals = _reached(robot, T_goal, GOALS, checker, rng)
        if goals is not None:
            return start[0], goals
    return None


def _pose(rng: np.random.Generator) -> ndarray:
    """A random pose of the hand pointing down."""
    return transform(rng.uniform(LOW, HIGH), rotation_from_rpy(np.pi, 0.0, float(rng.uniform(-np.pi, np.pi))))


def _reached(
    robot: Robot, T: ndarray, count: int, checker: CollisionChecker, rng: np.random.Generator
) -> ndarray | None:
    configurations = inverse_kinematics(robot, HAND, T, count, rng=rng, accept=checker.free)
    return configurations if len(configurations) else None


def ours(planner: Planner, problem: Problem, seed: int) -> Answer:
    """The answer of a planner of this package."""
    result = planner.plan(problem, time_limit=LONG, seed=seed)
    if result.path is None or result.trajectory is None:
        return Answer(result.planning_time, np.inf, None, np.inf, False)
    first = result.progress[0][0]
    return Answer(result.planning_time, first, result.trajectory.positions, result.path.length, True)


class _Arm:
    """This package's kinematics and collision check, with the interface that sscbirrt expects."""

    def __init__(self, problem: Problem) -> None:
        self.robot, self.checker = problem.robot, CollisionChecker(problem.robot, problem.scene)
        self.dof = self.robot.dof
        self.joint_limits = (self.robot.lower, self.robot.upper)

    def forward_kinematics(self, q: ndarray) -> ndarray:
        return self.robot.fk(q, HAND)

    def is_valid(self, q: ndarray) -> bool:
        return bool(self.checker.free(q[None])[0])


class _Set:
    """This package's projection onto constraints, with the interface that sscbirrt expects."""

    def __init__(self, problem: Problem) -> None:
        self.ready = PathConstraints(problem)
        self.rows, self.work = self.ready.rows, kernel.make_work(self.ready.rows)
        self.projection_limit = self.rows.limit - 0.05 * self.rows.tolerance

    def contains(self, q: ndarray) -> bool:
        kernel.evaluate(self.rows, q, 0, self.work)
        return bool((self.work.values[0] <= self.rows.limit).all())

    def project(self, q_previous: ndarray, q_proposed: ndarray) -> ndarray | None:
        q = q_proposed.copy()
        return q if project(self.rows, self.projection_limit, q, self.work) else None


def peer(problem: Problem, seed: int) -> Answer:
    """The answer of sscbirrt with its default settings."""
    import sscbirrt  # pyright: ignore[reportMissingImports]
    from sscbirrt.testing import PlanarIK  # pyright: ignore[reportMissingImports]

    arm = _Arm(problem)
    goal = problem.goal
    assert isinstance(goal, JointGoal)
    began = time.process_time()
    config = sscbirrt.CBiRRTConfig(timeout=1e4, abort_fn=lambda: time.process_time() - began > LONG)
    planner = sscbirrt.CBiRRT(arm, PlanarIK(), arm, config, backend="python")
    task = sscbirrt.PlanningProblem(
        space=planner.space,
        start=sscbirrt.FiniteSet([problem.start], metric=planner.space.distance),
        goal=sscbirrt.FiniteSet(list(goal.positions), metric=planner.space.distance),
        validator=arm,
        path_constraint=_Set(problem),
    )
    path = planner.solve(task, seed=seed).path
    spent = time.process_time() - began
    if path is None:
        return Answer(spent, np.inf, None, np.inf, False)
    rows = np.stack(path)
    joint_path = Path(problem.robot.joint_names, rows)
    return Answer(spent, spent, rows, joint_path.length, verifier(problem).path(joint_path).valid)


def checked(problem: Problem, rows: ndarray) -> Checked:
    """Check a motion on the meshes and against the constraint."""
    frames = dense(rows, STEP)
    contacts = contacts_on_meshes(problem, frames[:: max(1, len(frames) // CONTACT_FRAMES)])
    return Checked(*contacts, _excess(problem, frames))


def _excess(problem: Problem, frames: ndarray) -> float:
    """The largest violation of the problem's only constraint by PyBullet's kinematics, as a fraction of its
    tolerance."""
    [constraint] = problem.constraints
    with World(problem.robot, rd.Scene()) as world:

        def pose(q: ndarray) -> ndarray:
            world.place(q)
            link = world.links[constraint.frame]
            state = world.bullet.getLinkState(world.body, link, computeForwardKinematics=1)
            x, y, z, w = state[5]
            return transform(np.array(state[4]), rotation_from_quaternion(np.array([w, x, y, z])))

        poses = [pose(q) for q in frames]
    if isinstance(constraint, rd.AxisCone):
        cosines = [T[:3, :3] @ constraint.axis @ constraint.direction for T in poses]
        return float((np.arccos(np.clip(cosines, -1, 1)).max() - ROUNDING) / constraint.angle - 1)
    assert isinstance(constraint, rd.CartesianLine)
    first = poses[0]
    last = poses[-1]
    segment = last[:3, 3] - first[:3, 3]
    p = np.array([T[:3, 3] for T in poses])
    shares = np.clip((p - first[:3, 3]) @ segment / (segment @ segment), 0, 1)
    distance = np.linalg.norm(p - first[:3, 3] - shares[:, None] * segment, axis=1).max()
    turned = max(rotation_angle(first[:3, :3].T @ T[:3, :3]) for T in poses)
    return float(max((distance - ROUNDING) / OFF_LINE, (turned - ROUNDING) / TURNED) - 1)


def compared(kind: str, number: int, with_peer: bool) -> None:
    """Plan with each planner, check on meshes, and print."""
    problems = list(drawn(kind, number))
    answers = dict[str, list[Answer]]()
    for name in ("aorrtc", "diffusion"):
        planner = rd.load_planner(name)
        planner.warm_up(problems[0])
        answers[name] = [ours(planner, p, i) for i, p in enumerate(progress(problems, f"{kind}, {name}"))]
    if with_peer:
        peer(problems[0], 0)
        answers["sscbirrt"] = [peer(p, i) for i, p in enumerate(progress(problems, f"{kind}, sscbirrt"))]
    possible = sum(any(a[i].positions is not None for a in answers.values()) for i in range(number))
    solved_by_all = [i for i in range(number) if all(a[i].positions is not None for a in answers.values())]
    columns = []
    for name, planner_answers in answers.items():
        done = [(problems[i], a) for i, a in enumerate(planner_answers) if a.positions is not None]
        checks = [
            checked(p, a.positions)
            for p, a in progress(done, f"{kind}, checks of {name}")
            if a.positions is not None
        ]
        if not done:
            columns.append([f"0 of {possible}", *["-"] * 9])
            continue
        times, firsts = ([1e3 * t for t in each] for each in zip(*(a[:2] for _, a in done), strict=True))
        columns.append(
            [
                f"{sum(a.seconds <= SHORT for _, a in done)} of {possible}",
                f"{len(done)} of {possible}",
                f"{np.median(firsts):.0f} / {np.percentile(firsts, 95):.0f} ms",
                f"{np.median(times):.0f} / {np.percentile(times, 95):.0f} ms",
                f"{np.median([planner_answers[i].length for i in solved_by_all]):.2f} rad"
                if solved_by_all
                else "-",
                str(sum(s.coal > 0 for s in checks)),
                str(sum(s.pybullet for s in checks)),
                str(sum(s.excess > 0 for s in checks)),
                f"{100 * (1 + max(s.excess for s in checks)):.1f} %",
                f"{sum(a.proved for _, a in done)} of {len(done)}",
            ]
        )
    rows = (
        f"solved in {SHORT:.0f} s, of what any solves",
        f"solved in {LONG:.0f} s",
        "CPU time until the first path, median / p95",
        "CPU time until it answers, median / p95",
        f"length, median of the {len(solved_by_all)} that all solve",
        "motions in collision by Coal",
        "in collision by PyBullet",
        "beyond the tolerance at 1 mm steps",
        "most of the tolerance that any takes",
        "motions proved by the validator",
    )
    table = list(zip(rows, *columns, strict=True))
    print_table(f"{kind}: {number} problems", ("", *answers), table)


def main() -> None:
    parser = argparse.ArgumentParser(description="Path constraints: upright cups and straight lines.")
    parser.add_argument("--number", type=int, default=200, help="number of problems of each kind (200)")
    parser.add_argument("--kinds", default="upright,line", help="kinds of constraints (upright,line)")
    parser.add_argument("--without-peer", action="store_true", help="leave sscbirrt out")
    arguments = parse(parser, number=1, without_peer=True)
    use_processor_time()
    print(header("numba", "numpy", "coal", "pybullet", "sscbirrt"))
    for kind in parts_of(arguments.kinds, ("upright", "line")):
        compared(kind, arguments.number, not arguments.without_peer)


if __name__ == "__main__":
    main()
