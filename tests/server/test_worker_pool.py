"""Workers that fail in other ways than dying, and bodies that arrive in small pieces."""

import asyncio
from concurrent.futures import Future
from typing import Any

import pytest

pytest.importorskip("fastapi")

from fastapi import Request

from robotdiffuse.server import worker_pool
from robotdiffuse.server.app import JSON, read_body
from robotdiffuse.server.settings import ServeSettings
from robotdiffuse.server.worker import PLAN, Answer
from robotdiffuse.server.worker_pool import WorkerPool


def done(outcome: Any) -> "Future[Any]":
    future: Future[Any] = Future()
    if isinstance(outcome, BaseException):
        future.set_exception(outcome)
    else:
        future.set_result(outcome)
    return future


class Process:
    """A worker process whose calls return these futures, in turn."""

    def __init__(self, *futures: "Future[Any]") -> None:
        self.futures = list(futures)

    def submit(self, *_: Any) -> "Future[Any]":
        return self.futures.pop(0)

    def terminate(self, _: int) -> None:
        pass


def pool_of(monkeypatch: pytest.MonkeyPatch, *futures: "Future[Any]") -> WorkerPool:
    monkeypatch.setattr(worker_pool, "RESTART_DELAY", 0.0)
    monkeypatch.setattr(worker_pool, "SingleWorker", lambda *_: Process(*futures))
    return WorkerPool({}, ServeSettings(workers=1))


NO_REPLY = TypeError("cannot pickle this reply")
COMPILED = False
ANSWER = Answer(200, b"{}", "solved")


def test_a_worker_that_lacks_memory_to_start_is_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only a dead one was; after another error the server had one worker less for good."""
    starts = done(COMPILED), done(NO_REPLY), done(MemoryError()), done(COMPILED)
    pool = pool_of(monkeypatch, *starts, done(ANSWER))

    async def talk() -> None:
        await pool.start()
        answer = await pool.run(PLAN, b"{}")
        assert answer.code == 500 and b"TypeError: cannot pickle this reply" in answer.body
        assert await asyncio.wait_for(pool.run(PLAN, b"{}"), 10.0) is ANSWER

    asyncio.run(talk())
    assert pool.ready == 1


def test_a_cancelled_call_whose_reply_fails_does_not_keep_its_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    class Running(Future):
        def cancel(self) -> bool:  # as a call that has begun
            return False

    running = Running()
    pool = pool_of(monkeypatch, done(COMPILED), running, done(COMPILED), done(ANSWER))

    async def talk() -> None:
        await pool.start()
        task = asyncio.ensure_future(pool.run(PLAN, b"{}"))
        await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.sleep(0.01)
        running.set_exception(NO_REPLY)
        assert await asyncio.wait_for(pool.run(PLAN, b"{}"), 10.0) is ANSWER

    asyncio.run(talk())
    assert pool.ready == 1


class Piece(bytes):
    """Counts how often any piece's length is asked for."""

    asked = 0

    def __len__(self) -> int:
        Piece.asked += 1
        return super().__len__()


def test_the_work_for_a_body_in_pieces_grows_with_their_number() -> None:
    """All pieces were measured again for each one: 20,000 of a byte each kept the server busy for 15 s."""
    pieces = [Piece(b"x") for _ in range(300)]

    async def receive() -> dict[str, Any]:
        body = pieces.pop()
        return {"type": "http.request", "body": body, "more_body": bool(pieces)}

    scope = {"type": "http", "method": "POST", "headers": [(b"content-type", JSON.encode())]}
    pool = WorkerPool({}, ServeSettings(max_request_size=300))
    assert asyncio.run(read_body(Request(scope, receive), pool, JSON)) == b"x" * 300
    assert pool.arriving == 0
    assert Piece.asked < 3000
