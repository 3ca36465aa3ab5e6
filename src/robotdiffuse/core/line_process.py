"""A subprocess that answers lines with lines."""

import os
import select
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path


class LineProcess:
    """A subprocess that reads lines on stdin and answers with lines on stdout; its crash does not affect this
    one.

    Use it from one thread at a time, except `close`, which any thread may call.
    """

    def __init__(self, command: Sequence[str], log: Path) -> None:
        """`log`: its standard error is appended to this file."""
        self._command, self._log = command, log
        self._process: subprocess.Popen[bytes] | None = None
        self._unread = b""
        self._closed = False

    @property
    def runs(self) -> bool:
        """Whether the subprocess is running."""
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        """Start or restart the subprocess."""
        self._unread = b""
        self._log.parent.mkdir(parents=True, exist_ok=True)
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=os.environ | {"OMP_NUM_THREADS": "1"},
                start_new_session=True,  # so that Ctrl-C reaches only this process
            )
        if self._closed:  # meanwhile, by another thread that saw only the old process
            self._process.kill()

    def tell(self, line: str) -> bool:
        """Send a line; returns whether the subprocess was there to take it."""
        assert self._process is not None and self._process.stdin is not None
        try:
            self._process.stdin.write(line.encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            return False
        return True

    def answer(self, patience: float) -> bytes | None:
        """Its next line; None if it ends or writes nothing within `patience` [s]."""
        assert self._process is not None and self._process.stdout is not None
        out, until = self._process.stdout, time.monotonic() + patience
        while b"\n" not in self._unread:
            ready, _, _ = select.select([out], [], [], max(until - time.monotonic(), 0.0))
            part = os.read(out.fileno(), 1 << 20) if ready else b""
            if not part:
                return None
            self._unread += part
        line, _, self._unread = self._unread.partition(b"\n")  # more than one line may have arrived
        return line

    def ended(self) -> str | None:
        """How the subprocess ended, and its last line on standard error; None if it had to be killed."""
        assert self._process is not None
        try:
            code = self._process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            return None
        how = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit status {code}"
        lines = self._log.read_text(errors="replace").strip().splitlines()
        return f"{how}: {lines[-1][:300]}" if lines else how

    def close(self) -> None:
        """Kill the subprocess, even while another thread waits for it."""
        self._closed = True
        if self._process is not None:
            self._process.kill()
            self._process.wait()
