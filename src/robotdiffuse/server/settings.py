"""Settings and timeouts of a server."""

import os
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Annotated

from robotdiffuse.core.settings import Bound, Count, Natural, Positive, Settings

# Time until a worker is killed while it compiles code for a request, and while it loads code and weights [s].
COMPILE_TIMEOUT = 300.0
WARM_UP_TIMEOUT = 60.0
GRACE_TIME = 5.0
"""Time that a call may take beyond its time limit, for reading the request, validation and timing, until its
worker is killed [s]."""
READ_TIMEOUT = 10.0
"""Time for a client to send a request, from its first byte [s]."""
WRITE_TIMEOUT = 60.0
"""Time for a client to read an answer that is waiting for it [s]."""
KEEP_ALIVE_TIMEOUT = 5
"""Time that an idle connection stays open [s]."""
MAX_ARRIVING = 64
"""Largest amount of data of incomplete requests, as a multiple of the largest request."""
MAX_ENTRIES = {
    "scene": 10_000,
    "goal": 1000,
    "waypoints": 200,
    "constraints": 50,
    "moving": 200,
    "views": 20,
    "attached": 50,
}
"""Largest number of entries of the lists of a problem."""
# Largest number of rows of a motion in a request, and in the answer to a request with `rate`.
MAX_ROWS = 100_000
MAX_ANSWER_ROWS = 20_000
MAX_SEED = 2**32 - 1
"""Largest seed that all random generators accept."""


@dataclass(frozen=True)
class ServeSettings(Settings):
    """Address and limits of a server."""

    host: str = "127.0.0.1"
    """Address to listen on."""
    port: Natural = 8000
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

    @property
    def on_loopback(self) -> bool:
        """Whether only programs on this machine can connect."""
        try:
            return ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"
