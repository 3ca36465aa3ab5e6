"""One server for all tests that do not stop it."""

from collections.abc import Iterator

import httpx
import pytest

from helpers.serving import serving


@pytest.fixture(scope="session")
def server() -> Iterator[httpx.Client]:
    with serving("--workers", "1", "--queue", "2", "--max-time-limit", "60", "--max-request-size", "2") as (client, _):
        yield client
