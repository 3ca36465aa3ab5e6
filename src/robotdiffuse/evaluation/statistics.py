"""Confidence intervals, paired comparisons of two planners on the same problems, and the paper's ComScore."""

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Values

RESAMPLES = 2000
TIE = 1e-6
"""Lengths below this [rad] or [m] count as this; logarithms of ratios within this of 0 are ties."""


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """The 95 % interval of a share by its score test (E. B. Wilson 1927); (0, 1) without trials.

    Unlike the interval by the standard error it stays within 0 and 1 and has a width at shares of 0 and 1.
    """
    from scipy.stats import binomtest

    if n == 0:
        return 0.0, 1.0
    interval = binomtest(successes, n).proportion_ci(0.95, "wilson")
    return float(interval.low), float(interval.high)


def bootstrap_interval(values: Values, statistic: Callable[..., ndarray] = np.mean) -> tuple[float, float]:
    """The 95 % interval of a statistic of independent values, by resampling them (B. Efron 1979).

    statistic: as np.mean or np.median, with an argument `axis`.
    """
    picked = np.random.default_rng(0).integers(0, len(values), (RESAMPLES, len(values)))
    low, high = np.percentile(statistic(values[picked], axis=1), (2.5, 97.5))
    return float(low), float(high)


@dataclass(frozen=True)
class Paired:
    """Planner A against planner B on the same problems."""

    a_only: int
    """Number of problems that only A solves."""
    b_only: int
    both: int
    neither: int
    p_success: float
    """Probability of a split of `a_only` and `b_only` this uneven or more if both planners were equally good:
    exact test of Q. McNemar 1947, two-sided; 1.0 if they solve the same problems."""
    ratio: float | None
    """Median of the ratio of A's length to B's over the problems that both solve; None if there are none."""
    ratio_interval: tuple[float, float] | None
    """The 95 % interval of the ratio, by resampling the problems."""
    p_length: float
    """Probability that the logarithms of these ratios lie this much to one side or more if neither planner's
    motions were longer: signed ranks (F. Wilcoxon 1945), two-sided, without ties; 1.0 if all are ties."""


def compare(a: Values, b: Values) -> Paired:
    """Compare two planners by the lengths of their motions [rad] or [m] on the same problems in the same
    order; NaN without a solution.

    The tests assume that problems are independent: merge several seeds of one problem into one row first, or
    the p-values are too small. Raises InputError if the arrays differ in length.
    """
    from scipy.stats import binomtest, wilcoxon

    if len(a) != len(b):
        raise InputError(f"a has {len(a)} problems, b {len(b)}; they must be the same problems")
    solved_a = ~np.isnan(a)
    solved_b = ~np.isnan(b)
    both = solved_a & solved_b
    a_only = int((solved_a & ~solved_b).sum())
    b_only = int((solved_b & ~solved_a).sum())
    p_success = float(binomtest(a_only, a_only + b_only).pvalue) if a_only + b_only else 1.0
    ratio = None
    ratio_interval = None
    p_length = 1.0
    if both.any():
        logs = np.log(np.maximum(a[both], TIE)) - np.log(np.maximum(b[both], TIE))
        logs[np.abs(logs) < TIE] = 0.0
        ratios = np.exp(logs)
        ratio = float(np.median(ratios))
        ratio_interval = bootstrap_interval(ratios, np.median)
        if logs.any():
            p_length = float(wilcoxon(logs).pvalue)  # pyright: ignore[reportAttributeAccessIssue]
    neither_solved = int((~solved_a & ~solved_b).sum())
    return Paired(a_only, b_only, int(both.sum()), neither_solved, p_success, ratio, ratio_interval, p_length)


# The paper's ComScore


@dataclass(frozen=True)
class Indicators:
    """The four figures of a planner that ComScore weighs; NaN if unknown."""

    success: float
    """Share of problems solved, in any unit that all rows share (the paper: per cent)."""
    collision: float
    """Share of motions in collision."""
    length: float
    """Path length; in the paper the sum over all links, without a unit."""
    time: float
    """Time per problem [s]."""


HIGHER_IS_BETTER = np.array([True, False, False, False])
"""For each field of Indicators, whether higher values are better."""


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
    minimum = np.fmin.reduce(gains, axis=0)
    best = np.fmax.reduce(gains, axis=0)
    span = best - minimum
    with np.errstate(invalid="ignore"):
        share = np.where(span > 0, (gains - minimum) / np.where(span > 0, span, 1.0), 1.0)
    return np.where(np.isnan(values), 0.0, share)


def comscores(rows: Sequence[Indicators]) -> Values:
    """The ComScore of each row, in [0, 1], with the paper's equal weights. It depends on which rows are
    compared."""
    return normalized(rows).mean(axis=1)
