"""Prometheus metrics of a server."""

from collections.abc import Callable

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

PREFIX = "robotdiffuse"
BUCKETS = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
"""Upper bounds of the histogram of request times [s]."""


class Metrics:
    """The metrics of one server, in a registry of their own."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._requests = Counter(
            "requests",
            "Answers of the worker pool by endpoint and HTTP status code; each line of a batch counts, "
            "refused and cancelled requests do not.",
            ("endpoint", "code"),
            namespace=PREFIX,
            registry=self.registry,
        )
        self._results = Counter(
            "results",
            "Results by endpoint and status.",
            ("endpoint", "status"),
            namespace=PREFIX,
            registry=self.registry,
        )
        self._seconds = Histogram(
            "request_seconds",
            "Time from the request to its answer.",
            namespace=PREFIX,
            registry=self.registry,
            buckets=BUCKETS,
        )
        self.lost_workers = self._counter("workers_lost", "Workers that died or were killed.")
        self.renewed_workers = self._counter(
            "workers_renewed", "Workers replaced because they used too much memory."
        )

    def _counter(self, name: str, description: str) -> Counter:
        return Counter(name, description, namespace=PREFIX, registry=self.registry)

    def gauge(self, name: str, description: str, value: Callable[[], float]) -> None:
        """Add a gauge; `value()` is called for each report."""
        Gauge(name, description, namespace=PREFIX, registry=self.registry).set_function(value)

    def answered(self, endpoint: str, code: int, status: str, seconds: float) -> None:
        """Count an answer; `seconds` includes the time in the queue [s], `status` is "" for errors."""
        self._requests.labels(endpoint, str(code)).inc()
        if status:
            self._results.labels(endpoint, status).inc()
        self._seconds.observe(seconds)

    def text(self) -> bytes:
        """All metrics in Prometheus' text format."""
        return generate_latest(self.registry)
