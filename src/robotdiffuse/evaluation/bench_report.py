"""The report of a bench: tables and plots of every problem set and time limit, and the motions to replay."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.tables import Cell, Column, Figure, Table, plain
from robotdiffuse.evaluation import plots
from robotdiffuse.evaluation.comparison import (
    FAILURES,
    Bench,
    Comparison,
    Curve,
    Row,
    Section,
    base_name,
    calls_on,
    deciding_record,
    outcome,
    plain_name,
)
from robotdiffuse.evaluation.metrics import METRICS, Metric
from robotdiffuse.evaluation.problem_sets import read_cases
from robotdiffuse.evaluation.report import Report, interval, share_cell
from robotdiffuse.evaluation.runs import CRASHED, OVERRAN, RAISED, RESTARTED, Record
from robotdiffuse.evaluation.statistics import Paired
from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS, SEARCH
from robotdiffuse.problems.held_out import Case
from robotdiffuse.problems.problem import JointGoal

if TYPE_CHECKING:
    from matplotlib.figure import Figure as PlotFigure

UNEQUAL = " †"
UNEQUAL_NOTE = (
    "† not at equal time: this planner or the reference ended before the limit. `bench run --equal-time` "
    "repeats such calls until the limit."
)
NOTES = (
    "A call counts for a limit if its own limit was at least as long, or if it ended by itself before: "
    "more time would change nothing. A table compares the problems on which all its planners have such a "
    "call.",
    "success: verified motions found by the limit, with the 95 % interval over problems (Wilson). A "
    "motion that a call returned up to 10 % or 50 ms after its own limit counts: planners stop in time, "
    "and validation follows.",
    "collision: share of problems on which the validator refused the planner's last path because it "
    "collides.",
    "link length: the paper's, the path lengths of the links that joints move together, mean over the "
    "problems that the planner itself solved; planners that solve only easy problems seem short. If a call "
    "continued and returned a shorter path, its length by the limit is that of the returned path, scaled by "
    "the lengths in joint space.",
    "ratio: median of the length in joint space over that of the reference, on problems that both solve, "
    "with its 95 % interval (bootstrap over problems), at equal time: for planners that use up the limit. "
    "restarted: a planner that ends earlier is called again with other seeds until its calls have used up "
    "the limit together, and the shortest path counts; the time for timing the other motions does not.",
    "first: median time to the first path of solved problems. returns: mean time until the planner "
    "returns; anytime planners use up the limit, and unsolved problems count with it.",
    "ComScore: as in the paper, from success, collision, length and time until the planner returns, each "
    "from 0 for the worst row of the table to 1 for the best. It depends on the rows of the table; those "
    "with restarts are left out. `robotdiffuse reproduce table1` computes it among the paper's rows.",
    "Quality: means with 95 % intervals of the returned motions, over the solved problems. clearance: a lower"
    " bound, to obstacles (scene), of the arm to itself (self), and the smaller of the two. over straight "
    "line: duration over the least time along the straight line, obstacles and limits of jerk aside. stops: "
    "times that the whole arm rests on the way. peak and mean jerk: of the joint where it is largest. "
    "bending: the integral of the squared second derivative of the path, over its squared length. jerk: "
    "logarithm of the dimensionless jerk, lower is smoother; sparc: spectral arc length of the joints' and "
    "the tip's speed, closer to 0 is smoother.",
    "p of success: McNemar's exact test; p of joint length: Wilcoxon's signed ranks; neither is corrected "
    "for the number of comparisons. With several seeds, a problem counts as solved if more than half of them "
    "are.",
)


def named(planner: str) -> str:
    """The name of a planner in tables: with its settings, and whether it is the hybrid and was restarted."""
    name, *settings = plain_name(planner).split(":")
    if base_name(planner) == DEFAULT_PLANNER:
        name += ": hybrid"
    restarted = ["restarted"] if planner.endswith(RESTARTED) else []
    return ", ".join([name, *settings, *restarted])


# Tables

Spec = Sequence[tuple[Column, Callable[[Row], Cell]]]
"""Columns of a table of planners, with the functions for their cells."""


def seconds(value: float) -> Cell:
    """A time with two significant digits."""
    if not np.isfinite(value):
        return None
    return Figure(f"{value:.{max(0, 1 - int(np.floor(np.log10(max(value, 1e-4)))))}f}", value)


def title(section: Section, comparison: Comparison) -> str:
    """The title of a comparison: problem set, limit and number of problems."""
    of = "" if comparison.problems == comparison.of else f" of {comparison.of}"
    plural = "problem" if comparison.problems == 1 else "problems"
    seeds = f", {comparison.seeds} seeds each" if comparison.seeds > 1 else ""
    return f"{section.name}, {comparison.limit:g} s: {comparison.problems}{of} {plural}{seeds}"


def tables(section: Section, comparison: Comparison, reference: str) -> list[Table]:
    """All tables of a comparison, without empty ones."""
    name = title(section, comparison)
    reasons = [reason for reason in FAILURES if any(reason in row.failures for row in comparison.rows)]
    compared_rows = [row for row in comparison.rows if row.paired is not None]
    quality: Spec = (
        *map(_metric, comparison.metrics),
        (Column("memory", "MB", ".0f", "less"), lambda row: row.memory),
    )
    families: Spec = [
        (Column(family), lambda row, family=family: share_cell(*row.families[family]))
        for family in comparison.rows[0].families
    ]
    pairs: Spec = (
        _of_pair("alone solves", lambda pair: pair.a_only),
        _of_pair("reference alone", lambda pair: pair.b_only),
        _of_pair("both", lambda pair: pair.both),
        _of_pair("neither", lambda pair: pair.neither),
        _of_pair("p of success", lambda pair: probability(pair.p_success)),
        _ratio(comparison, reference),
        _of_pair("p of joint length", lambda pair: probability(pair.p_length) if pair.both else None),
    )
    failures: Spec = (
        (Column("failures"), lambda row: row.failures.total()),
        *((Column(reason), lambda row, reason=reason: row.failures.get(reason)) for reason in reasons),
    )
    all_tables = [
        main_table(section, comparison, reference),
        _table(f"Quality of the motions; {name}", comparison.rows, quality),
        _table(f"Against {named(reference)}, in pairs; {name}", compared_rows, pairs),
        _table(f"Failures by reason; {name}", comparison.rows, failures),
        _table(f"Success by family [%]; {name}", comparison.rows, families),
    ]
    return [table for table in all_tables if table.rows and len(table.columns) > 2]


def main_table(section: Section, comparison: Comparison, reference: str) -> Table:
    """The paper's columns, with intervals and the ratio of lengths to those of the reference."""
    spec: Spec = (
        (Column("success", "%", better="more"), lambda row: share_cell(row.success, row.success_interval)),
        (Column("collision", "%", ".1f", "less", scale=100.0), lambda row: row.collision),
        (Column("link length", "m", ".2f"), lambda row: row.link_length),
        _ratio(comparison, reference),
        _metric(METRICS["duration"]),
        (Column("first", "s", better="less"), lambda row: seconds(row.first)),
        (Column("returns", "s", better="less"), lambda row: seconds(row.returned)),
        (Column("ComScore", "", ".3f", "more"), lambda row: row.comscore),
        *(() if comparison.alike else ((Column("timed", left=True), lambda row: row.timed),)),
    )
    table = _table(title(section, comparison), comparison.rows, spec)
    loads = comparison.loads
    load = f"; load average {min(loads):.1f} to {max(loads):.1f}" if loads else ""
    note = f"All rows were timed alike: {comparison.rows[0].timed}{load}."
    if not comparison.alike:
        alone = "their times cannot be compared as such"
        note = f"Not all rows were timed alike, see the last column{load}; {alone}."
    unequal = any(UNEQUAL in text for row in table.texts for text in row)
    return replace(table, notes=(note, UNEQUAL_NOTE) if unequal else (note,))


def _table(heading: str, rows: Sequence[Row], spec: Spec) -> Table:
    cells = [[named(row.planner), *(of(row) for _, of in spec)] for row in rows]
    return Table.of(heading, ["planner", *(column for column, _ in spec)], cells)


def _ratio(comparison: Comparison, reference: str) -> tuple[Column, Callable[[Row], Cell]]:
    """A column with the ratio of lengths to those of the reference and its interval; none for a planner
    whose restarts have it."""
    full = {row.planner: row.full for row in comparison.rows}

    def ratio(row: Row) -> Cell:
        pair = row.paired
        if row.planner == reference:
            return "1"
        sign = "" if row.full and full.get(reference, True) else UNEQUAL
        if pair is None or pair.ratio_interval is None or (sign and row.planner + RESTARTED in full):
            return None
        ends = interval(*pair.ratio_interval, digits=3)
        return Figure(f"{pair.ratio:.3f} ({ends}){sign}", pair.ratio or 0.0)

    return Column(f"joint length / {named(reference)}"), ratio


def _metric(metric: Metric) -> tuple[Column, Callable[[Row], Cell]]:
    """A column with the mean of a metric over the solved problems."""
    column = Column(metric.heading, metric.unit, better=metric.better)
    return column, lambda row: row.measures[metric.name].cell(metric)


def _of_pair(heading: str, of: Callable[[Paired], Cell]) -> tuple[Column, Callable[[Row], Cell]]:
    """A column of comparisons with the reference on the same problems."""
    return Column(heading), lambda row: row.paired and of(row.paired)


def probability(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


# Plots


def success_over_time(section: Section, planners: Sequence[str]) -> str:
    """Draw the share of problems solved over time, as in the paper's figure."""

    def steps(curve: Curve) -> tuple[ndarray, ndarray]:
        solved = np.arange(len(curve.found) + 1)
        return np.append(curve.found, curve.end), np.append(solved[1:], solved[-1]) / curve.calls

    curves = [curve for curve in section.curves if curve.planner == plain_name(curve.planner)]
    return _over_time(curves, planners, "solved", steps)


def length_over_time(section: Section, planners: Sequence[str]) -> str:
    """Draw the median length over time."""
    of = "joint length / best known"
    return _over_time(section.curves, planners, of, lambda curve: (curve.times, curve.ratios))


def _over_time(
    curves: Sequence[Curve],
    planners: Sequence[str],
    label: str,
    of: Callable[[Curve], tuple[ndarray, ndarray]],
) -> str:
    """Curves of planners, solid with a network and dashed for search; restarts have the planner's color."""
    names = list(dict.fromkeys(map(plain_name, planners)))

    def fill(figure: "PlotFigure") -> None:
        axes = figure.subplots()
        for curve in curves:
            entry = PLANNERS.get(base_name(curve.planner))
            axes.plot(
                *of(curve),
                drawstyle="steps-post",
                label=curve.planner,
                color=f"C{names.index(plain_name(curve.planner))}",
                linestyle="--" if entry is None or entry.kind == SEARCH else "-",
            )
        axes.set(xscale="log", xlabel="time [s]", ylabel=label)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        figure.legend(loc="outside right upper")

    return plots.draw(fill, width=9.0)


# The report


def bench_report(bench: Bench, parts: Sequence[Section], replays: str | None = None) -> Report:
    """The report of a bench. `replays`: name of a page beside it.

    Raises InputError without matplotlib.
    """
    planners = list(bench.records)
    report = Report(f"Bench {bench.folder.resolve().name}")
    report.items([*map(plain, about(bench)), *facts(bench)])
    if replays:
        report.add(
            f"[Motions in 3D]({replays}), of problems with long detours and of those that planners failed on"
        )
    for section in parts:
        report.add(f"## {plain(section.name)}")
        file = "_".join(re.findall(r"\w+", section.name))
        if section.curves:
            calls = f"share of {section.curves[0].calls} calls"
            caption = f"Success over time, {calls}; planners with a network solid, search dashed"
            report.plot(f"success_{file}.svg", caption, success_over_time(section, planners))
            caption = "Length over time, median over the best known, of non-trivial problems"
            report.plot(f"length_{file}.svg", caption, length_over_time(section, planners))
        for comparison in section.comparisons:
            main, *further_tables = tables(section, comparison, bench.reference)
            report.table(main)
            if comparison.missing:
                report.add(plain(missing_line(comparison)))
            for table in further_tables:
                report.table(table, level=4)
    if broken := crashes(bench):
        report.add("## Crashes and exceptions")
        report.items(map(plain, broken))
    report.add("## How to read the tables")
    report.items(NOTES)
    return report


def missing_line(comparison: Comparison) -> str:
    """A line that names the planners missing from the table; empty if there are none."""
    if not comparison.missing:
        return ""
    return (
        f"Not run for {comparison.limit:g} s on these problems: {', '.join(map(named, comparison.missing))}."
    )


def about(bench: Bench) -> list[str]:
    """Machine, dates and versions of the sessions, a line for each combination."""
    dates: dict[str, list[str]] = {}
    for run in bench.sessions:
        versions = ", ".join(f"{name} {version}" for name, version in run["versions"].items())
        machine = f"{run.get('processor', '?')}, {run.get('cores', '?')} cores"
        text = f"{machine}, {run.get('workers', '?')} at once; Python {run.get('python', '?')}, {versions}"
        dates.setdefault(text, []).append(run["date"])
    return [
        f"{of[0] if min(of) == max(of) else f'{min(of)} to {max(of)}'} UTC: {text}"
        for text, of in dates.items()
    ]


def facts(bench: Bench) -> list[str]:
    """How much was run."""
    records = [record for of in bench.records.values() for record in of]
    problems = {(record.problem_set, record.name) for record in records}
    minutes = sum(record.time for record in records) / 60
    solved = sum(record.solved for record in records)
    return [
        f"{len(bench.records)} planners, {len(problems):,} problems in {len(bench.problem_sets)} sets",
        f"{len(records):,} calls in {minutes:.1f} min of planning: {solved:,} verified motions",
    ]


def crashes(bench: Bench) -> list[str]:
    """The reasons of crashes, overruns and exceptions with their numbers."""
    counts = Counter(
        f"{planner}, {record.status}: {record.reason}"
        for planner, records in bench.records.items()
        for record in records
        if record.status in (CRASHED, OVERRAN, RAISED)
    )
    return [f"{count} x {text}" for text, count in counts.most_common()]


# Motions to replay

MAX_REPLAYS = 12
SOLVED_PROBLEMS = 2
"""In replays, each with two planners; the other replays are of failures."""


class Replay(NamedTuple):
    """A motion for the replays."""

    title: str
    caption: str
    case: Case
    positions: Float[ndarray, "n dof"]


def motions_to_replay(bench: Bench, parts: Sequence[Section]) -> list[Replay]:
    """The shortest and the longest motion of the problems with the longest detours, then motions of problems
    on which the reference, or else another planner, failed; at the main limit of their set, for cases that
    the folder keeps."""
    tries: list[tuple[Case, list[Record], dict[str, str]]] = []
    for section in (section for section in parts if section.name == section.problem_set):
        main = section.main
        calls = [calls_on(bench.records[row.planner], section.problem_set) for row in main.rows]
        for case in read_cases(bench.folder, section.problem_set):
            key = case.name, main.keys[0][1]
            if key in main.keys:
                records = (deciding_record(of[key], main.limit) for of in calls)
                outcomes = [outcome(record, main.limit) for record in records if record is not None]
                solved = [o.record for o in outcomes if o.solved]
                solved.sort(key=lambda record: record.joint_length or 0.0)
                failed = {o.record.planner: o.failure for o in outcomes if not o.solved}
                tries.append((case, solved, failed))
    tries.sort(key=lambda of: (len(of[1]) > 1, *map(_detour, of[1][:1])), reverse=True)
    replays = []
    for case, solved, _ in tries[:SOLVED_PROBLEMS]:
        for record in solved[:1] + solved[1:][-1:]:
            extreme = "shortest" if record is solved[0] else "longest"
            caption = f"{record.joint_length:.2f} rad, {extreme}, in {seconds(record.time)} s"
            replays.append(Replay(f"{record.planner} · {case.name}", caption, case, record.waypoints))
    rest = sorted(tries[SOLVED_PROBLEMS:], key=lambda of: (bench.reference not in of[2], len(of[1])))
    replays += [replay for of in rest for replay in _failure(*of, bench.reference)]
    return replays[:MAX_REPLAYS]


def _detour(record: Record) -> float:
    """Length of a motion over that of the straight line between its ends."""
    straight = float(np.linalg.norm(record.waypoints[-1] - record.waypoints[0]))
    return (record.joint_length or 0.0) / max(straight, 1e-6)


def _failure(case: Case, solved: list[Record], failed: dict[str, str], reference: str) -> Iterator[Replay]:
    """A motion that solves a problem on which planners failed, or the straight line."""
    goal = case.problem.goal
    if failed and solved:
        loser = reference if reference in failed else next(iter(failed))
        caption = f"{failed[loser]}; shown: {solved[0].planner}, {len(solved)} solve it"
        yield Replay(f"{loser} fails · {case.name}", caption, case, solved[0].waypoints)
    elif failed and isinstance(goal, JointGoal):
        caption = "solved by no planner; shown: the straight line, which is no solution"
        line = np.stack([case.problem.start, goal.positions[0]])
        yield Replay(f"not solved · {case.name}", caption, case, line)
