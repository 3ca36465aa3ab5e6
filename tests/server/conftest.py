"""One server for all tests that do not stop it."""

from collections.abc import Iterator

import httpx
import pytest

from helpers.serving import serving


@pytest.fixture(scope="session")
def server() -> Iterator[httpx.Client]:
    limits = ("--max-time-limit", "60", "--max-request-size", "2", "--max-worker-memory", "1400")
    with serving("--workers", "1", "--queue", "2", *limits) as (client, _):
        yield client
