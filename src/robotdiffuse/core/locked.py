"""A lock for the methods of objects that keep a state between calls."""

from collections.abc import Callable
from functools import wraps
from threading import Lock, RLock
from typing import Any, Concatenate, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
# The locks are kept outside of their objects, since objects are copied and pickled and locks cannot be.
_locks: "WeakKeyDictionary[object, Any]" = WeakKeyDictionary()
# Held while `_locks` is used
_table_lock = Lock()


def locked(
    method: Callable[Concatenate[Any, Arguments], Result],
) -> Callable[Concatenate[Any, Arguments], Result]:
    """The method, waiting while another thread is in a locked method of the same object."""

    @wraps(method)
    def alone(self: object, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with _table_lock:
            lock = _locks.setdefault(self, RLock())
        with lock:
            return method(self, *args, **kwargs)

    return alone
