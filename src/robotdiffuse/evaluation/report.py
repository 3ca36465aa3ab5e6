"""A report: texts, tables and plots, written as Markdown or as an HTML page that works offline.

Plots are SVG and need matplotlib. HTML pages need markdown-it-py. Neither is part of the core install.
"""

import html
import io
import platform
import re
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from robotdiffuse.core.errors import needs
from robotdiffuse.core.files import write_atomically
from robotdiffuse.core.tables import Figure, Table, markdown, plain

STYLE = """
body { max-width: 1320px; margin: 0 auto; padding: 24px; color: #222b38; background: white;
  font: 14px/1.45 system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
nav { position: sticky; top: 0; padding: 8px 0; background: white; }
nav a { margin-right: 16px; }
h2 { margin-top: 36px; padding-top: 12px; border-top: 1px solid #ccd2d9; }
table { display: block; overflow-x: auto; border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: 4px 9px; border-bottom: 1px solid #eef0f3; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
strong { color: #0a7d5e; }
svg { max-width: 100%; height: auto; }
"""


class Report:
    """A report as blocks of Markdown, and plots."""

    def __init__(self, title: str) -> None:
        self.title = title
        self.blocks = [f"# {plain(title)}"]
        self.plots = dict[str, str]()
        """SVG by file name."""

    def add(self, *blocks: str) -> None:
        """Add blocks of Markdown."""
        self.blocks += blocks

    def items(self, texts: Iterable[str]) -> None:
        """Add a list."""
        self.add("\n".join(f"- {text}" for text in texts))

    def table(self, table: Table, level: int = 3) -> None:
        """Add a table, with its title as a heading of this level."""
        if table.title:
            self.add(f"{level * '#'} {plain(table.title)}")
        self.add("\n".join(markdown(table)))

    def plot(self, file: str, caption: str, svg: str) -> None:
        """Add a plot. `write` writes it to a file with this name in the folder of the report."""
        self.plots[file] = svg
        self.picture(file, caption)

    def picture(self, file: str, caption: str) -> None:
        """Add a picture: a file in the folder of the report."""
        self.add(plain(caption), f"![{Path(file).stem}]({file})")

    @property
    def markdown(self) -> str:
        return "\n\n".join(self.blocks) + "\n"

    @property
    def page(self) -> str:
        """The report as HTML, with the plots in the page and links to the sections."""
        with needs("markdown-it-py", "data"):
            from markdown_it import MarkdownIt

        body = MarkdownIt().enable("table").render(self.markdown)
        for file, svg in self.plots.items():
            # make the ids unique: plots use the same ids, and a plot's reference would find the id of an
            # earlier plot, which draws nothing
            svg = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{Path(file).stem}-", svg)
            body = re.sub(rf'<img src="{re.escape(file)}"[^>]*>', lambda _, svg=svg: svg, body)
        titles = re.findall("<h2>(.*?)</h2>", body)
        for i, title in enumerate(titles):
            body = body.replace(f"<h2>{title}</h2>", f'<h2 id="part-{i}">{title}</h2>', 1)
        links = "".join(f'<a href="#part-{i}">{title}</a>' for i, title in enumerate(titles))
        head = (
            '<!doctype html>\n<html lang="en">\n<head><meta charset="utf-8">'
            f"<title>{html.escape(self.title)}</title>"
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<style>{STYLE}</style></head>\n<body><nav>{links}</nav>\n"
        )
        return f"{head}{body}</body></html>\n"

    def write(self, file: Path) -> None:
        """Write the report as Markdown, and the plots as files in the same folder."""
        write_atomically(file, self.markdown, make_folder=True)
        for name, svg in self.plots.items():
            # dark text needs a white background, also in a viewer with a dark background
            write_atomically(file.with_name(name), svg.replace("<svg ", '<svg style="background: white" ', 1))


def share_cell(value: float, ends: tuple[float, float]) -> Figure:
    """A cell with a fraction and its interval, in percent."""
    low, high = ends
    return Figure(f"{100 * value:.1f} ({100 * low:.1f} to {100 * high:.1f})", value)


def processor() -> str:
    """The name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = (line.split(": ")[1] for line in lines if line.startswith("model name"))
    return next(names, platform.processor())


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Versions of packages; `none` for one that is not installed."""
    return {
        name: next((package.version for package in distributions(name=name)), "none") for name in packages
    }


# Plots

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
"""For each panel, by its label: the edges of the bins, and the values of each line by name."""


def draw_plot(fill: Callable[[Any], object], width: float = 6.25, height: float = 3.7) -> str:
    """Lets `fill` draw on matplotlib's figure of about this size [inch], and returns its SVG element. Raises
    InputError if matplotlib is not installed."""
    with needs("matplotlib", "data"):
        import matplotlib
        from matplotlib.figure import Figure as Plot
    with matplotlib.rc_context(SETTINGS):
        figure = Plot((width, height))
        fill(figure)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def histograms(panels: Histograms, across: int) -> str:
    """Draws histograms as panels, `across` in a row; returns SVG. A panel has a line for each name, in
    percent of the values of that name. Outliers are counted in the outer bins. The legend has the names of
    the first panel."""
    down = -(-len(panels) // across)

    def fill(figure: Any) -> None:
        grid = figure.subplots(down, across, squeeze=False)
        for axes in grid.flat[len(panels) :]:
            axes.set_axis_off()
        for axes, (label, (bins, parts)) in zip(grid.flat, panels.items(), strict=False):
            for name, values in parts.items():
                weights = np.full(len(values), 100 / max(len(values), 1))
                axes.hist(values.clip(bins[0], bins[-1]), bins, weights=weights, histtype="step", label=name)
            axes.set_xlabel(label)
            axes.yaxis.set_major_formatter("{x:g}%")
        figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=5)

    return draw_plot(fill, 12.7, PANEL_HEIGHT * down)
