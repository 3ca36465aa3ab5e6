"""The report of a bench: tables and plots of every problem set and time limit, and the motions to replay."""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.tables import Cell, Column, Figure, Table, plain
from robotdiffuse.evaluation import plots
from robotdiffuse.evaluation.comparison import (
    FAILURES,
    Bench,
    Comparison,
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
from robotdiffuse.evaluation.report import Report, interval
from robotdiffuse.evaluation.runs import CRASHED, OVERRAN, RAISED, RESTARTED, Record
from robotdiffuse.evaluation.statistics import Paired, wilson_interval
from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS, SEARCH
from robotdiffuse.problems.held_out import Case
from robotdiffuse.problems.problem import JointGoal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
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
    "Quality: means over the solved problems of the motions that the calls returned. clearance: a lower "
    "bound, to obstacles (scene), of the arm to itself (self), and the smaller of the two. over straight "
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
    others = [row for row in comparison.rows if row.paired is not None]
    quality: Spec = (
        *map(_metric, comparison.metrics),
        (Column("memory", "MB", ".0f", "less"), lambda row: row.memory),
    )
    pairs: Spec = (
        _of_pair("alone solves", lambda pair: pair.a_only),
        _of_pair("reference alone", lambda pair: pair.b_only),
        _of_pair("both", lambda pair: pair.both),
        _of_pair("neither", lambda pair: pair.neither),
        _of_pair("p of success", lambda pair: probability(pair.p_success)),
        *_ratio(comparison, reference),
        _of_pair("p of joint length", lambda pair: probability(pair.p_length) if pair.both else None),
    )
    failures: Spec = (
        (Column("failures"), lambda row: row.failures.total()),
        *((Column(reason), lambda row, reason=reason: row.failures.get(reason)) for reason in reasons),
    )
    made = [
        main_table(section, comparison, reference),
        _table(f"Quality of the motions; {name}", comparison.rows, quality),
        _table(f"Against {named(reference)}, in pairs; {name}", others, pairs),
        _table(f"Failures by reason; {name}", comparison.rows, failures),
    ]
    return [table for table in made if table.rows and len(table.columns) > 2]


def main_table(section: Section, comparison: Comparison, reference: str) -> Table:
    """The paper's columns, with intervals and the ratio of lengths to those of the reference."""
    spec: Spec = (
        (Column("success", "%", ".1f", "more", scale=100.0), lambda row: row.success),
        (Column("95 %"), lambda row: interval(*row.success_interval, scale=100.0)),
        (Column("collision", "%", ".1f", "less", scale=100.0), lambda row: row.collision),
        (Column("link length", "m", ".2f"), lambda row: row.link_length),
        *_ratio(comparison, reference),
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


def _ratio(comparison: Comparison, reference: str) -> Spec:
    reference_row = comparison.row(reference)
    restarted = {plain_name(row.planner) for row in comparison.rows if row.planner.endswith(RESTARTED)}

    def mark(row: Row) -> str | None:
        """The sign behind a figure; None if the figure is not shown."""
        if row.full and (reference_row is None or reference_row.full):
            return ""
        return None if row.planner in restarted else UNEQUAL

    def ratio(row: Row) -> Cell:
        if row.planner == reference:
            return "1"
        sign = mark(row)
        if row.paired is None or row.paired.ratio is None or sign is None:
            return None
        return Figure(f"{row.paired.ratio:.3f}{sign}", row.paired.ratio)

    def ends(row: Row) -> Cell:
        pair = None if mark(row) is None else row.paired
        return pair and pair.ratio_interval and interval(*pair.ratio_interval, digits=3)

    return (Column(f"joint length / {named(reference)}"), ratio), (Column("95 % "), ends)


def _metric(metric: Metric) -> tuple[Column, Callable[[Row], Cell]]:
    """A column with the mean of a metric over the solved problems."""
    column = Column(metric.heading, metric.unit, metric.format, metric.better, scale=metric.scale)
    return column, lambda row: row.measures[metric.name].value


def _of_pair(heading: str, of: Callable[[Paired], Cell]) -> tuple[Column, Callable[[Row], Cell]]:
    """A column of comparisons with the reference on the same problems."""
    return Column(heading), lambda row: row.paired and of(row.paired)


def probability(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


# Plots


def is_learned(planner: str) -> bool:
    """Whether a planner has a network, whatever its weights, settings and restarts."""
    entry = PLANNERS.get(base_name(planner))
    return entry is not None and entry.kind != SEARCH


def colors_of(planners: Sequence[str]) -> dict[str, str]:
    """Colours of planners, the same with restarts or without."""
    names = list(dict.fromkeys(map(plain_name, planners)))
    return {name: f"C{names.index(plain_name(name))}" for name in planners}


def success_over_time(section: Section, planners: Sequence[str]) -> str:
    """Draw the share of problems solved over time on a logarithmic axis, as in the paper's figure."""

    def fill(axes: "Axes") -> None:
        first = min((c.found[0] for c in section.curves if len(c.found)), default=0.1)
        plots.time_axis(axes, first, max(c.end for c in section.curves))
        for curve in (curve for curve in section.curves if curve.planner == plain_name(curve.planner)):
            shares = 100 * np.arange(len(curve.found) + 1) / curve.calls
            times = [axes.get_xlim()[0], *curve.found, curve.end]
            axes.step(times, [*shares, shares[-1]], where="post", **_stroke(curve.planner, planners))
        axes.set_ylim(-1.5, 101.5)
        plots.percent_axis(axes)

    return _over_time(fill)


def length_over_time(section: Section, planners: Sequence[str]) -> str:
    """Draw the median length over time: a line for planners that improve their paths, else a point."""

    def fill(axes: "Axes") -> None:
        curves = [curve for curve in section.curves if len(curve.times)]
        first = min((curve.times[0] for curve in curves), default=0.1)
        plots.time_axis(axes, first, max((curve.end for curve in section.curves), default=1.0))
        longest = max((float(np.quantile(curve.ratios, 0.9)) for curve in curves), default=1.5)
        top = 1 + 1.12 * min(max(longest - 1, 0.1), 2.0)
        for curve in curves:
            stroke = _stroke(curve.planner, planners)
            if curve.anytime:
                axes.plot(curve.times, curve.ratios, **stroke)
            else:
                axes.plot(curve.times[0], min(float(curve.ratios[-1]), top), "o", **stroke)
        axes.set_ylim(1 - 0.035 * (top - 1), top)
        axes.set_ylabel("joint length / best known")

    return _over_time(fill)


def _over_time(fill: "Callable[[Axes], None]") -> str:
    """Curves of planners, with their names beside them."""

    def draw(figure: "PlotFigure") -> None:
        axes = figure.subplots()
        fill(axes)
        axes.legend(**plots.LEGEND_BESIDE)

    return plots.draw(draw, plots.HALF, 3.7)


def _stroke(planner: str, planners: Sequence[str]) -> dict[str, Any]:
    """The style of a planner's line: solid with a network, dashed for search."""
    return {
        "label": planner,
        "color": colors_of(planners)[planner],
        "linestyle": "-" if is_learned(planner) else "--",
        "linewidth": 2.4 if planner == DEFAULT_PLANNER else 1.35,
    }


def families(comparisons: Sequence[Comparison], planners: Sequence[str]) -> str:
    """Draw the success of every planner on every family of problems [%], with 95 % intervals."""
    panels: dict[str, dict[str, plots.Interval]] = {}
    for row in (row for comparison in comparisons for row in comparison.rows):
        for family, (solved, calls) in row.families.items():
            low, high = wilson_interval(solved, calls)
            panel = panels.setdefault(f"{family} ({calls})", {})
            panel[row.planner] = (100 * solved / calls, 100 * low, 100 * high)
    return plots.intervals(planners, panels, colors_of(planners))


def failures(comparison: Comparison) -> str:
    """Draw stacked bars of the failed calls by reason, in percent of all calls."""
    shares = {
        reason: [100 * row.failures[reason] / len(comparison.keys) for row in comparison.rows]
        for reason in FAILURES
        if any(row.failures[reason] for row in comparison.rows)
    }
    planners = [row.planner for row in comparison.rows]
    height = 0.258 * len(planners) + 0.85
    return plots.draw(
        lambda figure: plots.stacked_bars(figure.subplots(), planners, shares), plots.HALF, height
    )


def metrics(comparison: Comparison, planners: Sequence[str]) -> str:
    """Draw a panel for each metric of motions: the means of all planners with their 95 % intervals."""
    panels = {}
    for metric in comparison.metrics:
        better = f", {metric.better} is better" if metric.better else ""
        heading = f"{metric.heading}{f' [{metric.unit}]' if metric.unit else ''}{better}"
        panel: dict[str, plots.Interval] = {}
        for row in comparison.rows:
            mean, half = row.measures[metric.name]
            panel[row.planner] = (
                metric.scale * mean,
                metric.scale * (mean - half),
                metric.scale * (mean + half),
            )
        panels[heading] = panel
    return plots.intervals([row.planner for row in comparison.rows], panels, colors_of(planners))


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
            caption = (
                "Length over time, median over the best known, of non-trivial problems; points: one path"
            )
            report.plot(f"length_{file}.svg", caption, length_over_time(section, planners))
        for comparison in section.comparisons:
            main, *others = tables(section, comparison, bench.reference)
            report.table(main)
            if comparison.missing:
                report.add(plain(missing_line(comparison)))
            for table in others:
                report.table(table, level=4)
        main = section.main
        report.plot(
            f"metrics_{file}.svg", f"Quality within {main.limit:g} s, 95 % intervals", metrics(main, planners)
        )
        report.plot(f"failures_{file}.svg", f"Failed calls within {main.limit:g} s", failures(main))
    report.add("## All problems")
    mains = [section.main for section in parts if section.name == section.problem_set]
    limits = " and ".join(f"{limit:g} s" for limit in sorted({main.limit for main in mains}))
    caption = f"Success [%] by family within {limits}, 95 % intervals; in brackets: calls"
    report.plot("families.svg", caption, families(mains, planners))
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
"""In replays, each with up to three planners; the other replays are of failures."""


@dataclass(frozen=True, eq=False)
class Replay:
    """A motion for the replays."""

    title: str
    caption: str
    case: Case
    positions: Float[ndarray, "n dof"]


@dataclass(frozen=True, eq=False)
class _Tries:
    """The calls of all planners on a problem."""

    case: Case
    solved: list[Record]
    """Shortest path first."""
    failed: dict[str, str]
    """Reasons of failures by planner."""

    @property
    def detour(self) -> float:
        """Length of the shortest motion over that of the straight line between its ends."""
        best = self.solved[0]
        straight = float(np.linalg.norm(best.waypoints[-1] - best.waypoints[0]))
        return (best.joint_length or 0.0) / max(straight, 1e-6)


def motions_to_replay(bench: Bench, parts: Sequence[Section]) -> list[Replay]:
    """Motions of the problems with the longest detours, then of problems on which the reference, or else
    another planner, failed; at the main limit of their set, for cases that the folder keeps."""
    tries: list[_Tries] = []
    for section in (section for section in parts if section.name == section.problem_set):
        main = section.main
        cases = {case.name: case for case in read_cases(bench.folder, section.problem_set)}
        calls = {row.planner: calls_on(bench.records[row.planner], section.problem_set) for row in main.rows}
        for key in main.keys:
            if key[1] == main.keys[0][1] and key[0] in cases:
                records = {planner: deciding_record(of[key], main.limit) for planner, of in calls.items()}
                outcomes = [outcome(record, main.limit) for record in records.values() if record is not None]
                solved = [o.record for o in outcomes if o.solved]
                solved.sort(key=lambda record: record.joint_length or 0.0)
                failed = {o.record.planner: o.failure for o in outcomes if not o.solved}
                tries.append(_Tries(cases[key[0]], solved, failed))
    hardest = sorted((t for t in tries if t.solved), key=lambda t: (len(t.solved) < 2, -t.detour))
    hardest = hardest[:SOLVED_PROBLEMS]
    failed = [
        t
        for t in tries
        if t.failed and t not in hardest and (t.solved or isinstance(t.case.problem.goal, JointGoal))
    ]
    failed.sort(key=lambda t: (bench.reference not in t.failed, len(t.solved)))
    replays = [replay for t in hardest for replay in _solved(t, bench.reference)]
    return [*replays, *(_failed(t, bench.reference) for t in failed)][:MAX_REPLAYS]


def _solved(tries: _Tries, reference: str) -> list[Replay]:
    """The motion of the reference, the shortest and the longest."""
    shortest = tries.solved[0]
    longest = tries.solved[-1]
    chosen = [*(r for r in tries.solved if r.planner == reference), shortest, longest]
    replays = []
    for record in {record.planner: record for record in chosen}.values():
        which = "shortest, " if record is shortest else "longest, " if record is longest else ""
        caption = f"{record.joint_length:.2f} rad, {which}in {seconds(record.time)} s"
        replays.append(Replay(f"{record.planner} · {tries.case.name}", caption, tries.case, record.waypoints))
    return replays


def _failed(tries: _Tries, reference: str) -> Replay:
    """A motion that solves a problem on which planners failed, or the straight line."""
    name = tries.case.name
    if tries.solved:
        loser = reference if reference in tries.failed else next(iter(tries.failed))
        number = len(tries.solved)
        solvers = tries.solved[0].planner + (f", {number} solve it" if number > 1 else "")
        caption = f"{tries.failed[loser]}; shown: {solvers}"
        return Replay(f"{loser} fails · {name}", caption, tries.case, tries.solved[0].waypoints)
    problem = tries.case.problem
    assert isinstance(problem.goal, JointGoal)
    caption = "solved by no planner; shown: the straight line, which is no solution"
    line = np.stack([problem.start, problem.goal.positions[0]])
    return Replay(f"not solved · {name}", caption, tries.case, line)
