"""Curves of success and path length over time, for each planner."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.evaluation.bench.outcomes import Calls, Key, outcome
from robotdiffuse.evaluation.records import Record


@dataclass(frozen=True, eq=False)
class Curve:
    """Success and path lengths of a planner over time, from its calls with the longest limit."""

    planner: str
    calls: int
    end: float
    """Results later than this [s] are known for some problems only."""
    found: Float[ndarray, "solved"]
    """Times of first paths [s], sorted."""
    anytime: bool
    """Whether more than a tenth of the solved calls on non-trivial problems improved their path."""
    times: Float[ndarray, "t"]
    """Times from which half of these problems are solved [s]."""
    ratios: Float[ndarray, "t"]
    """Median at these times of joint-space length over the best known one, on the non-trivial problems that
    the planner solves in the end; problems not solved yet count as infinite."""


def curves(calls: dict[str, Calls]) -> tuple[Curve, ...]:
    """The curves on the problems that every planner was called on."""
    with_calls = {name: of for name, of in calls.items() if of}
    keys = sorted(set.intersection(*(set(of) for of in with_calls.values()))) if with_calls else []
    best = {
        key: min(
            (r.joint_length for of in with_calls.values() for r in of[key] if r.joint_length), default=1.0
        )
        for key in keys
    }
    if not keys:
        return ()
    longest = max(of[key][-1].time_limit for of in with_calls.values() for key in keys)
    return tuple(
        _curve(name, {key: of[key][-1] for key in keys}, best, longest) for name, of in with_calls.items()
    )


def _curve(planner: str, records: dict[Key, Record], best: dict[Key, float], longest: float) -> Curve:
    """The curve of a planner. `longest`: the longest limit of any planner [s], where the plot ends."""
    end = min([longest, *(r.time_limit for r in records.values() if not r.ended_by_itself)])
    done = {key: r for key, r in records.items() if outcome(r, r.time_limit).found <= end}
    found = np.sort([min(r.progress[0][0], end) for r in done.values()])
    hard = {key: r for key, r in done.items() if not r.trivial}
    improved = sum(len(r.progress) > 1 for r in hard.values())
    times = np.geomspace(1e-4, end, 240)
    lengths = np.full((len(hard), len(times)), np.inf)
    for row, (key, record) in zip(lengths, hard.items(), strict=True):
        for at, length in record.progress:
            row[times >= min(at, end)] = length / best[key]
    with np.errstate(invalid="ignore"):
        ratios = np.median(lengths, axis=0) if hard else np.full(len(times), np.inf)
    known = np.isfinite(ratios)
    return Curve(planner, len(records), end, found, improved > 0.1 * len(hard), times[known], ratios[known])
