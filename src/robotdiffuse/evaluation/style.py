"""The frame and style sheet of pages on data sets and benches, and plots as SVG.

Plots need matplotlib, which is not part of the core install.
"""

import html
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from robotdiffuse.core.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, SOFT, LINE, FAINT = "#222b38", "#6b7684", "#d9dde2", "#eef0f3"
WIDTHS = {4: 4.1, 6: 6.25, 12: 12.7}
"""Width of plots by the number of columns that they span [inch], so that text has one size everywhere."""
STYLE = """
:root { --ink: #222b38; --soft: #6b7684; --line: rgba(34, 43, 56, .09); }
* { box-sizing: border-box; }
body { margin: 0; background: #f2f4f6; color: var(--ink);
  font: 14px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 1320px; margin: 0 auto; padding: 34px 26px 40px; }
h1 { margin: 0; font-size: 27px; font-weight: 680; letter-spacing: -.018em; }
.about { margin: 5px 0 22px; color: var(--soft); }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(136px, 1fr)); gap: 12px;
  margin-bottom: 14px; }
.tile, .card { background: white; border: 1px solid var(--line); border-radius: 14px;
  box-shadow: 0 2px 12px rgba(30, 40, 60, .045); }
.tile { padding: 12px 16px 11px; }
.tile b { display: block; font-size: 23px; font-weight: 640; letter-spacing: -.02em;
  font-variant-numeric: tabular-nums; }
.tile span { color: var(--soft); font-size: 12.5px; }
.cards { display: grid; grid-template-columns: repeat(12, 1fr); gap: 14px; }
.card { padding: 17px 20px 12px; min-width: 0; display: flex; flex-direction: column; }
.card h2 { margin: 0; font-size: 15.5px; font-weight: 640; letter-spacing: -.005em; }
.card p { margin: 2px 0 10px; color: var(--soft); font-size: 12.5px; }
.card svg { display: block; width: 100%; height: auto; margin-top: auto; }
.card svg text { font-family: system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial,
  sans-serif !important; }
.w4 { grid-column: span 4; } .w6 { grid-column: span 6; } .w12 { grid-column: span 12; }
.wide { overflow-x: auto; margin: 2px -20px 0; padding: 0 20px 6px; }
.card .wide svg { min-width: 470px; }
.card.w12 .wide svg { min-width: 880px; }
table { width: 100%; border-collapse: collapse; font-size: 12.8px; font-variant-numeric: tabular-nums; }
th { padding: 5px 8px; border-bottom: 1px solid #ccd2d9; color: var(--soft); font-weight: 500;
  font-size: 12px; line-height: 1.25; text-align: right; vertical-align: bottom; }
td { padding: 3.5px 8px; border-bottom: 1px solid #f0f2f4; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { position: sticky; left: 0; padding-left: 0; background: white;
  text-align: left; }
td:first-child i { display: inline-block; width: 9px; height: 9px; margin-right: 8px; border-radius: 3px; }
tr.ours td { font-weight: 640; }
tbody tr:hover td { background: #f7f8fa; }
td.best { color: #0a7d5e; font-weight: 640; }
td.dim { color: var(--soft); }
.bar { display: inline-block; width: 74px; height: 8px; margin-right: 8px; border-radius: 4px;
  background: #eef0f3; vertical-align: 1px; overflow: hidden; text-align: left; }
.bar b { display: block; height: 100%; border-radius: 4px; }
.bar + span { display: inline-block; min-width: 40px; }
footer { margin-top: 20px; color: var(--soft); font-size: 12px; }
@media (max-width: 900px) { .w4, .w6 { grid-column: span 12; } }
"""


def page(
    name: str,
    about: Sequence[str],
    facts: Sequence[tuple[str, str]],
    content: str,
    own: str = "",
    end: str = "",
) -> str:
    """The HTML of a page.

    about: lines below the name.
    facts: figures and their captions.
    own: further style sheet.
    end: further elements of the body, such as scripts.
    """
    tiles = "".join(
        f'<div class="tile"><b>{html.escape(value)}</b><span>{html.escape(what)}</span></div>'
        for value, what in facts
    )
    lines = (
        '<!doctype html>\n<html lang="en">\n<head><meta charset="utf-8">',
        f"<title>{html.escape(name)}</title>",
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<style>{STYLE}{own}</style></head>\n<body><main>",
        f"<h1>{html.escape(name)}</h1>",
        f'<div class="about">{"<br>".join(html.escape(line) for line in about)}</div>',
        f'<div class="tiles">{tiles}</div>',
        content,
        f"</main>{end}</body></html>\n",
    )
    return "\n".join(lines)


def card(title: str, width: int, text: str, content: str) -> str:
    """A part of a page, as wide as so many of its 12 columns."""
    return f'<section class="card w{width}"><h2>{title}</h2><p>{text}</p>{content}</section>'


@contextmanager
def style() -> Iterator[None]:
    """Apply the style of all plots. Raises InputError if matplotlib is missing."""
    try:
        import matplotlib
    except ImportError:
        raise InputError(
            'the page needs matplotlib, which is not installed: pip install "robotdiffuse[data]"'
        ) from None
    settings: dict[Any, Any] = {
        "svg.fonttype": "none",
        "svg.hashsalt": "robotdiffuse",
        "font.size": 8.0,
        "text.parse_math": False,
        "text.color": INK,
        "axes.edgecolor": LINE,
        "axes.labelcolor": SOFT,
        "axes.labelsize": 8.0,
        "axes.titlesize": 8.5,
        "axes.titlecolor": INK,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.axisbelow": True,
        "xtick.color": LINE,
        "ytick.color": LINE,
        "xtick.labelcolor": SOFT,
        "ytick.labelcolor": SOFT,
        "xtick.labelsize": 7.5,
        "ytick.labelsize": 7.5,
        "xtick.major.size": 3.0,
        "ytick.major.size": 0.0,
        "legend.frameon": False,
        "legend.fontsize": 7.5,
        "legend.handlelength": 0.9,
        "legend.handleheight": 0.9,
        "figure.constrained_layout.use": True,
    }
    with matplotlib.rc_context(settings):
        yield


def make_figure(width: int, height: float) -> "Figure":
    """A figure as wide as so many columns of the page, with this height [inch]."""
    from matplotlib.figure import Figure

    return Figure((WIDTHS[width], height))


def as_svg(figure: "Figure") -> str:
    """The figure as an SVG element, larger where a legend or a name needs it."""
    from matplotlib.transforms import Bbox

    buffer = io.StringIO()
    figure.draw_without_rendering()  # places everything
    bounds = Bbox.union([figure.bbox_inches, figure.get_tightbbox()])
    about = {"Date": None, "Creator": None}
    figure.savefig(buffer, format="svg", transparent=True, dpi=220, metadata=about, bbox_inches=bounds)
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def percent_axis(axes: "Axes") -> None:
    """Format the value axis in per cent."""
    from matplotlib.ticker import FuncFormatter

    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g} %"))
    axes.grid(axis="y", color=FAINT, linewidth=0.8)
    axes.spines[["left"]].set_visible(False)
