"""The commands `robotdiffuse bench` and `reproduce`, which makes the paper's tables and figures again."""

import os
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Iterator
from contextlib import contextmanager
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
    option,
    options,
    positive,
)
from robotdiffuse.cli.console import progress
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.processes.ray_cluster import CLUSTERS

if TYPE_CHECKING:
    from robotdiffuse.evaluation import report
    from robotdiffuse.evaluation.bench import BenchSettings, Done, Report
    from robotdiffuse.evaluation.bench_report import Bench, Section
    from robotdiffuse.evaluation.paper import Table1Settings


def add_bench(commands: Commands) -> None:
    actions = group(commands, "bench", "benchmark planners", "Benchmark planners and networks.")
    run = command(
        actions,
        "run",
        "run planners on problems and record every call",
        "Run planners on the same problems, in turns, each planner in a process of its own. "
        "Results are lines of JSON in the folder. Ctrl-C or a crash loses at most the running calls; run "
        "the same command again to continue; with a longer --time-limit it repeats only calls that could "
        "improve.",
        run_run,
        (
            "--planners NAME,...",
            "names that `planner list` shows, or all. NAME:SETTING=VALUE:SETTING=VALUE changes settings, "
            "or until=first|converged|time_limit, objective=length|time and clearance=M of the calls; "
            "NAME@FOLDER uses other weights. Example: aorrtc:range=0.5,diffusion@runs/mine",
        ),
        (
            "--problems SET,...",
            f"{', '.join(FAMILIES)}, each also with _nontrivial; or files or folders of problems; with "
            "--preset, sets in addition to its own",
        ),
        (
            "--preset NAME",
            "a stored comparison with its planners, limits and seeds (benchmarks/README.md): equal_time, "
            "learning, durations, anytime or restarts",
        ),
        ("--out FOLDER !", "folder for problems and results"),
        ("--time-limit S", "time limit of a call [s] (default: 1)", positive),
        ("--seeds N", "calls per problem, with different seeds (default: 1)", count),
        ("--count N", "problems per set (default: 100; all of a folder)", count),
        (
            "--equal-time",
            "also call planners that end early again until the time limit, as extra rows, to compare lengths",
        ),
        ("--data FOLDER", "data set, for a row of its nearest motions"),
        ("--cpu-time", "limits and times are CPU time, for a machine that does other work"),
        ("--workers N", "planners that run at once (default: half of the cores)", count),
        ("--cluster", "use the Ray cluster at RAY_ADDRESS", {"choices": CLUSTERS}),
    )
    add_import_option(run)
    report = command(
        actions,
        "report",
        "write tables, plots and replays of a run",
        "Write report.md with its plots as .svg, the same as index.html, and replays.html "
        "(motions in 3D), and print the table of each problem set.",
        run_report,
        ("folder FOLDER", "folder of `robotdiffuse bench run`"),
        ("--limits S,...", "time limits [s] (default: those of the run, and 0.1, 1, 10, 60 below them)"),
        ("--planners NAME,...", "planners to include (default: all)"),
        ("--out OUT", "folder to write to (default: FOLDER)"),
        ("--no-replays", "do not write replays.html"),
    )
    add_import_option(report)
    command(
        actions,
        "confirm",
        "check the motions of a run with PyBullet",
        "Check every solved motion of `bench run` with PyBullet, on meshes, as a second "
        "validator. The exit status is 1 if it finds a collision.",
        run_confirm,
        ("folder FOLDER", "folder of `bench run`"),
        ("--count N", "check only the first N problems of each set (default: all)", count),
    )


def run_run(arguments: Namespace) -> None:
    from robotdiffuse.evaluation.bench import run_bench

    calls_made = 0
    for settings in _bench_settings(arguments):
        with calls_shown(settings) as (report, on_progress):
            calls_made += run_bench(settings, report, on_progress)
    print(
        f"{calls_made} calls made; for tables, plots and replays: robotdiffuse bench report {arguments.out}"
    )


@contextmanager
def calls_shown(settings: "BenchSettings") -> "Iterator[tuple[Report, Done]]":
    """The functions for `run_bench` that print messages and show a progress bar for each planner."""
    import sys

    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        bars = {name: bar.add_task(name, total=None, start=False) for name in settings.specs}

        def done(planner: str, calls: int, all_calls: int) -> None:
            bar.start_task(bars[planner])
            bar.update(bars[planner], completed=calls, total=all_calls)

        yield lambda text: print(text, file=sys.stderr, flush=True), done


def _bench_settings(arguments: Namespace) -> "list[BenchSettings]":
    """The settings of each pass: of the preset, or one from the options."""
    from robotdiffuse.evaluation.bench import BenchSettings, preset_settings

    if arguments.cluster is not None and arguments.workers is not None:
        raise InputError("--workers sets the processes on this machine; --cluster always uses all its cores")
    out = Path(arguments.out)
    workers = arguments.workers or max(1, (os.cpu_count() or 1) // 2)
    problems = () if arguments.problems is None else tuple(arguments.problems.split(","))
    if arguments.preset is not None:
        fixed = ("planners", "time_limit", "seeds", "equal_time")
        options = [f"--{name.replace('_', '-')}" for name in fixed if getattr(arguments, name)]
        if options:
            raise InputError(f"--preset cannot be combined with {', '.join(options)}: the preset fixes these")
        return preset_settings(arguments.preset, out, problems, arguments.count, workers, arguments.cluster)
    if arguments.planners is None or arguments.problems is None:
        raise InputError("name --planners and --problems, or a --preset")
    return [
        BenchSettings(
            planners=tuple(arguments.planners.split(",")),
            problems=problems,
            out=out,
            time_limit=arguments.time_limit or 1.0,
            seeds=arguments.seeds or 1,
            count=arguments.count,
            workers=workers,
            cluster=arguments.cluster,
            equal_time=arguments.equal_time,
        )
    ]


def run_report(arguments: Namespace) -> None:
    from robotdiffuse.core.output_files import write_atomically
    from robotdiffuse.core.tables import show
    from robotdiffuse.evaluation.bench_report import (
        bench_report,
        main_table,
        missing_line,
        read_bench,
        sections,
    )

    planners = None if arguments.planners is None else arguments.planners.split(",")
    limits = None if arguments.limits is None else _limits(arguments.limits)
    bench = read_bench(Path(arguments.folder), planners)
    parts = sections(bench, limits)
    out = Path(arguments.out or arguments.folder)
    replays = None if arguments.no_replays else _write_replays(bench, parts, out / "replays.html")
    report = bench_report(bench, parts, replays)
    report.write(out / "report.md")
    write_atomically(out / "index.html", report.page)
    for section in parts:
        show(main_table(section, section.main, bench.reference))
        print(missing_line(section.main), end="\n\n" if section.main.missing else "\n")
    files = ["index.html", *([replays] if replays else []), "report.md"]
    print(f"wrote {', '.join(str(out / name) for name in files)} and {len(report.plots)} plots as .svg")


def _write_replays(bench: "Bench", parts: "list[Section]", file: "Path") -> str | None:
    """The name of the written file; None if there is no motion to replay."""
    from robotdiffuse.core.types import Path as Waypoints
    from robotdiffuse.evaluation.bench_report import motions_to_replay
    from robotdiffuse.visualization.replay_page import GalleryEntry, write_gallery

    motions = motions_to_replay(bench, parts)
    if not motions:
        return None
    robot = motions[0].case.problem.robot
    entries = [
        GalleryEntry(
            motion.title, motion.caption, problem.scene, Waypoints(robot.joint_names, motion.positions)
        )
        for motion in motions
        if (problem := motion.case.problem).robot.name == robot.name
    ]
    write_gallery(robot, entries, file, "Motions")
    return file.name


def _limits(text: str) -> list[float]:
    try:
        return [positive(part) for part in text.split(",")]
    except (ArgumentTypeError, ValueError):
        raise InputError(
            f"limits are {shown(text)}; they must be positive times [s], such as 0.1,1,10"
        ) from None


def run_confirm(arguments: Namespace) -> int:
    from robotdiffuse.core.tables import Table, show
    from robotdiffuse.evaluation.checks import confirm

    with progress("checking problems") as update:
        confirmation = confirm(Path(arguments.folder), arguments.count, update)
    refuted = [record.planner for record, _ in confirmation.refuted]
    rows = [(planner, checked, refuted.count(planner)) for planner, checked in confirmation.checked.items()]
    show(Table.of("", ("planner", "motions", "in collision (PyBullet)"), rows))
    for record, contact in confirmation.refuted:
        print(
            f"{record.planner}, {record.problem_set} {record.name}, seed {record.seed}: {contact.link} and "
            f"{contact.other}, {-1000 * contact.distance:.1f} mm deep"
        )
    return 1 if refuted else 0


FIGURE_PROBLEMS = 60
"""Most problems of the plot of success against denoising steps."""
FIGURE_AZIMUTH = -0.9
"""Azimuth of the camera of figure 1, the same for all noise levels [rad]."""


def add_reproduce(commands: Commands) -> None:
    actions = group(
        commands,
        "reproduce",
        "make the paper's tables and figures again, beside the printed ones",
        "Draw the paper's problems, plan, validate, and write one page. Ctrl-C stops; run the "
        "same command again to continue.",
        "parts",
        "PART",
    )
    table1 = command(
        actions,
        "table1",
        "planners on ROP, with poses and with configurations as goals",
        "Write table1.md in the folder, which is one of `bench run` too.",
        run_table1,
    )
    _add_planning(table1)
    command(
        actions,
        "table2",
        "train and compare the rows of the ablation",
        "Train every row of the paper's Table 2 on the same number of samples, test it on the "
        "same held-out problems, and write table2.md in the folder.",
        run_table2,
        ("--data DATA !", "data set of `data generate`"),
        ("--out FOLDER !", "folder for networks and page"),
        ("--samples N", "training samples per row (default: 300000)", count),
        ("--encoder-samples N", "point clouds to train the frozen encoder on (default: 300000)", count),
        ("--problems N", "held-out problems (default: 500)", count),
        ("--family NAME", "family of these problems (default: rop)"),
        ("--rows NAME,...", "rows to train (default: all ten)"),
        ("--seeds N", "trainings of each row, with different seeds (default: 1)", count),
        ("--workers N", "processes (default: all cores)", count, os.cpu_count() or 1),
    )
    figures = command(
        actions,
        "figures",
        "denoising, success over time, motions of two planners",
        "Write figures.md and its pictures in the folder of `reproduce table1`; calls that are "
        "missing there are made first.",
        run_figures,
    )
    _add_planning(figures)


def _add_planning(parser: ArgumentParser) -> None:
    options(
        parser,
        ("--out FOLDER !", "folder for problems, results, page"),
        ("--problems N", "problems of each kind of goal that are not trivial (default: 60)", count, 60),
        ("--time-limit S", "of a call [s] (default: 10)", positive, 10.0),
        (
            "--paper-weights FOLDER",
            "weights of `train planner --config paper`, or points, for rows of single samples without "
            "clearances, with and without guidance (default: a note says how to train them)",
        ),
        ("--data FOLDER", "data set, for a row of its nearest motions"),
        ("--cpu-time", "limits and times are CPU time, for a machine that does other work"),
        ("--workers N", "planners that run at once (default: half of the cores)", count),
    )
    option(parser, "--cluster", "use the Ray cluster at RAY_ADDRESS", choices=CLUSTERS)


def run_table1(arguments: Namespace) -> int:
    from robotdiffuse.evaluation.paper import table1

    settings, bench = _table1(arguments)
    return _write(table1(settings, bench), settings.out / "table1.md")


def _write(page: "report.Report", file: Path) -> int:
    page.write(file)
    print(f"wrote {file}")
    return 0


def _table1(arguments: Namespace) -> "tuple[Table1Settings, Bench]":
    """The settings of table 1, and its calls, of which the missing ones are made."""
    from robotdiffuse.evaluation.paper import Table1Settings, run_table1

    settings = Table1Settings(
        out=Path(arguments.out),
        problems=arguments.problems,
        time_limit=arguments.time_limit,
        cpu_time=arguments.cpu_time,
        paper_weights=arguments.paper_weights,
        data=arguments.data,
        workers=arguments.workers or max(1, (os.cpu_count() or 1) // 2),
        cluster=arguments.cluster,
    )
    with calls_shown(settings.bench) as (report, on_progress):
        return settings, run_table1(settings, report, on_progress)


def run_table2(arguments: Namespace) -> int:
    import sys

    from robotdiffuse.learning import need_packages

    need_packages("the ablation", "torch")
    from robotdiffuse.evaluation.ablation import ROWS, AblationSettings, run_ablation, table2

    settings = AblationSettings(**chosen(arguments, AblationSettings.__dataclass_fields__))
    rows = list(ROWS) if arguments.rows is None else arguments.rows.split(",")
    results = run_ablation(
        settings, rows, arguments.workers, lambda text: print(text, file=sys.stderr, flush=True)
    )
    return _write(table2(settings, results), Path(settings.out) / "table2.md")


def run_figures(arguments: Namespace) -> int:
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
