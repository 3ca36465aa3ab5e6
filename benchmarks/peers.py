"""Comparison with peers: MPlib, roboplan, sscbirrt, OMPL with Pinocchio and RobotDiffuse on equal problems.

    python benchmarks/peers.py --problems FOLDER --environments FOLDER
        [--families bookshelf_small_panda,box_panda,cage_panda] [--each 10] [--peers mplib,roboplan,...]

Prints benchmarks/results/peers.txt. The first FOLDER holds families of MotionBenchMaker (scene and request
files), the second an environment for each peer, made once, outside the repository:

    python -m venv FOLDER/mplib && FOLDER/mplib/bin/pip install mplib==0.2.1 "numpy<2"
    python -m venv FOLDER/roboplan && FOLDER/roboplan/bin/pip install roboplan
    python -m venv FOLDER/sscbirrt && FOLDER/sscbirrt/bin/pip install "sscbirrt[mujoco,ssik]"
    python -m venv FOLDER/ompl && FOLDER/ompl/bin/pip install ompl pin toppra

A peer without an environment is left out, and the report says so. Each peer runs in a process of its own
(benchmarks/workers/peer.py), on the URDF and the convex meshes of this package's Panda, with the same
checked pairs of links, the same scene and the same limits of position, velocity and acceleration;
RobotDiffuse also keeps jerk limits. Each goal is given as a configuration, and as the pose of the hand in
this configuration. A problem counts as solved if the answer takes at most TIME_LIMIT seconds of CPU time. The
validator and Coal check the motions along straight lines between their rows, which are 4 ms apart.
"""

import argparse
import json
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy import ndarray

import robotdiffuse as rd
from common import (
    CONVERGED,
    FIRST,
    contacts_on_meshes,
    dense,
    draw_hard_cases,
    header,
    parse,
    parts_of,
    print_table,
    progress,
    use_processor_time,
)
from robotdiffuse.core.transforms import pose_entry
from robotdiffuse.core.types import Path as JointPath
from robotdiffuse.problems.files import ProblemEntry, goal_of, load_motion_bench_maker
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.shapes import Box, Cylinder
from robotdiffuse.simulation.world import write_urdf

TIME_LIMIT = 1.0
"""CPU time of an answer that counts as solved [s]."""
WALL_SHARE = 10.0
"""Peers limit wall time. Their limit is this factor times TIME_LIMIT, so that other work on the machine does
not end their searches early."""
MESH_STEP = 0.005
"""Largest motion of a joint between two configurations that are checked on meshes [rad]."""
ROW = 0.004
"""Time between the rows of a motion [s], as by default in RobotDiffuse."""
PEERS = ("mplib", "roboplan", "sscbirrt", "ompl")
GOALS = ("configuration", "pose")
WORKER = Path(__file__).parent / "workers" / "peer.py"


class Answer(NamedTuple):
    cpu: float
    """CPU time of the call [s]."""
    duration: float | None
    """Duration of the motion [s]; None without a motion."""
    rows: ndarray | None
    """Configurations of the motion, every ROW; None without a motion."""
    reason: str = ""
    """Why there is no motion."""


def robot_files(robot: Robot, folder: Path) -> dict[str, Any]:
    """Writes the robot as a URDF and an SRDF, and returns the description that workers read. In the URDF,
    joints that are not planned are fixed at their locked values."""
    urdf = write_urdf(robot, folder)
    tree = ET.parse(urdf)
    for element, joint in zip(tree.iter("joint"), robot.joints, strict=True):
        if joint.movable and joint.name not in robot.joint_names:
            element.set("type", "fixed")
            origin = element.find("origin")
            assert origin is not None
            shift = joint.T_parent_joint[:3, :3] @ joint.axis * robot.locked[joint.name]
            origin.set("xyz", " ".join(map(repr, (joint.T_parent_joint[:3, 3] + shift).tolist())))
    for element, joint in zip(tree.iter("joint"), robot.joints, strict=True):
        limit = element.find("limit")
        if joint.name in robot.joint_names and limit is not None:
            i = robot.joint_names.index(joint.name)
            limit.set("velocity", repr(float(robot.velocity[i])))
    tree.write(urdf)
    for link, meshes in robot.meshes.items():
        for i, mesh in enumerate(meshes):  # as MPlib names convex meshes
            solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
            solid.export(folder / f"{link}_{i}.obj.convex.stl")
    solid = [link for link in robot.link_names if robot.meshes.get(link)]
    unchecked = [
        (a, b)
        for a, b in combinations(solid, 2)
        if robot.link_frame(a) == robot.link_frame(b) or frozenset((a, b)) in robot.allowed_collisions
    ]
    root = ET.Element("robot", name="robot")
    for a, b in unchecked:
        ET.SubElement(root, "disable_collisions", link1=a, link2=b, reason="Never")
    srdf = folder / "robot.srdf"
    ET.ElementTree(root).write(srdf)
    return {
        "urdf": str(urdf),
        "srdf": str(srdf),
        "base": robot.base,
        "tip": robot.tip,
        "joints": robot.joint_names,
        "lower": robot.lower.tolist(),
        "upper": robot.upper.tolist(),
        "velocity": robot.velocity.tolist(),
        "acceleration": robot.acceleration.tolist(),
        "fixed_links": [link for link in solid if robot.link_frame(link) == 0],
        "unchecked": unchecked,
    }


def problem_entry(case: ProblemEntry, goal: str) -> dict[str, Any]:
    """The problem as the workers read it."""
    problem = case.problem
    assert problem is not None
    shapes = []
    for shape in problem.known_scene.shapes:
        entry: dict[str, Any] = {"name": shape.name} | pose_entry(shape.T_base_shape)
        if isinstance(shape, Box):
            entry |= {"kind": "box", "size": shape.size.tolist()}
        else:
            assert isinstance(shape, Cylinder), "scenes of MotionBenchMaker have boxes and cylinders"
            entry |= {"kind": "cylinder", "radius": shape.radius, "height": shape.height}
        shapes.append(entry)
    q = goal_of(problem)
    pose = pose_entry(problem.robot.fk(q))
    end = {"positions": q.tolist()} if goal == "configuration" else pose
    return {"name": case.name, "start": problem.start.tolist(), "goal": end, "shapes": shapes}


def asked(case: ProblemEntry, goal: str) -> rd.Problem:
    """The problem with its goal in one of the forms of GOALS."""
    problem = case.problem
    assert problem is not None
    if goal == "configuration":
        return problem
    T = problem.robot.fk(goal_of(problem))
    return rd.Problem(problem.robot, problem.scene, problem.start, rd.PoseGoal(problem.robot.tip, T))


def ours(cases: Sequence[ProblemEntry], goal: str, until: str) -> list[Answer]:
    """The answers of `rd.plan` with its defaults, which keep a clearance where they can."""
    rd.plan(asked(cases[0], goal), time_limit=TIME_LIMIT, until=until)
    answers = []
    for case in progress(cases, f"robotdiffuse, {goal}, {until}"):
        result = rd.plan(asked(case, goal), time_limit=TIME_LIMIT, until=until)
        rows = None if result.trajectory is None else result.trajectory.resample(1 / ROW).positions
        answers.append(Answer(result.planning_time, result.duration, rows, result.reason))
    return answers


def of_peer(name: str, python: Path, robot: dict[str, Any], problems: list[dict]) -> tuple[list[Answer], str]:
    """The answers of a peer and the versions of its packages; or no answers and the reason."""
    with TemporaryDirectory() as folder:
        task = Path(folder, "task.json")
        answers = Path(folder, "answers.json")
        task.write_text(
            json.dumps({"robot": robot, "wall_limit": WALL_SHARE * TIME_LIMIT, "problems": problems})
        )
        command = [str(python), str(WORKER), name, str(task), str(answers)]
        environment = {"OMP_NUM_THREADS": "1", "PATH": str(python.parent)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["no message"])[-1]
            return [], f"{name} cannot be run: exit status {done.returncode}, {last}"
        data = json.loads(answers.read_text())
    parsed = [
        Answer(a["cpu"], a["duration"], None if a["rows"] is None else np.array(a["rows"]), a["reason"])
        for a in data["answers"]
    ]
    return parsed, ", ".join(f"{package} {number}" for package, number in data["versions"].items())


def row(
    name: str, goal: str, cases: Sequence[ProblemEntry], answers: Sequence[Answer], common: set[int]
) -> list[str]:
    """A row of the table; `common`: the problems whose durations are compared."""
    solved = [i for i, a in enumerate(answers) if a.rows is not None and a.cpu <= TIME_LIMIT]
    if not solved:
        return [goal, name, f"0 of {len(cases)}", *["-"] * 6]
    certified = free = shallow = 0
    for i in progress(solved, f"checks of {name}"):
        problem = asked(cases[i], goal)
        rows = answers[i].rows
        assert rows is not None
        rows = np.clip(rows, problem.robot.lower, problem.robot.upper)
        certified += rd.verify(problem, JointPath(problem.robot.joint_names, rows)).valid
        contacts = contacts_on_meshes(problem, dense(rows, MESH_STEP))
        free += contacts.coal == 0
        shallow += not contacts.pybullet
    times = [1e3 * answers[i].cpu for i in solved]
    durations = [d for i in common if (d := answers[i].duration) is not None]
    return [
        goal,
        name,
        f"{len(solved)} of {len(cases)}",
        f"{np.median(times):.1f}",
        f"{np.percentile(times, 95):.1f}",
        f"{np.mean(durations):.2f}" if durations else "-",
        f"{certified} of {len(solved)}",
        f"{free} of {len(solved)}",
        f"{shallow} of {len(solved)}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description="MPlib, roboplan, sscbirrt and OMPL beside RobotDiffuse.")
    parser.add_argument(
        "--problems", type=Path, help="folder with MotionBenchMaker families (one problem of the package)"
    )
    parser.add_argument(
        "--environments",
        type=Path,
        default=Path("peers"),
        help="folder with an environment of each peer (peers)",
    )
    parser.add_argument("--families", default="bookshelf_small_panda,box_panda,cage_panda")
    parser.add_argument("--each", type=int, default=10, help="number of problems of each family (10)")
    parser.add_argument("--peers", default=",".join(PEERS), help="peers, separated by commas (all)")
    arguments = parse(parser, each=1)
    names = arguments.families.split(",")
    print(header("numba", "coal", "pybullet"))
    use_processor_time()
    with TemporaryDirectory() as folder:
        cases: list[ProblemEntry] = []
        for name in names if arguments.problems else ():
            entries = load_motion_bench_maker(arguments.problems / name)
            cases += entries[:: max(len(entries) // arguments.each, 1)][: arguments.each]
        if not cases:
            cases = [ProblemEntry(case.name, case.problem) for case in draw_hard_cases("shelf", 1)]
        robot = robot_files(asked(cases[0], GOALS[0]).robot, Path(folder))
        rows = []
        notes = []
        for goal in GOALS:
            problems = [problem_entry(case, goal) for case in cases]
            answers = {
                "robotdiffuse, first motion": ours(cases, goal, FIRST),
                "robotdiffuse, converged": ours(cases, goal, CONVERGED),
            }
            for name in parts_of(arguments.peers, PEERS):
                python = arguments.environments / name / "bin" / "python"
                if not python.exists():
                    note = f"{name} is not installed: {python} does not exist"
                else:
                    planner_answers, note = of_peer(name, python, robot, problems)
                    if planner_answers:
                        answers[name] = planner_answers
                notes += [note] if note not in notes else []
            solved_by_all = {
                i
                for i in range(len(cases))
                if all(a[i].rows is not None and a[i].cpu <= TIME_LIMIT for a in answers.values())
            }
            rows += [
                row(name, goal, cases, planner_answers, solved_by_all)
                for name, planner_answers in answers.items()
            ]
            for name, planner_answers in answers.items():
                reasons = [a.reason for a in planner_answers if a.rows is None]
                notes += [f"{goal}, {name}: {reason}" for reason in dict.fromkeys(reasons)]
            notes.append(f"{goal}: durations are means over the {len(solved_by_all)} problems that all solve")
    columns = [
        "goal",
        "planner",
        "solved",
        "CPU ms, median",
        "p95",
        "duration s",
        "certified",
        "free",
        "1 mm",
    ]
    explanation = (
        f"solved: within {TIME_LIMIT:g} s of CPU time. CPU: until the answer, a timed motion. certified: by "
        "rd.verify along the lines between the rows; free: by Coal on the convex meshes every "
        f"{MESH_STEP:g} rad; 1 mm: no deeper contact by PyBullet."
    )
    sources = ", ".join(names if arguments.problems else ("shelf",))
    print_table(f"{len(cases)} problems of {sources}", columns, rows, (explanation, *notes))


if __name__ == "__main__":
    main()
