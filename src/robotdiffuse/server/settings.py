"""What a server is told when it starts."""

import os
from dataclasses import dataclass
from ipaddress import ip_address

from robotdiffuse.core.settings import Count, Natural, Positive, Settings

PREPARING = 300.0
"""Until a worker that reads a request, or compiles for it, is given up [s]."""
GRACE = 10.0
"""Beyond its time limit that a call may take, as for the validator and timing, until its worker is killed [s]."""
CANCELLING = 1.0
"""Until a worker that was told to leave its call is killed [s]."""
SENDING = 10.0
"""For a client to send a request [s]."""
TAKING = 60.0
"""For a client to take what waits for it [s]."""
KEPT = 5
"""For a connection to be used again [s]."""


@dataclass(frozen=True)
class ServeSettings(Settings):
    """Limits of a server. The robots that it knows are named apart."""

    host: str = "127.0.0.1"
    """Address to listen at."""
    port: Natural = 8000
    """0: any that is free."""
    workers: Count = os.cpu_count() or 1
    """Processes that plan."""
    queue: Natural = 16
    """Requests that may wait for a worker; further ones are told to come again."""
    longest: Positive = 10.0
    """Time limit that a request may ask for at most [s]."""
    largest: Count = 8 * 2**20
    """Bytes that a request may have."""
    batch: Count = 1000
    """Lines that a batch may have."""
    memory: Count = 2 * 2**30
    """Bytes that a worker may hold after an answer; one that holds more is replaced before the next."""
    token: str = ""
    """That requests must bring; "" for none."""

    @property
    def on_loopback(self) -> bool:
        """Whether only programs of this machine can connect."""
        try:
            return ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"
