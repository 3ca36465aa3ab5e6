"""robotdiffuse data info, check, view, export and import"""

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import count, natural, positive
from robotdiffuse.core.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.progress import Progress

    from robotdiffuse.robots.robot import Robot
    from robotdiffuse.visualization.gallery import Exhibit

CLEAN, VIOLATIONS = 0, 1
FOLDER_HELP = "folder of `robotdiffuse data generate`"
ROBOT_HELP = "the robot of the data, where its name in the manifest does not find it"


def add_info(actions: argparse._SubParsersAction) -> None:
    parser = actions.add_parser(
        "info",
        help="figures and a page of plots",
        description="Print the figures of a data set and write a page of plots.",
    )
    parser.add_argument("folder", metavar="FOLDER", help=FOLDER_HELP)
    parser.add_argument("--page", metavar="FILE.html", help="page of plots (default: FOLDER/report.html)")
    parser.add_argument("--robot", metavar="NAME", help=ROBOT_HELP)
    parser.set_defaults(run=run_info)


def add_check(actions: argparse._SubParsersAction) -> None:
    parser = actions.add_parser(
        "check",
        help="check every shard, and validate motions anew",
        description="Check the structure of every shard and validate motions anew, by our validator and by PyBullet "
        "on meshes. Exit status: 0 clean, 1 violations found, 2 bad input.",
    )
    parser.add_argument("folder", metavar="FOLDER", help=FOLDER_HELP)
    parser.add_argument("--count", type=count, metavar="N", help="validator N random motions (default: all)")
    parser.add_argument("--seed", type=natural, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument(
        "--workers",
        type=count,
        default=os.cpu_count() or 1,
        metavar="N",
        help="processes (default: all cores)",
    )
    parser.add_argument("--no-pybullet", action="store_true", help="leave PyBullet's opinion out")
    parser.add_argument("--robot", metavar="NAME", help=ROBOT_HELP)
    parser.set_defaults(run=run_check)


def add_view(actions: argparse._SubParsersAction) -> None:
    parser = actions.add_parser(
        "view",
        help="random motions in the 3D replay",
        description="Draw random motions of a data set as replays in one page. Without --out, it opens in "
        "the browser.",
    )
    parser.add_argument("folder", metavar="FOLDER", help=FOLDER_HELP)
    parser.add_argument("--count", type=count, default=6, metavar="N", help="motions (default: 6)")
    parser.add_argument("--seed", type=natural, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument("--out", metavar="FILE.html", help="page (default: FOLDER/samples.html)")
    parser.add_argument("--robot", metavar="NAME", help=ROBOT_HELP)
    parser.set_defaults(run=run_view)


def add_export(actions: argparse._SubParsersAction) -> None:
    parser = actions.add_parser(
        "export",
        help="write the authors' robot.npz",
        description="Write the motions among exactly two spheres in the layout of the authors' robot.npz: "
        "x_train n x 254 x 7, y_train n x 23.",
    )
    parser.add_argument("folder", metavar="FOLDER", help=FOLDER_HELP)
    parser.add_argument("file", metavar="FILE.npz", help="where to write it")
    parser.set_defaults(run=run_export)


def add_import(actions: argparse._SubParsersAction) -> None:
    parser = actions.add_parser(
        "import",
        help="make a data set of the authors' robot.npz",
        description="Make a data set of a file in the layout of the authors' robot.npz, to be checked and "
        "trained on like any other. The file does not say how large the spheres are.",
    )
    parser.add_argument("file", metavar="FILE.npz", help="x_train n x 254 x 7, y_train n x 23")
    parser.add_argument("--out", required=True, metavar="FOLDER", help="folder for the data")
    parser.add_argument(
        "--robot", default="panda", metavar="NAME", help="bundled name or URDF (default: panda)"
    )
    parser.add_argument(
        "--radius", type=positive, default=0.25, metavar="M", help="of the spheres [m] (default: 0.25)"
    )
    parser.set_defaults(run=run_import)


def _robot(name: str | None) -> "Robot | None":
    from robotdiffuse.robots import load_robot

    return None if name is None else load_robot(name)


def _bar() -> "Progress":
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (*Progress.get_default_columns()[:2], MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(
        *columns, TimeRemainingColumn(), console=console, transient=True, disable=not console.is_terminal
    )


def run_info(arguments: argparse.Namespace) -> int:
    from robotdiffuse.evaluation.datasets.page import write_page
    from robotdiffuse.evaluation.datasets.report import tables
    from robotdiffuse.evaluation.tables import show

    page = Path(arguments.page or Path(arguments.folder) / "report.html")
    show(*tables(write_page(arguments.folder, page, _robot(arguments.robot))))
    print(f"wrote {page}")
    return 0


def run_check(arguments: argparse.Namespace) -> int:
    from robotdiffuse.evaluation.datasets.check import check_data
    from robotdiffuse.evaluation.tables import show

    with _bar() as bar:
        task = bar.add_task("motions", total=None)
        check = check_data(
            arguments.folder,
            _robot(arguments.robot),
            arguments.count,
            arguments.seed,
            arguments.workers,
            not arguments.no_pybullet,
            lambda done, total: bar.update(task, completed=done, total=total),
        )
    show(*check.tables)
    return CLEAN if check.clean else VIOLATIONS


def run_view(arguments: argparse.Namespace) -> int:
    from robotdiffuse.cli.drawing import show
    from robotdiffuse.core.output_files import check_output
    from robotdiffuse.datasets.manifest import read_manifest
    from robotdiffuse.robots import load_robot
    from robotdiffuse.visualization.gallery import write_gallery

    folder = Path(arguments.folder)
    manifest = read_manifest(folder)
    out = check_output(arguments.out or folder / "samples.html", (".html", ".htm"))
    robot = _robot(arguments.robot) or load_robot(manifest.robot)
    manifest.check_robot(robot)
    exhibits = list(_exhibits(folder, robot, arguments.count, arguments.seed))
    if not exhibits:
        raise InputError(f"{folder} holds no motions yet; go on with robotdiffuse data generate")
    with _bar() as bar:
        task = bar.add_task("drawing", total=len(exhibits))
        write_gallery(
            robot, exhibits, out, folder.resolve().name, lambda done, _: bar.update(task, completed=done)
        )
    print(f"wrote {out}")
    if not arguments.out:
        show(out)
    return 0


def _exhibits(folder: Path, robot: "Robot", number: int, seed: int) -> "Iterator[Exhibit]":
    """Random rows, in the order of the shards."""
    from robotdiffuse.datasets.manifest import read_manifest
    from robotdiffuse.datasets.shards import motion_of, random_rows, scenes_of
    from robotdiffuse.visualization.gallery import Exhibit

    manifest = read_manifest(folder)
    for shard, rows in random_rows(folder, number, seed):
        for row in rows.tolist():
            family = list(manifest.families)[int(shard["family"][row])]
            scene = scenes_of(manifest, shard, slice(row, row + 1)).scene(0)
            cost, detour, clearance = (float(shard[name][row]) for name in ("cost", "detour", "clearance"))
            line = "line free" if shard["line_free"][row] else f"detour {detour:.2f}"
            caption = f"{cost:.2f} rad · {line} · {100 * clearance:.1f} cm clear"
            title = f"{family} · shard {shard.index}, row {row}"
            yield Exhibit(title, caption, scene, motion_of(robot, shard, row))


def run_export(arguments: argparse.Namespace) -> int:
    from robotdiffuse.datasets.robot_npz import export_npz

    made = export_npz(arguments.folder, arguments.file)
    print(f"wrote {arguments.file}: {made:,} motions")
    return 0


def run_import(arguments: argparse.Namespace) -> int:
    from robotdiffuse.datasets.robot_npz import import_npz

    with _bar() as bar:
        task = bar.add_task("motions", total=None)
        made = import_npz(
            arguments.file,
            arguments.out,
            arguments.robot,
            arguments.radius,
            lambda done, total: bar.update(task, completed=done, total=total),
        )
    print(f"{made:,} motions in {arguments.out}; validate them with: robotdiffuse data check {arguments.out}")
    return 0
