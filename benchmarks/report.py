"""What every benchmark prints first, and how it shows tables."""

from collections.abc import Iterable, Sequence
from datetime import date
from typing import TypeVar

from rich.console import Console
from rich.progress import track

from robotdiffuse.evaluation.machine import about
from robotdiffuse.evaluation.tables import Column, Rows, Table, show

Item = TypeVar("Item")
WIDTH = 120


def header(*packages: str) -> str:
    """Date, processor, load and versions: one line for the head of a report."""
    return f"{date.today()}; {about(packages)}"


def print_table(title: str, columns: Sequence[Column | str], rows: Rows, notes: Sequence[str] = ()) -> None:
    """A table that lines up; all columns but the first to the right."""
    show(Table.of(title, columns, rows, notes), width=WIDTH)


def progress(items: Sequence[Item], title: str) -> Iterable[Item]:
    """The items, with a bar beside the report rather than in it."""
    return track(items, title, transient=True, console=Console(stderr=True))
