"""Work of a page in threads, the clock of playback, and what has changed since it was shown.

Independent of browsers.
"""

import logging
import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

FRAME_RATE = 30.0
"""Calls of `Player.show` per second while playing."""
END_PAUSE = 0.7
"""Pause at the end of a motion before it repeats [s]."""
Work = TypeVar("Work")


class LatestTask(Generic[Work]):
    """Calls `do` in a thread of its own with the most recent request.

    A request that has not begun is dropped when a newer one arrives. Errors of `do` are logged.
    """

    def __init__(self, do: Callable[[Work], None], name: str) -> None:
        self._do = do
        self._pending = list[Work]()
        self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, work: Work) -> None:
        """Replace the pending request; returns at once."""
        with self._changed:
            self._pending[:] = [work]
            self._changed.notify()

    def close(self) -> None:
        """Start no more requests; the running one continues to its end."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._pending or self._closed)
                if self._closed:
                    return
                work = self._pending.pop()
            try:
                self._do(work)
            except Exception:
                logging.getLogger(__name__).exception("%s failed", self._thread.name)


class Changes:
    """The values that were last shown, by name."""

    def __init__(self) -> None:
        self._shown: dict[str, tuple[object, ...]] = {}

    def new(self, what: str, *values: object) -> bool:
        """Whether values differ from the last ones; of arrays and such the identity counts."""
        last_values = self._shown.get(what)
        self._shown[what] = values
        return last_values is None or not all(map(_same, last_values, values))

    def forget(self, *names: str) -> None:
        """Values of these names are new the next time."""
        for name in names:
            self._shown.pop(name, None)


def _same(known: object, value: object) -> bool:
    plain = isinstance(value, str | bytes | bool | float | tuple)
    return known is value or (plain and known == value)


class Player:
    """Calls `show` with the time in the motion [s]; while playing, from a thread of its own, in a loop."""

    def __init__(self, show: Callable[[float], None]) -> None:
        self._show = show
        self._lock = threading.RLock()
        self._playing = threading.Event()
        self._ended = False
        self.duration = 0.0
        self.time = 0.0
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
