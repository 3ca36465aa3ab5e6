"""robotdiffuse robot info, robotdiffuse robot add"""

import argparse
import sys
from collections import Counter
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import assignment, folder, natural
from robotdiffuse.core.errors import InputError

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from robotdiffuse.robots.fitting.add import AddReport
    from robotdiffuse.robots.robot import Joint, Robot


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "robot", help="show or prepare a robot", description="Show a robot, or prepare one for planning."
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)

    listing = actions.add_parser(
        "list",
        help="list robots",
        description="List the bundled and the added robots.",
    )
    listing.set_defaults(run=run_list)

    info = actions.add_parser(
        "info",
        help="show joints, limits and collision model",
        description="Show joints, limits and collision model of a robot.",
    )
    info.add_argument("robot", metavar="ROBOT", help="a bundled name, a prepared folder or a URDF file")
    info.set_defaults(run=run_info)

    make = actions.add_parser(
        "add",
        help="prepare a robot from its URDF",
        description="Fit covering spheres to the collision meshes of a URDF, find the pairs of links that "
        "need no check, and write a robot folder that problems can name.",
    )
    make.add_argument("urdf", metavar="URDF", help="URDF or xacro file of an arm")
    make.add_argument("--name", metavar="NAME", help="name of the robot in problems (default: the URDF's)")
    make.add_argument(
        "--out", metavar="FOLDER", help="folder to write (default: in the user's data directory)"
    )
    make.add_argument(
        "--group",
        metavar="NAME",
        help="SRDF group or arm to plan for; 'both' or 'all' for all arms as one robot (default: the only "
        "arm)",
    )
    make.add_argument("--base", metavar="LINK", help="first link of the arm (default: the root)")
    make.add_argument(
        "--tip", metavar="LINK", help="last link of the arm (default: the link where a gripper begins)"
    )
    make.add_argument(
        "--lock",
        type=assignment,
        action="append",
        default=[],
        metavar="JOINT=VALUE",
        help="lock a joint at a value [rad or m]; repeatable",
    )
    make.add_argument(
        "--srdf",
        metavar="FILE",
        help="SRDF with groups, poses, passive joints and allowed pairs of links (default: groups, poses and "
        "passive joints of the SRDF beside the URDF)",
    )
    make.add_argument(
        "--allow",
        nargs=2,
        action="append",
        default=[],
        metavar=("LINK", "LINK"),
        help="two links that are not checked against each other; repeatable",
    )
    make.add_argument(
        "--package",
        type=folder,
        action="append",
        default=[],
        metavar="NAME=FOLDER",
        help="folder of a ROS package (default: search ROS_PACKAGE_PATH, AMENT_PREFIX_PATH and the folders "
        "above the URDF)",
    )
    make.add_argument(
        "--limits", metavar="FILE", help="joint limits, a file in the form of MoveIt's joint_limits.yaml"
    )
    make.add_argument(
        "--licence", metavar="TEXT", help="licence of the URDF's geometry, stored with the robot"
    )
    make.add_argument("--seed", type=natural, default=0, metavar="N", help="random seed (default: 0)")
    make.set_defaults(run=run_add)


def run_list(arguments: argparse.Namespace) -> int:
    from robotdiffuse.evaluation.tables import Column, Table, show
    from robotdiffuse.learning.weights_registry import weights_for
    from robotdiffuse.robots import known_robots, load_robot
    from robotdiffuse.robots.robot_folder import read_source

    rows = []
    for name, place in known_robots().items():
        try:
            robot = load_robot(name)
        except InputError as error:
            rows.append((name, None, None, None, None, "", str(error)))
            continue
        spheres = sum(len(part) for part in robot.spheres.values())
        weights = "no" if weights_for("model", robot) is None else "yes"
        refused, pairs = read_source(place).get("refused"), len(robot.checked_pairs())
        rows.append((name, robot.dof, spheres, pairs, refused, weights, str(place)))
    refused = Column("false collisions", "%", ".1f", scale=100.0)
    columns = ("robot", "joints", "spheres", "checked pairs", refused, "weights", Column("folder", left=True))
    show(Table.of("", columns, rows))
    return 0


def run_info(arguments: argparse.Namespace) -> int:
    from robotdiffuse.robots import load_robot

    print_robot(load_robot(arguments.robot))
    return 0


def run_add(arguments: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.progress import Progress

    from robotdiffuse.core.processes import interrupts_at_once

    console = Console(stderr=True)
    bar = Progress(console=console, transient=True, disable=not console.is_terminal)
    with interrupts_at_once(bar.stop), bar:
        from robotdiffuse.cli.robot_report import print_preparation
        from robotdiffuse.robots.fitting.add import add_robot

        task = bar.add_task("reading the URDF")

        def progress(what: str, step: int, steps: int) -> None:
            if console.is_terminal:
                bar.update(task, description=what, completed=step, total=steps)
            else:
                print(f"{step} of {steps}: {what}", file=sys.stderr, flush=True)

        report = add_robot(
            arguments.urdf,
            name=arguments.name,
            base=arguments.base,
            tip=arguments.tip,
            locked=dict(arguments.lock),
            limits=arguments.limits,
            out=arguments.out,
            licence=arguments.licence or "see the URDF",
            seed=arguments.seed,
            group=arguments.group,
            srdf=arguments.srdf,
            allow=[tuple(pair) for pair in arguments.allow],
            packages=dict(arguments.package),
            progress=progress,
        )
    print_preparation(report)
    _print_pairs(report)
    print_robot(report.robot)
    print(f"wrote {report.folder}")
    return 0


def _print_pairs(report: "AddReport") -> None:
    """Print how many pairs of links are allowed for which reason, and where the SRDF differs."""
    from robotdiffuse.evaluation.tables import Column, Table, show

    reasons = Counter(pair.reason for pair in report.pairs)
    counted = ", ".join(f"{reason} {count}" for reason, count in sorted(reasons.items()))
    show(Table.pairs("", [("pairs of links", counted)]))
    if report.srdf is None:
        return
    columns = ("link", "link", "by sampling", Column("colliding", "%", ".1f", scale=100.0), "by the SRDF")
    rows = [(*pair.links, pair.sampled, pair.colliding, pair.srdf) for pair in report.differences]
    title = f"differences from {report.srdf.name}"
    show(Table.of(title, columns, rows) if rows else Table.pairs("", [(title, "none")]))


def print_robot(robot: "Robot") -> None:
    """Print tables of joints, limits and collision model."""
    from robotdiffuse.core.transforms import inverse
    from robotdiffuse.evaluation.tables import Column, Table, show

    columns = ("joint", Column("kind", left=True), "lower", "upper", "velocity", "accel.", "jerk")
    joints = [(j.name, j.kind, *_range(j), j.velocity, j.acceleration, j.jerk) for j in robot.planned_joints]
    spheres = sum(len(rows) for rows in robot.spheres.values())
    meshes = sum(len(pieces) for pieces in robot.meshes.values())
    ends = [("tip", tip) for tip in robot.tips] if robot.other_tips else []
    pairs = [("base", robot.base), *ends] if ends else [("base, tip", f"{robot.base}, {robot.tip}")]
    if robot.root not in ("", robot.base):
        at = "on a movable joint" if robot.T_base_root is None else _place(inverse(robot.T_base_root))
        pairs.append((f"base in {robot.root}", at))
    pairs += [
        ("links", f"{len(robot.link_names)}"),
        ("collision model", f"{spheres} spheres on {len(robot.spheres)} links, {meshes} convex meshes"),
        ("checked pairs of links", f"{len(robot.checked_pairs())}"),
        *(("locked", f"{name} = {value:g}") for name, value in robot.locked.items()),
        *(("note", note) for note in robot.notes),
    ]
    show(Table.of(robot.name, columns, joints), Table.pairs("", pairs))


def _range(joint: "Joint") -> tuple[float | None, float | None]:
    return (None, None) if joint.kind == "continuous" else (joint.lower, joint.upper)


def _place(T: "Float[ndarray, '4 4']") -> str:
    from robotdiffuse.core.transforms import quaternion_from_rotation

    xyz, wxyz = T[:3, 3], quaternion_from_rotation(T[:3, :3])
    return " ".join(["xyz", *(f"{value:g}" for value in xyz), "wxyz", *(f"{value:.4g}" for value in wxyz)])
