"""The commands `robotdiffuse robot list`, `info` and `add`."""

from collections import Counter
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import Namespace, chosen
from robotdiffuse.cli.console import say
from robotdiffuse.core.errors import InputError, counted
from robotdiffuse.core.interrupts import exit_on_interrupt
from robotdiffuse.core.tables import Column, Table, show
from robotdiffuse.core.transforms import inverse, quaternion_from_rotation
from robotdiffuse.core.types import Pose
from robotdiffuse.learning.weight_files import weights_for
from robotdiffuse.robots import known_robots, load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.robot_folder import read_source

if TYPE_CHECKING:
    from robotdiffuse.robots.fitting.preparation import AddReport

MAX_PAIRS = 8
"""Largest number of pairs of links whose false collisions `robot add` prints."""


def run_list(arguments: Namespace) -> None:
    rows = []
    for name, place in known_robots().items():
        try:
            robot = load_robot(name)
        except InputError as error:
            rows.append((name, None, None, None, None, "", str(error)))
            continue
        spheres = sum(map(len, robot.spheres.values()))
        weights = "no" if weights_for("model", robot) is None else "yes"
        # the fraction of free configurations in which spheres collide falsely
        false_share = read_source(place).get("refused")
        rows.append((name, robot.dof, spheres, len(robot.checked_pairs()), false_share, weights, str(place)))
    false_column = Column("false collisions", "%", ".1f", scale=100.0)
    columns = (
        "robot",
        "joints",
        "spheres",
        "checked pairs",
        false_column,
        "weights",
        Column("folder", left=True),
    )
    show(Table.of("", columns, rows))


def run_info(arguments: Namespace) -> None:
    print_robot(load_robot(arguments.robot))


def run_add(arguments: Namespace) -> None:
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    bar = Progress(console=console, transient=True, disable=not console.is_terminal)
    with exit_on_interrupt(bar.stop), bar:
        from robotdiffuse.robots.fitting.preparation import add_robot

        task = bar.add_task("reading the robot")

        def progress(what: str, step: int, steps: int) -> None:
            if console.is_terminal:
                bar.update(task, description=what, completed=step, total=steps)
            else:
                say(f"{step} of {steps}: {what}")

        report = add_robot(
            arguments.urdf,
            **chosen(arguments, ("name", "base", "tip", "limits", "out", "license", "seed", "group", "srdf")),
            locked=dict(arguments.lock),
            allow=[tuple(pair) for pair in arguments.allow],
            packages=dict(arguments.package),
            progress=progress,
        )
    print_preparation(report)
    _print_pairs(report)
    print_robot(report.robot)
    print(f"wrote {report.folder}")


def print_preparation(report: "AddReport") -> None:
    """Print the links, the pairs of links with the most false collisions, and the time and memory of the
    preparation; warnings go to standard error."""

    columns = ("link", "convex parts", "spheres", Column("stick-out", "mm", ".1f", scale=1e3), "covered")
    links = [
        (link.link, link.parts, link.spheres, link.stick_out, "yes" if link.covered else "no")
        for link in report.links
    ]
    fractions = [
        Column(name, "%", ".1f", scale=100.0) for name in ("colliding", "false by parts", "false by spheres")
    ]
    false_collisions = report.false_collisions
    parts = sum(link.parts for link in report.links)
    pairs = [
        (", ".join(pair.links), pair.colliding, pair.by_parts, pair.by_spheres)
        for pair in false_collisions.pairs[:MAX_PAIRS]
    ]
    summary = [
        ("convex parts, spheres", f"{parts}, {report.sphere_count}"),
        ("configurations free of self-collision", f"{false_collisions.free:.1%}"),
        (
            "of these in false collision by convex parts, by spheres",
            f"{false_collisions.by_parts:.1%}, {false_collisions.by_spheres:.1%}",
        ),
        ("processor time, memory", f"{report.seconds:.0f} s, {report.memory / 2**20:.0f} MiB"),
    ]
    show(
        Table.of("", columns, links),
        Table.of("", ("pair of links", *fractions), pairs),
        Table.pairs("", summary),
    )
    for warning in report.warnings:
        say(f"warning: {warning}")


def _print_pairs(report: "AddReport") -> None:
    """Print how many pairs of links are checked, how many are allowed for each reason, and where this differs
    from the SRDF."""
    reasons = Counter(pair.reason for pair in report.pairs)
    counts = ", ".join(f"{reason} {count}" for reason, count in sorted(reasons.items()))
    show(Table.pairs("", [("pairs of links", counts)]))
    if report.srdf is None:
        return
    columns = ("link", "link", "by sampling", Column("colliding", "%", ".1f", scale=100.0), "by the SRDF")
    rows = [(*pair.links, pair.sampled, pair.colliding, pair.srdf) for pair in report.differences]
    title = f"pairs that differ from {report.srdf.name}"
    show(Table.of(title, columns, rows) if rows else Table.pairs("", [(title, "none")]))


def print_robot(robot: Robot) -> None:
    """Print joints, limits, collision model and notes of a robot."""
    columns = ("joint", Column("kind", left=True), "lower", "upper", "velocity", "accel.", "jerk")
    joints = []
    for joint in robot.planned_joints:
        limits = (None, None) if joint.kind == "continuous" else (joint.lower, joint.upper)
        joints.append((joint.name, joint.kind, *limits, joint.velocity, joint.acceleration, joint.jerk))
    spheres = sum(map(len, robot.spheres.values()))
    meshes = sum(map(len, robot.meshes.values()))
    pairs = [("base, tip", f"{robot.base}, {robot.tip}")]
    if robot.other_tips:
        pairs = [("base", robot.base), *(("tip", tip) for tip in robot.tips)]
    if robot.root not in ("", robot.base):
        at = "on a moving joint" if robot.T_base_root is None else _place(inverse(robot.T_base_root))
        pairs.append((f"base in {robot.root}", at))
    pairs += [
        ("links", f"{len(robot.link_names)}"),
        (
            "collision model",
            f"{counted(spheres, 'sphere')} on {counted(len(robot.spheres), 'link')}, "
            f"{counted(meshes, 'convex mesh', 'convex meshes')}",
        ),
        ("checked pairs of links", f"{len(robot.checked_pairs())}"),
        *(("locked", f"{name} = {value:g}") for name, value in robot.locked.items()),
        *(("note", note) for note in robot.notes),
    ]
    show(Table.of(robot.name, columns, joints), Table.pairs("", pairs))


def _place(T: Pose) -> str:
    wxyz = quaternion_from_rotation(T)
    xyz = T[:3, 3]
    return " ".join(["xyz", *(f"{value:g}" for value in xyz), "wxyz", *(f"{value:.4g}" for value in wxyz)])
