"""A thread that runs only the most recent request; older ones are dropped."""

import logging
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

Work = TypeVar("Work")


class LatestTask(Generic[Work]):
    """Calls `do` in a thread of its own with the most recent request.

    A request that has not begun is dropped when a newer one arrives. Errors of `do` are logged.
    """

    def __init__(self, do: Callable[[Work], None], name: str) -> None:
        self._do, self._pending, self._closed = do, list[Work](), False
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
