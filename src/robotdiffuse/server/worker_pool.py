"""The worker processes of a server, and who waits for them."""

import asyncio
import itertools
import multiprocessing
import signal
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.processes import SingleWorker
from robotdiffuse.robots.robot import Robot
from robotdiffuse.server import worker
from robotdiffuse.server.metrics import Metrics
from robotdiffuse.server.settings import CANCELLING, GRACE, PREPARING, ServeSettings
from robotdiffuse.server.worker import Answer, failed

AGAIN = 1.0
"""Between two attempts to start a worker [s]."""
TYPICAL = 0.5
"""What a request takes, until some have been answered [s]."""
STOPPING = "the server is stopping"


class QueueFullError(Exception):
    """No more requests may wait; `seconds` until it is worth trying again."""

    def __init__(self, seconds: float) -> None:
        super().__init__(f"{seconds:g} s")
        self.seconds = seconds


class StoppingError(Exception):
    """The server ends."""


class _Seat:
    """A worker, and the memory by which it is told which call to leave."""

    def __init__(self, robots: dict[str, Robot], longest: float) -> None:
        self.shared = multiprocessing.get_context("spawn").RawValue(worker.Shared)
        bare = {name: replace(robot) for name, robot in robots.items()}  # without what was compiled of them
        self.process = SingleWorker(worker.prepare, (bare, longest, self.shared))


class Pool:
    """Workers that answer one request at a time each, in the order in which requests come.

    A worker that dies, or takes longer than it may, costs the request that it had: another takes its place.
    All methods are for one event loop.
    """

    def __init__(self, robots: dict[str, Robot], settings: ServeSettings) -> None:
        self.settings, self.metrics = settings, Metrics()
        self.ready = self.inside = self.busy = 0
        """Workers that are prepared; places that are taken; workers that are at a request."""
        self.stopping = False
        self._seats = [_Seat(robots, settings.longest) for _ in range(settings.workers)]
        self._idle: list[_Seat] = []
        self._waiting: deque[asyncio.Future[_Seat]] = deque()
        self._numbers = itertools.count(1)
        self._tasks: set[asyncio.Task[None]] = set()
        self._typical = TYPICAL

    async def start(self) -> None:
        """Prepare the workers, the first one first: where code is not compiled yet, it does that for all.

        Raises InputError if it cannot be started.
        """
        first, *others = self._seats
        try:
            await self._prepared(first)
        except BrokenProcessPool:
            raise InputError("a worker process could not be started; its message is above") from None
        for seat in others:
            self._later(self._replace(seat))

    @contextmanager
    def places(self, count: int) -> Iterator[None]:
        """So many requests are inside while this lasts; raises QueueFullError without room for them."""
        most = self.settings.workers + self.settings.queue
        if self.inside + count > most:
            ahead = self.inside / self.settings.workers
            raise QueueFullError(max(1.0, ahead * self._typical))
        self.inside += count
        try:
            yield
        finally:
            self.inside -= count

    async def run(self, what: str, body: bytes) -> Answer:
        """The answer to a request, when a worker has time for it. Cancelled, it makes the worker stop."""
        began = time.monotonic()
        answer = await self._answer(what, body)
        self.metrics.answered(what, answer.code, answer.status, time.monotonic() - began)
        return answer

    async def _answer(self, what: str, body: bytes) -> Answer:
        try:
            seat = await self._next_idle()
        except StoppingError:
            return failed(503, STOPPING)
        self.busy += 1
        number, began = next(self._numbers), time.monotonic()
        current: Future[Answer] | None = None
        try:
            seat.shared.due = 0.0
            current = seat.process.submit(worker.respond, number, what, body)
            answer = await self._ended(seat, current)
        except TimeoutError:
            took = time.monotonic() - began
            self._later(self._lost(seat))
            return failed(503, f"the request was given up after {took:.0f} s, and its worker ended")
        except BrokenProcessPool:
            self._later(self._lost(seat))
            return failed(500, "the worker process died of this request, or was killed")
        except asyncio.CancelledError:
            seat.shared.cancelled = number
            self._later(self._left(seat, current))
            raise
        finally:
            self.busy -= 1
        if answer.memory > self.settings.memory:
            self.metrics.renewed_workers += 1
            self._later(self._renew(seat))
        else:
            self._free(seat)
        self._typical += 0.1 * (time.monotonic() - began - self._typical)
        return answer

    async def _ended(self, seat: _Seat, current: "Future[Answer]") -> Answer:
        """The answer; TimeoutError where a call goes on for longer than it may, and than it said."""
        began, waiting = time.monotonic(), asyncio.wrap_future(current)
        waiting.add_done_callback(_seen)
        until = began + self.settings.longest + GRACE
        while time.monotonic() < until:
            await asyncio.wait({waiting}, timeout=until - time.monotonic())
            if waiting.done():
                return waiting.result()
            until = seat.shared.due or began + PREPARING
        raise TimeoutError

    async def _next_idle(self) -> _Seat:
        """First come, first served."""
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

    def _free(self, seat: _Seat) -> None:
        while self._waiting:
            waiting = self._waiting.popleft()
            if not waiting.done():
                waiting.set_result(seat)
                return
        self._idle.append(seat)

    def stop(self) -> None:
        """Requests that wait are refused; those that a worker has are finished."""
        self.stopping = True
        for waiting in self._waiting:
            if not waiting.done():
                waiting.set_exception(StoppingError())

    def close(self) -> None:
        """End the workers, whatever they do."""
        self.stopping = True
        for task in self._tasks:
            task.cancel()
        for seat in self._seats:
            seat.process.close(signal.SIGKILL)

    def gauges(self) -> dict[str, tuple[str, float]]:
        """For `Metrics.text`."""
        return {
            "workers": ("Worker processes.", self.settings.workers),
            "workers_ready": ("Workers that are prepared.", self.ready),
            "workers_busy": ("Workers that are at a request.", self.busy),
            "requests_waiting": ("Requests that wait for a worker.", max(0, self.inside - self.busy)),
        }

    async def _left(self, seat: _Seat, current: "Future[Any] | None") -> None:
        """A worker was told to leave its call: it is idle when it has, or another takes its place."""
        try:
            if current is not None:
                await asyncio.wait_for(asyncio.wrap_future(current), CANCELLING)
        except (TimeoutError, BrokenProcessPool):
            await self._lost(seat)
            return
        except worker.Cancelled:
            pass
        self._free(seat)

    async def _lost(self, seat: _Seat) -> None:
        self.metrics.lost_workers += 1
        await self._renew(seat)

    async def _renew(self, seat: _Seat) -> None:
        """Another worker in this one's place."""
        self.ready -= 1
        seat.process.terminate(signal.SIGKILL)
        await self._replace(seat)

    async def _replace(self, seat: _Seat) -> None:
        """Prepare a worker, as often as it takes."""
        while True:
            try:
                await self._prepared(seat)
                return
            except BrokenProcessPool:
                await asyncio.sleep(AGAIN)

    async def _prepared(self, seat: _Seat) -> None:
        """One that compiled makes place for one that loads: so all give the same numbers, bit for bit."""
        if await asyncio.wrap_future(seat.process.submit(worker.warm_up)):
            seat.process.terminate(signal.SIGKILL)
            await asyncio.wrap_future(seat.process.submit(worker.warm_up))
        self.ready += 1
        self._free(seat)

    def _later(self, work: Any) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def _seen(done: "asyncio.Future[Answer]") -> None:
    """asyncio writes down errors that nobody has looked at, such as those of calls that were left."""
    if not done.cancelled():
        done.exception()
