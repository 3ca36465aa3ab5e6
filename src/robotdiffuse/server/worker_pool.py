"""The worker processes of a server, and the queue of requests for them."""

import asyncio
import itertools
import multiprocessing
import signal
import sys
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from robotdiffuse.core.errors import InputError, shortened
from robotdiffuse.core.processes import SingleWorker
from robotdiffuse.robots.robot import Robot
from robotdiffuse.server import worker
from robotdiffuse.server.metrics import Metrics
from robotdiffuse.server.settings import CANCEL_TIMEOUT, GRACE_TIME, ServeSettings
from robotdiffuse.server.worker import Answer, failed

RESTART_DELAY = 1.0
"""Time between two attempts to start a worker [s]."""
CHECK_INTERVAL = 0.1
"""Time between two checks whether a call takes too long [s]."""
INITIAL_REQUEST_SECONDS = 0.5
"""Assumed time of a request until some have been answered [s]."""
STOPPING = "the server is stopping"
GAUGES = {
    "workers": "Worker processes.",
    "workers_ready": "Workers that can take requests.",
    "workers_busy": "Workers that answer a request.",
    "requests_waiting": "Requests that wait for a worker.",
}


class QueueFullError(Exception):
    """The queue is full; try again in about `seconds`."""

    def __init__(self, seconds: float) -> None:
        super().__init__(f"{seconds:g} s")
        self.seconds = seconds


class StoppingError(Exception):
    """The server is stopping."""


class _Slot:
    """A worker process, and the memory through which its call can be cancelled."""

    def __init__(self, robots: dict[str, Robot], settings: ServeSettings) -> None:
        self.shared = multiprocessing.get_context("spawn").RawValue(worker.Shared)
        bare = {name: replace(robot) for name, robot in robots.items()}  # without compiled arrays
        self.process = SingleWorker(worker.prepare, (bare, settings), (self.shared,))


class WorkerPool:
    """Workers that each answer one request at a time; requests are served in order of arrival.

    A worker that dies or exceeds its time is replaced; only its own request fails. Call all methods from one
    event loop.
    """

    def __init__(self, robots: dict[str, Robot], settings: ServeSettings) -> None:
        self.settings, self.metrics = settings, Metrics()
        self.ready = self.admitted = self.busy = 0
        """Workers that are ready; requests admitted; workers that answer a request."""
        self.arriving = 0
        """Data of incomplete requests [bytes]."""
        self.stopping = False
        self._slots = [_Slot(robots, settings) for _ in range(settings.workers)]
        self._idle: list[_Slot] = []
        self._waiting: deque[asyncio.Future[_Slot]] = deque()
        self._numbers = itertools.count(1)
        self._tasks: set[asyncio.Task[None]] = set()
        self._request_seconds = INITIAL_REQUEST_SECONDS
        for name, description in GAUGES.items():
            self.metrics.gauge(name, description, lambda name=name: self.state()[name])

    async def start(self) -> None:
        """Start the workers. The first one compiles, if necessary, for all; the others follow.

        Raises InputError if the first cannot be started.
        """
        first, *others = self._slots
        try:
            await self._warm_up(first)
        except BrokenProcessPool:
            raise InputError("a worker process could not be started; its message is above") from None
        for slot in others:
            self._spawn(self._replace(slot))

    @contextmanager
    def admit(self, count: int) -> Iterator[None]:
        """Count `count` requests as admitted within the block. Raises QueueFullError if the queue lacks
        room."""
        most = self.settings.workers + self.settings.queue
        if self.admitted + count > most:
            waiting = self.admitted / self.settings.workers
            raise QueueFullError(max(1.0, waiting * self._request_seconds))
        self.admitted += count
        try:
            yield
        finally:
            self.admitted -= count

    async def run(self, endpoint: str, body: bytes) -> Answer:
        """The answer to a request, from the next idle worker. Cancelling this task cancels the worker's
        call."""
        began = time.monotonic()
        answer = await self._answer(endpoint, body)
        self.metrics.answered(endpoint, answer.code, answer.status, time.monotonic() - began)
        return answer

    async def _answer(self, endpoint: str, body: bytes) -> Answer:
        try:
            slot = await self._next_idle()
        except StoppingError:
            return failed(503, STOPPING)
        self.busy += 1
        number, began = next(self._numbers), time.monotonic()
        current: Future[Answer] | None = None
        try:
            slot.shared.due = began + self.settings.max_time_limit + GRACE_TIME
            current = slot.process.submit(worker.respond, number, endpoint, body)
            answer = await self._result(slot, current)
        except TimeoutError:
            took = time.monotonic() - began
            self._spawn(self._replace_lost(slot))
            why = f"after {took:.1f} s, {GRACE_TIME:g} s beyond its time limit"
            return failed(503, f"the request was stopped {why}, and its worker replaced")
        except BrokenProcessPool:
            self._spawn(self._replace_lost(slot))
            return failed(500, "the worker process died on this request, or was killed")
        except asyncio.CancelledError:
            slot.shared.cancelled = number
            self._spawn(self._cancel(slot, current))
            raise
        except Exception as error:  # such as a reply that cannot be pickled
            self._spawn(self._replace_lost(slot))
            return failed(500, _described(error))
        finally:
            self.busy -= 1
        if answer.memory > self.settings.max_worker_memory / 2:
            self.metrics.renewed_workers.inc()
            self._spawn(self._renew(slot))
        else:
            self._free(slot)
        self._request_seconds += 0.1 * (time.monotonic() - began - self._request_seconds)
        return answer

    async def _result(self, slot: _Slot, current: "Future[Answer]") -> Answer:
        """The answer of a call. Raises TimeoutError if the call is still running when it is due."""
        waiting = asyncio.wrap_future(current)
        waiting.add_done_callback(_retrieve_error)
        while time.monotonic() < slot.shared.due:
            await asyncio.wait({waiting}, timeout=CHECK_INTERVAL)
            if waiting.done():
                return waiting.result()
        raise TimeoutError

    async def _next_idle(self) -> _Slot:
        """The next idle worker, in order of arrival."""
        if self.stopping:
            raise StoppingError
        if self._idle:
            return self._idle.pop()
        waiting = asyncio.get_running_loop().create_future()
        self._waiting.append(waiting)
        try:
            return await waiting
        except asyncio.CancelledError:
            if waiting.done() and not waiting.cancelled() and waiting.exception() is None:
                self._free(waiting.result())
            raise

    def _free(self, slot: _Slot) -> None:
        """Give an idle worker to the request that has waited longest."""
        while self._waiting:
            waiting = self._waiting.popleft()
            if not waiting.done():
                waiting.set_result(slot)
                return
        self._idle.append(slot)

    def stop(self) -> None:
        """Refuse waiting requests; let running ones finish."""
        self.stopping = True
        for waiting in self._waiting:
            if not waiting.done():
                waiting.set_exception(StoppingError())

    def close(self) -> None:
        """Kill the workers."""
        self.stopping = True
        for task in self._tasks:
            task.cancel()
        for slot in self._slots:
            slot.process.close(signal.SIGKILL)

    def state(self) -> dict[str, int]:
        """The numbers of workers and waiting requests now, for /health."""
        return {
            "workers": self.settings.workers,
            "workers_ready": self.ready,
            "workers_busy": self.busy,
            "requests_waiting": max(0, self.admitted - self.busy),
        }

    async def _cancel(self, slot: _Slot, current: "Future[Any] | None") -> None:
        """Wait until the worker has left a cancelled call; replace it if that takes too long."""
        try:
            if current is not None:
                await asyncio.wait_for(asyncio.wrap_future(current), CANCEL_TIMEOUT)
        except worker.Cancelled:
            pass
        except Exception:  # a timeout, a dead process, or a reply that cannot be pickled
            await self._replace_lost(slot)
            return
        self._free(slot)

    async def _replace_lost(self, slot: _Slot) -> None:
        self.metrics.lost_workers.inc()
        await self._renew(slot)

    async def _renew(self, slot: _Slot) -> None:
        """Replace a worker by a new one."""
        self.ready -= 1
        slot.process.terminate(signal.SIGKILL)
        await self._replace(slot)

    async def _replace(self, slot: _Slot) -> None:
        """Start a worker; repeat until it succeeds."""
        while True:
            try:
                await self._warm_up(slot)
                return
            except Exception as error:
                print(f"a worker could not be started: {_described(error)}", file=sys.stderr)
                slot.process.terminate(signal.SIGKILL)
                await asyncio.sleep(RESTART_DELAY)

    async def _warm_up(self, slot: _Slot) -> None:
        """Prepare a worker. If it compiled code, replace it by one that loads the code from the cache, so
        that all workers give the same numbers, bit for bit."""
        if await asyncio.wrap_future(slot.process.submit(worker.warm_up)):
            slot.process.terminate(signal.SIGKILL)
            await asyncio.wrap_future(slot.process.submit(worker.warm_up))
        self.ready += 1
        self._free(slot)

    def _spawn(self, work: Any) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def _described(error: Exception) -> str:
    return f"{type(error).__name__}: {shortened(str(error))}"


def _retrieve_error(done: "asyncio.Future[Answer]") -> None:
    """Mark the error of a cancelled call as seen; otherwise asyncio would log it."""
    if not done.cancelled():
        done.exception()
