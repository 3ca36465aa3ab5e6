"""robotdiffuse data info, check, view, export and import"""

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import count, natural, positive
from robotdiffuse.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.progress import Progress

    from robotdiffuse.evaluation.data.check import DataCheck
    from robotdiffuse.evaluation.data.report import DataSummary, Spread
    from robotdiffuse.robots.robot import Robot
    from robotdiffuse.viewer.gallery import Exhibit

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
        help="check every shard, and judge motions anew",
        description="Check the structure of every shard and judge motions anew, by our judge and by PyBullet "
        "on meshes. Exit status: 0 clean, 1 violations found, 2 bad input.",
    )
    parser.add_argument("folder", metavar="FOLDER", help=FOLDER_HELP)
    parser.add_argument("--count", type=count, metavar="N", help="judge N random motions (default: all)")
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
    from robotdiffuse.evaluation.data.page import write_page

    page = Path(arguments.page or Path(arguments.folder) / "report.html")
    print_summary(write_page(arguments.folder, page, _robot(arguments.robot)))
    print(f"wrote {page}")
    return 0


def print_summary(summary: "DataSummary") -> None:
    """The figures, as tables."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from robotdiffuse.evaluation.data.page import size_in_words

    console, counts = Console(), summary.counts
    made = f"{summary.trajectories:,}"
    if summary.trajectories < summary.planned:
        made += f" of {summary.planned:,} planned"
    lost = ", ".join(f"{counts.get(name, 0):,} {name}" for name in ("unsolved", "refused", "thinned"))
    table = Table(show_header=False, title=f"{escape(summary.robot)}: {made} motions", title_justify="left")
    spacing = "length" if summary.timing == "arc" else "time"
    table.add_row("frames", f"{summary.frames:,}, evenly spaced in {spacing}")
    table.add_row("on disk", f"{size_in_words(summary.bytes)} in {summary.shards:,} shards")
    table.add_row("splits", ", ".join(f"{name} {n:,}" for name, n in summary.splits.items()))
    table.add_row(
        "problems tried", f"{counts.get('tried', 0):,}: {100 * summary.success:.1f} % solved; {lost}"
    )
    safety = (
        f"{100 * summary.safety_distance:.3g} cm, or what start and goal have, kept by "
        f"{100 * summary.kept:.1f} %; where both have it, by {100 * summary.kept_throughout:.1f} %"
    )
    table.add_row("safety distance", safety)
    table.add_row("goals reached", f"{summary.goals_reached:.1f} per problem")
    console.print(table)

    units = (escape("length [rad]"), "detour", escape("clearance [cm]"))
    families = Table("medians of", "motions", "trivial", *units)
    for name, family in summary.families.items():
        families.add_row(
            escape(name),
            f"{family.trajectories:,}",
            f"{100 * family.trivial:.1f} %",
            _median(family.length),
            _median(family.detour),
            _median(family.clearance, 100.0),
        )
    console.print(families)

    spreads = Table("", "mean", "least", "5 %", "median", "95 %", "most")
    parts = ((summary.length, 1.0), (summary.detour, 1.0), (summary.clearance, 100.0))
    for name, (spread, scale) in zip(units, parts, strict=True):
        spreads.add_row(name, *(_rounded(scale * value) for value in (spread.mean, *spread.quantiles)))
    console.print(spreads)


def _median(spread: "Spread", scale: float = 1.0) -> str:
    return _rounded(scale * spread.quantiles[2])


def _rounded(value: float) -> str:
    return f"{round(value, 3) + 0.0:.3f}"  # no negative zero


def run_check(arguments: argparse.Namespace) -> int:
    from robotdiffuse.evaluation.data.check import check_data

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
    print_check(check)
    return CLEAN if check.clean else VIOLATIONS


def print_check(check: "DataCheck") -> None:
    """What was found, as a table, with the first examples of each kind below."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from robotdiffuse.evaluation.data.check import KINDS

    console = Console()
    title = f"{check.robot}: {'clean' if check.clean else 'violations found'}"
    table = Table(show_header=False, title=escape(title), title_justify="left")
    made = f"{check.motions:,}" + (f" of {check.planned:,} planned" if check.motions < check.planned else "")
    table.add_row("shards, motions", f"{check.shards:,}, {made}")
    rate = check.checked / max(check.seconds, 1e-9)
    table.add_row("judged", f"{check.checked:,} in {check.seconds:.1f} s ({rate:.0f}/s)")
    for kind, name in KINDS.items():
        left_out = kind == "pybullet" and not check.pybullet
        table.add_row(name, "not asked" if left_out else f"{check.counts[kind]:,}")
    table.add_row("least clearance recorded", f"{_rounded(1e3 * check.least_clearance)} mm")
    console.print(table)
    if check.examples:
        examples = Table("first examples", "where", "what")
        for finding in check.examples:
            examples.add_row(finding.kind, finding.where, escape(finding.message))
        console.print(examples)


def run_view(arguments: argparse.Namespace) -> int:
    from robotdiffuse.cli.draw import show
    from robotdiffuse.data.manifest import read_manifest
    from robotdiffuse.files import check_output
    from robotdiffuse.robots import load_robot
    from robotdiffuse.viewer.gallery import write_gallery

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
    from robotdiffuse.data.manifest import read_manifest
    from robotdiffuse.data.shards import motion_of, random_rows, scenes_of
    from robotdiffuse.viewer.gallery import Exhibit

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
    from robotdiffuse.data.robot_npz import export_npz

    made = export_npz(arguments.folder, arguments.file)
    print(f"wrote {arguments.file}: {made:,} motions")
    return 0


def run_import(arguments: argparse.Namespace) -> int:
    from robotdiffuse.data.robot_npz import import_npz

    with _bar() as bar:
        task = bar.add_task("motions", total=None)
        made = import_npz(
            arguments.file,
            arguments.out,
            arguments.robot,
            arguments.radius,
            lambda done, total: bar.update(task, completed=done, total=total),
        )
    print(f"{made:,} motions in {arguments.out}; judge them with: robotdiffuse data check {arguments.out}")
    return 0
