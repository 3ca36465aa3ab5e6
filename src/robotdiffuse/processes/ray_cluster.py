"""Calls on a Ray cluster."""

import logging
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from robotdiffuse import __version__
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.registry import AddedEntries, added_entries, adopt_entries
from robotdiffuse.processes.workers import RERUN_HINT, Results

CONNECT_TIMEOUT = 5.0
"""Time for a Ray cluster to answer [s]; Ray itself would try for minutes."""
MAX_RETRIES = 20
"""Largest number of times that a call is repeated on another node of a Ray cluster after the loss of its
node."""


def on_ray(call: Callable[..., Any], calls: Sequence[tuple]) -> Results:
    """Run the calls on a Ray cluster, one core each; calls of a lost node are repeated on another node.

    See `ray_cluster`. Each node needs this package and, under the same paths, the files that the calls read.
    """
    pending = list(enumerate(calls))[::-1]
    running = {}
    with ray_cluster() as ray:
        task = ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(_on_node)
        while pending or running:
            max_running = 2 * max(1, int(ray.cluster_resources().get("CPU", 0)))
            while pending and len(running) < max_running:
                number, arguments = pending.pop()
                running[task.remote(added_entries(), call, arguments)] = number
            finished, _ = ray.wait(list(running), num_returns=1)
            for reference in finished:
                yield running.pop(reference), ray.get(reference)


def _on_node(entries: AddedEntries, call: Callable[..., Any], arguments: tuple) -> Any:
    adopt_entries(entries)
    return call(*arguments)


CLUSTERS: dict[str, Callable[[Callable[..., Any], Sequence[tuple]], Results]] = {"ray": on_ray}
"""Cluster backends by the name that --cluster takes."""


@contextmanager
def ray_cluster() -> Iterator[Any]:
    """The module ray, connected to the cluster at RAY_ADDRESS, or to a new local one with all cores.

    Raises InputError if Ray is not installed, if its cluster cannot be reached or fails, if a task raises
    InputError, and if a node lacks this package.
    """
    # Ray reads these variables on import. The first hides its page-long messages about a lost node.
    os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", "Raylet is terminated")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
        from ray.exceptions import RayError, RayTaskError
    except ImportError:
        raise InputError('a Ray cluster needs ray: pip install "robotdiffuse[cluster]"') from None
    started_here = not ray.is_initialized()
    if started_here:
        _check_reachable(os.environ.get("RAY_ADDRESS", ""))
    connected = False
    try:
        if started_here:
            ray.init(log_to_driver=False, logging_level=logging.CRITICAL)
        connected = True
        yield ray
    except RayTaskError as error:
        if isinstance(error.cause, InputError):
            raise type(error.cause)(str(error.cause)) from None
        if "No module named 'robotdiffuse'" in str(error):
            raise InputError(
                f"a node of the Ray cluster cannot import robotdiffuse; install {__version__} on every node"
            ) from None
        raise
    except RayError as error:
        raise InputError(f"the Ray cluster failed: {_line(error)}; {RERUN_HINT}") from None
    except (ConnectionError, RuntimeError, ValueError) as error:
        if connected:
            raise
        raise InputError(f"no Ray cluster: {_line(error)}") from None
    finally:
        if started_here:
            ray.shutdown()


def _check_reachable(address: str) -> None:
    """Raises InputError if nothing listens at the address HOST:PORT or ray://HOST:PORT. Other addresses are
    not checked."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal():
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_TIMEOUT).close()
    except (OSError, OverflowError) as error:
        raise InputError(f"no Ray cluster at {address}, the value of RAY_ADDRESS: {error}") from None


def _line(error: Exception) -> str:
    """The message of an error on one line."""
    return " ".join(str(error).split())
