"""What a server counts, as text for Prometheus (exposition format 0.0.4)."""

from collections import Counter
from collections.abc import Iterable

PREFIX = "robotdiffuse_"
BUCKETS = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
"""Upper ends of the histogram of seconds."""

Sample = tuple[str, dict[str, str], float]


class Metrics:
    """Counters of a server; gauges are asked for when they are read."""

    def __init__(self) -> None:
        self.answers: Counter[tuple[str, str]] = Counter()
        """By what was asked, and the code of the answer."""
        self.results: Counter[tuple[str, str]] = Counter()
        """By what was asked, and the status of the result."""
        self.lost_workers = self.renewed_workers = 0
        self._buckets = [0] * len(BUCKETS)
        self._seconds, self._count = 0.0, 0

    def answered(self, what: str, code: int, status: str, seconds: float) -> None:
        """Count an answer, which took so long with waiting [s]."""
        self.answers[what, str(code)] += 1
        if status:
            self.results[what, status] += 1
        self._seconds, self._count = self._seconds + seconds, self._count + 1
        for i, most in enumerate(BUCKETS):
            self._buckets[i] += seconds <= most

    def text(self, gauges: dict[str, tuple[str, float]]) -> str:
        """`gauges`: by their names, what they are and their values."""
        answers = [("", {"what": w, "code": c}, n) for (w, c), n in sorted(self.answers.items())]
        results = [("", {"what": w, "status": s}, n) for (w, s), n in sorted(self.results.items())]
        seconds: list[Sample] = [
            ("_bucket", {"le": f"{most:g}"}, count)
            for most, count in zip(BUCKETS, self._buckets, strict=True)
        ]
        seconds += [("_bucket", {"le": "+Inf"}, self._count), ("_sum", {}, self._seconds)]
        seconds += [("_count", {}, self._count)]
        lines = [
            *_lines("requests_total", "counter", "Answers, those of a batch one by one.", answers),
            *_lines("results_total", "counter", "Results by their status.", results),
            *_lines(
                "workers_lost_total",
                "counter",
                "Workers that died or were killed.",
                [("", {}, self.lost_workers)],
            ),
            *_lines(
                "workers_renewed_total",
                "counter",
                "Workers replaced for what they held.",
                [("", {}, self.renewed_workers)],
            ),
            *_lines("request_seconds", "histogram", "From the request to its answer.", seconds),
        ]
        for name, (help_, value) in gauges.items():
            lines += _lines(name, "gauge", help_, [("", {}, value)])
        return "\n".join(lines) + "\n"


def _lines(name: str, kind: str, help_: str, samples: Iterable[Sample]) -> list[str]:
    name = PREFIX + name
    lines = [f"# HELP {name} {help_}", f"# TYPE {name} {kind}"]
    for suffix, labels, value in samples:
        told = ",".join(f'{label}="{text}"' for label, text in labels.items())
        lines.append(f"{name}{suffix}{{{told}}} {value:.12g}" if told else f"{name}{suffix} {value:.12g}")
    return lines
