"""Tables of methods on the same cases: a row for each method, a column for each figure."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from robotdiffuse.evaluation.records import Record
from robotdiffuse.evaluation.statistics import wilson_interval
from robotdiffuse.evaluation.tables import Cell, Column, Figure, Table


class Summary(NamedTuple):
    """A column, and its figure of some records."""

    column: Column
    of: Callable[[Sequence[Record]], Cell]


def _solved(records: Sequence[Record]) -> Cell:
    return share([record.solved for record in records])


def share(passed: Sequence[bool]) -> Cell:
    """A share in per cent with its 95 % interval."""
    low, high = wilson_interval(int(np.sum(passed)), len(passed))
    text = f"{100 * np.mean(passed):.1f} % ({100 * low:.1f} to {100 * high:.1f})"
    return Figure(text, float(np.mean(passed)))


def half_width(values: Sequence[float]) -> float:
    """Half the width of the 95 % interval of a mean."""
    return 1.96 * float(np.std(values)) / len(values) ** 0.5


def _single(records: Sequence[Record]) -> Cell:
    shares = [record.passed or 0.0 for record in records]
    return Figure(f"{100 * np.mean(shares):.1f} ± {100 * half_width(shares):.1f} %", float(np.mean(shares)))


def _ratio(records: Sequence[Record]) -> Cell:
    ratios = [r.joint_length / r.reference for r in records if r.joint_length is not None and r.reference]
    return float(np.mean(ratios)) if ratios else None


def _cpu(records: Sequence[Record]) -> Cell:
    seconds = [record.cpu for record in records if record.cpu is not None]
    median, most = (1e3 * np.percentile(seconds, (50, 95))).tolist()
    return Figure(f"{median:.1f} / {most:.1f}", median)


SINGLE = Summary(Column("single", better="more"), _single)
"""Share of the samples that pass the validator."""
BEST = Summary(Column("best", better="more"), _solved)
"""Share of problems with such a sample."""
SOLVED = Summary(Column("solved", better="more"), _solved)
LENGTH = Summary(Column("length*", "", ".3f", "less"), _ratio)
"""Mean ratio to the cases' reference lengths."""
CPU = Summary(Column("CPU ms median / p95", better="less"), _cpu)


def summary(title: str, of: Mapping[str, Sequence[Record]], figures: Sequence[Summary]) -> Table:
    """The table of each method's records."""
    rows = [(name, *(figure.of(records) for figure in figures)) for name, records in of.items()]
    return Table.of(title, [Column(""), *(figure.column for figure in figures)], rows)
