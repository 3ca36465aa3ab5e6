"""The plots of a bench's page, as SVG. All need matplotlib, which the core install lacks."""

import hashlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from robotdiffuse.evaluation.bench.figures import Comparison, Section
from robotdiffuse.evaluation.bench.outcomes import FAILURES
from robotdiffuse.evaluation.bench.run_folder import base_name, plain_name
from robotdiffuse.evaluation.records import CRASHED, OVERRAN, RAISED
from robotdiffuse.evaluation.statistics import wilson_interval
from robotdiffuse.evaluation.style import FAINT, INK, LINE, SOFT, as_svg, make_figure, percent_axis
from robotdiffuse.planning import PLANNERS, SEARCH

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEARNED_COLORS = ("#0c9b74", "#7a9e1c", "#d9622b", "#c23f78", "#d99a17", "#8b55b8")
"""Of planners with a network, in the order of PLANNERS."""
SEARCH_COLORS = (
    "#1d4e9e",
    "#3f8ae0",
    "#1b8fa8",
    "#6a6fd1",
    "#6fb1ea",
    "#41597a",
    "#9c93e6",
    "#58b9c7",
    "#8a9bb2",
)
"""Of search, and of learned planners with weights or settings of their own."""
SOLID, DASHED = "-", (0, (4.5, 1.6))
REASONS = dict(
    zip(
        FAILURES,
        (
            *("#c5ccd6", "#97a3b4", "#dfe4ea"),  # of time
            *("#c8443c", "#e08a5b", "#efc49a"),  # of refused paths
            "#b79bd6",
            *("#2f3745", "#5a6475", "#7d4f5d"),  # of broken planners
        ),
        strict=True,
    )
)
"""Colours of failures."""
assert {CRASHED, OVERRAN, RAISED} <= set(REASONS)
AXES_BESIDE_NAMES = (0.085, 0.07, 0.655, 0.9)
"""Place of the axes in a figure with names at the right."""
LABEL_SIZE = 7.2
"""Of names in plots [pt]."""
LABEL_GAP = 0.0535
"""Between names beside a plot [share of its height]."""


def color_of(planner: str, planners: Sequence[str]) -> str:
    """The colour of a planner, the same in all plots of a report on these planners, with restarts or
    without."""
    planner, learned = plain_name(planner), [name for name in PLANNERS if is_learned(name)]
    if planner in learned:
        return LEARNED_COLORS[learned.index(planner) % len(LEARNED_COLORS)]
    others = list(dict.fromkeys(name for name in map(plain_name, planners) if name not in learned))
    return SEARCH_COLORS[others.index(planner) % len(SEARCH_COLORS)]


def is_learned(planner: str) -> bool:
    """Whether a planner has a network, whatever its weights, settings and restarts."""
    entry = PLANNERS.get(base_name(planner))
    return entry is not None and entry.kind != SEARCH


def line_of(planner: str) -> str | tuple[int, tuple[float, float]]:
    """The style of a planner's line: solid with a network, dashed for search."""
    return SOLID if is_learned(planner) else DASHED


def success_over_time(section: Section, planners: Sequence[str]) -> str:
    """Draw the share of problems solved over time on a logarithmic axis, as in the paper's figure."""
    figure = make_figure(6, 3.7)
    figure.set_layout_engine("none")
    axes = figure.add_axes(AXES_BESIDE_NAMES)
    ends = {}
    first = min((c.found[0] for c in section.curves if len(c.found)), default=0.1)
    low, high = _decade_below(first), max(c.end for c in section.curves)
    for curve in (curve for curve in section.curves if curve.planner == plain_name(curve.planner)):
        shares = 100 * np.arange(len(curve.found) + 1) / curve.calls
        times = np.concatenate([[low], curve.found, [curve.end]])
        shares = np.append(shares, shares[-1])
        axes.step(times, shares, where="post", **_stroke(curve.planner, planners))
        ends[curve.planner] = curve.end, float(shares[-1])
    _time_axis(axes, low, high)
    axes.set_ylim(-1.5, 101.5)
    percent_axis(axes)
    _names_at_right(axes, ends, planners)
    return _svg(figure, f"success {section.name}")


def length_over_time(section: Section, planners: Sequence[str]) -> str:
    """Draw the median length over time: a line for planners that improve their paths, else a point."""
    figure = make_figure(6, 3.7)
    figure.set_layout_engine("none")
    axes = figure.add_axes(AXES_BESIDE_NAMES)
    curves = [curve for curve in section.curves if len(curve.times)]
    low = _decade_below(min((c.times[0] for c in curves), default=0.1))
    high = max((c.end for c in section.curves), default=1.0)
    worst = max((float(np.quantile(c.ratios, 0.9)) for c in curves), default=1.5)
    top = 1 + 1.12 * min(max(worst - 1, 0.1), 2.0)
    ends = {}
    for curve in curves:
        last = min(float(curve.ratios[-1]), top)
        if curve.anytime:
            axes.plot(curve.times, curve.ratios, **_stroke(curve.planner, planners))
            ends[curve.planner] = curve.end, last
        else:
            middle = float(curve.times[0])
            style = _stroke(curve.planner, planners)
            axes.plot(
                middle,
                last,
                marker="o" if is_learned(curve.planner) else "D",
                markersize=6.5 if style["linewidth"] > 2 else 4.8,
                color=style["color"],
                markeredgecolor="white",
                markeredgewidth=0.7,
                zorder=style["zorder"] + 5,
                clip_on=False,
            )
            ends[curve.planner] = middle, last
    _time_axis(axes, low, high)
    axes.set_ylim(1 - 0.035 * (top - 1), top)
    axes.set_ylabel("joint length / best known")
    axes.grid(axis="y", color=FAINT, linewidth=0.8)
    axes.spines[["left"]].set_visible(False)
    _names_at_right(axes, ends, planners)
    return _svg(figure, f"length {section.name}")


def families(comparisons: Sequence[Comparison], planners: Sequence[str]) -> str:
    """Draw the success of every planner on every family of problems with 95 % intervals."""
    shown = {family: of for c in comparisons for family, of in c.families.items()}
    titles = [f"{family}  ({max(n for _, n in of.values())})" for family, of in shown.items()]
    figure, panels = _panels(titles, planners, 0.42)
    for panel, of in zip(panels, shown.values(), strict=True):
        for y, planner in enumerate(planners):
            if planner not in of:
                panel.text(1, y, "not run", va="center", fontsize=6.5, color="#a8b0ba")
                continue
            solved, n = of[planner]
            low, high = wilson_interval(solved, n)
            color = color_of(planner, planners)
            panel.barh(y, 100 * solved / n, 0.66, color=color, alpha=0.88, linewidth=0)
            panel.plot([100 * low, 100 * high], [y, y], color=INK, linewidth=0.9, solid_capstyle="butt")
        panel.set_xlim(0, 101)
        panel.set_xticks([0, 50, 100], ["0", "50", "100 %"])
    return _svg(figure, "families")


def failures(section: Section, comparison: Comparison, planners: Sequence[str]) -> str:
    """Draw stacked bars of the failed calls by reason, in percent of all calls."""
    rows = {row.planner: row.failures for row in comparison.rows}
    shown = [name for name in planners if name in rows]
    figure = make_figure(6, 0.258 * len(shown) + 0.85)
    axes = figure.subplots()
    calls = max(1, len(comparison.keys))
    left = np.zeros(len(shown))
    for reason, color in REASONS.items():
        shares = np.array([100 * rows[name].get(reason, 0) / calls for name in shown])
        if shares.any():
            axes.barh(shown, shares, 0.68, left=left, color=color, label=reason, linewidth=0)
        left += shares
    most = max(5.0, float(left.max(initial=0.0)))
    for y, total in enumerate(left):
        axes.text(total + 0.012 * most, y, f"{total:.1f}", va="center", fontsize=6.8, color=SOFT)
    axes.set_xlim(0, 1.09 * most)
    _planner_axis(axes, shown)
    axes.set_xlabel("calls that failed [%]")
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="outside upper left", ncols=5, columnspacing=1.1, handletextpad=0.4)
    return _svg(figure, f"failures {section.name} {comparison.limit:g}")


def metrics(section: Section, comparison: Comparison, planners: Sequence[str]) -> str:
    """Draw a panel for each metric of motions: the means of all planners with their 95 % intervals."""
    rows = {row.planner: row for row in comparison.rows}
    shown = [name for name in planners if name in rows]
    titles = [
        f"{metric.heading}{f' [{metric.unit}]' if metric.unit else ''}"
        + (f", {metric.better} is better" if metric.better else "")
        for metric in comparison.metrics
    ]
    figure, panels = _panels(titles, shown, 0.5)
    for panel, metric in zip(panels, comparison.metrics, strict=True):
        for y, planner in enumerate(shown):
            value, half = (metric.scale * x for x in rows[planner].measures[metric.name])
            color = color_of(planner, planners)
            panel.plot([value - half, value + half], [y, y], color=color, linewidth=1.1)
            panel.plot(value, y, "o", color=color, markersize=3.2)
    return _svg(figure, f"metrics {section.name} {comparison.limit:g}")


def _panels(titles: Sequence[str], planners: Sequence[str], margin: float) -> "tuple[Figure, list[Axes]]":
    """Panels in rows of four, with a line for each planner. `margin`: for title and ticks [inch]."""
    across = min(4, len(titles))
    down = -(-len(titles) // across)
    figure = make_figure(12, (0.165 * len(planners) + margin) * down + 0.1)
    panels = figure.subplots(down, across, squeeze=False, sharey=True).reshape(-1).tolist()
    for panel in panels[len(titles) :]:
        panel.set_axis_off()
    for i, (panel, title) in enumerate(zip(panels, titles, strict=False)):
        panel.set_title(title, loc="left")
        _planner_axis(panel, planners)
        panel.tick_params(axis="y", labelleft=i % across == 0)
    return figure, panels[: len(titles)]


def _planner_axis(axes: "Axes", planners: Sequence[str]) -> None:
    """List the planners from top to bottom."""
    axes.grid(axis="x", color=FAINT, linewidth=0.8)
    axes.spines[["left", "bottom"]].set_visible(False)
    axes.tick_params(axis="x", length=0)
    axes.set_ylim(len(planners) - 0.4, -0.6)
    axes.set_yticks(range(len(planners)), planners)
    axes.tick_params(axis="y", labelcolor=INK, labelsize=LABEL_SIZE)


def _svg(figure: "Figure", name: str) -> str:
    """The figure as SVG with identifiers of its own, as references into another, hidden plot would draw
    nothing."""
    text = as_svg(figure)
    own = f"p{hashlib.sha256(name.encode()).hexdigest()[:8]}-"
    for reference in ('id="', "url(#", 'href="#'):
        text = text.replace(reference, reference + own)
    return text


def _stroke(planner: str, planners: Sequence[str]) -> dict[str, Any]:
    ours = planner == "robotdiffuse"
    return {
        "color": color_of(planner, planners),
        "linestyle": line_of(planner),
        "linewidth": 2.4 if ours else 1.35,
        "zorder": 4 if ours else 3,
    }


def _decade_below(time: float) -> float:
    """The power of ten below a time, with a small margin: the start of a logarithmic axis."""
    return float(10 ** np.floor(np.log10(max(time, 2e-4)) - 0.05))


def _time_axis(axes: "Axes", low: float, high: float) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.set_xlim(low, max(high, 2 * low))
    axes.xaxis.set_major_locator(LogLocator(10))
    axes.xaxis.set_major_formatter(
        FuncFormatter(lambda t, _: f"{1e3 * t:g} ms" if t < 0.0999 else f"{t:g} s")
    )
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(axis="x", which="minor", length=1.6)
    axes.grid(axis="x", color=FAINT, linewidth=0.8)


def _names_at_right(axes: "Axes", ends: dict[str, tuple[float, float]], planners: Sequence[str]) -> None:
    """Write names beside the plot in the order of the ends of their lines, moved apart so that they do not
    touch, each with a thin line from the end to the name."""
    transform = axes.transData + axes.transAxes.inverted()
    at = {name: transform.transform(end) for name, end in ends.items()}
    order = sorted(at, key=lambda name: (at[name][1], -planners.index(name)))
    heights = spread_apart(np.array([at[name][1] for name in order]), LABEL_GAP)
    for name, height in zip(order, heights.tolist(), strict=True):
        (x, y), color = at[name], color_of(name, planners)
        axes.plot(
            [x, max(x, 1.0), 1.035],
            [y, y, height],
            transform=axes.transAxes,
            color=color,
            linewidth=0.6,
            alpha=0.45,
            clip_on=False,
            zorder=1,
        )
        axes.plot(
            [1.04, 1.085],
            [height, height],
            transform=axes.transAxes,
            color=color,
            linestyle=line_of(name),
            linewidth=2.2 if name == "robotdiffuse" else 1.4,
            clip_on=False,
        )
        axes.text(
            1.097,
            height,
            name,
            transform=axes.transAxes,
            color=INK,
            fontsize=LABEL_SIZE,
            va="center",
            fontweight="bold" if name == "robotdiffuse" else "normal",
        )
    axes.spines[["bottom"]].set_color(LINE)


def spread_apart(wanted: np.ndarray, gap: float) -> np.ndarray:
    """Ascending heights, at least `gap` apart and within 0.01 to 0.99, as close as possible to the wanted
    ones."""
    blocks: list[list[float]] = []  # sum of the heights that their first would take, count
    for value in wanted:
        blocks.append([value, 1])
        while len(blocks) > 1:
            (a, n), (b, m) = blocks[-2:]
            if a / n + n * gap <= b / m:
                break
            blocks[-2:] = [[a + b - m * n * gap, n + m]]
    heights = np.concatenate(
        [np.clip(total / n, 0.01, 0.99 - (n - 1) * gap) + gap * np.arange(n) for total, n in blocks]
        or [np.zeros(0)]
    )
    for i in range(1, len(heights)):
        heights[i] = max(heights[i], heights[i - 1] + gap)
    heights[-1:] = np.minimum(heights[-1:], 0.99)
    for i in range(len(heights) - 1)[::-1]:
        heights[i] = min(heights[i], heights[i + 1] - gap)
    return heights
