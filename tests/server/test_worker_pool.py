"""Bodies that arrive in small pieces."""

import asyncio
from typing import Any

import pytest

pytest.importorskip("fastapi")

from fastapi import Request

from robotdiffuse.server.app import JSON, read_body
from robotdiffuse.server.settings import ServeSettings
from robotdiffuse.server.worker_pool import WorkerPool


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
