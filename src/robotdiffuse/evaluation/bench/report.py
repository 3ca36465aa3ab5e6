"""The tables of a bench's report, and the report as Markdown and LaTeX."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from robotdiffuse.evaluation.bench.figures import Comparison, Row, Section
from robotdiffuse.evaluation.bench.outcomes import FAILURES
from robotdiffuse.evaluation.bench.run_folder import Bench, base_name, plain_name
from robotdiffuse.evaluation.metrics import METRICS, Metric
from robotdiffuse.evaluation.records import RESTARTED
from robotdiffuse.evaluation.statistics import Paired
from robotdiffuse.evaluation.tables import Cell, Column, Figure, Table, plain, tex
from robotdiffuse.evaluation.tables import latex as latex_table
from robotdiffuse.evaluation.tables import markdown as markdown_table

HYBRID = "robotdiffuse"
"""The planner of search and network."""
TITLES = {HYBRID: "hybrid"}
"""Additions to names of planners."""
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


Spec = Sequence[tuple[Column, Callable[[Row], Cell]]]
"""Columns of a table of planners, with the functions for their cells."""


def named(planner: str) -> str:
    """The name of a planner in tables: with its title, its settings and whether it was restarted."""
    name, *settings = plain_name(planner).split(":")
    title = TITLES.get(base_name(planner))
    again = ["restarted"] if planner.endswith(RESTARTED) else []
    return ", ".join([name if title is None else f"{name}: {title}", *settings, *again])


def _table(
    heading: str, section: Section, comparison: Comparison, spec: Spec, notes: Sequence[str] = ()
) -> Table:
    whole = (Column("planner"), lambda row: named(row.planner)), *spec
    rows = [[of(row) for _, of in whole] for row in comparison.rows]
    name = title(section, comparison)
    return Table.of(f"{heading}; {name}" if heading else name, [column for column, _ in whole], rows, notes)


def seconds(value: float) -> Cell:
    """A time with two significant digits."""
    if not np.isfinite(value):
        return None
    return Figure(f"{value:.{max(0, 1 - int(np.floor(np.log10(max(value, 1e-4)))))}f}", value)


def interval(low: float, high: float, digits: int) -> str:
    return f"{low:.{digits}f} to {high:.{digits}f}"


def percents(shares: tuple[float, float]) -> str:
    return interval(100 * shares[0], 100 * shares[1], 1)


def title(section: Section, comparison: Comparison) -> str:
    """The title of a comparison: problem set, limit and number of problems."""
    of = "" if comparison.problems == comparison.of else f" of {comparison.of}"
    plural = "problem" if comparison.problems == 1 else "problems"
    seeds = f", {comparison.seeds} seeds each" if comparison.seeds > 1 else ""
    return f"{section.name}, {comparison.limit:g} s: {comparison.problems}{of} {plural}{seeds}"


def main_table(section: Section, comparison: Comparison, reference: str) -> Table:
    """The paper's columns, with intervals and the ratio of lengths to those of the reference."""
    spec: Spec = (
        (Column("success", "%", ".1f", "more", scale=100.0, bar=True), lambda row: row.success),
        (Column("95 %", dim=True), lambda row: percents(row.success_interval)),
        (Column("collision", "%", ".1f", "less", scale=100.0), lambda row: row.collision),
        (Column("link length", "m", ".2f"), lambda row: row.link_length),
        *_ratio(comparison, reference),
        _metric(METRICS["duration"]),
        (Column("first", "s", better="less"), lambda row: seconds(row.first)),
        (Column("returns", "s", better="less"), lambda row: seconds(row.returned)),
        (Column("ComScore", "", ".3f", "more"), lambda row: row.comscore),
        *(() if comparison.alike else ((Column("timed", left=True, dim=True), lambda row: row.timed.text),)),
    )
    found = _table("", section, comparison, spec, [timed_line(comparison)])
    unequal = any(UNEQUAL in text for row in found.texts for text in row)
    return replace(found, notes=(*found.notes, UNEQUAL_NOTE)) if unequal else found


def timed_line(comparison: Comparison) -> str:
    """A line that says whether all rows were timed under the same conditions."""
    load = ""
    if comparison.load is not None:
        least, most = comparison.load
        load = f"; load average {least:.1f} to {most:.1f}"
    if comparison.alike:
        return f"All rows were timed alike: {comparison.rows[0].timed.text}{load}."
    return (
        f"Not all rows were timed alike, see the last column{load}; their times cannot be compared as such."
    )


def _ratio(comparison: Comparison, reference: str) -> Spec:
    known = comparison.row(reference)
    restarted = {plain_name(row.planner) for row in comparison.rows if row.planner.endswith(RESTARTED)}

    def mark(row: Row) -> str | None:
        """The sign behind a figure; None if the figure is not shown."""
        if row.full and (known is None or known.full):
            return ""
        return None if row.planner in restarted else UNEQUAL

    def ratio(row: Row) -> Cell:
        if row.planner == reference:
            return "1"
        sign = mark(row)
        if row.paired is None or row.paired.ratio is None or sign is None:
            return None
        return Figure(f"{row.paired.ratio:.3f}{sign}", row.paired.ratio)

    def of_ratio(row: Row) -> Cell:
        pair = None if mark(row) is None else row.paired
        return pair and pair.ratio_interval and interval(*pair.ratio_interval, 3)

    return (Column(f"joint length / {named(reference)}"), ratio), (Column("95 % ", dim=True), of_ratio)


def _metric(metric: Metric) -> tuple[Column, Callable[[Row], Cell]]:
    """A column with the mean of a metric over the solved problems."""
    column = Column(metric.heading, metric.unit, metric.format, metric.better, scale=metric.scale)
    return column, lambda row: row.measures[metric.name].value


def quality_table(section: Section, comparison: Comparison) -> Table:
    """All metrics of the motions, and memory."""
    spec: Spec = (
        *map(_metric, comparison.metrics),
        (Column("memory", "MB", ".0f", "less"), lambda row: row.memory),
    )
    return _table("Quality of the motions", section, comparison, spec)


def paired_table(section: Section, comparison: Comparison, reference: str) -> Table:
    """Comparisons of each planner with the reference on the same problems."""

    def p_of_length(pair: Paired) -> Cell:
        return probability(pair.p_length) if pair.both else None

    others = replace(comparison, rows=tuple(row for row in comparison.rows if row.paired is not None))
    spec: Spec = (
        (Column("alone solves"), lambda row: row.paired and row.paired.a_only),
        (Column("reference alone"), lambda row: row.paired and row.paired.b_only),
        (Column("both"), lambda row: row.paired and row.paired.both),
        (Column("neither"), lambda row: row.paired and row.paired.neither),
        (Column("p of success"), lambda row: row.paired and probability(row.paired.p_success)),
        *_ratio(comparison, reference),
        (Column("p of joint length"), lambda row: row.paired and p_of_length(row.paired)),
    )
    return _table(f"Against {named(reference)}, in pairs", section, others, spec)


def probability(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def failure_table(section: Section, comparison: Comparison) -> Table:
    """Numbers of failures by reason; reasons that do not occur are left out."""
    kinds = [kind for kind in FAILURES if any(kind in row.failures for row in comparison.rows)]
    spec: Spec = (
        (Column("failures"), lambda row: sum(row.failures.values())),
        *((Column(kind), lambda row, kind=kind: row.failures.get(kind)) for kind in kinds),
    )
    return _table("Failures by reason", section, comparison, spec)


def tables(section: Section, comparison: Comparison, reference: str) -> list[Table]:
    """All tables of a comparison, without empty ones."""
    found = [
        main_table(section, comparison, reference),
        quality_table(section, comparison),
        paired_table(section, comparison, reference),
        failure_table(section, comparison),
    ]
    return [table for table in found if table.rows and len(table.columns) > 2]


def missing_line(comparison: Comparison) -> str:
    """A line that names the planners missing from the table; empty if there are none."""
    if not comparison.missing:
        return ""
    return (
        f"Not run for {comparison.limit:g} s on these problems: {', '.join(map(named, comparison.missing))}."
    )


def about(bench: Bench) -> list[str]:
    """Machine, dates and versions of the sessions, a line for each combination."""
    lines: dict[str, list[str]] = {}
    for run in bench.sessions:
        versions = ", ".join(f"{name} {version}" for name, version in run["versions"].items())
        machine = f"{run.get('processor', '?')}, {run.get('cores', '?')} cores"
        text = f"{machine}, {run.get('workers', '?')} at once; Python {run.get('python', '?')}, {versions}"
        lines.setdefault(text, []).append(run["date"])
    return [
        f"{dates[0] if min(dates) == max(dates) else f'{min(dates)} to {max(dates)}'} UTC: {text}"
        for text, dates in lines.items()
    ]


def crashes(bench: Bench) -> list[str]:
    """The reasons of crashes, overruns and exceptions with their numbers."""
    counts: dict[str, int] = {}
    for planner, records in bench.records.items():
        for record in records:
            if record.status in ("crashed", "overran", "exception"):
                text = f"{planner}, {record.status}: {record.reason}"
                counts[text] = counts.get(text, 0) + 1
    return [f"{count} x {text}" for text, count in sorted(counts.items(), key=lambda item: -item[1])]


def markdown(bench: Bench, parts: Sequence[Section]) -> str:
    """The report as Markdown."""
    lines = [f"# Bench {plain(bench.folder.resolve().name)}", ""]
    lines += [f"- {plain(line)}" for line in about(bench)]
    for section in parts:
        lines += ["", f"## {plain(section.name)}"]
        for comparison in section.comparisons:
            for i, table in enumerate(tables(section, comparison, bench.reference)):
                lines += ["", f"{'###' if i == 0 else '####'} {plain(table.title)}", ""]
                lines += markdown_table(table)
                if i == 0 and comparison.missing:
                    lines += ["", plain(missing_line(comparison))]
    if broken := crashes(bench):
        lines += ["", "## Crashes and exceptions", "", *(f"- {plain(line)}" for line in broken)]
    lines += ["", "## How to read the tables", "", *(f"- {note}" for note in NOTES)]
    return "\n".join(lines) + "\n"


def latex(bench: Bench, parts: Sequence[Section]) -> str:
    """The report as a LaTeX document; each tabular can be copied into documents that use booktabs."""
    lines = [
        r"\documentclass[landscape]{article}",
        r"\usepackage[T1]{fontenc}",
        r"\usepackage[a4paper,margin=15mm]{geometry}",
        r"\usepackage{booktabs}",
        r"\setlength{\parindent}{0pt}",
        r"\setlength{\tabcolsep}{4pt}",
        r"\begin{document}",
        r"\footnotesize",
        rf"\section*{{Bench {tex(bench.folder.resolve().name)}}}",
        *(tex(line) + r"\par" for line in about(bench)),
    ]
    for section in parts:
        lines.append(rf"\section*{{{tex(section.name)}}}")
        for comparison in section.comparisons:
            for table in tables(section, comparison, bench.reference):
                lines += [rf"\subsection*{{{tex(table.title)}}}", *latex_table(table)]
            if comparison.missing:
                lines += ["", tex(missing_line(comparison))]
    lines += [r"\section*{How to read the tables}", *(tex(note) + r"\par" for note in NOTES)]
    return "\n".join([*lines, r"\end{document}"]) + "\n"
