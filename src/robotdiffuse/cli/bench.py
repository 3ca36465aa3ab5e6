"""robotdiffuse bench ablation"""

import argparse
import os

from robotdiffuse.cli.arguments import count


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("bench", help="measure", description="Measure planners and networks.")
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    ablation = actions.add_parser(
        "ablation",
        help="the rows of the paper's Table 2, trained and tried at equal budget",
        description="Train every row of the paper's Table 2 on the same number of samples, and try it on the "
        "same held-out problems. Ctrl-C stops; the same command goes on.",
    )
    ablation.add_argument("--data", required=True, metavar="FOLDER", help="data set of `data generate`")
    ablation.add_argument("--out", required=True, metavar="FOLDER", help="folder for the trained networks")
    ablation.add_argument("--samples", type=count, metavar="N", help="training samples of a row (300000)")
    ablation.add_argument(
        "--encoder-samples", type=count, metavar="N", help="clouds for the frozen encoder (300000)"
    )
    ablation.add_argument("--problems", type=count, metavar="N", help="held-out problems (500)")
    ablation.add_argument("--rows", metavar="NAME,...", help="some of the rows (default: all ten)")
    ablation.add_argument(
        "--workers", type=count, default=os.cpu_count() or 1, metavar="N", help="processes (all cores)"
    )
    ablation.set_defaults(run=run_ablation)


def run_ablation(arguments: argparse.Namespace) -> int:
    import sys

    import numpy as np
    from rich.console import Console
    from rich.table import Table

    from robotdiffuse.evaluation import ablation
    from robotdiffuse.evaluation.metrics import bootstrap_interval

    names = ("data", "out", "samples", "encoder_samples", "problems")
    given = {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
    settings = ablation.AblationSettings(**given)
    rows = list(ablation.ROWS) if arguments.rows is None else arguments.rows.split(",")
    results = ablation.run_ablation(
        settings, rows, arguments.workers, lambda text: print(text, file=sys.stderr, flush=True)
    )
    table = Table(title=f"Table 2: {ablation.settings_line(settings)}", title_justify="left", box=None)
    table.add_column("row")
    for column in (
        "single %",
        "95 %",
        "best %",
        "collision %",
        "95 %",
        "length m",
        "ms",
        "paper: suc",
        "col",
        "len",
        "s",
    ):
        table.add_column(column, justify="right")
    for result in results:
        low, high = (100 * x for x in bootstrap_interval(result.single))
        low_hit, high_hit = (100 * x for x in bootstrap_interval(result.collided))
        length = f"{result.length.mean():.3f}" if len(result.length) else "-"
        paper = ablation.ROWS[result.name].paper
        table.add_row(
            result.name,
            f"{100 * result.single.mean():.1f}",
            f"{low:.1f} to {high:.1f}",
            f"{100 * result.best.mean():.1f}",
            f"{100 * result.collided.mean():.1f}",
            f"{low_hit:.1f} to {high_hit:.1f}",
            length,
            f"{1e3 * np.median(result.seconds):.0f}",
            *(f"{value:g}" for value in paper),
        )
    Console(width=None if sys.stdout.isatty() else 160).print(table)
    return 0
