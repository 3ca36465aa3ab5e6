"""robotdiffuse bench ablation"""

import argparse
import os
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import count

if TYPE_CHECKING:
    from numpy import ndarray


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


def _share(values: "ndarray") -> tuple[str, str]:
    """Mean of shares and its interval, in per cent."""
    from robotdiffuse.evaluation.metrics import bootstrap_interval

    low, high = (100 * x for x in bootstrap_interval(values))
    return f"{100 * values.mean():.1f}", f"{low:.1f} to {high:.1f}"


def _mean(values: "ndarray", form: str) -> str:
    """Of those that are not nan."""
    known = values[values == values]
    return form.format(known.mean()) if len(known) else "-"


def run_ablation(arguments: argparse.Namespace) -> int:
    import sys

    import numpy as np
    from rich.console import Console
    from rich.table import Table

    from robotdiffuse.evaluation import ablation

    names = ("data", "out", "samples", "encoder_samples", "problems")
    given = {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
    settings = ablation.AblationSettings(**given)
    rows = list(ablation.ROWS) if arguments.rows is None else arguments.rows.split(",")
    results = ablation.run_ablation(
        settings, rows, arguments.workers, lambda text: print(text, file=sys.stderr, flush=True)
    )
    title = f"Table 2: {ablation.settings_line(settings)}"
    table = Table(title=title, title_justify="left", box=None, padding=(0, 1))
    table.add_column("row")
    columns = "guided", "single %", "95 %", "best %", "collision %", "95 %", "length m", "to first", "CPU ms"
    for column in (*columns, "unguided %", "95 %", "paper: suc", "col", "len", "s"):
        table.add_column(column, justify="right")
    first = results[0].as_in_paper
    for result in results:
        tried, row = result.as_in_paper, ablation.ROWS.get(result.name)
        table.add_row(
            result.name,
            "yes" if tried is result.guided else "no",
            *_share(tried.single),
            f"{100 * tried.best.mean():.1f}",
            *_share(tried.collided),
            _mean(tried.length, "{:.3f}"),
            _mean(tried.length / first.length, "{:.3f}"),
            f"{1e3 * np.median(tried.seconds):.0f}",
            *_share(result.alone.single),
            *(["-"] * 4 if row is None else (f"{value:g}" for value in row.paper)),
        )
    Console(width=None if sys.stdout.isatty() else 170).print(table)
    print(
        "single: share of samples that pass the judge; best: of problems with at least one such sample.\n"
        "length: of the shortest such sample, over the problems that have one; to first: the mean ratio to\n"
        "that of the first row, over the problems that both solve. Intervals are over problems, of one\n"
        "training each: another seed may move a row by more."
    )
    return 0
