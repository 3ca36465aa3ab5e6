"""Settings and timeouts of a server."""

import os
from dataclasses import dataclass
from typing import Annotated

from robotdiffuse.core.settings import Bound, Count, Natural, Positive, Settings

GRACE_TIME = 5.0
"""Time that a call may take beyond its time limit, for reading the request, validation and timing, until its
worker is killed [s]."""


@dataclass(frozen=True)
class ServeSettings(Settings):
    """Address and limits of a server."""

    host: str = "127.0.0.1"
    """Address to listen on."""
    port: Annotated[int, Bound(least=0.0, most=65535.0)] = 8000
    """TCP port; 0 for any free one."""
    workers: Count = os.cpu_count() or 1
    """Processes that plan."""
    queue: Natural = 16
    """Requests that may wait for a worker; further ones are answered with 429."""
    max_time_limit: Positive = 10.0
    """Largest time limit that a request may ask for [s]."""
    max_request_size: Count = 8 * 2**20
    """Largest body of a request [bytes]."""
    max_batch: Count = 1000
    """Largest number of lines of a batch."""
    max_worker_memory: Annotated[int, Bound(least=512.0 * 2**20)] = 2 * 2**30
    """Memory that a worker may use [bytes]: a request that needs more is refused. A worker that holds more
    than half of it after an answer is replaced before its next request."""
    token: str = ""
    """Bearer token that requests must carry; "" for none."""
