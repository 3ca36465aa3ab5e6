"""The commands `robotdiffuse bench` and `reproduce`, which makes the paper's tables and figures again."""

import os
from pathlib import Path
from typing import Any

from robotdiffuse.cli.arguments import Namespace, check_workers, chosen
from robotdiffuse.cli.console import progress, say
from robotdiffuse.core.errors import InputError, counted
from robotdiffuse.core.files import write_atomically
from robotdiffuse.core.tables import Table, show
from robotdiffuse.core.types import Path as Waypoints
from robotdiffuse.evaluation import paper
from robotdiffuse.evaluation.bench import BenchSettings, preset_settings, run_bench
from robotdiffuse.evaluation.bench_comparisons import Bench, read_bench, sections
from robotdiffuse.evaluation.bench_report import (
    Replay,
    about,
    bench_report,
    main_table,
    missing_line,
    motions_to_replay,
)
from robotdiffuse.evaluation.checks import confirm
from robotdiffuse.evaluation.report import Report
from robotdiffuse.evaluation.runs import hard_cases
from robotdiffuse.visualization.picture import PictureSettings, write_comparison, write_picture
from robotdiffuse.visualization.replay_page import GalleryEntry, write_gallery

HALF_OF_CORES = max(1, (os.cpu_count() or 1) // 2)


def run_run(arguments: Namespace) -> None:
    calls_made = 0
    for settings in _bench_settings(arguments):
        with progress("calls") as update:
            calls_made += run_bench(settings, say, update)
    print(f"{counted(calls_made, 'call')} made; tables and plots: robotdiffuse bench report {arguments.out}")


def _bench_settings(arguments: Namespace) -> list[BenchSettings]:
    """The settings of each run of the bench: those of the preset, or a single one from the options."""
    changes = _changes(arguments, BenchSettings)
    if arguments.preset:
        fixed = ("planners", "time_limit", "seeds", "equal_time")
        options = [f"--{name.replace('_', '-')}" for name in fixed if changes.pop(name, None)]
        if options:
            raise InputError(f"--preset cannot be combined with {', '.join(options)}: the preset fixes these")
        return preset_settings(arguments.preset, **changes)
    if not (arguments.planners and arguments.problems):
        raise InputError("name --planners and --problems, or a --preset")
    return [BenchSettings(**changes)]


def _changes(arguments: Namespace, settings: Any) -> dict[str, Any]:
    """The settings that the command's options set. By default, there is one worker process for every two
    cores."""
    check_workers(arguments)
    options = chosen(arguments, settings.__dataclass_fields__)
    return {"workers": HALF_OF_CORES} | options | {"out": Path(arguments.out)}


def run_report(arguments: Namespace) -> None:
    bench = read_bench(Path(arguments.folder), arguments.planners)
    parts = sections(bench, arguments.limits)
    out = Path(arguments.out or arguments.folder)
    motions = [] if arguments.no_replays else motions_to_replay(bench, parts)
    replays = "replays.html" if motions else None
    report = bench_report(bench, parts, replays)
    report.write(out / "report.md")
    write_atomically(out / "index.html", report.page)
    if replays:
        _write_replays(motions, out / replays)
    for section in parts:
        show(main_table(section, section.main, bench.reference))
        print(missing_line(section.main), end="\n\n" if section.main.missing else "\n")
    files = ["index.html", *([replays] if replays else []), "report.md"]
    print(
        f"wrote {', '.join(str(out / name) for name in files)}, {counted(len(report.plots), 'plot')} as .svg"
    )


def _write_replays(motions: list[Replay], file: Path) -> None:
    """Writes a page with the motions of the first motion's robot: a page shows one robot."""
    robot = motions[0].case.problem.robot
    entries = [
        GalleryEntry(
            motion.title,
            motion.caption,
            problem.scene,
            Waypoints(robot.joint_names, motion.positions),
            problem.moving,
        )
        for motion in motions
        if (problem := motion.case.problem).robot == robot
    ]
    write_gallery(robot, entries, file, "Motions")


def run_confirm(arguments: Namespace) -> int:
    with progress("checking problems") as update:
        checked, contacts = confirm(Path(arguments.folder), arguments.count, update)
    refuted = [record.planner for record, _ in contacts]
    rows = [(planner, motions, refuted.count(planner)) for planner, motions in checked.items()]
    show(Table.of("", ("planner", "motions", "in collision (PyBullet)"), rows))
    for record, contact in contacts:
        print(
            f"{record.planner}, {record.problem_set} {record.name}, seed {record.seed}: {contact.link} and "
            f"{contact.other}, {-1000 * contact.distance:.1f} mm deep"
        )
    return 1 if refuted else 0


FIGURE_PROBLEMS = 60
"""Largest number of problems for the plot of success over denoising steps."""
FIGURE_AZIMUTH = -0.9
"""Azimuth of the camera of figure 1, the same for all noise levels [rad]."""


def run_table1(arguments: Namespace) -> int:
    settings, bench = _table1(arguments)
    return _write(paper.table1(settings, bench), settings.out / "table1.md")


def _write(page: Report, file: Path) -> int:
    page.write(file)
    print(f"wrote {file}")
    return 0


def _table1(arguments: Namespace) -> tuple[paper.Table1Settings, Bench]:
    """The settings of table 1, and the records of its calls; calls that the folder lacks are made first."""
    settings = paper.Table1Settings(**_changes(arguments, paper.Table1Settings))
    with progress("calls") as update:
        return settings, paper.run_table1(settings, say, update)


def run_table2(arguments: Namespace) -> int:
    from robotdiffuse.learning import need_packages

    need_packages("the ablation", "torch")
    from robotdiffuse.evaluation.ablation import ROWS, AblationSettings, run_ablation, table2

    settings = AblationSettings(**chosen(arguments, AblationSettings.__dataclass_fields__))
    results = run_ablation(settings, list(arguments.rows or ROWS), arguments.workers, say)
    return _write(table2(settings, results), Path(settings.out) / "table2.md")


def run_figures(arguments: Namespace) -> int:
    settings, bench = _table1(arguments)
    out = settings.out
    count = min(settings.problems, FIGURE_PROBLEMS)
    report = paper.paper_report("Figures", settings.command("figures"))
    report.add("## Figure 1")
    problem = hard_cases("rop", 1, out / "problems")[0].problem
    for number, state in enumerate(paper.denoising(problem)):
        file = f"figure1_{number}.png"
        size = PictureSettings(width=960, height=600, ghosts=8, azimuth=FIGURE_AZIMUTH)
        title = f"{state.level:.2f} of the largest noise level"
        write_picture(problem.robot, problem.scene, state.path, out / file, title=title, settings=size)
        report.picture(file, f"A motion at {title}")
    by_steps = paper.plot_success_by_steps(paper.success_by_steps(out, count))
    report.plot(
        "figure1_steps.svg",
        f"Success against T, the number of denoising steps; {counted(count, 'problem')}, 95 % intervals",
        by_steps,
    )
    report.add("## Figure 3")
    caption = "a: success over time; goals are poses; problems that the straight line does not solve"
    report.plot("figure3a.svg", caption, paper.plot_success_over_time(bench))
    compared = paper.compared_motions(bench)
    if compared is None:
        report.add(f"b: missing, since no problem is solved by both {' and '.join(paper.COMPARED)}")
    else:
        robot, scene = compared.case.problem.robot_and_scene_in_world()
        size = PictureSettings(shell=0.05)
        title = compared.case.name
        write_comparison(robot, scene, compared.motions, out / "figure3b.png", title=title, settings=size)
        report.picture("figure3b.png", "b: motions of two planners, with a safety shell of 5 cm")
    paper.add_notes(report, about(bench))
    return _write(report, out / "figures.md")
