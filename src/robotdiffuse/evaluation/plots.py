"""Plots of reports, as SVG. They need matplotlib, which is not part of the core install."""

import io
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK = "#222b38"
FAINT = "#eef0f3"
HALF = 6.25
FULL = 12.7
"""Widths of plots [inch]."""
COLORS = [
    *("#1d4e9e", "#0c9b74", "#d9622b", "#c23f78", "#d99a17", "#8b55b8", "#3f8ae0", "#7a9e1c"),
    *("#41597a", "#e08a5b", "#1b8fa8", "#b79bd6", "#7d4f5d", "#97a3b4", "#58b9c7", "#c8443c"),
]
SETTINGS: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "robotdiffuse",
    "font.size": 8.0,
    "text.parse_math": False,
    "text.color": INK,
    "axes.edgecolor": "#d9dde2",
    "axes.grid": True,
    "axes.prop_cycle": f"cycler(color={COLORS})",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": FAINT,
    "legend.frameon": False,
    "legend.handlelength": 2.0,
    "figure.constrained_layout.use": True,
}
LEGEND_ABOVE: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 0.98), "ncols": 5}
LEGEND_BESIDE: dict[str, Any] = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)}
"""Places of legends."""

Interval = tuple[float, float, float]
"""A value with the ends of its interval."""


def draw(fill: "Callable[[Figure], None]", width: float, height: float) -> str:
    """The SVG element of a figure of this size [inch] that `fill` draws on, larger where a legend or a name
    needs it. Raises InputError if matplotlib is missing."""
    try:
        import matplotlib
        from matplotlib.figure import Figure
        from matplotlib.transforms import Bbox
    except ImportError:
        raise InputError(
            'the page needs matplotlib, which is not installed: pip install "robotdiffuse[data]"'
        ) from None
    with matplotlib.rc_context(SETTINGS):
        figure = Figure((width, height))
        fill(figure)
        figure.draw_without_rendering()  # places everything
        bounds = Bbox.union([figure.bbox_inches, figure.get_tightbbox()])
        buffer = io.StringIO()
        about = {"Date": None, "Creator": None}
        figure.savefig(buffer, format="svg", transparent=True, dpi=220, metadata=about, bbox_inches=bounds)
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def percent_axis(axes: "Axes") -> None:
    """Format the value axis in per cent."""
    axes.yaxis.set_major_formatter("{x:g} %")


def time_axis(axes: "Axes", low: float, high: float) -> None:
    """Make the x axis one of times on a logarithmic scale, from the power of ten below `low` [s]."""
    axes.set_xscale("log")
    axes.set_xlim(float(10 ** np.floor(np.log10(max(low, 2e-4)) - 0.05)), max(high, 2 * low))
    axes.xaxis.set_major_formatter(lambda t, _: f"{1e3 * t:g} ms" if t < 0.0999 else f"{t:g} s")


def panels(figure: "Figure", titles: Sequence[str], across: int) -> "list[Axes]":
    """Axes with titles, in rows of `across`."""
    down = -(-len(titles) // across)
    axes = figure.subplots(down, across, squeeze=False).reshape(-1).tolist()
    for panel, title in zip(axes, titles, strict=False):
        panel.set_title(title, loc="left")
    for panel in axes[len(titles) :]:
        panel.set_axis_off()
    return axes[: len(titles)]


def intervals(
    names: Sequence[str], values: Mapping[str, Mapping[str, Interval]], colors: Mapping[str, str]
) -> str:
    """A panel for each key of `values`: a line for each name, from top to bottom, with a point and an
    interval."""

    def fill(figure: "Figure") -> None:
        drawn = zip(panels(figure, list(values), 4), values.values(), strict=True)
        for i, (panel, of) in enumerate(drawn):
            for y, name in enumerate(names):
                value, low, high = of.get(name, (np.nan,) * 3)
                panel.plot([low, high], [y, y], color=colors[name])
                panel.plot(value, y, "o", color=colors[name], markersize=4)
            panel.set_yticks(range(len(names)), names)
            panel.set_ylim(len(names) - 0.4, -0.6)
            panel.tick_params(labelleft=i % 4 == 0)

    return draw(fill, FULL, (0.165 * len(names) + 0.5) * -(-len(values) // 4) + 0.1)


def stacked_bars(axes: "Axes", names: Sequence[str], shares: Mapping[str, Sequence[float]]) -> None:
    """Draw a bar for each name, divided into shares [%] by their labels."""
    left = np.zeros(len(names))
    for label, part in shares.items():
        bars = axes.barh(names, part, 0.66, left=left, label=label)
        axes.bar_label(bars, [f"{x:.0f}" if x >= 5 else "" for x in part], label_type="center", fontsize=7)
        left += part
    axes.invert_yaxis()
    axes.set_xlabel("[%]")
    if shares:
        axes.legend(**LEGEND_ABOVE)


def histogram(
    axes: "Axes", values: Mapping[str, Float[ndarray, "_"]], bins: Float[ndarray, "b"], label: str
) -> None:
    """Draw a histogram stacked by name, in percent of all values; outliers are in the outer bins."""
    parts = [part.clip(bins[0], bins[-1]) for part in values.values()]
    total = max(1, sum(map(len, parts)))
    weights = [np.full(len(part), 100 / total) for part in parts]
    axes.hist(parts, bins.tolist(), weights=weights, stacked=True, label=list(values))
    axes.set_xlim(bins[0], bins[-1])
    axes.set_xlabel(label)
    percent_axis(axes)
    if len(parts) > 1:
        axes.legend(**LEGEND_ABOVE)
