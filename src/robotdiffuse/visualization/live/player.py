"""Playback clock of a motion: play in a loop, pause and seek."""

import threading
import time
from collections.abc import Callable

FRAME_RATE = 30.0
"""Calls of `show` per second while playing."""
END_PAUSE = 0.7
"""Pause at the end of the motion before it repeats [s]."""


class Player:
    """Calls `show` with the time in the motion [s]; while playing, from a thread of its own."""

    def __init__(self, show: Callable[[float], None]) -> None:
        self._show = show
        self._lock, self._playing, self._ended = threading.RLock(), threading.Event(), False
        self.duration, self.time = 0.0, 0.0
        self._thread = threading.Thread(target=self._run, name="player", daemon=True)
        self._thread.start()

    @property
    def playing(self) -> bool:
        """Whether the motion is playing."""
        return self._playing.is_set()

    def play(self) -> None:
        """Start or resume playing."""
        self._playing.set()

    def pause(self) -> None:
        """Stop at the current time."""
        with self._lock:
            self._playing.clear()

    def load(self, duration: float) -> None:
        """Switch to a motion of this duration [s], at the same fraction of it."""
        with self._lock:
            share = self.time / self.duration if self.duration else 0.0
            self.duration = duration
            self.seek(min(share, 1.0) * duration)

    def seek(self, at: float) -> None:
        """Go to a time [s], clipped to the motion."""
        with self._lock:
            self.time = min(max(at, 0.0), self.duration)
            self._show(self.time)

    def close(self) -> None:
        """End the thread."""
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
                    self.time = at if at <= self.duration + END_PAUSE else 0.0
                    self._show(min(self.time, self.duration))
            last = now
            time.sleep(1 / FRAME_RATE)
