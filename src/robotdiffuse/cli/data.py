"""The commands `robotdiffuse data generate`, `info`, `check`, `view`, `export` and `import`."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import (
    Commands,
    Namespace,
    add_import_option,
    chosen,
    command,
    count,
    group,
    natural,
    not_negative,
    options,
    positive,
    share,
    shares,
)
from robotdiffuse.cli.console import progress
from robotdiffuse.core.errors import InputError
from robotdiffuse.problems.families import FAMILIES

if TYPE_CHECKING:
    from collections.abc import Iterator

    from robotdiffuse.robots.robot import Robot
    from robotdiffuse.visualization.replay_page import GalleryEntry

CLEAN = 0
VIOLATIONS = 1
FOLDER_HELP = "folder of `robotdiffuse data generate`"
ROBOT_HELP = "the robot of the data, if the name in the manifest is not known here"


def add(commands: Commands) -> None:
    actions = group(
        commands, "data", "generate and inspect training data", "Generate and inspect training data."
    )
    for add_action in (add_generate, add_info, add_check, add_view, add_export, add_import):
        add_action(actions)


def add_generate(actions: Commands) -> None:
    parser = command(
        actions,
        "generate",
        "plan motions for many random problems",
        "Solve many random problems with Shared-Tree Informed RRT* or another planner, and "
        "write the motions that pass the validator to shards. Ctrl-C or a crash loses at most the "
        "unfinished shards; run the same command again to continue.",
        run_generate,
        ("--out FOLDER !", "folder for the data"),
        ("--robot NAME", "bundled name or URDF (default: panda)"),
        ("--trajectories N", "motions to make (default: 140000)", count),
        ("--seed N", "random seed (default: 0)", natural),
        (
            "--mix NAME=P,...",
            f"fractions of the problem families {', '.join(FAMILIES)} (default: rop=1)",
            shares,
        ),
        (
            "--trivial-share P",
            "fraction to keep of the problems that a straight line solves (default: 1, as in the paper)",
            share,
        ),
        ("--target KIND", "goal type: tip position (default) or full pose"),
        ("--goals N", "maximum number of goal configurations per target (default: 10)", count),
    )
    parser.add_argument(
        "--waypoints", "--frames", type=count, metavar="N", help="waypoints of a motion (default: 254)"
    )
    options(
        parser,
        ("--timing KIND", "waypoints equally spaced in arc length (arc, default) or in time (time)"),
        ("--safety-distance M", "distance to keep to obstacles [m] (default: 0.05)", not_negative),
        ("--planner NAME", "shared_tree_rrt_star (default, as in the paper) or aorrtc"),
        ("--shard N", "motions per shard (default: 500)", count),
        ("--workers N", "processes (default: all cores)", count),
        ("--cluster NAME", "ray: use the Ray cluster at RAY_ADDRESS"),
    )
    add_import_option(parser)


def add_info(actions: Commands) -> None:
    command(
        actions,
        "info",
        "print statistics and write a page of plots",
        "Print the statistics of a data set and write a page of plots.",
        run_info,
        ("folder FOLDER", FOLDER_HELP),
        ("--page FILE.html", "page of plots (default: FOLDER/report.html)"),
        ("--robot NAME", ROBOT_HELP),
    )


def add_check(actions: Commands) -> None:
    command(
        actions,
        "check",
        "check all shards and validate their motions again",
        "Check the structure of all shards and validate their motions again, with RobotDiffuse's "
        "validator and with PyBullet on meshes. Exit status: 0 clean, 1 violations found, 2 bad input.",
        run_check,
        ("folder FOLDER", FOLDER_HELP),
        ("--count N", "validate N random motions (default: all)", count),
        ("--seed N", "random seed (default: 0)", natural, 0),
        ("--workers N", "processes (default: all cores)", count, os.cpu_count() or 1),
        ("--no-pybullet", "do not validate with PyBullet"),
        ("--robot NAME", ROBOT_HELP),
    )


def add_view(actions: Commands) -> None:
    command(
        actions,
        "view",
        "show random motions as 3D replays",
        "Write random motions of a data set as 3D replays in one page. Without --out, the page "
        "opens in the browser.",
        run_view,
        ("folder FOLDER", FOLDER_HELP),
        ("--count N", "motions (default: 6)", count, 6),
        ("--seed N", "random seed (default: 0)", natural, 0),
        ("--out FILE.html", "page (default: FOLDER/samples.html)"),
        ("--robot NAME", ROBOT_HELP),
    )


def add_export(actions: Commands) -> None:
    command(
        actions,
        "export",
        "write the data in the format of the paper's robot.npz",
        "Write the motions among exactly two spheres in the layout of the paper's robot.npz: "
        "x_train n x 254 x 7, y_train n x 23.",
        run_export,
        ("folder FOLDER", FOLDER_HELP),
        ("file FILE.npz", "file to write"),
    )


def add_import(actions: Commands) -> None:
    command(
        actions,
        "import",
        "make a data set from the paper's robot.npz",
        "Make a data set from a file in the layout of the paper's robot.npz, to check and "
        "train on like any other. The file does not contain the radius of its spheres.",
        run_import,
        ("file FILE.npz", "x_train n x 254 x 7, y_train n x 23"),
        ("--out FOLDER !", "folder for the data"),
        ("--robot NAME", "bundled name or URDF (default: panda)", None, "panda"),
        ("--radius M", "radius of the spheres [m] (default: 0.25)", positive, 0.25),
    )


def _robot(name: str | None) -> "Robot | None":
    from robotdiffuse.robots import load_robot

    return None if name is None else load_robot(name)


def run_generate(arguments: Namespace) -> None:
    from dataclasses import replace

    from robotdiffuse.generation import GenerationSettings, generate
    from robotdiffuse.generation.factory import SEARCHES

    if arguments.cluster is not None and arguments.workers is not None:
        raise InputError(
            "--workers sets the processes on this machine; --cluster always uses all cores of the cluster"
        )
    options = chosen(arguments, GenerationSettings.__dataclass_fields__)
    if arguments.planner is not None and arguments.planner != GenerationSettings.planner:
        options["search"] = SEARCHES.defaults(arguments.planner)
    settings = GenerationSettings(**options)
    if arguments.safety_distance is not None:
        search = replace(settings.search, safety_distance=arguments.safety_distance)
        settings = replace(settings, search=search)
    with progress("trajectories") as update:
        workers = arguments.workers or os.cpu_count() or 1
        count = generate(settings, Path(arguments.out), workers, arguments.cluster, update)
    print(f"{count:,} trajectories of {settings.waypoints} waypoints in {arguments.out}")


def run_info(arguments: Namespace) -> None:
    from robotdiffuse.core.tables import show
    from robotdiffuse.evaluation.data_report import tables, write_page

    page = Path(arguments.page or Path(arguments.folder) / "report.html")
    show(*tables(write_page(arguments.folder, page, _robot(arguments.robot))))
    print(f"wrote {page}")


def run_check(arguments: Namespace) -> int:
    from robotdiffuse.core.tables import show
    from robotdiffuse.evaluation.checks import check_data

    with progress("checking motions") as update:
        check = check_data(
            arguments.folder,
            _robot(arguments.robot),
            arguments.count,
            arguments.seed,
            arguments.workers,
            not arguments.no_pybullet,
            update,
        )
    show(*check.tables)
    return VIOLATIONS if check.findings else CLEAN


def run_view(arguments: Namespace) -> None:
    from robotdiffuse.cli.view import show
    from robotdiffuse.core.output_files import check_output
    from robotdiffuse.datasets.shards import read_manifest
    from robotdiffuse.robots import load_robot
    from robotdiffuse.visualization.replay_page import write_gallery

    folder = Path(arguments.folder)
    manifest = read_manifest(folder)
    out = check_output(arguments.out or folder / "samples.html", (".html", ".htm"))
    robot = _robot(arguments.robot) or load_robot(manifest.robot)
    manifest.check_robot(robot)
    entries = list(_gallery_entries(folder, robot, arguments.count, arguments.seed))
    if not entries:
        raise InputError(f"{folder} holds no motions yet; continue `robotdiffuse data generate` first")
    with progress("drawing motions") as update:
        write_gallery(robot, entries, out, folder.resolve().name, update)
    print(f"wrote {out}")
    if not arguments.out:
        show(out)


def _gallery_entries(folder: Path, robot: "Robot", number: int, seed: int) -> "Iterator[GalleryEntry]":
    """Random motions, in the order of the shards."""
    from robotdiffuse.datasets.rows import motion_of, scenes_of
    from robotdiffuse.datasets.shards import random_rows, read_manifest
    from robotdiffuse.visualization.replay_page import GalleryEntry

    manifest = read_manifest(folder)
    for shard, rows in random_rows(folder, number, seed):
        for row in rows.tolist():
            family = list(manifest.families)[int(shard["family"][row])]
            scene = scenes_of(manifest, shard, slice(row, row + 1)).scene(0)
            cost, detour, clearance = (float(shard[name][row]) for name in ("cost", "detour", "clearance"))
            line = "line free" if shard["line_free"][row] else f"detour {detour:.2f}"
            caption = f"{cost:.2f} rad · {line} · {100 * clearance:.1f} cm clear"
            title = f"{family} · shard {shard.index}, row {row}"
            yield GalleryEntry(title, caption, scene, motion_of(robot, shard, row))


def run_export(arguments: Namespace) -> None:
    from robotdiffuse.datasets.external import export_npz

    count, left_out = export_npz(arguments.folder, arguments.file)
    left_out_text = f"; left out {left_out:,}, whose scenes are not exactly two spheres" if left_out else ""
    print(f"wrote {arguments.file}: {count:,} motions{left_out_text}")


def run_import(arguments: Namespace) -> None:
    from robotdiffuse.datasets.external import import_npz

    with progress("importing motions") as update:
        count = import_npz(arguments.file, arguments.out, arguments.robot, arguments.radius, update)
    print(
        f"{count:,} motions in {arguments.out}; validate them with: robotdiffuse data check {arguments.out}"
    )
