"""The command `robotdiffuse reproduce`: the paper's tables and figures beside ours, one page each."""

import argparse
import os
from pathlib import Path

from robotdiffuse.cli.arguments import count, positive
from robotdiffuse.core.ray_cluster import CLUSTERS


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "reproduce",
        help="make the paper's tables and figures again, beside the printed ones",
        description="Draw the paper's problems, plan, validate, and write one page. Ctrl-C stops; run the "
        "same command again to continue.",
    )
    actions = parser.add_subparsers(title="parts", metavar="PART", required=True)
    table1 = actions.add_parser(
        "table1",
        help="planners on ROP, with poses and with configurations as goals",
        description="Write table1.md in the folder, which is one of `bench run` too.",
    )
    _add_planning(table1)
    table1.set_defaults(run=run_table1)


def _add_planning(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", required=True, metavar="FOLDER", help="folder for problems, results, page")
    parser.add_argument(
        "--problems", type=count, default=300, metavar="N", help="of each kind of goal (default: 300)"
    )
    parser.add_argument(
        "--time-limit", type=positive, default=10.0, metavar="S", help="of a call [s] (default: 10)"
    )
    parser.add_argument(
        "--paper-weights",
        metavar="FOLDER",
        help="weights of `train planner --config paper`, for the row of the paper's method as it says "
        "(default: the row says how to train them)",
    )
    parser.add_argument(
        "--workers", type=count, metavar="N", help="planners that run at once (default: half of the cores)"
    )
    parser.add_argument("--cluster", choices=CLUSTERS, help="use the Ray cluster at RAY_ADDRESS")


def run_table1(arguments: argparse.Namespace) -> int:
    from robotdiffuse.cli.bench import calls_shown
    from robotdiffuse.evaluation.paper import page, table1

    settings = table1.Table1Settings(
        out=Path(arguments.out),
        problems=arguments.problems,
        time_limit=arguments.time_limit,
        paper_weights=arguments.paper_weights,
        workers=arguments.workers or max(1, (os.cpu_count() or 1) // 2),
        cluster=arguments.cluster,
    )
    with calls_shown(settings.bench) as (report, done):
        bench = table1.run_table1(settings, report, done)
    print(f"wrote {page.write_table1(settings, bench)}")
    return 0
