"""What every benchmark prints first, and how it shows a table."""

import os
import platform
from datetime import date
from importlib.metadata import version
from pathlib import Path

from rich.console import Console
from rich.table import Table


def header(*packages: str) -> str:
    """Date, processor, load and versions: one line for the head of a report."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = (line.split(": ")[1] for line in lines if line.startswith("model name"))
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    return (
        f"{date.today()}; {next(names, platform.processor())}, {os.cpu_count()} cores, load average "
        f"{os.getloadavg()[0]:.1f} before; Python {platform.python_version()}, {versions}"
    )


def print_table(title: str, columns: list[str], rows: list[list[str]]) -> None:
    """A table that lines up; all columns but the first to the right."""
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 else "right")
    for row in rows:
        table.add_row(*row)
    Console(width=120).print(table)
