"""The page of a bench: plots and tables in one HTML file that needs no network; and the motions to replay."""

import html
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.output_files import check_output, write_atomically
from robotdiffuse.evaluation import style
from robotdiffuse.evaluation.bench import plots, report
from robotdiffuse.evaluation.bench.figures import Comparison, Section
from robotdiffuse.evaluation.bench.outcomes import Outcome, calls_on, deciding_record, outcome
from robotdiffuse.evaluation.bench.run_folder import Bench
from robotdiffuse.evaluation.problem_sets import read_cases
from robotdiffuse.evaluation.records import Record
from robotdiffuse.evaluation.style import card
from robotdiffuse.evaluation.tables import html as html_table
from robotdiffuse.problems.held_out import Case
from robotdiffuse.problems.problem import JointGoal

OWN_STYLE = """
[hidden] { display: none !important; }
.pick { position: sticky; top: 0; z-index: 2; display: flex; flex-wrap: wrap; gap: 6px 18px;
  margin: 20px -26px 14px; padding: 10px 26px; background: rgba(242, 244, 246, .93);
  backdrop-filter: blur(6px); border-bottom: 1px solid var(--line); }
.pick div { display: flex; flex-wrap: wrap; gap: 5px; }
.pick button { padding: 5px 12px; border: 0; border-radius: 999px; background: white; color: var(--ink);
  font: inherit; font-size: 13px; cursor: pointer; box-shadow: 0 0 0 1px var(--line); }
.pick button:hover { box-shadow: 0 0 0 1px rgba(34, 43, 56, .28); }
.pick button[aria-pressed=true] { background: var(--ink); color: white; }
.cards + .cards { margin-top: 14px; }
iframe { display: block; width: 100%; height: min(760px, 82vh); margin-top: 4px;
  border: 1px solid var(--line); border-radius: 12px; }
.wrong td { text-align: left; white-space: normal; }
details { margin-top: 14px; } summary { cursor: pointer; font-weight: 640; font-size: 15.5px; }
details li { margin: 5px 0; color: #4c5766; }
h3 { margin: 26px 0 12px; font-size: 19px; font-weight: 660; letter-spacing: -.01em; }
@media (max-width: 900px) { main { padding: 22px 12px 30px; }
  .pick { margin: 16px -12px 12px; padding: 8px 12px; } .pick button { padding: 4px 10px; font-size: 12.5px; }
  .tiles { grid-template-columns: repeat(2, 1fr); } }
"""

SCRIPT = """
const chosen = {}, picks = [...document.querySelectorAll(".pick button")];
function show() {
  for (const part of document.querySelectorAll("[data-set]"))
    part.hidden = part.dataset.set !== chosen.set || (part.dataset.limit || chosen.limit) !== chosen.limit;
  for (const pick of picks) {
    pick.setAttribute("aria-pressed", chosen[pick.dataset.kind] === pick.value);
    if (pick.dataset.kind === "limit") pick.hidden = !limits[chosen.set].includes(pick.value);
  }
}
const limits = {};
for (const part of document.querySelectorAll("[data-limit]"))
  (limits[part.dataset.set] = limits[part.dataset.set] || []).push(part.dataset.limit);
for (const pick of picks) pick.addEventListener("click", () => {
  chosen[pick.dataset.kind] = pick.value;
  if (!limits[chosen.set].includes(chosen.limit)) chosen.limit = mains[chosen.set];
  show();
});
chosen.set = picks[0].value;
chosen.limit = mains[chosen.set];
show();
"""

MAX_REPLAYS = 12
SOLVED_PROBLEMS = 2
"""In replays, each with up to three planners; the other replays are of failures."""


def write_page(bench: Bench, parts: Sequence[Section], file: str | FilePath, replays: str | None) -> None:
    """Write the page as .html. `replays`: name of a file beside it, shown in a frame.

    Raises InputError without matplotlib and for a file that cannot be written.
    """
    target = check_output(file, (".html", ".htm"))
    with style.style():
        text = _page(bench, parts, replays)
    write_atomically(target, text, make_folder=True)


def write_plots(bench: Bench, parts: Sequence[Section], folder: FilePath) -> list[str]:
    """Write the curves of each problem set as success_SET.svg and length_SET.svg; returns their names.

    Raises InputError as `write_page` does.
    """
    planners, drawn = list(bench.records), {}
    with style.style():
        for section in (section for section in parts if section.curves):
            name = "_".join(re.findall(r"\w+", section.name))
            drawn[f"success_{name}.svg"] = plots.success_over_time(section, planners)
            drawn[f"length_{name}.svg"] = plots.length_over_time(section, planners)
    for file, svg in drawn.items():
        # the text is dark
        write_atomically(folder / file, svg.replace("<svg ", '<svg style="background: white" ', 1))
    return list(drawn)


def _page(bench: Bench, parts: Sequence[Section], replays: str | None) -> str:
    planners = list(bench.records)
    apart = [section for section in parts if section.name == section.problem_set]
    families = plots.families([section.main for section in apart], planners)
    limits = " and ".join(f"{x:g} s" for x in sorted({section.main.limit for section in apart}))
    text = f"Share of problems solved within {limits}, with 95 % intervals; in brackets: calls"
    frame = ""
    if replays:
        frame = card(
            "Motions",
            12,
            "Problems with the longest detours, by several planners; and problems that planners failed on, "
            "with a motion that solves them if there is one; "
            f'<a href="{html.escape(replays)}">on a page of their own</a>',
            f'<iframe title="replays" loading="lazy" src="{html.escape(replays)}"></iframe>',
        )
    # an unescaped '<' in a string could end the script element
    mains = json.dumps({s.name: f"{s.main.limit:g}" for s in parts}).replace("<", "\\u003c")
    content = (
        _picks(parts),
        *(_section(bench, section, planners) for section in parts),
        '<h3>All problems</h3><div class="cards">',
        card("Success by family", 12, text, f'<div class="wide">{families}</div>'),
        _crashes(bench),
        frame,
        "</div>",
        "<details><summary>How to read the tables</summary><ul>",
        *(f"<li>{html.escape(note)}</li>" for note in report.NOTES),
        "</ul></details>",
    )
    script = f"<script>const mains = {mains};{SCRIPT}</script>"
    name = bench.folder.resolve().name
    return style.page(name, report.about(bench), _facts(bench), "\n".join(content), OWN_STYLE, script)


def _facts(bench: Bench) -> list[tuple[str, str]]:
    records = [record for of in bench.records.values() for record in of]
    problems = {(record.problem_set, record.name) for record in records}
    limits = sorted({record.time_limit for record in records})
    hours = sum(record.time for record in records) / 3600
    return [
        (f"{len(bench.records)}", "planners"),
        (f"{len(problems):,}", f"problems in {len(bench.problem_sets)} sets"),
        (f"{len(records):,}", "calls"),
        (" · ".join(f"{limit:g}" for limit in limits) + "\u202fs", "time limits"),
        (f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.1f} min", "of planning"),
        (f"{sum(record.solved for record in records):,}", "verified motions"),
    ]


def _picks(parts: Sequence[Section]) -> str:
    """Buttons that choose the problem set and the time limit."""
    limits = sorted({c.limit for section in parts for c in section.comparisons})
    kinds = (
        ("set", [(section.name, section.name) for section in parts]),
        ("limit", [(f"{limit:g}", f"{limit:g} s") for limit in limits]),
    )
    return '<div class="pick">{}</div>'.format(
        "".join(
            "<div>{}</div>".format(
                "".join(
                    f'<button data-kind="{kind}" value="{html.escape(value)}">{html.escape(text)}</button>'
                    for value, text in values
                )
            )
            for kind, values in kinds
        )
    )


def _section(bench: Bench, section: Section, planners: list[str]) -> str:
    """Plots of a problem set, and tables of each limit."""
    name = html.escape(section.name)
    curves = ""
    if section.curves:
        ran = section.curves[0].calls
        curves = card(
            "Success over time",
            6,
            f"{name}: share of {ran} calls. Planners with a network solid, search dashed",
            f'<div class="wide">{plots.success_over_time(section, planners)}</div>',
        ) + card(
            "Length over time",
            6,
            f"{name}: median length over the best known, of non-trivial problems. Points: one path a call",
            f'<div class="wide">{plots.length_over_time(section, planners)}</div>',
        )
    tables = "".join(
        f'<div class="cards" data-set="{name}" data-limit="{comparison.limit:g}">'
        f"{_comparison(bench, section, comparison)}</div>"
        for comparison in section.comparisons
    )
    return f'<div class="cards" data-set="{name}">{curves}</div>{tables}'


def _comparison(bench: Bench, section: Section, comparison: Comparison) -> str:
    main, *others = report.tables(section, comparison, bench.reference)
    text, planners = html.escape(report.missing_line(comparison)), list(bench.records)

    colors = {report.named(name): plots.color_of(name, planners) for name in planners}
    cards = [card(html.escape(main.title), 12, text, html_table(main, colors, report.named(bench.reference)))]
    for table in others:
        heading, _, rest = table.title.partition("; ")
        wide = len(table.columns) >= 8 and not heading.startswith("Failures")
        if heading.startswith("Failures"):
            plot = plots.failures(section, comparison, planners)
            cards.append(card("Failures", 6, html.escape(rest), f'<div class="wide">{plot}</div>'))
        cards.append(
            card(html.escape(heading), 12 if wide else 6, html.escape(rest), html_table(table, colors))
        )
        if heading.startswith("Quality"):
            plot = plots.metrics(section, comparison, planners)
            text = "Means over the solved problems with 95 % intervals; empty for planners that solved none"
            cards.append(card("Quality", 12, text, f'<div class="wide">{plot}</div>'))
    return "".join(cards)


def _crashes(bench: Bench) -> str:
    lines = report.crashes(bench)
    if not lines:
        return ""
    rows = "".join(f"<tr><td>{html.escape(line)}</td></tr>" for line in lines[:20])
    return card("Crashes and exceptions", 12, "", f'<table class="wrong"><tbody>{rows}</tbody></table>')


@dataclass(frozen=True, eq=False)
class Replay:
    """A motion for the replays."""

    title: str
    caption: str
    case: Case
    positions: Float[ndarray, "n dof"]
    """Waypoints [rad]; the straight line to the goal if no planner found a motion."""


def motions_to_replay(bench: Bench, parts: Sequence[Section]) -> list[Replay]:
    """Motions of the problems with the longest detours, then of problems on which the reference, or else
    another planner, failed; at the main limit of their set, for cases that the folder keeps."""
    tries: list[_ProblemOutcomes] = []
    for section in (section for section in parts if section.name == section.problem_set):
        calls = {name: calls_on(records, section.problem_set) for name, records in bench.records.items()}
        cases = {case.name: case for case in read_cases(bench.folder, section.problem_set)}
        compared = [row.planner for row in section.main.rows]
        for name, seed in section.main.keys:
            if seed == section.main.keys[0][1] and name in cases:
                found = {
                    planner: deciding_record(calls[planner][name, seed], section.main.limit)
                    for planner in compared
                }
                outcomes = {k: outcome(r, section.main.limit) for k, r in found.items() if r is not None}
                tries.append(_ProblemOutcomes(cases[name], outcomes))
    hardest = sorted((t for t in tries if t.solved), key=lambda t: (len(t.solved) < 2, -t.detour))[
        :SOLVED_PROBLEMS
    ]
    shown = [motion for t in hardest for motion in _solved(t, bench.reference)]
    failed = [
        t
        for t in tries
        if t.failed and t not in hardest and (t.solved or isinstance(t.case.problem.goal, JointGoal))
    ]
    failed.sort(key=lambda t: (bench.reference not in t.failed, len(t.solved)))
    return shown + [_failed(t, bench.reference) for t in failed[: MAX_REPLAYS - len(shown)]]


@dataclass(frozen=True, eq=False)
class _ProblemOutcomes:
    """The outcomes of all planners on a problem."""

    case: Case
    outcomes: dict[str, Outcome]

    @property
    def solved(self) -> list[Record]:
        """Records of the solved calls, shortest path first."""
        records = [o.record for o in self.outcomes.values() if o.solved]
        return sorted(records, key=lambda record: record.joint_length or 0.0)

    @property
    def failed(self) -> dict[str, str]:
        """Reasons of failures by planner."""
        return {name: o.failure for name, o in self.outcomes.items() if not o.solved}

    @property
    def detour(self) -> float:
        """Length of the shortest motion over that of the straight line between its ends."""
        best = self.solved[0]
        straight = float(np.linalg.norm(best.waypoints[-1] - best.waypoints[0]))
        return (best.joint_length or 0.0) / max(straight, 1e-6)


def _solved(tries: _ProblemOutcomes, reference: str) -> list[Replay]:
    """The motion of the reference, the shortest and the longest."""
    solved = tries.solved
    chosen = [*(r for r in solved if r.planner == reference), solved[0], solved[-1]]
    shown = []
    for record in {record.planner: record for record in chosen}.values():
        which = "shortest, " if record is solved[0] else "longest, " if record is solved[-1] else ""
        caption = f"{record.joint_length:.2f} rad, {which}in {report.seconds(record.time)} s"
        shown.append(Replay(f"{record.planner} · {tries.case.name}", caption, tries.case, record.waypoints))
    return shown


def _failed(tries: _ProblemOutcomes, reference: str) -> Replay:
    failures, solved = tries.failed, tries.solved
    loser = reference if reference in failures else next(iter(failures))
    title = f"{loser} fails · {tries.case.name}"
    if solved:
        others = f"; shown: {solved[0].planner}" + (f", {len(solved)} solve it" if len(solved) > 1 else "")
        return Replay(title, failures[loser] + others, tries.case, solved[0].waypoints)
    problem = tries.case.problem
    assert isinstance(problem.goal, JointGoal)
    caption = "solved by no planner; shown: the straight line, which is no solution"
    line = np.stack([problem.start, problem.goal.positions[0]])
    return Replay(f"not solved · {tries.case.name}", caption, tries.case, line)
