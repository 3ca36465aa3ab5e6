"""The paper's ComScore, and the Table 1 that it prints.

By the paper's own formulas, the figures of its Table 1 give these scores instead of the printed ones:

| row          | success | collision | length | time  | ComScore | printed | difference |
|--------------|---------|-----------|--------|-------|----------|---------|------------|
| RRT*         | 0       | 1         | 0.794  | 0     | 0.4486   | 0.4175  | +0.031     |
| MPNet        | 0.794   | 0         | 0      | 0     | 0.1986   | 0.19    | +0.009     |
| MPiNets      | 1       | 0.189     | 0.472  | 0     | 0.4152   | 0.4175  | -0.002     |
| MPD          | 0.454   | 0.133     | 1      | 1     | 0.6467   | 0.645   | +0.002     |
| RobotDiffuse | 0.823   | 0.315     | 0.983  | 0.990 | 0.7774   | 0.765   | +0.012     |

The order of the rows is the printed one, except for RRT* and MPiNets, which are equal in print. The cause of
the differences is unknown. These explanations were tried:

- Rounding: four times each printed score has no more than two decimals (1.67, 0.76, 1.67, 2.58, 3.06), so
  normalised values were probably first rounded to two. Then MPD is 0.645 exactly; MPiNets is 0.4150, and
  MPNet 0.1975, of which 0.19 is the first two decimals; RRT* (0.4475) and RobotDiffuse (0.7750) are one
  digit away from print. So slips of the pen in three rows, and one score cut short, would explain it all.
- Columns normalised otherwise (shares of the maximum, logarithms, ranks; all combinations): the largest
  difference stays at 0.025 or more.
- Other weights: the best that sum to 1 leave 0.011. (0.24, 0.19, 0.29, 0.22), which sum to 0.94, leave 0.002;
  four free numbers for five scores prove little, and the paper says that its weights are equal.
- Other figures than the printed ones, as of an earlier state of the table: no change of a single cell leaves
  less than 0.012. RRT*'s length 15.6 in place of 15.037, and MPiNets' success 88.0 in place of 87.4, leave
  0.004. At equal weights RRT*'s score can only mean a normalised length of 0.67 for it: it is worst in
  success and time and best in collision.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray


@dataclass(frozen=True)
class Indicators:
    """The four figures of a planner that ComScore weighs; NaN if unknown."""

    success: float
    """Share of problems solved, in any unit that all rows share (the paper: per cent)."""
    collision: float
    """Share of motions in collision."""
    length: float
    """Path length; in the paper that of all links, without a unit."""
    time: float
    """Time per problem [s]."""


HIGHER_IS_BETTER = np.array([True, False, False, False])
"""For the fields of Indicators, in their order."""


def normalized(rows: Sequence[Indicators]) -> Float[ndarray, "n 4"]:
    """V_norm of every row and indicator: 1 for the best of these rows, 0 for the worst, linear in between.

    If all rows have the same indicator, where the paper's formulas give 0 / 0, it is 1 for all: each row is
    as good as the best. An unknown indicator (NaN, such as the length if nothing was solved) is 0, as for the
    worst.
    """
    values = np.array([astuple(row) for row in rows], dtype=np.float64).reshape(len(rows), 4)
    if not len(rows):
        return values
    gains = np.where(HIGHER_IS_BETTER, values, -values)
    worst, best = np.fmin.reduce(gains, axis=0), np.fmax.reduce(gains, axis=0)
    span = best - worst
    with np.errstate(invalid="ignore"):
        share = np.where(span > 0, (gains - worst) / np.where(span > 0, span, 1.0), 1.0)
    return np.where(np.isnan(values), 0.0, share)


def comscores(rows: Sequence[Indicators]) -> Float[ndarray, "n"]:
    """The ComScore of each row, in [0, 1], with the paper's equal weights. It depends on which rows are
    compared."""
    return normalized(rows).mean(axis=1)


@dataclass(frozen=True)
class PaperRow:
    """A row of the paper's Table 1, as printed."""

    name: str
    indicators: Indicators
    """Success and collision in per cent, time in seconds."""
    comscore: float


PAPER_TABLE_1 = (
    PaperRow("RRT*", Indicators(73.3, 0.0, 15.037, 600.0), 0.4175),
    PaperRow("MPNet", Indicators(84.5, 14.3, 18.492, 600.0), 0.19),
    PaperRow("MPiNets", Indicators(87.4, 11.6, 16.438, 600.0), 0.4175),
    PaperRow("MPD", Indicators(79.7, 12.4, 14.142, 9.0), 0.645),
    PaperRow("RobotDiffuse", Indicators(84.9, 9.8, 14.218, 15.0), 0.765),
)
