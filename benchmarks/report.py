"""What every benchmark prints first, and how it shows a table."""

import os
import platform
from collections.abc import Iterable, Sequence
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

import numpy as np
from rich.console import Console
from rich.progress import track

from robotdiffuse.evaluation.tables import Column, Rows, Table, show

Item = TypeVar("Item")


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


def print_table(title: str, columns: Sequence[Column | str], rows: Rows, notes: Sequence[str] = ()) -> None:
    """A table that lines up; all columns but the first to the right."""
    show(Table.of(title, columns, rows, notes), width=120)


def progress(items: Sequence[Item], title: str) -> Iterable[Item]:
    """The items, with a bar beside the report rather than in it."""
    return track(items, title, transient=True, console=Console(stderr=True))


def share(passed: Sequence[bool]) -> str:
    """With the 95 % interval of Wilson."""
    p, low, high = wilson(passed)
    return f"{100 * p:.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def wilson(passed: Sequence[bool]) -> tuple[float, float, float]:
    """A share, and its 95 % interval by E. B. Wilson 1927."""
    n, p, z = len(passed), float(np.mean(passed)), 1.96
    middle, half = p + z**2 / (2 * n), z * (p * (1 - p) / n + z**2 / (4 * n**2)) ** 0.5
    low, high = ((middle + side * half) / (1 + z**2 / n) for side in (-1, 1))
    return p, max(low, 0.0), min(high, 1.0)
