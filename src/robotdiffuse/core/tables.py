"""Tables for the terminal and Markdown."""

import re
import shutil
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from rich.table import Table as RichTable

NO_VALUE = "–"
WIDTH = 150
"""Width of tables without a terminal [characters]."""
MIN_TEXT_WIDTH = 20
"""Minimum width of the texts of `Table.pairs` in narrow terminals [characters]."""


@dataclass(frozen=True)
class Column:
    heading: str
    unit: str = ""
    format: str = ""
    """Format of numbers, such as `.2f`; empty: integers in full, others with six significant digits."""
    better: Literal["more", "less", ""] = ""
    """Whether the largest or the smallest value is the best, which is marked; "": no value is marked."""
    left: bool = False
    """Whether texts are aligned left. Texts of the first column always are."""
    scale: float = 1.0
    """Factor from a cell's number to the shown number, such as 1000 from s to ms."""

    @property
    def title(self) -> str:
        return f"{self.heading} {self.unit}".strip()


class Figure(NamedTuple):
    """A text to show, and the number by which it is compared with other figures of its column."""

    text: str
    value: float

    def __str__(self) -> str:
        return self.text


Cell = str | int | float | Figure | None
Rows = Sequence[Sequence[Cell]]


@dataclass(frozen=True)
class Table:
    """Rows of texts and numbers; the first column holds the names of the rows."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...] = ()
    """Lines below the table."""

    @classmethod
    def of(
        cls, title: str, columns: Sequence[Column | str], rows: Rows, notes: Sequence[str] = ()
    ) -> "Table":
        """Make a table; a column can be given by its heading."""
        of_columns = (Column(column) if isinstance(column, str) else column for column in columns)
        return cls(title, tuple(of_columns), tuple(map(tuple, rows)), tuple(notes))

    @classmethod
    def pairs(cls, title: str, rows: Sequence[tuple[str, str]]) -> "Table":
        """A table of names and texts without headings."""
        return cls.of(title, ("", Column("", left=True)), rows)

    @property
    def headed(self) -> bool:
        return any(column.title for column in self.columns)

    @property
    def texts(self) -> list[list[str]]:
        """All cells as texts."""
        return [
            [_text(cell, column) for cell, column in zip(row, self.columns, strict=True)] for row in self.rows
        ]

    @property
    def best(self) -> set[tuple[int, int]]:
        """Row and column of each best figure. Figures with the same text are equally good. If more than half
        of the rows have the best figure of a column, it is not marked."""
        places = set[tuple[int, int]]()
        for j, column in enumerate(self.columns):
            values = {i: _value(row[j]) for i, row in enumerate(self.rows)}
            numbers = {i: value for i, value in values.items() if value == value}
            if column.better and numbers:
                best = (max if column.better == "more" else min)(numbers.values())
                texts = {_text(self.rows[i][j], column) for i, value in numbers.items() if value == best}
                winners = [i for i in numbers if _text(self.rows[i][j], column) in texts]
                places |= {(i, j) for i in winners if 2 * len(winners) <= len(self.rows)}
        return places

    def at_left(self, j: int) -> bool:
        return j == 0 or self.columns[j].left


def _value(cell: Cell) -> float:
    """The number of a cell; NaN for a text."""
    if isinstance(cell, Figure):
        return cell.value
    return float("nan") if cell is None or isinstance(cell, str) else float(cell)


def _text(cell: Cell, column: Column) -> str:
    if isinstance(cell, str | Figure):
        return str(cell)
    if cell is None or cell != cell:
        return NO_VALUE
    plain = isinstance(cell, int) and column.scale == 1 and not column.format
    text = f"{cell:,}" if plain else format(column.scale * cell, column.format or "g")
    # a number that is shown as zero has no minus sign
    return text.replace("-", "−") if text.strip("-0.") else text.removeprefix("-")


def terminal(table: Table) -> "RichTable":
    """The table for rich's console."""
    from rich.markup import escape
    from rich.table import Table as RichTable

    rich_table = RichTable(
        title=escape(table.title) or None,
        title_justify="left",
        caption=escape("\n".join(table.notes)) or None,
        caption_justify="left",
        show_header=table.headed,
        box=None,
        pad_edge=False,
        padding=(0, 1),
    )
    for j, column in enumerate(table.columns):
        rich_table.add_column(escape(column.title), justify="left" if table.at_left(j) else "right")
    best = table.best
    for i, texts in enumerate(table.texts):
        marked = (f"[bold]{escape(t)}[/bold]" if (i, j) in best else escape(t) for j, t in enumerate(texts))
        rich_table.add_row(*marked)
    return rich_table


def show(*tables: Table, width: int | None = None) -> None:
    """Print tables as wide as the terminal, or as WIDTH without one."""
    # Tables of pairs are printed without rich: importing it takes longer than planning a motion.
    if all(len(table.columns) == 2 and not table.headed for table in tables):
        columns = width or (shutil.get_terminal_size().columns if sys.stdout.isatty() else WIDTH)
        print("\n\n".join("\n".join(pair_lines(table, columns)) for table in tables))
        return
    from rich.console import Console

    console = Console(width=width or (None if sys.stdout.isatty() else WIDTH))
    for i, table in enumerate(tables):
        console.print(*([""] if i else []), terminal(table), sep="\n")


def pair_lines(table: Table, width: int) -> list[str]:
    """Lines of a table of pairs with its title. Rows fit into `width` characters, but texts get at least
    MIN_TEXT_WIDTH."""
    margin = max((len(name) for name, _ in table.texts), default=0) + 2
    lines = [table.title] if table.title else []
    for name, text in table.texts:
        parts = [
            part
            for line in text.splitlines() or [""]
            for part in textwrap.wrap(line, max(width - margin, MIN_TEXT_WIDTH), break_on_hyphens=False)
            or [""]
        ]
        lines += [
            f"{start:<{margin}}{part}".rstrip() for start, part in zip_longest([name], parts, fillvalue="")
        ]
    return [*lines, *table.notes]


def markdown(table: Table) -> list[str]:
    """Lines of Markdown, without the title."""
    best = table.best
    texts = [
        [f"**{plain(text)}**" if (i, j) in best else plain(text) for j, text in enumerate(row)]
        for i, row in enumerate(table.texts)
    ]
    headings = [plain(column.title) for column in table.columns]
    widths = [max(3, *(len(row[j]) for row in (headings, *texts))) for j in range(len(headings))]

    def line(cells: Sequence[str]) -> str:
        padded = (
            cell.ljust(width) if table.at_left(j) else cell.rjust(width)
            for j, (cell, width) in enumerate(zip(cells, widths, strict=True))
        )
        return f"| {' | '.join(padded)} |"

    rule = "|".join(
        "-" * (width + 2) if table.at_left(j) else "-" * (width + 1) + ":" for j, width in enumerate(widths)
    )
    notes = [text for note in table.notes for text in ("", plain(note))]
    return [line(headings), f"|{rule}|", *(line(row) for row in texts), *notes]


def plain(text: str) -> str:
    """The text with \\, |, *, <, backticks and underscores escaped, except underscores within a word."""
    return re.sub(r"[\\|*<`]|(?<!\w)_|_(?!\w)", r"\\\g<0>", text)
