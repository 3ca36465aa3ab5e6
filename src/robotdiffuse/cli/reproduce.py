"""The command `robotdiffuse reproduce`: the paper's tables and figures beside ours, one page each."""

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import count, positive
from robotdiffuse.core.ray_cluster import CLUSTERS

if TYPE_CHECKING:
    from robotdiffuse.evaluation.bench.run_folder import Bench
    from robotdiffuse.evaluation.paper.table1 import Table1Settings

FIGURE_PROBLEMS = 60
"""Most problems of the plot of success against denoising steps."""
FIGURE_AZIMUTH = -0.9
"""Of the camera of figure 1, the same for all noise levels [rad]."""


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
    table2 = actions.add_parser(
        "table2",
        help="train and compare the rows of the ablation",
        description="Train every row of the paper's Table 2 on the same number of samples, test it on the "
        "same held-out problems, and write table2.md in the folder.",
    )
    table2.add_argument("--data", required=True, metavar="DATA", help="data set of `data generate`")
    table2.add_argument("--out", required=True, metavar="FOLDER", help="folder for networks and page")
    table2.add_argument(
        "--samples", type=count, metavar="N", help="training samples per row (default: 300000)"
    )
    table2.add_argument(
        "--encoder-samples",
        type=count,
        metavar="N",
        help="point clouds to train the frozen encoder on (default: 300000)",
    )
    table2.add_argument("--problems", type=count, metavar="N", help="held-out problems (default: 500)")
    table2.add_argument("--family", metavar="NAME", help="family of these problems (default: rop)")
    table2.add_argument("--rows", metavar="NAME,...", help="rows to train (default: all ten)")
    table2.add_argument(
        "--seeds", type=count, metavar="N", help="trainings of each row, with different seeds (default: 1)"
    )
    table2.add_argument(
        "--workers",
        type=count,
        default=os.cpu_count() or 1,
        metavar="N",
        help="processes (default: all cores)",
    )
    table2.set_defaults(run=run_table2)
    figures = actions.add_parser(
        "figures",
        help="denoising, success over time, motions of two planners",
        description="Write figures.md and its pictures in the folder of `reproduce table1`; calls that are "
        "missing there are made first.",
    )
    _add_planning(figures)
    figures.set_defaults(run=run_figures)


def _add_planning(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", required=True, metavar="FOLDER", help="folder for problems, results, page")
    parser.add_argument(
        "--problems",
        type=count,
        default=300,
        metavar="N",
        help="problems of each kind of goal (default: 300)",
    )
    parser.add_argument(
        "--time-limit", type=positive, default=10.0, metavar="S", help="of a call [s] (default: 10)"
    )
    parser.add_argument(
        "--paper-weights",
        metavar="FOLDER",
        help="weights of `train planner --config paper`, or points, for a row of the diffusion model without "
        "clearances, guidance and further samples (default: a note says how to train them)",
    )
    parser.add_argument(
        "--workers", type=count, metavar="N", help="planners that run at once (default: half of the cores)"
    )
    parser.add_argument("--cluster", choices=CLUSTERS, help="use the Ray cluster at RAY_ADDRESS")


def run_table1(arguments: argparse.Namespace) -> int:
    from robotdiffuse.evaluation.paper import page

    settings, bench = _table1(arguments)
    print(f"wrote {page.write_table1(settings, bench)}")
    return 0


def _table1(arguments: argparse.Namespace) -> "tuple[Table1Settings, Bench]":
    """The settings of table 1, and its calls, of which the missing ones are made."""
    from robotdiffuse.cli.bench import calls_shown
    from robotdiffuse.evaluation.paper import table1

    settings = table1.Table1Settings(
        out=Path(arguments.out),
        problems=arguments.problems,
        time_limit=arguments.time_limit,
        paper_weights=arguments.paper_weights,
        workers=arguments.workers or max(1, (os.cpu_count() or 1) // 2),
        cluster=arguments.cluster,
    )
    with calls_shown(settings.bench) as (report, done):
        return settings, table1.run_table1(settings, report, done)


def run_table2(arguments: argparse.Namespace) -> int:
    import sys

    from robotdiffuse.learning import need_packages

    need_packages("the ablation", "torch")
    from robotdiffuse.evaluation.paper import page, table2

    names = ("data", "out", "samples", "encoder_samples", "problems", "family", "seeds")
    given = {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
    settings = table2.AblationSettings(**given)
    rows = list(table2.ROWS) if arguments.rows is None else arguments.rows.split(",")
    results = table2.run_ablation(
        settings, rows, arguments.workers, lambda text: print(text, file=sys.stderr, flush=True)
    )
    print(f"wrote {page.write_table2(settings, results)}")
    return 0


def run_figures(arguments: argparse.Namespace) -> int:
    from robotdiffuse.core.output_files import write_atomically
    from robotdiffuse.evaluation.bench.report import about
    from robotdiffuse.evaluation.paper import figures, page
    from robotdiffuse.evaluation.problem_sets import hard_cases
    from robotdiffuse.visualization.picture import PictureSettings, write_comparison, write_picture

    settings, bench = _table1(arguments)
    out, count = settings.out, min(settings.problems, FIGURE_PROBLEMS)
    pictures = []

    def keep(name: str, caption: str) -> Path:
        pictures.append((caption, name))
        return out / name

    problem = hard_cases("rop", 1, out / "problems")[0].problem
    for number, state in enumerate(figures.denoising(problem)):
        file = keep(f"figure1_{number}.png", f"Figure 1: a motion at noise level {state.level:.2f} T")
        size = PictureSettings(width=960, height=600, ghosts=8, azimuth=FIGURE_AZIMUTH)
        write_picture(
            problem.robot, problem.scene, state.path, file, title=f"{state.level:.2f} T", settings=size
        )
    by_steps = figures.plot_success_by_steps(figures.success_by_steps(out, count))
    write_atomically(
        keep("figure1_steps.svg", f"Figure 1: success against T, {count} problems, 95 % intervals"), by_steps
    )
    write_atomically(
        keep("figure3a.svg", "Figure 3a: success over time, goals are poses, trivial problems too"),
        figures.plot_success_over_time(bench),
    )
    compared = figures.compared_motions(bench)
    if compared is not None:
        robot, scene = compared.case.problem.standing()
        file = keep("figure3b.png", "Figure 3b: motions of two planners, with a safety shell of 5 cm")
        write_comparison(
            robot,
            scene,
            compared.motions,
            file,
            title=compared.case.name,
            settings=PictureSettings(shell=0.05),
        )
    command = f"robotdiffuse reproduce figures --out FOLDER --problems {settings.problems} "
    command += f"--time-limit {settings.time_limit:g}"
    print(f"wrote {page.write_page(out / 'figures.md', 'Figures', command, about(bench), (), pictures)}")
    return 0
