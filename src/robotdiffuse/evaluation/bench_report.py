"""The report of a bench: comparisons of its planners as tables and plots, and motions to replay."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from robotdiffuse.core.errors import counted
from robotdiffuse.core.tables import Cell, Column, Figure, Table, plain
from robotdiffuse.core.types import Configurations
from robotdiffuse.evaluation.bench_comparisons import (
    FAILURES,
    Bench,
    Comparison,
    Curve,
    Paired,
    Row,
    Section,
    base_name,
    calls_on,
    deciding_record,
    outcome,
    plain_name,
    solved_share,
)
from robotdiffuse.evaluation.metrics import METRICS, Metric
from robotdiffuse.evaluation.report import Report, draw_plot
from robotdiffuse.evaluation.runs import (
    CRASHED,
    OVERRAN,
    RAISED,
    RESTARTED,
    Record,
    read_cases,
)
from robotdiffuse.planning import PLANNERS, SEARCH
from robotdiffuse.problems.files import Case
from robotdiffuse.problems.problem import JointGoal

UNEQUAL = " †"
UNEQUAL_NOTE = (
    "† not at equal time: this planner or the reference ended before the limit. The option "
    "--equal-time of bench run repeats such calls until the limit."
)
NOTES = """\
- A call counts in a table if its own limit was at least that of the table. A call with a smaller limit
  counts too if it ended by itself before that limit, since more time would have changed nothing. A table
  compares the problems on which all its planners have such a call.
- success: share of problems with a verified motion found by the limit, with the 95 % interval over problems
  (Wilson). A motion returned after the call's own limit counts if it is late by at most 10 % of the limit
  or 50 ms, whichever is more: planners stop in time, and validation follows.
- collision: share of problems on which the validator refused the planner's last path because it collides.
- link length: the paper's path length, the sum of the path lengths of all links that joints move. It is the
  mean over the problems that the planner itself solved, so planners that solve only easy problems have
  short paths. If a call continued after the limit and returned a shorter path, the length at the limit is
  estimated: the returned path's link length, times the ratio of both paths' lengths in joint space.
- joint length / a planner: median ratio of the length in joint space to that of the reference planner, on
  problems that both solve, with its 95 % interval (bootstrap over problems). The ratio is at equal time if
  both planners use up the limit; † marks other ratios. Computing trajectories is not counted.
- restarted (in a planner's name): a planner that ends before the limit is called again with other seeds
  until less time is left than its shortest call took. The shortest path counts.
- first: median time to the first path of solved problems. returns: mean time until the planner returns,
  without computing the trajectory. Anytime planners use up the limit, and unsolved problems count with the
  limit.
- ComScore: as in the paper, the mean of success, collision, length and time until the planner returns, each
  scaled from 0 for the worst row of the table to 1 for the best. It depends on the rows of the table; rows
  with restarts are left out. `robotdiffuse reproduce table1` computes it among the paper's rows.
- Quality: means over seeds, then over the solved problems, with 95 % intervals. clearance: a lower
  bound of the distance to obstacles (scene), between links of the arm (self), and the smaller of the two
  (min). over straight line: duration divided by the shortest time along the straight line without obstacles
  and jerk limits. stops: how often the whole arm stops on the way. peak and mean jerk: of the joint with the
  largest jerk at each time. bending: integral of the squared second derivative of the path, divided by the
  squared length. jerk: logarithm of the dimensionless jerk, lower is smoother. sparc: spectral arc length of
  the speed of the joints or of the tip, closer to 0 is smoother.
- p of success: McNemar's exact test. p of joint length: Wilcoxon's signed-rank test. Neither is corrected
  for the number of comparisons. With several seeds, a problem counts as solved if it is solved with more
  than half of the seeds."""
"""Notes below the tables, in Markdown."""


def named(planner: str) -> str:
    """The name of a planner in tables: with its settings, and with "restarted" for restarts."""
    restarted = ["restarted"] if planner.endswith(RESTARTED) else []
    return ", ".join([*plain_name(planner).split(":"), *restarted])


# Tables

PlannerColumn = tuple[Column, Callable[[Row], Cell]]
"""A column of a table of planners, and the function for its cells."""
Spec = Sequence[PlannerColumn]


def seconds(value: float) -> Cell:
    """A time with two significant digits."""
    if not np.isfinite(value):
        return None
    return Figure(f"{value:.{max(0, 1 - int(np.floor(np.log10(max(value, 1e-4)))))}f}", value)


def title(section: Section, comparison: Comparison) -> str:
    """The title of a comparison: problem set, limit and number of problems."""
    total = "" if comparison.problems == comparison.section_problems else f"of {comparison.section_problems} "
    problems = counted(comparison.problems, f"{total}problem")
    seeds = f", {comparison.seeds} seeds each" if comparison.seeds > 1 else ""
    return f"{section.name}, {comparison.limit:g} s: {problems}{seeds}"


def tables(section: Section, comparison: Comparison, reference: str) -> list[Table]:
    """The tables of a comparison, without those that have no rows or only one column besides the planner."""
    name = title(section, comparison)
    reasons = [reason for reason in FAILURES if any(reason in row.failures for row in comparison.rows)]
    compared_rows = [row for row in comparison.rows if row.paired is not None]
    quality: Spec = (
        *map(_metric, comparison.metrics),
        (
            Column("memory", "MB", ".0f", "less"),
            lambda row: max((o.record.memory or 0.0 for o in row.outcomes), default=0.0) or None,
        ),
    )
    families: Spec = [
        (Column(family), lambda row, family=family: success_in(family, row))
        for family in dict.fromkeys(o.record.family for o in comparison.rows[0].outcomes)
    ]
    pairs: Spec = (
        _of_pair("only this solves", lambda pair: pair.a_only),
        _of_pair("only reference", lambda pair: pair.b_only),
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


def success_in(family: str, row: Row) -> Figure:
    """The share of solved calls among the calls on a family's problems."""
    return solved_share([o for o in row.outcomes if o.record.family == family])


def main_table(section: Section, comparison: Comparison, reference: str) -> Table:
    """The table with the paper's columns, intervals, and the ratio of path lengths to the reference
    planner."""
    spec: Spec = (
        (Column("success", "%", better="more"), lambda row: row.success),
        (Column("collision", "%", ".1f", "less"), lambda row: row.figures.collision),
        (Column("link length", "m", ".2f"), lambda row: row.figures.length),
        _ratio(comparison, reference),
        _metric(METRICS["duration"]),
        (
            Column("first", "s", better="less"),
            lambda row: seconds(float(np.median([o.found for o in row.solved] or np.nan))),
        ),
        (Column("returns", "s", better="less"), lambda row: seconds(row.figures.time)),
        (Column("ComScore", "", ".3f", "more"), lambda row: row.comscore),
        *(() if comparison.alike else ((Column("timed", left=True), lambda row: row.timed),)),
    )
    table = _table(title(section, comparison), comparison.rows, spec)
    loads = comparison.loads
    load = f"; load average {min(loads):.1f} to {max(loads):.1f}" if loads else ""
    note = f"All rows were timed alike: {comparison.rows[0].timed}{load}."
    if not comparison.alike:
        note = f"Not all rows were timed alike, see the last column{load}; their times cannot be compared."
    unequal = any(UNEQUAL in text for row in table.texts for text in row)
    return replace(table, notes=(note, UNEQUAL_NOTE) if unequal else (note,))


def _table(heading: str, rows: Sequence[Row], spec: Spec) -> Table:
    cells = [[named(row.planner), *(cell(row) for _, cell in spec)] for row in rows]
    return Table.of(heading, ["planner", *(column for column, _ in spec)], cells)


def _ratio(comparison: Comparison, reference: str) -> PlannerColumn:
    """A column with the ratio of path lengths to those of the reference planner, and its interval. The cell
    is empty if no problem is solved by both. It is also empty if the planner or the reference ended early,
    and a row of the planner with restarts shows the ratio instead."""
    full = {row.planner: row.full for row in comparison.rows}

    def ratio(row: Row) -> Cell:
        pair = row.paired
        if row.planner == reference:
            return "1"
        sign = "" if row.full and full.get(reference, True) else UNEQUAL
        if pair is None or pair.ratio_interval is None or (sign and row.planner + RESTARTED in full):
            return None
        low, high = pair.ratio_interval
        return Figure(f"{pair.ratio:.3f} ({low:.3f} to {high:.3f}){sign}", pair.ratio or 0.0)

    return Column(f"joint length / {named(reference)}"), ratio


def _metric(metric: Metric) -> PlannerColumn:
    """A column with the mean of a metric over the solved problems."""
    return Column(metric.heading, metric.unit, better=metric.better), lambda row: row.mean(metric)


def _of_pair(heading: str, cell: Callable[[Paired], Cell]) -> PlannerColumn:
    """A column of the paired comparison with the reference planner."""
    return Column(heading), lambda row: row.paired and cell(row.paired)


def probability(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


# Plots


def success_over_time(section: Section, planners: Sequence[str]) -> str:
    """Draw the share of solved calls over time, as in the paper's figure 3a, without the rows with restarts;
    returns SVG."""

    def steps(curve: Curve) -> tuple[ndarray, ndarray]:
        solved = np.arange(len(curve.found) + 1)
        return np.append(curve.found, curve.end), np.append(solved[1:], solved[-1]) / curve.calls

    curves = [curve for curve in section.curves if curve.planner == plain_name(curve.planner)]
    return _over_time(curves, planners, "solved", steps)


def length_over_time(section: Section, planners: Sequence[str]) -> str:
    """Draw the median ratio of path length to the best known length over time; returns SVG."""
    label = "joint length / best known"
    return _over_time(section.curves, planners, label, lambda curve: (curve.times, curve.ratios))


def _over_time(
    curves: Sequence[Curve],
    planners: Sequence[str],
    label: str,
    data: Callable[[Curve], tuple[ndarray, ndarray]],
) -> str:
    """Draws curves: solid for planners with a network, dashed for search. A planner with restarts has the
    same color as without."""
    names = list(dict.fromkeys(map(plain_name, planners)))

    def fill(figure: Any) -> None:
        axes = figure.subplots()
        for curve in curves:
            entry = PLANNERS.get(base_name(curve.planner))
            axes.plot(
                *data(curve),
                drawstyle="steps-post",
                label=curve.planner,
                color=f"C{names.index(plain_name(curve.planner))}",
                linestyle="--" if entry is None or entry.kind == SEARCH else "-",
            )
        axes.set(xscale="log", xlabel="time [s]", ylabel=label)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        figure.legend(loc="outside right upper")

    return draw_plot(fill, width=9.0)


# The report


def bench_report(bench: Bench, parts: Sequence[Section], replays: str | None = None) -> Report:
    """The report of a bench. `replays` is the file name of a page with replays in the same folder, to which
    the report links.

    Raises InputError if matplotlib is not installed.
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
            caption = "Length relative to the best known, over time; median of the non-trivial problems"
            report.plot(f"length_{file}.svg", caption, length_over_time(section, planners))
        for comparison in section.comparisons:
            main, *further_tables = tables(section, comparison, bench.reference)
            report.table(main)
            if line := missing_line(comparison):
                report.add(plain(line))
            for table in further_tables:
                report.table(table, level=4)
    if broken := crashes(bench):
        report.add("## Crashes and exceptions")
        report.items(map(plain, broken))
    report.add("## How to read the tables")
    report.add(NOTES)
    return report


def missing_line(comparison: Comparison) -> str:
    """A line that names the planners missing from the table; an empty string if none is missing."""
    if not comparison.missing:
        return ""
    return (
        f"Not run for {comparison.limit:g} s on these problems: {', '.join(map(named, comparison.missing))}."
    )


def about(bench: Bench) -> list[str]:
    """Machine, dates and versions of the sessions: one line for each combination of machine and versions."""
    dates = dict[str, list[str]]()
    for run in bench.sessions:
        versions = ", ".join(f"{name} {version}" for name, version in run["versions"].items())
        machine = f"{run.get('processor', '?')}, {counted(run.get('cores', '?'), 'core')}"
        clock = ", CPU time" if run.get("cpu_time") else ""
        text = (
            f"{machine}, {counted(run.get('workers', '?'), 'worker')}{clock}; Python "
            f"{run.get('python', '?')}, {versions}"
        )
        dates.setdefault(text, []).append(run["date"])
    return [
        f"{days[0] if min(days) == max(days) else f'{min(days)} to {max(days)}'} UTC: {text}"
        for text, days in dates.items()
    ]


def facts(bench: Bench) -> list[str]:
    """Numbers of planners, problems and calls."""
    records = [record for planner_records in bench.records.values() for record in planner_records]
    problems = {(record.problem_set, record.name) for record in records}
    minutes = sum(record.time for record in records) / 60
    solved = sum(record.solved for record in records)
    return [
        f"{counted(len(bench.records), 'planner')}, {counted(len(problems), 'problem')} in "
        f"{counted(len(bench.problem_sets), 'set')}",
        f"{counted(len(records), 'call')} in {minutes:.1f} min of planning: "
        f"{counted(solved, 'verified motion')}",
    ]


def crashes(bench: Bench) -> list[str]:
    """One line for each reason of crashes, overruns and exceptions, with its count."""
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
"""Number of solved problems in the replays, each with the motions of two planners. The other replays show
failures."""


class Replay(NamedTuple):
    """A motion for the replays."""

    title: str
    caption: str
    case: Case
    positions: Configurations


def motions_to_replay(bench: Bench, parts: Sequence[Section]) -> list[Replay]:
    """Motions to replay: for the problems with the longest detours, the shortest and the longest motion.
    Then, for problems on which planners failed, another planner's motion, or the straight line if none solved
    the problem; failures of the reference planner come first.

    Motions are those of the main comparison of each problem set. Only problems that are stored in the folder
    are considered.
    """
    tries = list[tuple[Case, list[Record], dict[str, str]]]()
    # sections that hold only the non-trivial problems are left out
    for section in (section for section in parts if section.name == section.problem_set):
        main = section.main
        calls = [calls_on(bench.records[row.planner], section.problem_set) for row in main.rows]
        for case in read_cases(bench.folder, section.problem_set):
            key = case.name, main.keys[0][1]  # the first seed
            if key in main.keys:
                records = (deciding_record(planner_calls[key], main.limit) for planner_calls in calls)
                outcomes = [outcome(record, main.limit) for record in records if record is not None]
                solved = [o.record for o in outcomes if o.solved]
                solved.sort(key=lambda record: record.joint_length or 0.0)
                failed = {o.record.planner: o.failure for o in outcomes if not o.solved}
                tries.append((case, solved, failed))
    tries.sort(key=lambda attempt: (len(attempt[1]) > 1, *map(_detour, attempt[1][:1])), reverse=True)
    replays = []
    for case, solved, _ in tries[:SOLVED_PROBLEMS]:
        for record in solved[:1] + solved[1:][-1:]:
            extreme = "shortest" if record is solved[0] else "longest"
            caption = f"{record.joint_length:.2f} rad, {extreme}, in {seconds(record.time)} s"
            replays.append(Replay(f"{record.planner} · {case.name}", caption, case, record.waypoints))
    further_tries = sorted(
        tries[SOLVED_PROBLEMS:], key=lambda attempt: (bench.reference not in attempt[2], len(attempt[1]))
    )
    replays += [replay for attempt in further_tries for replay in _failure(*attempt, bench.reference)]
    return replays[:MAX_REPLAYS]


def _detour(record: Record) -> float:
    """Length of a motion divided by the length of the straight line from its start to its goal."""
    straight = float(np.linalg.norm(record.waypoints[-1] - record.waypoints[0]))
    return (record.joint_length or 0.0) / max(straight, 1e-6)


def _failure(case: Case, solved: list[Record], failed: dict[str, str], reference: str) -> Iterator[Replay]:
    """A replay of a problem on which a planner failed: another planner's motion, or, if none solved it, the
    straight line to a joint goal. Yields nothing if no planner failed, or if none solved the problem and its
    goal is not a joint goal."""
    goal = case.problem.goal
    if failed and solved:
        loser = reference if reference in failed else next(iter(failed))
        caption = f"{failed[loser]}; shown: {solved[0].planner}; solved by {counted(len(solved), 'planner')}"
        yield Replay(f"{loser} fails · {case.name}", caption, case, solved[0].waypoints)
    elif failed and isinstance(goal, JointGoal):
        caption = "solved by no planner; shown: the straight line, which is no solution"
        line = np.stack([case.problem.start, goal.positions[0]])
        yield Replay(f"not solved · {case.name}", caption, case, line)
