"""robotdiffuse data generate"""

import argparse
import os

from robotdiffuse.cli.arguments import count, natural


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("data", help="make training data", description="Make training data.")
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    generate = actions.add_parser(
        "generate",
        help="plan many random problems",
        description="Plan many random problems and keep the motions in shards. Ctrl-C stops; the same "
        "command continues.",
    )
    generate.add_argument("--out", required=True, metavar="FOLDER", help="folder for the shards")
    generate.add_argument("--robot", metavar="NAME", help="bundled name or URDF (default: panda)")
    generate.add_argument("--problems", type=count, metavar="N", help="problems drawn (default: 400000)")
    generate.add_argument("--seed", type=natural, metavar="N", help="random seed (default: 0)")
    generate.add_argument(
        "--workers",
        type=count,
        default=os.cpu_count() or 1,
        metavar="N",
        help="processes (default: all cores)",
    )
    generate.set_defaults(run=run_generate)


def run_generate(arguments: argparse.Namespace) -> int:
    from pathlib import Path

    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

    from robotdiffuse.generation import GenerationSettings, generate

    given = {name: getattr(arguments, name) for name in ("robot", "problems", "seed")}
    settings = GenerationSettings(**{name: value for name, value in given.items() if value is not None})
    console = Console(stderr=True)
    times = (MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    columns = (*Progress.get_default_columns()[:2], *times)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("shards")
        made = generate(
            settings,
            Path(arguments.out),
            arguments.workers,
            lambda done, total: bar.update(task, completed=done, total=total),
        )
    print(f"{made} trajectories in {arguments.out}")
    return 0
