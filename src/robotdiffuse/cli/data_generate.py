"""robotdiffuse data generate"""

import argparse
import os
import sys
import time
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import count, natural, not_negative, share, shares
from robotdiffuse.problems.families import FAMILIES

if TYPE_CHECKING:
    from robotdiffuse.generation import GenerationSettings

TELL_EVERY = 60.0
"""Between two lines on progress where there is no terminal [s]."""


def add_generate(actions: argparse._SubParsersAction) -> None:
    parser = actions.add_parser(
        "generate",
        help="plan many random problems",
        description="Solve many random problems by Shared-Tree Informed RRT*, or another planner, and keep "
        "what the validator passes in shards. Ctrl-C or a crash loses at most the shards in hand; the same "
        "command goes on.",
    )
    parser.add_argument("--out", required=True, metavar="FOLDER", help="folder for the data")
    parser.add_argument("--robot", metavar="NAME", help="bundled name or URDF (default: panda)")
    parser.add_argument("--trajectories", type=count, metavar="N", help="motions to make (default: 140000)")
    parser.add_argument("--seed", type=natural, metavar="N", help="random seed (default: 0)")
    parser.add_argument(
        "--mix",
        type=shares,
        metavar="NAME=P,...",
        help=f"shares of {', '.join(FAMILIES)} (default: rop=1)",
    )
    parser.add_argument(
        "--trivial-share",
        type=share,
        metavar="P",
        help="share to keep of what the straight line solves (default: 1, the paper's)",
    )
    parser.add_argument("--target", metavar="KIND", help="position (default) or pose of the tip")
    parser.add_argument("--goals", type=count, metavar="N", help="most goals of a target (default: 10)")
    parser.add_argument(
        "--waypoints", "--frames", type=count, metavar="N", help="waypoints of a motion (default: 254)"
    )
    parser.add_argument(
        "--timing", metavar="KIND", help="waypoints even in arc length (arc, default) or in time"
    )
    parser.add_argument(
        "--safety-distance", type=not_negative, metavar="M", help="to obstacles [m] (default: 0.05)"
    )
    parser.add_argument(
        "--planner", metavar="NAME", help="shared_tree_rrt_star (default, the paper's) or aorrtc"
    )
    parser.add_argument("--shard", type=count, metavar="N", help="motions in a shard (default: 500)")
    parser.add_argument(
        "--workers",
        type=count,
        metavar="N",
        help="processes (default: all cores)",
    )
    parser.add_argument("--cluster", metavar="NAME", help="ray: on the cluster that RAY_ADDRESS names")
    parser.set_defaults(run=run_generate)


SETTINGS = (
    "robot",
    "planner",
    "trajectories",
    "seed",
    "mix",
    "trivial_share",
    "target",
    "goals",
    "waypoints",
    "timing",
    "shard",
)


def run_generate(arguments: argparse.Namespace) -> int:
    from dataclasses import replace

    from robotdiffuse.core.errors import InputError
    from robotdiffuse.generation import GenerationSettings
    from robotdiffuse.generation.solvers import SEARCHES

    if arguments.cluster is not None and arguments.workers is not None:
        raise InputError("--workers is for this machine's processes; --cluster uses all cores that it has")
    given = {name: getattr(arguments, name) for name in SETTINGS if getattr(arguments, name) is not None}
    if arguments.planner is not None and arguments.planner != GenerationSettings.planner:
        given["search"] = SEARCHES.defaults(arguments.planner)
    settings = GenerationSettings(**given)
    if arguments.safety_distance is not None:
        search = replace(settings.search, safety_distance=arguments.safety_distance)
        settings = replace(settings, search=search)
    made = generated(settings, arguments.out, arguments.workers, arguments.cluster)
    print(f"{made:,} trajectories of {settings.waypoints} waypoints in {arguments.out}")
    return 0


def generated(
    settings: "GenerationSettings", out: str | Path, workers: int | None = None, cluster: str | None = None
) -> int:
    """`generation.generate` with a bar; on all cores unless told how many."""
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from robotdiffuse.generation import generate

    console = Console(stderr=True)
    columns = (
        *Progress.get_default_columns()[:2],
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("trajectories", rate="", left="", total=settings.trajectories)
        before, said = list[int](), [time.monotonic()]

        def show(done: int, total: int) -> None:
            if not before:
                before.append(done)
                bar.reset(task, completed=done)
            elapsed, new = bar.tasks[0].elapsed, done - before[0]
            if elapsed and new:
                left = timedelta(seconds=round((total - done) * elapsed / new))
                bar.update(task, completed=done, rate=f"{new / elapsed:.1f}/s", left=f"{left} left")
                if not console.is_terminal and time.monotonic() > said[-1] + TELL_EVERY:
                    said.append(time.monotonic())
                    print(f"{done:,} of {total:,} trajectories, {left} left", file=sys.stderr, flush=True)

        return generate(settings, Path(out), workers or os.cpu_count() or 1, cluster, show)
