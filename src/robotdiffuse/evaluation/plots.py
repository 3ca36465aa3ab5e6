"""Plots of reports, as SVG. They need matplotlib, which is not part of the core install."""

import io
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray

from robotdiffuse.core.errors import missing_package

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = (
    "#1d4e9e #0c9b74 #d9622b #c23f78 #d99a17 #8b55b8 #3f8ae0 #7a9e1c #41597a #e08a5b #1b8fa8 #b79bd6 #7d4f5d "
    "#97a3b4 #58b9c7 #c8443c"
)
SETTINGS: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "robotdiffuse",
    "savefig.bbox": "tight",
    "font.size": 8.0,
    "text.parse_math": False,
    "axes.grid": True,
    "axes.prop_cycle": f"cycler(color={COLORS.split()})",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": "#eef0f3",
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}
PANEL_HEIGHT = 2.4
"""Height of histograms [inch]."""

Histograms = dict[str, tuple[ndarray, Mapping[str, ndarray]]]
"""For each panel by its label, the edges of bins and the values by name."""


def draw(fill: "Callable[[Figure], object]", width: float = 6.25, height: float = 3.7) -> str:
    """The SVG element of a figure of about this size [inch] that `fill` draws on. Raises InputError if
    matplotlib is missing."""
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError:
        raise missing_package("matplotlib", "data") from None
    with matplotlib.rc_context(SETTINGS):
        figure = Figure((width, height))
        fill(figure)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def histograms(panels: Histograms, across: int) -> str:
    """Panels in rows of `across`, each with a line for each name, in percent of its values; outliers are in
    the outer bins. The names of the first panel are in the legend."""
    down = -(-len(panels) // across)

    def fill(figure: "Figure") -> None:
        grid = figure.subplots(down, across, squeeze=False)
        for axes in grid.flat[len(panels) :]:
            axes.set_axis_off()
        for axes, (label, (bins, parts)) in zip(grid.flat, panels.items(), strict=False):
            for name, values in parts.items():
                weights = np.full(len(values), 1 / max(len(values), 1))
                inside = values.clip(bins[0], bins[-1])
                axes.hist(inside, bins, weights=weights, histtype="step", label=name)
            axes.set_xlabel(label)
            axes.yaxis.set_major_formatter("{x:.0%}")
        figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=5)

    return draw(fill, 12.7, PANEL_HEIGHT * down)
