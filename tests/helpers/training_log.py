"""The log of a training."""

import csv
from pathlib import Path


def read_log(folder: Path) -> list[dict[str, str]]:
    """The rows of log.csv."""
    with open(folder / "log.csv") as file:
        return list(csv.DictReader(file))
