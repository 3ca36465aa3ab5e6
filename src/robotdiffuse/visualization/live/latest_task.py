"""A thread that does the latest of what it is asked."""

import logging
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

Work = TypeVar("Work")


class Latest(Generic[Work]):
    """Calls `do` in a thread of its own with the latest of what it was asked for; what was not begun by then
    is dropped. An error of `do` is logged, and costs what it was doing."""

    def __init__(self, do: Callable[[Work], None], name: str) -> None:
        self._do, self._asked, self._ended = do, list[Work](), False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def ask(self, work: Work) -> None:
        """Returns at once."""
        with self._changed:
            self._asked[:] = [work]
            self._changed.notify()

    def close(self) -> None:
        """Nothing more is begun; what was begun goes on to its end."""
        with self._changed:
            self._ended = True
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._asked or self._ended)
                if self._ended:
                    return
                work = self._asked.pop()
            try:
                self._do(work)
            except Exception:
                logging.getLogger(__name__).exception("%s broke off", self._thread.name)
