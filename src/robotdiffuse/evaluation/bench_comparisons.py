"""Comparisons of planners by the records of a bench, for every problem set and time limit.

Results for a time limit can come from calls with other limits. The record of a call with a longer limit shows
what the planner had found by the shorter limit. A call that ended before its own limit shows the result for
longer limits.

The statistics are confidence intervals, paired comparisons of two planners on the same problems, and the
paper's ComScore.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.files import JsonLines
from robotdiffuse.core.tables import Figure
from robotdiffuse.core.types import Status, Values, frozen_dataclass
from robotdiffuse.evaluation.metrics import METRICS, Metric
from robotdiffuse.evaluation.report import share_cell
from robotdiffuse.evaluation.runs import (
    CRASHED,
    ENDED_EARLY,
    FAMILY_COUNT,
    NONTRIVIAL_SUFFIX,
    OVERRAN,
    RAISED,
    RESTARTED,
    SHORTEST_FACTOR,
    Record,
    read_cases,
    read_records,
    recorded,
)
from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS
from robotdiffuse.problems.families import FAMILIES

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


class Indicators(NamedTuple):
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
    values = np.array(rows, dtype=np.float64).reshape(len(rows), 4)
    if not len(rows):
        return values
    gains = np.where(HIGHER_IS_BETTER, values, -values)
    minima = np.fmin.reduce(gains, axis=0)
    span = np.fmax.reduce(gains, axis=0) - minima
    with np.errstate(invalid="ignore"):
        share = np.where(span > 0, (gains - minima) / np.where(span > 0, span, 1.0), 1.0)
    return np.where(np.isnan(values), 0.0, share)


def comscores(rows: Sequence[Indicators]) -> Values:
    """The ComScore of each row, in [0, 1], with the paper's equal weights. Scores depend on which rows are
    compared."""
    return normalized(rows).mean(axis=1)


LIMITS = (0.1, 1.0, 10.0, 60.0)
"""Time limits that a report evaluates in addition to the limits of its records [s]; only those below the
longest limit of the records."""
NONTRIVIAL_LABEL = ", non-trivial"
LATE_SHARE = 0.1
"""If a call returns a path after its time limit, late by at most this fraction of the limit, the path still
counts: planners stop searching in time, but validation of the motion follows."""
LATE_SECONDS = 0.05
"""For short time limits, such a path may be late by this [s] instead."""
RAN_OUT = "time ran out"
GAVE_UP = "gave up before"
LATER = "found one later"
REFUSED = {"scene_collision": "scene collision", "self_collision": "self-collision"}
FAILURES = (
    *(RAN_OUT, GAVE_UP, LATER),
    *REFUSED.values(),
    *("other refusal", "ends refused", CRASHED, OVERRAN, RAISED),
)
"""Reasons of failures, in the order of tables:

- time ran out: there was no path at the end of the limit.
- gave up before: the planner ended without a path before the limit, and before 90 % of its call's own limit.
- found one later: the planner found a path after the limit.
- scene collision, self-collision: the validator refused the last path for this reason.
- other refusal: the validator refused the last path for another reason, such as limits or a missed goal.
- ends refused: the start or the goal was invalid, or the goal unreachable.
- crashed: the planner's process died.
- overran: the process did not answer and was killed.
- exception: the planner raised an exception.
"""

Key = tuple[str, int]
"""Name of a problem in its set, and a seed."""
Calls = dict[Key, list[Record]]
"""The records of one planner on one problem set, shorter limits first."""


# The folder


@frozen_dataclass
class Bench:
    """The content of a folder of `bench run`."""

    folder: Path
    sessions: tuple[dict[str, Any], ...]
    """One entry for each time that `bench run` was started: machine, versions, settings."""
    records: dict[str, list[Record]]
    """Records by planner, in the order of PLANNERS. A planner with restarts follows the same planner without
    restarts."""

    @property
    def reference(self) -> str:
        """The planner that all others are compared with: the default planner, else the first planner; with
        restarts, if it has records with restarts."""
        plain = DEFAULT_PLANNER if DEFAULT_PLANNER in self.records else next(iter(self.records))
        return plain + RESTARTED if plain + RESTARTED in self.records else plain

    @property
    def problem_sets(self) -> list[str]:
        return list(dict.fromkeys(r.problem_set for records in self.records.values() for r in records))


def plain_name(planner: str) -> str:
    """The name of a planner without the suffix of restarts."""
    return planner.removesuffix(RESTARTED)


def base_name(planner: str) -> str:
    """The name of a planner in PLANNERS, without weights, settings and the suffix of restarts."""
    return re.split("[@:+]", planner, maxsplit=1)[0]


def read_bench(folder: Path, planners: Sequence[str] | None = None) -> Bench:
    """Read the records of all planners, or of the given planners, including their records with restarts.

    Raises InputError for a folder without a bench, damaged files and planners without records.
    """
    if planners is not None:
        existing = recorded(folder)
        restarts = [name + RESTARTED for name in planners]
        planners = [*planners, *(name for name in restarts if name in existing)]
    records = read_records(folder, planners)
    order = {name: i for i, name in enumerate(PLANNERS)}
    names = sorted(
        records, key=lambda n: (order.get(base_name(n), len(order)), plain_name(n), n.endswith(RESTARTED))
    )
    for name in names:
        if name.endswith(RESTARTED):
            # calls that used up the limit were not repeated: their records without restarts count here too
            repeated = {record.key for record in records[name]}
            plain = [record for record in records.get(plain_name(name), ()) if record.key not in repeated]
            records[name] = records[name] + [replace(record, planner=name) for record in plain]
    if not any(records.values()):
        raise InputError(f"{folder} holds no records yet; continue with `robotdiffuse bench run`")
    file = folder / "runs.jsonl"
    sessions = JsonLines(file).rows
    for name in ("date", "versions", "planners", "problems", "time_limit", "seeds", "count"):
        if not all(name in run for run in sessions):
            raise InputError(f"{file} is damaged: a run has no {name}; results cannot be read without it")
    return Bench(folder, tuple(sessions), {name: records[name] for name in names})


# Results of a call by a time limit


@dataclass(frozen=True)
class Outcome:
    """The result of a call by a time limit."""

    record: Record
    found: float
    """Time of the first path [s]; infinite if there was no path by the limit."""
    returned: float
    """Time at which the planner returned, at most the time limit [s]; the time limit if there is no path."""
    joint_length: float
    """Length of the best path found by the time limit [rad]; NaN without a path."""
    link_length: float
    """The paper's path length of this path [m]; NaN without a path. If the call later returned a shorter
    path, it is estimated: the length of the returned path, scaled by the ratio of both paths' joint
    lengths."""

    @property
    def solved(self) -> bool:
        return self.found < np.inf

    def full(self, limit: float, shortest: float) -> bool:
        """Whether the planner used up the limit [s], possibly with restarts, or no shorter path exists.
        `shortest` is the length of the shortest path of any planner [rad]."""
        nothing_shorter = self.record.trivial and self.joint_length <= SHORTEST_FACTOR * shortest
        return self.record.restarts is not None or self.returned >= ENDED_EARLY * limit or nothing_shorter

    @property
    def failure(self) -> str:
        """One of FAILURES."""
        record = self.record
        if record.solved:
            return LATER
        if record.status in FAILURES:
            return record.status
        if record.status not in (Status.TIMEOUT.value, Status.NO_PATH.value):
            return "ends refused"
        if record.refused:
            return REFUSED.get(record.refused, "other refusal")
        return GAVE_UP if record.ended_by_itself and record.time < self.returned else RAN_OUT


def deciding_record(records: Sequence[Record], limit: float) -> Record | None:
    """The record that shows what a planner finds within a limit [s]; None if there is none.

    It is the record with the shortest time limit of at least `limit`, else the last record of a call that
    ended by itself. `records` are those of one problem and seed, shorter limits first.
    """
    for record in records:
        if record.time_limit >= limit:
            return record
    return next((record for record in reversed(records) if record.ended_by_itself), None)


def outcome(record: Record, limit: float) -> Outcome:
    """The result of a recorded call by a time limit [s]."""
    late = max(LATE_SHARE * limit, LATE_SECONDS) if record.time_limit == limit else 0.0
    paths = [(at, length) for at, length in record.progress if record.solved and at <= limit + late]
    if not paths:
        return Outcome(record, np.inf, limit, np.nan, np.nan)
    length = paths[-1][1]
    factor = length / record.joint_length if record.joint_length else 1.0
    link = factor * record.measures.get("link_length", np.nan)
    return Outcome(record, min(paths[0][0], limit), min(record.time, limit), length, link)


def calls_on(records: Iterable[Record], problem_set: str) -> Calls:
    """The records of a planner on one problem set, by problem and seed."""
    calls: Calls = {}
    for record in sorted(records, key=lambda record: record.time_limit):
        if record.problem_set == problem_set:
            calls.setdefault((record.name, record.seed), []).append(record)
    return calls


# Figures


class Mean(NamedTuple):
    """The mean over the motions that have a metric; NaN if no motion has it."""

    value: float
    half: float
    """Half the width of the 95 % interval of the mean, computed from the standard error."""

    @classmethod
    def of(cls, values: Iterable[float | None]) -> "Mean":
        """The mean of the values, leaving out None and NaN."""
        numbers = np.array([value for value in values if value is not None and value == value])
        if not len(numbers):
            return cls(np.nan, np.nan)
        half = 1.96 * float(numbers.std(ddof=1)) / len(numbers) ** 0.5 if len(numbers) > 1 else np.nan
        return cls(float(numbers.mean()), half)

    def cell(self, metric: Metric) -> Figure | None:
        """The cell of a table: the mean of a metric with its interval; None without a mean."""
        value, half = (f"{metric.scale * x:{metric.format}}" for x in self)
        text = value if np.isnan(self.half) else f"{value} ± {half}"
        return None if np.isnan(self.value) else Figure(text.replace("-", "−"), self.value)


@dataclass(frozen=True)
class Row:
    """A planner at a time limit."""

    planner: str
    outcomes: tuple[Outcome, ...]
    """Outcomes of all problems and seeds of the table."""
    figures: Indicators
    """The paper's four indicators. The length is the mean over the solved calls, NaN if there are none. The
    time is the mean until the planner returns; an unsolved call counts with the time limit."""
    comscore: float
    """ComScore, normalized over the rows without restarts of this table; NaN with restarts."""
    paired: Paired | None
    """Comparison with the reference planner by joint-space lengths; None for the reference itself, and if the
    reference has no results."""
    full: bool
    """Whether every solved call used up the limit (possibly with restarts), or found a path that cannot be
    shorter."""
    timed: str
    """The sessions in which the calls were made, with the number of simultaneous calls in each session."""

    @property
    def solved(self) -> list[Outcome]:
        return [o for o in self.outcomes if o.solved]

    @property
    def success(self) -> Figure:
        """The share of solved problems with its interval."""
        return solved_share(self.outcomes)

    @property
    def failures(self) -> Counter[str]:
        """The number of failures by reason, see FAILURES."""
        return Counter(o.failure for o in self.outcomes if not o.solved)

    def mean(self, metric: Metric) -> Figure | None:
        """The mean of a metric over the solved problems; a problem's value is the mean over its motions."""
        motions = defaultdict[str, list[float | None]](list)
        for o in self.solved:
            motions[o.record.name].append(o.record.measures.get(metric.name))
        return Mean.of(Mean.of(values).value for values in motions.values()).cell(metric)


def solved_share(outcomes: Collection[Outcome]) -> Figure:
    """The share of solved calls with its 95 % interval by E. B. Wilson's method. Results of several seeds on
    one problem are not independent, so a trial is a problem."""
    share = float(np.mean([o.solved for o in outcomes]))
    problems = len({o.record.name for o in outcomes})
    return share_cell(share, wilson_interval(round(share * problems), problems))


@dataclass(frozen=True)
class Comparison:
    """Planners at a time limit, on the problems for which all of these planners have results with this
    limit."""

    limit: float
    """Time limit [s]."""
    problems: int
    """Number of problems on which the planners are compared."""
    section_problems: int
    """Number of all problems in the section."""
    seeds: int
    """Number of seeds per problem."""
    rows: tuple[Row, ...]
    """One row for each planner."""
    missing: tuple[str, ...]
    """Planners without results for this limit."""
    keys: tuple[Key, ...]
    """The problems and seeds, in the order of the rows' outcomes."""
    loads: tuple[float, ...]
    """Load averages of the machine after the calls, where they were recorded."""

    @property
    def alike(self) -> bool:
        """Whether all rows were timed in the same sessions, with the same number of simultaneous calls."""
        return len({row.timed for row in self.rows}) < 2

    @property
    def metrics(self) -> list[Metric]:
        """The metrics that at least one row has."""
        return [m for m in METRICS.values() if any(row.mean(m) is not None for row in self.rows)]


@frozen_dataclass
class Curve:
    """Success and path lengths of a planner over time, from its calls with the longest limit."""

    planner: str
    calls: int
    """Number of calls."""
    end: float
    """Until this time, the results of all calls are known [s]."""
    found: Values
    """Times of first paths [s], sorted."""
    times: Values
    """Times at which the median ratio is finite: more than half of the calls of `ratios` have a path by then
    [s]."""
    ratios: Values
    """At each of `times`, the median over calls of the ratio of joint-space length to the best known length.
    The calls are those on non-trivial problems that find a path by `end`; until a call finds one, its ratio
    is infinite."""


@dataclass(frozen=True)
class Section:
    """Results on a problem set, or on its non-trivial problems that at least one planner solves."""

    name: str
    problem_set: str
    comparisons: tuple[Comparison, ...]
    """Comparisons by time limit, shorter limits first."""
    curves: tuple[Curve, ...]

    @property
    def main(self) -> Comparison:
        """The comparison with the largest number of planners times problems; among equal ones, that with the
        longest limit."""
        return max(self.comparisons, key=lambda c: (len(c.rows) * c.problems, c.limit))


def sections(bench: Bench, limits: Sequence[float] | None = None) -> list[Section]:
    """The results on all problem sets. Sets of random problems, some of them trivial, get a second section
    with only the non-trivial problems that at least one planner solves.

    `limits` are the time limits to report [s]; None: the limits of the records, and all LIMITS below the
    longest of them. Raises InputError if no planner has results for any of the limits, or those that have
    results share no calls.
    """
    results = []
    for problem_set in bench.problem_sets:
        calls = {name: calls_on(records, problem_set) for name, records in bench.records.items()}
        records = [r for by_problem in calls.values() for key in by_problem for r in by_problem[key]]
        names = list(dict.fromkeys(r.name for r in records))
        cases = [case.name for case in read_cases(bench.folder, problem_set)]
        places = {name: i for i, name in enumerate(dict.fromkeys([*cases, *names]))}
        if limits is None:
            record_limits = {record.time_limit for record in records}
            chosen = record_limits | {limit for limit in LIMITS if limit < max(record_limits)}
        else:
            chosen = set(limits)
        parts = {problem_set: set(names)}
        if any(r.trivial for r in records) and {r.family for r in records} <= set(FAMILIES):
            parts[problem_set + NONTRIVIAL_LABEL] = {r.name for r in records if r.solved and not r.trivial}
        for name, problems in parts.items():
            part = {
                planner: {key: by_key[key] for key in by_key if key[0] in problems}
                for planner, by_key in calls.items()
            }
            comparisons = (
                _comparison(bench, problem_set, part, len(problems), places, limit)
                for limit in sorted(chosen)
            )
            with_rows = tuple(comparison for comparison in comparisons if comparison.rows)
            if with_rows:
                results.append(Section(name, problem_set, with_rows, curves(part)))
    if not results:
        reported = "those of the records" if limits is None else f"{', '.join(f'{x:g}' for x in limits)} s"
        raise InputError(
            f"limits are {reported}; no planner was run that long, or the planners share no problem"
        )
    return results


def _counted(
    bench: Bench, planner: str, problem_set: str, calls: Calls, places: dict[str, int], limit: float
) -> dict[Key, Record]:
    """The records of a planner that count for a limit.

    The planner may have run with this limit or a longer one on the first problems only. Then the other
    problems are left out: they have results only from calls with shorter limits that ended by themselves, so
    mostly easy problems would count.
    """
    counted = {
        key: record
        for key, records in calls.items()
        if (record := deciding_record(records, limit)) is not None
    }
    if len(counted) == len(calls):
        return counted
    family = problem_set.removesuffix(NONTRIVIAL_SUFFIX) in FAMILIES
    counts = [
        (run["seeds"], run["count"] or (FAMILY_COUNT if family else len(places)))
        for run in bench.sessions
        if plain_name(planner) in run["planners"]
        and problem_set in run["problems"]
        and run["time_limit"] >= limit
    ]
    return {
        key: record
        for key, record in counted.items()
        if any(key[1] < seeds and places[key[0]] < count for seeds, count in counts)
    }


def _comparison(
    bench: Bench,
    problem_set: str,
    calls: dict[str, Calls],
    problems: int,
    places: dict[str, int],
    limit: float,
) -> Comparison:
    counted = {
        name: _counted(bench, name, problem_set, planner_calls, places, limit)
        for name, planner_calls in calls.items()
    }
    counted = {name: planner_calls for name, planner_calls in counted.items() if planner_calls}
    shared = set.intersection(*map(set, counted.values())) if counted else set()
    keys = sorted(shared, key=lambda key: (places[key[0]], key[1]))
    outcomes = {
        name: [outcome(by_key[key], limit) for key in keys] for name, by_key in counted.items() if keys
    }
    indicators = {
        name: _indicators(results) for name, results in outcomes.items() if not name.endswith(RESTARTED)
    }
    scores = dict(zip(indicators, comscores(list(indicators.values())).tolist(), strict=True))
    lengths = {name: _problem_lengths(keys, results) for name, results in outcomes.items()}
    shortest = [
        min((o.joint_length for o in results if o.solved), default=np.inf)
        for results in zip(*outcomes.values(), strict=True)
    ]
    reference = lengths.get(bench.reference)
    rows = []
    for planner, results in outcomes.items():
        timed = {f"run {o.record.run or '?'}, {o.record.workers or '?'} at once" for o in results}
        row = Row(
            planner,
            tuple(results),
            _indicators(results),
            scores.get(planner, np.nan),
            None if planner == bench.reference or reference is None else compare(lengths[planner], reference),
            all(o.full(limit, length) for o, length in zip(results, shortest, strict=True) if o.solved),
            " or ".join(sorted(timed)),
        )
        rows.append(row)
    loads = tuple(
        o.record.load for results in outcomes.values() for o in results if o.record.load is not None
    )
    missing = tuple(name for name in calls if name not in outcomes)
    seeds = len({seed for _, seed in keys})
    return Comparison(
        limit, len({name for name, _ in keys}), problems, seeds, tuple(rows), missing, tuple(keys), loads
    )


def _indicators(outcomes: Sequence[Outcome]) -> Indicators:
    """The paper's four indicators of all calls; the length is over the solved calls."""
    return Indicators(
        success=100 * float(np.mean([o.solved for o in outcomes])),
        collision=100 * float(np.mean([o.record.in_collision for o in outcomes])),
        length=Mean.of(o.link_length for o in outcomes).value,
        time=float(np.mean([o.returned for o in outcomes])),
    )


def _problem_lengths(keys: Sequence[Key], outcomes: Sequence[Outcome]) -> Values:
    """The joint-space length of each problem [rad]: the median over the seeds; NaN if the planner failed with
    half or more of the seeds."""
    lengths = dict[str, list[float]]()
    for (name, _), o in zip(keys, outcomes, strict=True):
        lengths.setdefault(name, []).append(o.joint_length)
    values = map(np.array, lengths.values())
    return np.array([np.nanmedian(v) if 2 * np.isnan(v).sum() < len(v) else np.nan for v in values])


def curves(calls: dict[str, Calls]) -> tuple[Curve, ...]:
    """The curves of all planners, on the problems that every planner was called on."""
    with_calls = {name: by_key for name, by_key in calls.items() if by_key}
    keys = sorted(set.intersection(*map(set, with_calls.values()))) if with_calls else []
    if not keys:
        return ()
    lengths = {key: [r.joint_length for by_key in with_calls.values() for r in by_key[key]] for key in keys}
    best = {key: min(filter(None, values), default=1.0) for key, values in lengths.items()}
    records = {name: {key: by_key[key][-1] for key in keys} for name, by_key in with_calls.items()}
    longest = max(r.time_limit for by_key in records.values() for r in by_key.values())
    return tuple(_curve(name, by_key, best, longest) for name, by_key in records.items())


def _curve(planner: str, records: dict[Key, Record], best: dict[Key, float], longest: float) -> Curve:
    """The curve of a planner. `best` are the best known lengths [rad]; `longest` is the longest limit of any
    planner [s], where the plot ends."""
    end = min([longest, *(r.time_limit for r in records.values() if not r.ended_by_itself)])
    solved = {key: r for key, r in records.items() if outcome(r, r.time_limit).found <= end}
    first_times = np.sort([min(r.progress[0][0], end) for r in solved.values()])
    hard = {key: r for key, r in solved.items() if not r.trivial}
    times = np.geomspace(1e-4, end, 240)
    ratios = np.full((max(len(hard), 1), len(times)), np.inf)
    for row, (key, record) in zip(ratios, hard.items(), strict=False):
        for at, length in record.progress:
            row[times >= min(at, end)] = length / best[key]
    with np.errstate(invalid="ignore"):
        medians = np.median(ratios, axis=0)
    finite = np.isfinite(medians)
    return Curve(planner, len(records), end, first_times, times[finite], medians[finite])
