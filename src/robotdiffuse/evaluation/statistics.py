"""Confidence intervals, paired comparisons of two planners on the same problems, and the paper's ComScore."""

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Values

RESAMPLES = 2000
"""Number of resamples of a bootstrap interval."""
TIE = 1e-6
"""Smaller lengths are replaced by this value [rad] or [m]; also, two lengths are tied if the logarithm of
their ratio is closer to 0 than this."""


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """The 95 % interval of a proportion by the score test (E. B. Wilson 1927); (0, 1) for n = 0.

    Unlike the interval by the standard error, it stays within 0 and 1, and its width is not 0 for proportions
    of 0 and 1.
    """
    from scipy.stats import binomtest

    if n == 0:
        return 0.0, 1.0
    interval = binomtest(successes, n).proportion_ci(0.95, "wilson")
    return float(interval.low), float(interval.high)


def bootstrap_interval(values: Values, statistic: Callable[..., ndarray] = np.mean) -> tuple[float, float]:
    """The 95 % bootstrap interval of a statistic of independent values (B. Efron 1979).

    `statistic` is a function with an argument `axis`, such as np.mean or np.median.
    """
    picked = np.random.default_rng(0).integers(0, len(values), (RESAMPLES, len(values)))
    low, high = np.percentile(statistic(values[picked], axis=1), (2.5, 97.5))
    return float(low), float(high)


@dataclass(frozen=True)
class Paired:
    """Comparison of planner A with planner B on the same problems."""

    a_only: int
    """Number of problems that only A solves."""
    b_only: int
    """Number of problems that only B solves."""
    both: int
    neither: int
    p_success: float
    """p-value of the hypothesis that both planners solve equally many problems: the exact two-sided test of
    Q. McNemar (1947) on `a_only` and `b_only`; 1.0 if both planners solve the same problems."""
    ratio: float | None
    """Median ratio of A's length to B's length, over the problems that both solve; None if there are no such
    problems."""
    ratio_interval: tuple[float, float] | None
    """The 95 % bootstrap interval of the ratio, by resampling the problems."""
    p_length: float
    """p-value of the hypothesis that neither planner's motions are longer: the two-sided signed-rank test of
    F. Wilcoxon (1945) on the logarithms of the ratios, without ties; 1.0 if all lengths are tied."""


def compare(a: Values, b: Values) -> Paired:
    """Compare two planners by the lengths of their motions [rad] or [m] on the same problems in the same
    order. A length is NaN if the planner does not solve the problem.

    The tests assume that the values are independent: merge several seeds of one problem into one value first,
    or the p-values are too small. Raises InputError if the arrays differ in length.
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
    """The four figures of a planner from which ComScore is computed; NaN if unknown."""

    success: float
    """Share of solved problems, in the same unit in all rows (in the paper: percent)."""
    collision: float
    """Share of motions in collision, in the same unit in all rows."""
    length: float
    """Path length; in the paper the sum over all links, without a unit."""
    time: float
    """Time per problem [s]."""


HIGHER_IS_BETTER = np.array([True, False, False, False])
"""Whether higher values are better, for each field of Indicators."""


def normalized(rows: Sequence[Indicators]) -> Float[ndarray, "n 4"]:
    """The paper's V_norm of every row and indicator: 1 for the best row, 0 for the worst, linear in between.

    If an indicator is equal in all rows, the paper's formula gives 0 / 0; here all rows get 1, since each is
    as good as the best. An unknown indicator (NaN, such as the length if no problem was solved) gets 0, like
    the worst row.
    """
    values = np.array([astuple(row) for row in rows], dtype=np.float64).reshape(len(rows), 4)
    if not len(rows):
        return values
    gains = np.where(HIGHER_IS_BETTER, values, -values)
    worst = np.fmin.reduce(gains, axis=0)
    best = np.fmax.reduce(gains, axis=0)
    span = best - worst
    with np.errstate(invalid="ignore"):
        share = np.where(span > 0, (gains - worst) / np.where(span > 0, span, 1.0), 1.0)
    return np.where(np.isnan(values), 0.0, share)


def comscores(rows: Sequence[Indicators]) -> Values:
    """The ComScore of each row, in [0, 1], with the paper's equal weights. Scores depend on which rows are
    compared."""
    return normalized(rows).mean(axis=1)
