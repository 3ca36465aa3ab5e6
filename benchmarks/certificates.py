"""Whether the validator and certificates catch motions that collide between waypoints, and what they cost.

    python benchmarks/certificates.py [--motions 100] [--resolution 0.01] [--commands 3]

Prints benchmarks/results/certificates.txt. Planners of OMPL plan held-out problems of furniture and dense
obstacles, without simplification. OMPL checks a motion at states whose distance is a fraction (--resolution)
of the space's extent; OMPL's default is 0.01. Paths are cut into waypoints at this distance, as MoveIt does,
so each waypoint is free on the exact meshes. The reference is Coal on these meshes every 0.002 rad. The
validator checks each motion; valid motions are certified, and the certificates checked. Times are CPU times
of warm calls in one process, the least of three. Commands are timed by wall time, each in a process of its
own, `verify` and `certificate check` alternating.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

import robotdiffuse as rd
from common import dense, header, parse, parts_of, print_table, progress
from robotdiffuse.certificates.search import certify
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Path as JointPath
from robotdiffuse.core.types import PlanResult, Status
from robotdiffuse.problems.files import held_out_problem, problem_record
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.validation.report import Report
from robotdiffuse.validation.validator import VerifySettings, verify

PLANNERS = {
    "RRTConnect": og.RRTConnect,
    "RRT": og.RRT,
    "KPIECE1": og.KPIECE1,
    "BKPIECE1": og.BKPIECE1,
}
FAMILIES = ("shelf", "table", "crate", "rop_dense")
# Time limit of a planner's call (wall time) [s]; largest joint motion between two configurations that the
# reference checks [rad].
LIMIT = 4.0
REFERENCE_STEP = 0.002
LENIENT = VerifySettings(reversals=1000)
"""Settings that allow many sharp reversals: OMPL's raw paths go back and forth."""


class Motion(NamedTuple):
    planner: str
    problem: Problem
    path: JointPath


class Checked(NamedTuple):
    planner: str
    waypoints_free: bool
    """Whether all waypoints are free on the exact meshes."""
    reference_free: bool
    """Whether the configurations between them, every REFERENCE_STEP, are free too."""
    report: Report
    """The validator's report."""


def motions(count: int, resolution: float) -> Iterator[Motion]:
    """`count` motions. Each problem is planned by all planners; problems of the families alternate."""
    solved = 0
    number = 0
    while solved < count:
        problem = held_out_problem(FAMILIES[number % len(FAMILIES)], number)
        for k, name in enumerate(PLANNERS):
            path = _planned(problem, name, resolution, 1 + len(PLANNERS) * number + k)
            if path is not None and solved < count:
                solved += 1
                yield Motion(name, problem, path)
        number += 1


def _planned(problem: Problem, name: str, resolution: float, seed: int) -> JointPath | None:
    robot = problem.robot
    exact = ExactCollision(problem.robot, problem.scene)
    if not isinstance(problem.goal, JointGoal):
        return None
    ou.RNG.setSeed(seed)
    space = ob.RealVectorStateSpace(robot.dof)
    bounds = ob.RealVectorBounds(robot.dof)
    for j in range(robot.dof):
        bounds.setLow(j, robot.lower[j])
        bounds.setHigh(j, robot.upper[j])
    space.setBounds(bounds)
    setup = og.SimpleSetup(space)

    def row(state: ob.State) -> list[float]:
        return [state[j] for j in range(robot.dof)]  # type: ignore[index]

    setup.setStateValidityChecker(lambda state: not exact.collides(np.array([row(state)]))[0])
    setup.getSpaceInformation().setStateValidityCheckingResolution(resolution)
    ends = space.allocState(), space.allocState()
    for state, q in zip(ends, (problem.start, problem.goal.positions[0]), strict=True):
        for j in range(robot.dof):
            state[j] = q[j]  # type: ignore[index]
    setup.setStartAndGoalStates(*ends)
    setup.setPlanner(PLANNERS[name](setup.getSpaceInformation()))
    if not setup.solve(LIMIT) or not setup.haveExactSolutionPath():
        return None
    path = setup.getSolutionPath()
    path.interpolate()
    rows = np.array([row(state) for state in path.getStates()])
    rows[0] = problem.start
    rows[-1] = problem.goal.positions[0]
    return JointPath(robot.joint_names, rows)


def check(motion: Motion) -> Checked:
    """Check a motion by the reference and by the validator."""
    exact = ExactCollision(motion.problem.robot, motion.problem.scene)
    q = motion.path.positions
    report = verify(motion.problem, motion.path, LENIENT)
    free = not exact.collides(q).any()
    return Checked(motion.planner, free, not exact.collides(dense(q, REFERENCE_STEP)).any(), report)


def least(act: Callable[[], object]) -> float:
    """CPU time of a warm call [ms]: the least of three."""
    act()
    times = []
    for _ in range(3):
        begun = time.process_time()
        act()
        times.append(time.process_time() - begun)
    return 1e3 * min(times)


class Cost(NamedTuple):
    """Costs of one certificate; times are CPU times [ms]."""

    validator: float
    write: float
    check: float
    size: float
    """Size of the certificate's file [kB]."""
    stretches: int
    planes: int
    share: float
    """Clearance that the certificate proves, as a fraction of the clearance that the validator certifies."""


def cost(problem: Problem, motion: rd.Path | rd.Trajectory, folder: Path) -> Cost:
    def validator() -> Report:
        return verify(problem, motion, LENIENT)  # type: ignore[arg-type]

    certificate = certify(problem, motion, LENIENT)
    file = folder / "certificate.json"
    certificate.save(file)
    assert certificate.check(problem).valid
    proved = min(certificate.scene_clearance, certificate.self_clearance)
    return Cost(
        least(validator),
        least(lambda: certify(problem, motion, LENIENT)),
        least(lambda: certificate.check(problem)),
        file.stat().st_size / 1000,
        len(certificate.proof.stretches.claim),
        len(certificate.proof.planes),
        proved / (validator().min_clearance or 1.0),
    )


def commands(
    problem: Problem, result: PlanResult, folder: Path, count: int
) -> tuple[list[float], list[float]]:
    """Wall times [s] of `robotdiffuse verify` and of `robotdiffuse certificate check`, `count` of each."""
    result.save(folder / "result.json", problem_record(problem))
    rd.certify(problem, result.trajectory or result.path).save(folder / "certificate.json")  # type: ignore[arg-type]
    wall_times: tuple[list[float], list[float]] = ([], [])
    for _ in range(count):
        for times, words in zip(
            wall_times,
            (["verify", "result.json"], ["certificate", "check", "certificate.json"]),
            strict=True,
        ):
            begun = time.perf_counter()
            subprocess.run(
                [sys.executable, "-m", "robotdiffuse", *words],
                cwd=folder,
                check=True,
                capture_output=True,
            )
            times.append(time.perf_counter() - begun)
    return wall_times


def main() -> None:
    parser = argparse.ArgumentParser(description="What certificates catch, and what they cost.")
    parser.add_argument("--motions", type=int, default=100, help="number of motions of OMPL's planners (100)")
    parser.add_argument(
        "--resolution", type=float, default=0.01, help="resolution of the checks of OMPL's planners (0.01)"
    )
    parser.add_argument("--commands", type=int, default=3, help="number of calls of each command (3)")
    parser.add_argument("--requests", default=",".join(REQUESTS), help="kinds of requests (all)")
    arguments = parse(parser, motions=2, commands=1, requests="moving obstacle")
    kinds = parts_of(arguments.requests, REQUESTS)
    ou.setLogLevel(ou.LOG_NONE)
    print(header("numpy", "coal", "ompl", "numba"))
    drawn = list(progress(list(motions(arguments.motions, arguments.resolution)), "motions"))
    validated = [check(motion) for motion in progress(drawn, "validating")]
    rows = []
    for name in (*PLANNERS, "all"):
        chosen = [motion for motion in validated if name in (motion.planner, "all")]
        defects = [motion for motion in chosen if motion.waypoints_free and not motion.reference_free]
        refused = [motion for motion in chosen if not motion.report.valid]
        rows.append(
            [
                name,
                len(chosen),
                sum(motion.waypoints_free for motion in chosen),
                len(defects),
                sum(not motion.report.valid for motion in defects),
                len(refused),
                sum(motion.report.valid and not motion.reference_free for motion in chosen),
            ]
        )
    print_table(
        f"Motions of OMPL's planners, checked at states {arguments.resolution:g} of the extent apart",
        [
            "planner",
            "motions",
            "all waypoints free",
            "collide between",
            "of them caught",
            "refused",
            "missed",
        ],
        rows,
        [
            "collide between: by Coal every 0.002 rad, though every waypoint is free",
            "missed: accepted by the validator, in collision by Coal",
            "also refused: contact between two checks of Coal, bodies nearer than 0.1 mm",
        ],
    )
    with tempfile.TemporaryDirectory() as name:
        measure_requests(kinds, Path(name), arguments.commands)
        measure(drawn, validated, Path(name), arguments.commands)


LOW = [-0.6, 0.2, 0, -2.0, 0, 2.2, 0.2]
FAR = [0.6, 0.2, 0, -2.0, 0, 2.2, 0.2]
TABLE = rd.Box([0.55, 0.0, 0.0], [0.5, 1.0, 0.2], name="table")
POST = rd.Cylinder([0.42, 0.35, 0.4], 0.06, 0.6, name="post")
REQUESTS: dict[str, dict[str, Any]] = {
    "axis cone": {"constraints": [rd.AxisCone("panda_hand", [0, 0, 1], [0, 0, -1], 0.1745)]},
    "straight line": {"constraints": [rd.CartesianLine("panda_hand", 0.002, 0.02, 0.2)]},
    "moving obstacle": {"moving": [rd.MovingObstacle(POST, velocity=[0.25, -0.1, 0.0])]},
    "start velocity": {"start_velocity": [0.5, 0, 0, 0, 0, 0, 0]},
    "payload of 3 kg": {"payload": rd.Payload(3.0, [0.0, 0.0, 0.1])},
}


def measure_requests(kinds: list[str], folder: Path, count: int) -> None:
    """Print what the certificate of one motion over a table costs, for these kinds of requests."""
    robot = rd.load_robot("panda")
    rows = []
    for name in kinds:
        problem = Problem(robot, rd.Scene([TABLE]), LOW, FAR, **REQUESTS[name])
        result = rd.load_planner("aorrtc").plan(problem, time_limit=20.0)
        assert result.trajectory is not None, result.reason
        costs = cost(problem, result.trajectory, folder)
        verified, checked = (float(np.median(times)) for times in commands(problem, result, folder, count))
        numbers = [
            f"{costs.validator:.1f}",
            f"{costs.write:.0f}",
            f"{costs.check:.1f}",
            f"{costs.check / costs.write:.2f}",
        ]
        rows.append([name, *numbers, f"{verified:.2f}", f"{checked:.2f}", f"{checked / verified:.2f}"])
    columns = ["", "validator ms", "certify ms", "check ms", "of certify", "verify s", "check s", "of verify"]
    print_table(
        "Requests, a motion each: CPU time in one warm process; wall time of commands",
        columns,
        rows,
    )


def measure(drawn: list[Motion], validated: list[Checked], folder: Path, count: int) -> None:
    """Print the costs of certificates: for the valid motions of OMPL, and for motions that this package plans
    for the same problems."""
    rough = []
    smooth = []
    failed = 0
    verified = list[float]()
    checked = list[float]()
    problems = list({id(motion.problem): motion.problem for motion in drawn}.values())
    for motion, checks in progress(list(zip(drawn, validated, strict=True)), "certifying"):
        if checks.report.valid:
            try:
                rough.append(cost(motion.problem, motion.path, folder))
            except InputError:
                failed += 1
    for problem in progress(problems, "ours"):
        result = rd.load_planner("rrt_connect").plan(problem, time_limit=LIMIT)
        if result.status is Status.SOLVED and result.trajectory is not None:
            smooth.append(cost(problem, result.trajectory, folder))
            if len(verified) < 3 * count:
                a, b = commands(problem, result, folder, count)
                verified = verified + a
                checked = checked + b
    rows = []
    for name, costs in (("paths of OMPL", rough), ("timed motions of rrt_connect", smooth)):
        if costs:
            table = np.array(costs, float)
            middle = np.median(table, axis=0)
            worst = np.percentile(table, 95, axis=0)
            ratio = np.median(table[:, 2] / table[:, 1])
            for label, line in ((f"{name}, median of {len(costs)}", middle), ("95th percentile", worst)):
                numbers = [f"{line[0]:.1f}", f"{line[1]:.0f}", f"{line[2]:.1f}", f"{line[3]:.0f}"]
                rows.append([label, *numbers, f"{line[4]:.0f}", f"{line[5]:.0f}", f"{line[6]:.2f}"])
            rows.append([f"check / (validator and search for the proof): {ratio:.2f}", *[""] * 7])
    print_table(
        "Certificates: CPU time in one warm process",
        ["", "validator ms", "certify ms", "check ms", "kB", "stretches", "planes", "proved"],
        rows,
        [
            "proved: clearance proved over the validator's",
            f"valid motions for which no proof was found: {failed}",
        ],
    )
    if verified:
        a = float(np.median(verified))
        b = float(np.median(checked))
        print(f"commands, median of {len(verified)}: verify {a:.2f} s, check {b:.2f} s, {b / a:.2f} of it")


if __name__ == "__main__":
    main()
