"""The figures of a bench's report, for every planner, problem set and time limit.

A time limit needs no calls of its own: records of a longer limit say what was found by then, and a call that
ended by itself says what a longer limit would have given.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.evaluation.bench.curves import Curve, curves
from robotdiffuse.evaluation.bench.outcomes import Calls, Key, Outcome, calls_on, deciding_record, outcome
from robotdiffuse.evaluation.bench.run_folder import Bench, plain_name
from robotdiffuse.evaluation.metrics import METRICS, Metric
from robotdiffuse.evaluation.paper.comscore import Indicators, comscores
from robotdiffuse.evaluation.problem_sets import read_cases
from robotdiffuse.evaluation.records import RESTARTED, Record
from robotdiffuse.evaluation.statistics import Paired, compare, wilson_interval
from robotdiffuse.problems.families import FAMILIES

LIMITS = (0.1, 1.0, 10.0, 60.0)
"""Time limits of a report beside those of its records, up to the longest of these [s]."""
NONTRIVIAL_LABEL = ", non-trivial"


class Timed(NamedTuple):
    """Under which conditions the calls of a row were timed."""

    runs: frozenset[str]
    """Numbers of the sessions that may have made them."""
    workers: frozenset[str]
    """Calls at a time in these sessions."""

    @property
    def text(self) -> str:
        return (
            f"run {' or '.join(sorted(self.runs)) or '?'}, {' or '.join(sorted(self.workers)) or '?'} at once"
        )


class Mean(NamedTuple):
    """The mean over the motions that have a metric; NaN without any."""

    value: float
    half: float
    """Half the width of its 95 % interval, by the standard error."""

    @classmethod
    def of(cls, values: Iterable[float]) -> "Mean":
        known = np.array(list(values))
        if not len(known):
            return cls(np.nan, np.nan)
        half = 1.96 * float(known.std(ddof=1)) / len(known) ** 0.5 if len(known) > 1 else np.nan
        return cls(float(known.mean()), half)


@dataclass(frozen=True)
class Row:
    """Figures of a planner at a time limit. Means are over the problems that it solved; NaN without any."""

    planner: str
    success: float
    success_interval: tuple[float, float]
    """95 %, by E. B. Wilson's method over problems."""
    collision: float
    """Share of the problems whose last path was in collision."""
    link_length: float
    """The paper's path length [m]."""
    first: float
    """Median time to the first path [s]."""
    returned: float
    """Mean time until the planner returns [s], over all problems; the limit for an unsolved one."""
    comscore: float
    """Among the rows of this table."""
    paired: Paired | None
    """Comparison with the reference by joint-space lengths; None for the reference and without it."""
    full: bool
    """Whether all solved calls used up the limit, with restarts or without."""
    timed: Timed
    measures: dict[str, Mean]
    """Of the returned motions, by the names of METRICS."""
    memory: float
    """Peak memory of the process [MB]."""
    failures: dict[str, int]


@dataclass(frozen=True)
class Comparison:
    """Planners at a time limit, on the problems for which all of them have results with that limit."""

    limit: float
    problems: int
    of: int
    """Problems in the section."""
    seeds: int
    rows: tuple[Row, ...]
    missing: tuple[str, ...]
    """Planners without results for this limit."""
    families: dict[str, dict[str, tuple[int, int]]]
    """Solved calls and all calls, by family and planner."""
    keys: tuple[Key, ...]
    load: tuple[float, float] | None
    """Lowest and highest load average after the calls; None if it was not noted."""

    @property
    def alike(self) -> bool:
        """Whether all rows were timed in the same sessions, with as many calls at a time."""
        return len({row.timed for row in self.rows}) < 2

    def row(self, planner: str) -> Row | None:
        return next((row for row in self.rows if row.planner == planner), None)

    @property
    def metrics(self) -> list[Metric]:
        """The metrics that some row has."""
        return [m for m in METRICS.values() if any(row.measures[m.name].value < np.inf for row in self.rows)]


@dataclass(frozen=True)
class Section:
    """Results on a problem set, or on its non-trivial part."""

    name: str
    problem_set: str
    comparisons: tuple[Comparison, ...]
    """Shorter limits first."""
    curves: tuple[Curve, ...]

    @property
    def main(self) -> Comparison:
        """The comparison of most planners and problems, and of those with the longest limit."""
        return max(self.comparisons, key=lambda c: (len(c.rows) * c.problems, c.limit))


def sections(bench: Bench, limits: Sequence[float] | None = None) -> list[Section]:
    """The results on all problem sets; sets of random problems also without their trivial ones.

    limits: time limits to report [s]; None: those of the records, and LIMITS below them.

    Raises InputError if no planner has results for any of these.
    """
    found = []
    for problem_set in bench.problem_sets:
        calls = {name: calls_on(records, problem_set) for name, records in bench.records.items()}
        records = [r for of in calls.values() for key in of for r in of[key]]
        names = list(dict.fromkeys(r.name for r in records))
        cases = [case.name for case in read_cases(bench.folder, problem_set)]
        places = {name: i for i, name in enumerate(dict.fromkeys([*cases, *names]))}
        chosen = _limits(records) if limits is None else sorted(limits)
        parts = {problem_set: set(names)}
        if any(r.trivial for r in records) and {r.family for r in records} <= set(FAMILIES):
            parts[problem_set + NONTRIVIAL_LABEL] = {r.name for r in records if r.solved and not r.trivial}
        for name, problems in parts.items():
            part = {
                planner: {key: of[key] for key in of if key[0] in problems} for planner, of in calls.items()
            }
            comparisons = [
                _comparison(bench, problem_set, part, len(problems), places, limit) for limit in chosen
            ]
            kept = tuple(c for c in comparisons if c.rows)
            if kept:
                found.append(Section(name, problem_set, kept, curves(part)))
    if not found:
        raise InputError(
            f"limits are {', '.join(f'{x:g}' for x in limits or ())} s; no planner was run that long"
        )
    return found


def _limits(records: Sequence[Record]) -> list[float]:
    recorded = {record.time_limit for record in records}
    return sorted(recorded | {limit for limit in LIMITS if limit < max(recorded)})


def _counted(
    bench: Bench, planner: str, problem_set: str, calls: Calls, places: dict[str, int], limit: float
) -> dict[Key, Record]:
    """The records that count for a limit.

    If a planner had this limit on the first problems only, the others do not count: of these only calls that
    ended by themselves are known, which are the easy ones.
    """
    counted = {key: record for key, of in calls.items() if (record := deciding_record(of, limit)) is not None}
    if len(counted) == len(calls):
        return counted
    given = [
        (run["seeds"], run["count"] or len(places))
        for run in bench.sessions
        if plain_name(planner) in run["planners"]
        and problem_set in run["problems"]
        and run["time_limit"] >= limit
    ]
    return {
        key: record
        for key, record in counted.items()
        if any(key[1] < seeds and places[key[0]] < count for seeds, count in given)
    }


def _comparison(
    bench: Bench,
    problem_set: str,
    calls: dict[str, Calls],
    problems: int,
    places: dict[str, int],
    limit: float,
) -> Comparison:
    counted = {name: _counted(bench, name, problem_set, of, places, limit) for name, of in calls.items()}
    present = [name for name, of in counted.items() if of]
    shared = set.intersection(*(set(counted[name]) for name in present)) if present else set()
    keys = tuple(sorted(shared, key=lambda key: (places[key[0]], key[1])))
    if not keys:
        return Comparison(limit, 0, problems, 0, (), tuple(calls), {}, (), None)
    outcomes = {name: [outcome(counted[name][key], limit) for key in keys] for name in present}
    names = tuple(dict.fromkeys(name for name, _ in keys))
    plain = [name for name in present if not name.endswith(RESTARTED)]
    scores = dict(
        zip(plain, comscores([_indicators(outcomes[name]) for name in plain]).tolist(), strict=True)
    )
    lengths = {name: _problem_lengths(keys, of) for name, of in outcomes.items()}
    shortest = [
        np.nanmin([of[i].joint_length for of in outcomes.values()] + [np.inf]) for i in range(len(keys))
    ]
    rows = tuple(
        _row(
            name,
            of,
            len(names),
            scores.get(name, np.nan),
            _paired(lengths, name, bench.reference),
            all(o.full(limit, least) for o, least in zip(of, shortest, strict=True) if o.solved),
            _timed(bench, of),
        )
        for name, of in outcomes.items()
    )
    loads = [o.record.load for of in outcomes.values() for o in of if o.record.load is not None]
    families: dict[str, dict[str, tuple[int, int]]] = {}
    for name, of in outcomes.items():
        calls_of = Counter(o.record.family for o in of)
        solved = Counter(o.record.family for o in of if o.solved)
        for family in calls_of:
            families.setdefault(family, {})[name] = solved[family], calls_of[family]
    seeds = len({seed for _, seed in keys})
    missing = tuple(name for name in calls if name not in present)
    load = (min(loads), max(loads)) if loads else None
    return Comparison(limit, len(names), problems, seeds, rows, missing, families, keys, load)


def _timed(bench: Bench, outcomes: Sequence[Outcome]) -> Timed:
    runs = frozenset[str]().union(*(bench.sessions_of(o.record) for o in outcomes))
    workers = {str(bench.sessions[int(number) - 1].get("workers", "?")) for number in runs}
    return Timed(runs, frozenset(workers))


def _mean(values: Iterable[float | None]) -> float:
    known = [value for value in values if value is not None and value == value]
    return float(np.mean(known)) if known else np.nan


def _indicators(outcomes: Sequence[Outcome]) -> Indicators:
    """The paper's four indicators of all calls; the length is that of the solved ones."""
    return Indicators(
        success=100 * float(np.mean([o.solved for o in outcomes])),
        collision=100 * float(np.mean([o.record.in_collision for o in outcomes])),
        length=_mean(o.link_length for o in outcomes),
        time=float(np.mean([o.returned for o in outcomes])),
    )


def _problem_lengths(keys: Sequence[Key], outcomes: Sequence[Outcome]) -> Float[ndarray, "problems"]:
    """The joint-space length of each problem [rad]: the median of its seeds, NaN if half or more of them
    failed."""
    of: dict[str, list[float]] = {}
    for (name, _), o in zip(keys, outcomes, strict=True):
        of.setdefault(name, []).append(o.joint_length)
    values = (np.array(lengths) for lengths in of.values())
    return np.array([np.nanmedian(v) if 2 * np.isnan(v).sum() < len(v) else np.nan for v in values])


def _paired(lengths: dict[str, Float[ndarray, "n"]], name: str, reference: str) -> Paired | None:
    if name == reference or reference not in lengths:
        return None
    return compare(lengths[name], lengths[reference])


def _row(
    planner: str,
    outcomes: Sequence[Outcome],
    problems: int,
    comscore: float,
    paired: Paired | None,
    full: bool,
    timed: Timed,
) -> Row:
    solved = [o for o in outcomes if o.solved]
    success = len(solved) / len(outcomes)
    indicators = _indicators(outcomes)
    found = [o.record.measures for o in solved]
    return Row(
        planner=planner,
        success=success,
        # the seeds of one problem are not independent, so trials are problems
        success_interval=wilson_interval(round(success * problems), problems),
        collision=indicators.collision / 100,
        link_length=indicators.length,
        first=float(np.median([o.found for o in solved])) if solved else np.nan,
        returned=indicators.time,
        comscore=comscore,
        paired=paired,
        full=full,
        timed=timed,
        measures={name: Mean.of(x[name] for x in found if name in x) for name in METRICS},
        memory=max((o.record.memory for o in outcomes if o.record.memory is not None), default=np.nan),
        failures=dict(Counter(o.failure for o in outcomes if not o.solved)),
    )
