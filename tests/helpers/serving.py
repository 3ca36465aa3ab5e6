"""`robotdiffuse serve` in a separate process, with an additional planner that fails on request."""

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import httpx

ROOT = Path(__file__).parents[2]


@contextmanager
def serving(
    *arguments: str, stderr: int | IO[bytes] = subprocess.DEVNULL, **environment: str
) -> Iterator[tuple[httpx.Client, subprocess.Popen]]:
    """A context with a client of a server that is ready, and the server's process, which ends with the context."""
    paths = os.pathsep.join((str(ROOT / "src"), str(ROOT / "tests")))
    command = [sys.executable, "-m", "helpers.serving", "serve", "--port", "0", *arguments]
    env = os.environ | {"PYTHONPATH": paths} | environment
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, text=True, env=env)
    try:
        assert process.stdout is not None
        found = re.search(r"http://[^;]+", process.stdout.readline())
        assert found is not None and "ready" in process.stdout.readline()
        # a kept connection may be closed by the server in the moment in which it is used again
        with httpx.Client(base_url=found.group(), timeout=500.0, limits=httpx.Limits(max_keepalive_connections=0)) as client:
            yield client, process
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()


if __name__ == "__main__":
    from helpers.planners import ENTRY
    from robotdiffuse.cli import main
    from robotdiffuse.planning import PLANNERS
    from robotdiffuse.server import app, connection

    def end_with_parent() -> None:
        os.read(0, 1)
        os._exit(0)

    PLANNERS["faulty"] = ENTRY
    connection.READ_TIMEOUT = app.KEEP_ALIVE_TIMEOUT = float(os.environ.get("CLIENT_TIMEOUT", "3.0"))
    threading.Thread(target=end_with_parent, daemon=True).start()
    sys.exit(main())
