"""The worker processes of a server, and the queue of requests for them."""

import asyncio
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from functools import partial
from math import ceil

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from robotdiffuse.core.errors import InputError, described
from robotdiffuse.processes.workers import EndedError, OverrunError, Workers
from robotdiffuse.robots.robot import Robot
from robotdiffuse.server import worker
from robotdiffuse.server.settings import GRACE_TIME, ServeSettings
from robotdiffuse.server.worker import Answer, failed

INITIAL_REQUEST_SECONDS = 0.5
"""Assumed time of a request until some have been answered [s]."""
STOPPING = "the server is stopping"
GAUGES = {
    "workers": "Worker processes.",
    "workers_ready": "Workers that are prepared, whether idle or busy.",
    "workers_busy": "Workers that answer a request.",
    "requests_waiting": "Requests that wait for a worker.",
}


class RequestError(Exception):
    """A request that is answered with an error before any worker sees it."""

    def __init__(self, code: int, message: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.headers = headers


class StoppingError(Exception):
    """The server is stopping."""


class WorkerPool:
    """Workers that each answer one request at a time; requests are served in order of arrival.

    A worker that dies or exceeds its time is replaced; only its own request fails. Call all methods from one
    event loop.
    """

    def __init__(self, robots: dict[str, Robot], settings: ServeSettings) -> None:
        self.settings, self.metrics = settings, Metrics(self.state)
        self.admitted = 0
        """Number of requests that wait or run."""
        self.arriving_bytes = 0
        """Data received so far of requests that are still arriving [bytes]."""
        self.stopping = False
        self._workers = Workers(settings.workers, worker.prepare, (robots, settings), 0.0, keep_ready=True)
        self._request_seconds = INITIAL_REQUEST_SECONDS

    async def start(self) -> None:
        """Start the workers. The first one compiles, if necessary, for all; the others follow.

        Raises InputError if the first cannot be started.
        """
        try:
            await asyncio.to_thread(self._workers.start)
        except EndedError:
            raise InputError("a worker process could not be started; its message is above") from None

    @contextmanager
    def admit(self, count: int) -> Iterator[None]:
        """Count `count` requests as admitted while the block runs. Raises RequestError if the queue is too
        full for them."""
        if self.admitted + count > self.settings.workers + self.settings.queue:
            waiting = self.admitted / self.settings.workers
            seconds = str(ceil(max(1.0, waiting * self._request_seconds)))
            message = f"the queue is full; try again in {seconds} s"
            raise RequestError(429, message, {"Retry-After": seconds})
        self.admitted += count
        try:
            yield
        finally:
            self.admitted -= count

    async def run(self, endpoint: str, body: bytes) -> Answer:
        """The answer to a request, from the next idle worker. Canceling this task cancels the worker's
        call."""
        began = time.monotonic()
        answer = await self._answer(endpoint, body)
        self.metrics.answered(endpoint, answer.code, answer.status, time.monotonic() - began)
        return answer

    async def _answer(self, endpoint: str, body: bytes) -> Answer:
        if self.stopping:
            return failed(503, STOPPING)
        call = self._workers.submit(
            worker.respond, endpoint, body, timeout=self.settings.max_time_limit + GRACE_TIME
        )
        call.add_done_callback(self._count_worker)
        try:
            answer: Answer = await asyncio.wrap_future(call)
        except StoppingError:
            return failed(503, STOPPING)
        except OverrunError:
            return failed(503, "the request took too long: it was stopped, and its worker replaced")
        except EndedError:
            return failed(500, "the worker process died on this request, or was killed")
        except Exception as error:  # such as a reply that cannot be pickled
            return failed(500, described(error))
        self._request_seconds += 0.1 * (answer.seconds - self._request_seconds)
        return answer

    def _count_worker(self, call: Future[Answer]) -> None:
        """Count the request's worker if it was lost or is renewed. Runs in the thread in which the request
        ends."""
        if call.cancelled():
            return
        if isinstance(call.exception(), EndedError):
            self.metrics.lost_workers.inc()
        elif call.exception() is None and call.result().renewed:
            self.metrics.renewed_workers.inc()

    def stop(self) -> None:
        """Refuse waiting requests; let running ones finish."""
        self.stopping = True
        self._workers.drop(StoppingError())

    def close(self) -> None:
        """Kill the workers."""
        self.stopping = True
        self._workers.close()

    @property
    def ready(self) -> int:
        """Number of workers that are prepared, whether idle or busy."""
        return sum(worker.ready for worker in self._workers.workers)

    def state(self) -> dict[str, int]:
        """The numbers of workers and waiting requests now, for /health and the metrics."""
        busy = sum(worker.busy for worker in self._workers.workers)
        return {
            "workers": self.settings.workers,
            "workers_ready": self.ready,
            "workers_busy": busy,
            "requests_waiting": max(0, self.admitted - busy),
        }


PREFIX = "robotdiffuse"
BUCKETS = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
"""Upper bounds of the histogram of request times [s]."""


class Metrics:
    """The metrics of one server, in a registry of their own."""

    def __init__(self, state: Callable[[], dict[str, int]]) -> None:
        """`state` returns the values of GAUGES; it is called for each report."""
        self.registry = CollectorRegistry()
        counter = partial(Counter, namespace=PREFIX, registry=self.registry)
        self._requests = counter(
            "requests",
            "Answers of the worker pool by endpoint and HTTP status code; each line of a batch counts; "
            "requests refused because the queue is full, and canceled ones, do not.",
            ("endpoint", "code"),
        )
        self._results = counter("results", "Results by endpoint and status.", ("endpoint", "status"))
        self._seconds = Histogram(
            "request_seconds",
            "Time from the request to its answer.",
            namespace=PREFIX,
            registry=self.registry,
            buckets=BUCKETS,
        )
        self.lost_workers = counter("workers_lost", "Workers that died or were killed.")
        self.renewed_workers = counter(
            "workers_renewed", "Workers replaced because they used too much memory."
        )
        for name, description in GAUGES.items():
            gauge = Gauge(name, description, namespace=PREFIX, registry=self.registry)
            gauge.set_function(lambda name=name: state()[name])

    def answered(self, endpoint: str, code: int, status: str, seconds: float) -> None:
        """Count an answer; `seconds` includes the time in the queue [s], `status` is "" for errors."""
        self._requests.labels(endpoint, str(code)).inc()
        if status:
            self._results.labels(endpoint, status).inc()
        self._seconds.observe(seconds)

    def text(self) -> bytes:
        """All metrics in Prometheus' text format."""
        return generate_latest(self.registry)
