"""Playing a motion: a clock that goes round and round, and stands where it is put."""

import threading
import time
from collections.abc import Callable

RATE = 30.0
"""Times a second."""
PAUSE = 0.7
"""At the end of the motion, before it begins again [s]."""


class Player:
    """Calls `show` with the time within the motion, from a thread of its own while it plays."""

    def __init__(self, show: Callable[[float], None]) -> None:
        self._show = show
        self._lock, self._playing, self._ended = threading.RLock(), threading.Event(), False
        self.duration, self.time = 0.0, 0.0
        self._thread = threading.Thread(target=self._run, name="player", daemon=True)
        self._thread.start()

    @property
    def playing(self) -> bool:
        return self._playing.is_set()

    def play(self) -> None:
        self._playing.set()

    def pause(self) -> None:
        with self._lock:
            self._playing.clear()

    def load(self, duration: float) -> None:
        """Another motion of this length [s]; the same share of it has gone by."""
        with self._lock:
            share = self.time / self.duration if self.duration else 0.0
            self.duration = duration
            self.seek(min(share, 1.0) * duration)

    def seek(self, at: float) -> None:
        """[s]"""
        with self._lock:
            self.time = min(max(at, 0.0), self.duration)
            self._show(self.time)

    def close(self) -> None:
        self._ended = True
        self._playing.set()

    def _run(self) -> None:
        last = time.perf_counter()
        while not self._ended:
            if not self._playing.wait(0.0):
                self._playing.wait()
                last = time.perf_counter()
            now = time.perf_counter()
            with self._lock:
                if self._playing.is_set():
                    at = self.time + now - last
                    self.time = at if at <= self.duration + PAUSE else 0.0
                    self._show(min(self.time, self.duration))
            last = now
            time.sleep(1 / RATE)
