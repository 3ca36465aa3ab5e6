"""The command `robotdiffuse reproduce`: the paper's tables and figures beside ours, one page each."""

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import command, count, option, positive
from robotdiffuse.core.ray_cluster import CLUSTERS

if TYPE_CHECKING:
    from robotdiffuse.evaluation.comparison import Bench
    from robotdiffuse.evaluation.paper import Table1Settings
    from robotdiffuse.evaluation.report import Report

FIGURE_PROBLEMS = 60
"""Most problems of the plot of success against denoising steps."""
FIGURE_AZIMUTH = -0.9
"""Of the camera of figure 1, the same for all noise levels [rad]."""


def add(commands: argparse._SubParsersAction) -> None:
    parser = command(
        commands,
        "reproduce",
        "make the paper's tables and figures again, beside the printed ones",
        "Draw the paper's problems, plan, validate, and write one page. Ctrl-C stops; run the "
        "same command again to continue.",
    )
    actions = parser.add_subparsers(title="parts", metavar="PART", required=True)
    table1 = command(
        actions,
        "table1",
        "planners on ROP, with poses and with configurations as goals",
        "Write table1.md in the folder, which is one of `bench run` too.",
        run_table1,
    )
    _add_planning(table1)
    table2 = command(
        actions,
        "table2",
        "train and compare the rows of the ablation",
        "Train every row of the paper's Table 2 on the same number of samples, test it on the "
        "same held-out problems, and write table2.md in the folder.",
        run_table2,
    )
    option(table2, "--data DATA !", "data set of `data generate`")
    option(table2, "--out FOLDER !", "folder for networks and page")
    option(table2, "--samples N", "training samples per row (default: 300000)", count)
    option(
        table2, "--encoder-samples N", "point clouds to train the frozen encoder on (default: 300000)", count
    )
    option(table2, "--problems N", "held-out problems (default: 500)", count)
    option(table2, "--family NAME", "family of these problems (default: rop)")
    option(table2, "--rows NAME,...", "rows to train (default: all ten)")
    option(table2, "--seeds N", "trainings of each row, with different seeds (default: 1)", count)
    option(table2, "--workers N", "processes (default: all cores)", count, os.cpu_count() or 1)
    figures = command(
        actions,
        "figures",
        "denoising, success over time, motions of two planners",
        "Write figures.md and its pictures in the folder of `reproduce table1`; calls that are "
        "missing there are made first.",
        run_figures,
    )
    _add_planning(figures)


def _add_planning(parser: argparse.ArgumentParser) -> None:
    option(parser, "--out FOLDER !", "folder for problems, results, page")
    option(parser, "--problems N", "problems of each kind of goal (default: 300)", count, 300)
    option(parser, "--time-limit S", "of a call [s] (default: 10)", positive, 10.0)
    option(
        parser,
        "--paper-weights FOLDER",
        "weights of `train planner --config paper`, or points, for a row of the diffusion model without "
        "clearances, guidance and further samples (default: a note says how to train them)",
    )
    option(parser, "--workers N", "planners that run at once (default: half of the cores)", count)
    option(parser, "--cluster", "use the Ray cluster at RAY_ADDRESS", choices=CLUSTERS)


def run_table1(arguments: argparse.Namespace) -> int:
    from robotdiffuse.evaluation.paper import table1

    settings, bench = _table1(arguments)
    return _write(table1(settings, bench), settings.out / "table1.md")


def _write(report: "Report", file: Path) -> int:
    report.write(file)
    print(f"wrote {file}")
    return 0


def _table1(arguments: argparse.Namespace) -> "tuple[Table1Settings, Bench]":
    """The settings of table 1, and its calls, of which the missing ones are made."""
    from robotdiffuse.cli.bench import calls_shown
    from robotdiffuse.evaluation.paper import Table1Settings, run_table1

    settings = Table1Settings(
        out=Path(arguments.out),
        problems=arguments.problems,
        time_limit=arguments.time_limit,
        paper_weights=arguments.paper_weights,
        workers=arguments.workers or max(1, (os.cpu_count() or 1) // 2),
        cluster=arguments.cluster,
    )
    with calls_shown(settings.bench) as (report, done):
        return settings, run_table1(settings, report, done)


def run_table2(arguments: argparse.Namespace) -> int:
    import sys
    from dataclasses import fields

    from robotdiffuse.learning import need_packages

    need_packages("the ablation", "torch")
    from robotdiffuse.evaluation.ablation import ROWS, AblationSettings, run_ablation, table2

    known = {field.name for field in fields(AblationSettings)}
    given = {name: value for name, value in vars(arguments).items() if name in known and value is not None}
    settings = AblationSettings(**given)
    rows = list(ROWS) if arguments.rows is None else arguments.rows.split(",")
    results = run_ablation(
        settings, rows, arguments.workers, lambda text: print(text, file=sys.stderr, flush=True)
    )
    return _write(table2(settings, results), Path(settings.out) / "table2.md")


def run_figures(arguments: argparse.Namespace) -> int:
    from robotdiffuse.evaluation import paper
    from robotdiffuse.evaluation.bench_report import about
    from robotdiffuse.evaluation.problem_sets import hard_cases
    from robotdiffuse.visualization.picture import PictureSettings, write_comparison, write_picture

    settings, bench = _table1(arguments)
    out = settings.out
    count = min(settings.problems, FIGURE_PROBLEMS)
    command = f"robotdiffuse reproduce figures --out FOLDER --problems {settings.problems} "
    command += f"--time-limit {settings.time_limit:g}"
    report = paper.paper_report("Figures", command)
    report.add("## Figure 1")
    problem = hard_cases("rop", 1, out / "problems")[0].problem
    for number, state in enumerate(paper.denoising(problem)):
        file = f"figure1_{number}.png"
        size = PictureSettings(width=960, height=600, ghosts=8, azimuth=FIGURE_AZIMUTH)
        title = f"{state.level:.2f} T"
        write_picture(problem.robot, problem.scene, state.path, out / file, title=title, settings=size)
        report.picture(file, f"A motion at noise level {title}")
    by_steps = paper.plot_success_by_steps(paper.success_by_steps(out, count))
    report.plot("figure1_steps.svg", f"Success against T, {count} problems, 95 % intervals", by_steps)
    report.add("## Figure 3")
    caption = "a: success over time, goals are poses, trivial problems too"
    report.plot("figure3a.svg", caption, paper.plot_success_over_time(bench))
    compared = paper.compared_motions(bench)
    if compared is not None:
        robot, scene = compared.case.problem.standing()
        size = PictureSettings(shell=0.05)
        title = compared.case.name
        write_comparison(robot, scene, compared.motions, out / "figure3b.png", title=title, settings=size)
        report.picture("figure3b.png", "b: motions of two planners, with a safety shell of 5 cm")
    paper.add_notes(report, about(bench))
    return _write(report, out / "figures.md")
