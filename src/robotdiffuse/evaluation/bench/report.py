"""The tables of a bench's report, as Markdown and LaTeX."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robotdiffuse.evaluation.bench.figures import (
    FAILURES,
    ROP,
    Bench,
    Comparison,
    Row,
    Section,
)
from robotdiffuse.evaluation.comscore import PAPER_TABLE_1, Indicators, comscores

IN_PAPER = {
    "ompl_rrt_star": "RRT*",
    "mpnet": "MPNet",
    "mpinets": "MPiNets",
    "mpd": "MPD",
    "robotdiffuse": "RobotDiffuse",
}
"""Our planners that are rows of the paper's Table 1."""
NONE = "–"
NOTES = (
    "A call counts for a limit if its own was at least as long, or if it ended by itself before: more time "
    "changes nothing then. Compared are the problems on which all planners of a table have such a call.",
    "success: verified motions found by the limit, with the 95 % interval over problems (Wilson). A motion "
    "that a call returned up to 10 % or 50 ms after its own limit counts: planners stop in time, then the "
    "judge takes its own.",
    "collision: share of problems on which the planner's last answer was a path in collision, which the "
    "judge refused.",
    "length: the paper's, the ways of all links together, mean over the problems that the planner itself "
    "solved; planners that solve easy problems only look short. Where a call ran on and returned a shorter "
    "path, its length by the limit is the returned one's, scaled by the joint-space lengths.",
    "ratio: median of joint-space length over that of the reference, on problems that both solve, with its "
    "95 % interval (bootstrap over problems).",
    "first: median time to the first path, of the solved. returns: mean time until the planner returns; "
    "anytime planners use up the limit, and an unsolved problem counts it.",
    "ComScore: as in the paper, from success, collision, length and time until it returns; each from 0 for "
    "the worst row of the table to 1 for the best. It depends on which rows there are.",
    "clearance, turning, tip, duration, jerk and SPARC are means over the solved problems, of the motions "
    "that the calls returned at their end. jerk: logarithm of the dimensionless jerk, less is smoother; "
    "SPARC: spectral arc length of the joints' and the tip's speed, nearer to 0 is smoother.",
    "p of success: McNemar's exact test; p of length: Wilcoxon's signed ranks; neither is corrected for the "
    "number of comparisons. With several seeds, a problem counts as solved if more than half of them are.",
)


@dataclass(frozen=True)
class TextTable:
    """A table of finished texts; all columns but the first are figures."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def number(value: float, digits: int = 2, scale: float = 1.0) -> str:
    """With a true minus sign; NONE for NaN."""
    return NONE if value != value else f"{scale * value:.{digits}f}".replace("-", "−")


def seconds(value: float) -> str:
    """Two digits that matter: times go from 0.1 ms to a minute."""
    if not np.isfinite(value):
        return NONE
    return f"{value:.{max(0, 1 - int(np.floor(np.log10(max(value, 1e-4)))))}f}"


def interval(low: float, high: float, digits: int) -> str:
    return f"{low:.{digits}f} to {high:.{digits}f}"


def probability(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def title(section: Section, comparison: Comparison) -> str:
    """What is compared: problems, limit and how many."""
    of = "" if comparison.problems == comparison.of else f" of {comparison.of}"
    plural = "problem" if comparison.problems == 1 else "problems"
    seeds = f", {comparison.seeds} seeds each" if comparison.seeds > 1 else ""
    return f"{section.name}, {comparison.limit:g} s: {comparison.problems}{of} {plural}{seeds}"


def main_table(section: Section, comparison: Comparison, reference: str) -> TextTable:
    """The paper's columns, with intervals and the ratio of lengths to the reference's."""
    columns = (
        "planner",
        "success %",
        "95 %",
        "collision %",
        "length m",
        f"ratio to {reference}",
        "95 % ",
        "first s",
        "returns s",
        "ComScore",
    )
    rows = []
    for row in comparison.rows:
        low, high = (100 * x for x in row.success_interval)
        rows.append(
            (
                row.planner,
                number(row.success, 1, 100.0),
                interval(low, high, 1),
                number(row.collision, 1, 100.0),
                number(row.link_length),
                *_ratio(row, reference),
                seconds(row.first),
                seconds(row.returned),
                number(row.comscore, 3),
            )
        )
    return TextTable(title(section, comparison), columns, tuple(rows))


def _ratio(row: Row, reference: str) -> tuple[str, str]:
    if row.planner == reference:
        return "1", NONE
    if row.paired is None or row.paired.ratio is None or row.paired.ratio_interval is None:
        return NONE, NONE
    return number(row.paired.ratio, 3), interval(*row.paired.ratio_interval, 3)


def quality_table(section: Section, comparison: Comparison) -> TextTable:
    """What a user asks besides: clearance, smoothness, memory."""
    columns = (
        "planner",
        "clearance mm",
        "turning rad",
        "tip m",
        "duration s",
        "jerk",
        "SPARC joints",
        "SPARC tip",
        "memory MB",
    )
    rows = tuple(
        (
            row.planner,
            number(row.clearance, 1, 1000.0),
            number(row.turning),
            number(row.tip_length),
            number(row.duration),
            number(row.jerk),
            number(row.sparc_joint),
            number(row.sparc_tip),
            number(row.memory, 0),
        )
        for row in comparison.rows
    )
    return TextTable(f"Quality of the motions; {title(section, comparison)}", columns, rows)


def paired_table(section: Section, comparison: Comparison, reference: str) -> TextTable:
    """Every planner against the reference on the same problems."""
    columns = (
        "planner",
        "alone solves",
        f"{reference} alone",
        "both",
        "neither",
        "p of success",
        "ratio of lengths",
        "95 %",
        "p of length",
    )
    rows = tuple(
        (
            row.planner,
            *(str(n) for n in (row.paired.a_only, row.paired.b_only, row.paired.both, row.paired.neither)),
            probability(row.paired.p_success),
            *_ratio(row, reference),
            probability(row.paired.p_length) if row.paired.both else NONE,
        )
        for row in comparison.rows
        if row.paired is not None
    )
    return TextTable(f"Against {reference}, in pairs; {title(section, comparison)}", columns, rows)


def failure_table(section: Section, comparison: Comparison) -> TextTable:
    """How many calls failed why; reasons that do not occur are left out."""
    kinds = [kind for kind in FAILURES if any(kind in row.failures for row in comparison.rows)]
    rows = tuple(
        (
            row.planner,
            str(sum(row.failures.values())),
            *(str(row.failures[kind]) if kind in row.failures else NONE for kind in kinds),
        )
        for row in comparison.rows
    )
    return TextTable(
        f"Failures by reason; {title(section, comparison)}", ("planner", "failures", *kinds), rows
    )


def paper_table(section: Section, comparison: Comparison) -> TextTable | None:
    """The rows of the paper's Table 1, ours beside the printed ones; None if there are none of them.

    ComScore is that among these rows alone.
    """
    rows = [row for row in comparison.rows if row.planner in IN_PAPER]
    if section.problem_set not in ROP or not rows:
        return None
    indicators = [Indicators(100 * r.success, 100 * r.collision, r.link_length, r.returned) for r in rows]
    paper = {row.name: row for row in PAPER_TABLE_1}
    cells = []
    for row, score in zip(rows, comscores(indicators).tolist(), strict=True):
        printed = paper[IN_PAPER[row.planner]]
        theirs = printed.indicators
        cells.append(
            (
                f"{row.planner} ({printed.name})",
                *(number(row.success, 1, 100.0), number(theirs.success, 1)),
                *(number(row.collision, 1, 100.0), number(theirs.collision, 1)),
                *(number(row.link_length), number(theirs.length)),
                *(seconds(row.returned), f"{theirs.time:g}"),
                *(number(score, 3), f"{printed.comscore:g}"),
            )
        )
    names = ("success %", "collision %", "length m", "returns s", "ComScore")
    columns = tuple(text for name in names for text in (name, f"paper: {name.split()[0]}"))
    return TextTable(
        f"Beside the paper's Table 1; {title(section, comparison)}", ("planner", *columns), tuple(cells)
    )


def tables(section: Section, comparison: Comparison, reference: str) -> list[TextTable]:
    """All of a section at a limit; tables that would say nothing are left out."""
    paper = paper_table(section, comparison)
    found = [main_table(section, comparison, reference)]
    if paper is not None:
        found.append(paper)
    found += [
        quality_table(section, comparison),
        paired_table(section, comparison, reference),
        failure_table(section, comparison),
    ]
    return [table for table in found if table.rows and len(table.columns) > 2]


def missing_line(comparison: Comparison) -> str:
    """Which planners are not in the table; empty if all are."""
    if not comparison.missing:
        return ""
    return f"Not run for {comparison.limit:g} s on these problems: {', '.join(comparison.missing)}."


def about(bench: Bench) -> list[str]:
    """Where, when and with what the runs were made, a line for each difference."""
    lines: dict[str, list[str]] = {}
    for run in bench.runs:
        versions = ", ".join(f"{name} {version}" for name, version in run["versions"].items())
        machine = f"{run.get('processor', '?')}, {run.get('cores', '?')} cores"
        text = f"{machine}, {run.get('workers', '?')} at once; Python {run.get('python', '?')}, {versions}"
        lines.setdefault(text, []).append(run["date"])
    return [
        f"{dates[0] if min(dates) == max(dates) else f'{min(dates)} to {max(dates)}'} UTC: {text}"
        for text, dates in lines.items()
    ]


def crashes(bench: Bench) -> list[str]:
    """The reasons of crashes, overruns and exceptions, each with how often it occurs."""
    counts: dict[str, int] = {}
    for planner, records in bench.records.items():
        for record in records:
            if record.status in ("crashed", "overran", "exception"):
                text = f"{planner}, {record.status}: {record.reason}"
                counts[text] = counts.get(text, 0) + 1
    return [f"{count} x {text}" for text, count in sorted(counts.items(), key=lambda item: -item[1])]


def markdown(bench: Bench, parts: Sequence[Section]) -> str:
    """The report with all tables."""
    lines = [f"# Bench {_plain(bench.folder.resolve().name)}", ""]
    lines += [f"- {_plain(line)}" for line in about(bench)]
    for section in parts:
        lines += ["", f"## {_plain(section.name)}"]
        for comparison in section.comparisons:
            for i, table in enumerate(tables(section, comparison, bench.reference)):
                lines += ["", f"{'###' if i == 0 else '####'} {_plain(table.title)}", ""]
                lines += _markdown_rows(table)
                if i == 0 and comparison.missing:
                    lines += ["", _plain(missing_line(comparison))]
    if broken := crashes(bench):
        lines += ["", "## Crashes and exceptions", "", *(f"- {_plain(line)}" for line in broken)]
    lines += ["", "## How to read the tables", "", *(f"- {note}" for note in NOTES)]
    return "\n".join(lines) + "\n"


def _plain(text: str) -> str:
    """For Markdown: what would be formatting or a column."""
    for sign in ("\\", "|", "*", "_", "<", "`"):
        text = text.replace(sign, "\\" + sign)
    return text


def _markdown_rows(table: TextTable) -> list[str]:
    widths = [max(len(row[i]) for row in (table.columns, *table.rows)) for i in range(len(table.columns))]

    def line(cells: Sequence[str]) -> str:
        padded = (
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(cells, widths, strict=True))
        )
        return f"| {' | '.join(padded)} |"

    rule = "|".join(
        "-" * (width + 2) if i == 0 else "-" * (width + 1) + ":" for i, width in enumerate(widths)
    )
    return [line(table.columns), f"|{rule}|", *(line(row) for row in table.rows)]


def latex(bench: Bench, parts: Sequence[Section]) -> str:
    """A document of all tables; each tabular can be copied into another one that uses booktabs."""
    lines = [
        r"\documentclass[landscape]{article}",
        r"\usepackage[T1]{fontenc}",
        r"\usepackage[a4paper,margin=15mm]{geometry}",
        r"\usepackage{booktabs}",
        r"\setlength{\parindent}{0pt}",
        r"\setlength{\tabcolsep}{4pt}",
        r"\begin{document}",
        r"\footnotesize",
        rf"\section*{{Bench {escaped(bench.folder.resolve().name)}}}",
        *(escaped(line) + r"\par" for line in about(bench)),
    ]
    for section in parts:
        lines.append(rf"\section*{{{escaped(section.name)}}}")
        for comparison in section.comparisons:
            for table in tables(section, comparison, bench.reference):
                lines += [rf"\subsection*{{{escaped(table.title)}}}", *_latex_rows(table)]
            if comparison.missing:
                lines += ["", escaped(missing_line(comparison))]
    lines += [r"\section*{How to read the tables}", *(escaped(note) + r"\par" for note in NOTES)]
    return "\n".join([*lines, r"\end{document}"]) + "\n"


def _latex_rows(table: TextTable) -> list[str]:
    def line(cells: Sequence[str]) -> str:
        return " & ".join(escaped(cell) for cell in cells) + r" \\"

    return [
        rf"\begin{{tabular}}{{l{'r' * (len(table.columns) - 1)}}}",
        r"\toprule",
        line(table.columns),
        r"\midrule",
        *(line(row) for row in table.rows),
        r"\bottomrule",
        r"\end{tabular}",
    ]


TEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "_": r"\_",
        "%": r"\%",
        "&": r"\&",
        "#": r"\#",
        "$": r"\$",
        "{": r"\{",
        "}": r"\}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": "$<$",
        ">": "$>$",
        "–": "--",
        "−": "$-$",
        "*": "$*$",
    }
)


def escaped(text: str) -> str:
    """For LaTeX."""
    return text.translate(TEX)
